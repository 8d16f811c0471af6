"""The controllers that drive an arm: names, files and objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.recommend import recommend
from rejoint.control.controllers.catalogue import (
    POLICY,
    PREDICTIVE,
    SHELF,
    contenders,
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
    Geared,
    in_words,
    inner_name,
)
from rejoint.runs.run import Run
from rejoint.session.context import trained_for_tuned, tuned_gains, twin_under
from rejoint.session.inputs import Period, as_policy, unfit
from rejoint.system.errors import ContractError, FileError, InputError

if TYPE_CHECKING:
    from rejoint.control.controllers.policy import Policy
    from rejoint.twin.twin import Twin

ControllerLike: TypeAlias = "str | Path | Policy | Controller | Callable[[Arm], Controller]"
"""A controller, its name, a policy or its file, or a factory"""

Controllers: TypeAlias = "Sequence[ControllerLike] | Mapping[str, ControllerLike]"
"""Controllers, or a mapping from their names"""

Factory = Callable[[Arm], Controller]

_OF_A_RUN = (POLICY, PREDICTIVE, *RIVALS)
"""Names that need what a run found out"""


def recommended(run: Run) -> str:
    """Name the controller that a run recommends, see `choice`."""
    return choice(run, run.arm, None)[0]


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
    if _on_shelf(arm, np.nan if period is None else sum(period) / 2):
        return SHELF, f"the policy that comes with rejoint; {lacks}"
    return FeedforwardController.name, f"no policy suits this arm; {lacks}"


def quick_note(run: Run | None) -> str:
    """Remark on a run of a quick try, or nothing."""
    return f"{run.path} is a quick try, which is no result." if run is not None and run.folder.quick.exists() else ""


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

    Nothing given: the `contenders` for a ``real`` arm or virtual time. Refuses what does not fit; ``posed`` targets
    need controllers that turn the tool.
    """
    usual = np.nan if period is None else sum(period) / 2
    if not given:
        given = _contenders(arm, usual, run, twin, real=real, posed=posed)
    named = given if isinstance(given, Mapping) else _unique(given)
    factories = {name: _factory(one, run, twin, usual) for name, one in named.items()}
    for name, make in factories.items():
        controller = make(arm)
        if not hasattr(controller, "reset"):
            raise unfit(controller, f"for {name} a controller, with the methods of rejoint.Controller")
        check_controller_period(controller, usual)
        if posed and not heeds_turn(controller):
            raise _turns_nothing(name)
    return factories


def require_possible(
    given: Controllers, arm: Arm, period: Period | None, *, tunable: bool, posed: bool = False
) -> None:
    """Refuse what `make_factories` would, before a run has twin, policy and gains."""
    named = given if isinstance(given, Mapping) else _unique(given)
    for name, one in named.items():
        if not (isinstance(one, str) and one in _OF_A_RUN):
            make_factories({name: one}, arm, period, posed=posed)
        elif one in RIVALS and not tunable:
            raise InputError(f"{one} needs servo gains that can be tuned; an SO-101 on its own bus has them")
        elif posed and inner_name(one) in (POLICY, PREDICTIVE):
            raise _turns_nothing(one)


def _turns_nothing(name: str) -> InputError:
    return InputError(
        f"{name} brings the tool to its place and does not turn it; for targets with an orientation take "
        f"{FeedforwardController.name}, integrator or default"
    )


def _contenders(
    arm: Arm, period: float, run: Run | None, twin: Twin | None, *, real: bool, posed: bool
) -> tuple[str, ...]:
    own, tuned = run is not None and run.folder.policy.exists() and not posed, tuned_gains(run) is not None
    plain = contenders(
        real=real,
        shelf=not posed and _on_shelf(arm, period),
        policy=own,
        twin=twin is not None and not tuned and not posed,
    )
    if not tuned:
        return plain
    geared = own and trained_for_tuned(run)
    missing = {
        POLICY: geared,
        GEARED_POLICY: not geared,
        GEARED_PREDICTIVE: posed or twin is None,
    }
    return tuple(name for name in (*plain, *RIVALS) if not missing.get(name))


