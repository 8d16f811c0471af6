"""Controllers by name: which drives by default, which are compared, and how each is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeGuard, cast

from rejoint.arms import Arm
from rejoint.control.comparison.recommend import recommend
from rejoint.control.controllers.catalogue import (
    CONTROLLERS,
    POLICY,
    PREDICTIVE,
    SHELF,
    make_controller,
    shelf_controller,
    shelf_policy,
)
from rejoint.control.controllers.contract import check_controller_period
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.robot import Controller, heeds_turn
from rejoint.control.servogains import (
    GEARED,
    GEARED_POLICY,
    GEARED_PREDICTIVE,
    RIVALS,
    GainsFound,
    differing,
    geared,
    in_words,
    inner_name,
)
from rejoint.runs.run import Run
from rejoint.session.context import twin_under
from rejoint.session.inputs import Period, as_policy
from rejoint.system.errors import ContractError, FileError, InputError
from rejoint.system.files import read_json

if TYPE_CHECKING:
    from rejoint.control.controllers.policy import Policy
    from rejoint.twin.twin import Twin

ControllerLike: TypeAlias = "str | Path | Policy | Controller | Callable[[Arm], Controller]"
"""A controller, its name, a policy or its file, or a factory"""

Controllers: TypeAlias = "Sequence[ControllerLike] | Mapping[str, ControllerLike] | str | Path"
"""Controllers, a mapping from their names, or a single name or file"""

Factory = Callable[[Arm], Controller]


def is_name(given: object) -> TypeGuard[str]:
    """Whether it names a controller, and no policy file."""
    return isinstance(given, str) and not given.endswith(".onnx")


def name_of(controller: ControllerLike) -> str:
    """Name of a controller in tables."""
    if is_name(controller):
        return controller
    if isinstance(controller, Path | str) or hasattr(controller, "controller"):  # a policy or its file
        return POLICY
    return str(getattr(controller, "name", "controller"))


def named(given: Controllers) -> dict[str, ControllerLike]:
    """Return controllers by name; those of one name are numbered."""
    if isinstance(given, Mapping):
        return dict(given)
    found: dict[str, ControllerLike] = {}
    for one in (given,) if isinstance(given, str | Path) else given:
        name = name_of(one)
        taken = sum(other == name or other.startswith(f"{name}-") for other in found)
        found[f"{name}-{taken + 1}" if name in found else name] = one
    return found


def tuned_gains(run: Run | None) -> GainsFound | None:
    """Gains that the run's search found."""
    if run is None or not run.folder.gains.exists():
        return None
    return read_json(run.folder.gains, GainsFound)


def trained_for_tuned(run: Run | None) -> bool:
    """Whether the policy of a run was trained for its tuned gains."""
    found, policy = tuned_gains(run), None if run is None else run.policy
    gains = None if policy is None else policy.contract.servo_gains
    return found is not None and gains is not None and not differing(gains, found.under)


def choice(run: Run | None, arm: Arm, period: Period | None) -> tuple[str, str]:
    """Return the controller that drives by default, and why.

    In this order: the run's recommendation, its policy, the generic policy if it suits arm and ``period`` [s],
    feed-forward.
    """
    comparison = None if run is None else run.comparison
    if run is not None and comparison is not None:
        return recommend(comparison).controller, f"{run.path} recommends it"
    if run is not None and run.folder.policy.exists():
        own = GEARED_POLICY if trained_for_tuned(run) else POLICY
        return own, f"the policy of {run.path}, which has no comparison yet"
    lacks = "without a run" if run is None else f"{run.path} has no policy yet"
    if _on_shelf(arm, usual(period)):
        return SHELF, f"the policy that comes with rejoint; {lacks}"
    return FeedforwardController.name, f"no policy suits this arm; {lacks}"


def contenders(
    arm: Arm, period: Period | None, run: Run | None, twin: Twin | None, *, real: bool, posed: bool
) -> tuple[str, ...]:
    """Name the controllers that are compared by default; a real arm gets the generic policy until it has its own."""
    tuned, own = tuned_gains(run) is not None, run is not None and run.folder.policy.exists() and not posed
    geared = own and trained_for_tuned(run)
    left_out = {
        SHELF: posed or (real and own) or not _on_shelf(arm, usual(period)),
        POLICY: geared or not own,
        PREDICTIVE: posed or tuned or twin is None,
        **dict.fromkeys(RIVALS, not tuned),
        GEARED_POLICY: not geared,
        GEARED_PREDICTIVE: posed or not tuned or twin is None,
    }
    return tuple(name for name in (*CONTROLLERS, *RIVALS) if not left_out.get(name))