def _on_shelf(arm: Arm, period: float) -> bool:
    """Whether a generic policy suits arm and control ``period`` [s]; NaN: not known yet."""
    try:
        check_controller_period(shelf_policy(arm), period)
    except ContractError:
        return False
    return True


def listed(given: Controllers | ControllerLike) -> Controllers:
    """Return controllers as given; one name or file as a tuple."""
    return (given,) if isinstance(given, str | Path) else cast("Controllers", given)


def any_geared(given: Controllers) -> bool:
    """Whether any of them needs a search for gains."""
    return any(name in RIVALS for name in given if isinstance(name, str))


def all_named(given: Controllers) -> bool:
    """Whether all controllers are given by known names."""
    return not isinstance(given, Mapping) and all(isinstance(one, str) and not one.endswith(".onnx") for one in given)


def name_of(controller: ControllerLike) -> str:
    """Name of a controller in tables."""
    if isinstance(controller, str) and not controller.endswith(".onnx"):
        return controller
    if isinstance(controller, Path | str) or hasattr(controller, "controller"):  # a policy or its file
        return POLICY
    return str(getattr(controller, "name", "controller"))


def _unique(given: Sequence[ControllerLike]) -> dict[str, ControllerLike]:
    found: dict[str, ControllerLike] = {}
    for one in given:
        name = name_of(one)
        taken = sum(other == name or other.startswith(f"{name}-") for other in found)
        found[f"{name}-{taken + 1}" if name in found else name] = one
    return found


def _predictive(arm: Arm, twin: Twin, period: float) -> Controller:
    from rejoint.twin.predictive import PredictiveController

    known = twin.parameters.stiffness
    holder = shelf_controller(arm) if _on_shelf(arm, period) else FeedforwardController(arm, known)
    return PredictiveController.of(arm, [twin], holder)


def _factory(given: ControllerLike, run: Run | None, twin: Twin | None, period: float) -> Factory:
    if given == PREDICTIVE and twin is not None:
        return lambda arm: _predictive(arm, twin, period)
    if isinstance(given, str) and given in RIVALS:
        return partial(_geared, given, run=run, twin=twin, period=period)
    if isinstance(given, str) and not given.endswith(".onnx"):
        file = run.folder.policy if run is not None and run.folder.policy.exists() else None
        return lambda arm: make_controller(given, arm, policy=file, stiffness=_stiffness(twin))
    if isinstance(given, Path | str):
        return as_policy(given).controller
    if hasattr(given, "controller"):
        return given.controller
    if hasattr(given, "reset") and not isinstance(given, type):
        return partial(_itself, cast(Controller, given))
    if not callable(given):
        raise unfit(given, "the name of a controller, a policy or its file, or a controller")
    return given


def _geared(name: str, arm: Arm, *, run: Run | None, twin: Twin | None, period: float) -> Controller:
    found = tuned_gains(run)
    if run is None or found is None:
        where = "RUN" if run is None else str(run.path)
        raise FileError(f"{where}/gains.json", "no such file", f"run `rejoint gains ROBOT {where}` first")
    inner, stiffer = inner_name(name), None if twin is None else twin_under(twin, found.found, found.under)
    if name == GEARED_POLICY and not trained_for_tuned(run):
        raise ContractError(
            f"{run.path} has no policy for the gains that its search found ({in_words(found.under)}); train one with: "
            f"rejoint train {run.path}"
        )
    if name == GEARED_PREDICTIVE and stiffer is not None:
        controller = _predictive(arm, stiffer, period)
    else:
        controller = make_controller(inner, arm, policy=run.folder.policy, stiffness=_stiffness(stiffer))
    return Geared(controller, found.alone if name == GEARED else found.under)


def _stiffness(twin: Twin | None) -> Array | None:
    return None if twin is None else twin.parameters.stiffness


def _itself(controller: Controller, arm: Arm) -> Controller:  # noqa: ARG001 - it was made for its arm
    return controller