def make_factories(
    given: Controllers,
    arm: Arm,
    period: Period | None,
    *,
    run: Run | None = None,
    twin: Twin | None = None,
    real: bool = False,
    posed: bool = False,
) -> dict[str, Factory]:
    """Return factories by name; ``twin`` gives the feed-forward its stiffness.

    Default: the `contenders` for a ``real`` arm or virtual time. ``posed`` targets need controllers that turn the tool.
    """
    asked = given or contenders(arm, period, run, twin, real=real, posed=posed)
    factories = {name: _factory(one, run, twin, usual(period)) for name, one in named(asked).items()}
    for name, make in factories.items():
        controller = make(arm)
        if not (hasattr(controller, "reset") and hasattr(controller, "command")):
            raise InputError(
                f"controller {name}: expected a name, an object with reset and command, or a function of an Arm that "
                f"returns one; it returned {type(controller).__name__}"
            )
        check_controller_period(controller, usual(period))
        if posed and not heeds_turn(controller):
            raise _turns_nothing(name)
    return factories


def require_possible(
    given: Controllers, arm: Arm, period: Period | None, *, tunable: bool, posed: bool = False
) -> None:
    """Refuse what `make_factories` would, before a run has twin, policy and gains."""
    for name, one in named(given).items():
        if one in RIVALS and not tunable:
            raise InputError(f"{one} needs servo gains that can be tuned; an SO-101 on its own bus has them")
        if one not in (POLICY, PREDICTIVE, *RIVALS):
            make_factories({name: one}, arm, period, posed=posed)
        elif posed and inner_name(str(one)) in (POLICY, PREDICTIVE):
            raise _turns_nothing(name)


def _turns_nothing(name: str) -> InputError:
    return InputError(
        f"{name} brings the tool to its place and does not turn it; for targets with an orientation take "
        f"{FeedforwardController.name}, integrator or default"
    )


def usual(period: Period | None) -> float:
    """Middle of the control periods [s]; NaN: not known yet."""
    return float("nan") if period is None else sum(period) / 2


def _on_shelf(arm: Arm, period: float) -> bool:
    """Whether a generic policy suits arm and control ``period`` [s]; NaN: not known yet."""
    try:
        check_controller_period(shelf_policy(arm), period)
    except ContractError:
        return False
    return True


def _factory(given: ControllerLike, run: Run | None, twin: Twin | None, period: float) -> Factory:
    if is_name(given):
        return partial(_by_name, given, run, twin, period)
    one = as_policy(given) if isinstance(given, Path | str) else given
    if hasattr(one, "controller"):
        return one.controller
    if hasattr(one, "reset") and not isinstance(one, type):
        return lambda _: cast(Controller, one)
    return cast("Factory", one)


def _by_name(name: str, run: Run | None, twin: Twin | None, period: float, arm: Arm) -> Controller:
    if name in RIVALS:
        return _geared(name, run, twin, period, arm)
    stiffness = None if twin is None else twin.parameters.stiffness
    if name == PREDICTIVE and twin is not None:
        from rejoint.twin.predictive import PredictiveController

        holder = shelf_controller(arm) if _on_shelf(arm, period) else FeedforwardController(arm, stiffness)
        return PredictiveController.of(arm, [twin], holder)
    file = run.folder.policy if run is not None and run.folder.policy.exists() else None
    return make_controller(name, arm, policy=file, stiffness=stiffness)


def _geared(name: str, run: Run | None, twin: Twin | None, period: float, arm: Arm) -> Controller:
    found = tuned_gains(run)
    if run is None or found is None:
        where = "RUN" if run is None else str(run.path)
        raise FileError(f"{where}/gains.json", "no such file", f"run `rejoint gains ROBOT {where}` first")
    if name == GEARED_POLICY and not trained_for_tuned(run):
        raise ContractError(
            f"{run.path} has no policy for the gains that its search found ({in_words(found.under)}); train one with: "
            f"rejoint train {run.path}"
        )
    stiffer = None if twin is None else twin_under(twin, found.found, found.under)
    inner = _by_name(inner_name(name), run, stiffer, period, arm)
    return geared(inner, found.alone if name == GEARED else found.under)
