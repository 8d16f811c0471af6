"""The controllers that drive an arm, by name, as files and as objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.catalogue import POLICY, PREDICTIVE, PUSH, contenders, make_controller
from rejoint.control.comparison.recommend import recommend
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller, heeds_turn
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.geared import GEARED, GEARED_POLICY, GEARED_PREDICTIVE, GEARED_PUSH, RIVALS, Geared, inner_name
from rejoint.control.servogains import in_words
from rejoint.control.shelf import SHELF, shelf_controller, shelf_policy
from rejoint.runs.given import Period, as_policy, unfit
from rejoint.runs.run import Run
from rejoint.runs.stages.known import trained_for_tuned, tuned_gains, twin_under
from rejoint.system.errors import ContractError, FileError, InputError

if TYPE_CHECKING:
    from rejoint.control.policy import Policy
    from rejoint.twin.twin import Twin

ControllerLike: TypeAlias = "str | Path | Policy | Controller | Callable[[Arm], Controller]"
"""The name of a controller, a policy or its file, a controller, or what makes one for an arm"""

Controllers: TypeAlias = "Sequence[ControllerLike] | Mapping[str, ControllerLike]"
"""Controllers, or controllers by the name that they are to have in tables"""

Factory = Callable[[Arm], Controller]

_OF_A_RUN = (POLICY, PREDICTIVE, PUSH, *RIVALS)
"""Names of controllers that need what a run has found out about its arm"""


def recommended(run: Run) -> str:
    """Name the controller that a run recommends: by its comparison; before one, its policy, or the feed-forward."""
    comparison = run.comparison
    if comparison is not None:
        return recommend(comparison).controller
    return _own_policy(run) if run.folder.policy.exists() else FeedforwardController.name


def _own_policy(run: Run) -> str:
    """Name the policy of a run among the controllers."""
    return GEARED_POLICY if trained_for_tuned(run) else POLICY


def make_factories(
    given: Controllers, arm: Arm, period: Period | None, *, run: Run | None = None, twin: Twin | None = None,
    real: bool = False, posed: bool = False,
) -> dict[str, Factory]:  # fmt: skip
    """Return what makes each controller, by its name; the feed-forward believes the stiffness of ``twin``.

    Nothing given means the `contenders` for a ``real`` arm or one in virtual time.
    A name, a policy or a control period that does not fit is refused here, before anything moves. For ``posed``
    targets, which have an orientation, those take part that turn the tool.
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
    """Refuse what `make_factories` would, before a run has made its own twin, policy and gains.

    Controllers that the run will make for itself are taken as given; those under tuned gains where the servos are
    ``tunable``.
    """
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
    """Name who takes part in a comparison: what the run has made, under tuned gains where it was made for those.

    Policies and plans do not turn a tool: for ``posed`` targets they are left out.
    """
    own, tuned = run is not None and run.folder.policy.exists() and not posed, tuned_gains(run) is not None
    plain = contenders(
        real=real, shelf=not posed and _on_shelf(arm, period), policy=own,
        twin=twin is not None and not tuned and not posed,
    )  # fmt: skip
    if not tuned:
        return plain
    geared = own and trained_for_tuned(run)
    missing = {
        POLICY: geared, GEARED_PUSH: twin is None, GEARED_POLICY: not geared, GEARED_PREDICTIVE: posed or twin is None,
    }  # fmt: skip
    return tuple(name for name in (*plain, *RIVALS) if not missing.get(name))


def usual_controller(run: Run | None, *, posed: bool = False) -> str:
    """Name what drives an arm where nothing else is asked for: the policy of its run, before one that of the shelf.

    Neither turns a tool: for ``posed`` targets it is the feed-forward, which knows the twin.
    """
    if posed:
        return FeedforwardController.name
    return _own_policy(run) if run is not None and run.folder.policy.exists() else SHELF


def _on_shelf(arm: Arm, period: float) -> bool:
    """Whether there is a policy from the shelf for this arm and control ``period`` [s]; NaN: not known yet."""
    try:
        check_controller_period(shelf_policy(arm), period)
    except ContractError:
        return False
    return True


def listed(given: Controllers | ControllerLike) -> Controllers:
    """Return controllers as given; one name or file alone as the only one, since a text is a sequence as well."""
    return (given,) if isinstance(given, str | Path) else cast("Controllers", given)


def any_geared(given: Controllers) -> bool:
    """Tell whether any of the controllers needs a search for gains."""
    return any(name in RIVALS for name in given if isinstance(name, str))


def all_named(given: Controllers) -> bool:
    """Tell whether all controllers are given by the names of known ones, or none is."""
    return not isinstance(given, Mapping) and all(isinstance(one, str) and not one.endswith(".onnx") for one in given)


def name_of(controller: ControllerLike) -> str:
    """Name of a controller in tables."""
    if isinstance(controller, str) and not controller.endswith(".onnx"):
        return controller
    if isinstance(controller, Path | str) or hasattr(controller, "controller"):  # a policy or its file
        return POLICY
    return str(getattr(controller, "name", "controller"))


def _unique(given: Sequence[ControllerLike]) -> dict[str, ControllerLike]:
    """Return controllers by name; a second one of a name gets a number."""
    found: dict[str, ControllerLike] = {}
    for one in given:
        name = name_of(one)
        taken = sum(other == name or other.startswith(f"{name}-") for other in found)
        found[f"{name}-{taken + 1}" if name in found else name] = one
    return found


def _predictive(arm: Arm, twin: Twin, period: float) -> Controller:
    """Make predictive control on ``twin``, which leaves the last millimetres to the policy from the shelf, if it suits.

    Else they are left to the feed-forward, which integrates. ``period`` [s] is NaN where it is not known yet.
    """
    from rejoint.twin.predictive import PredictiveController

    known = twin.parameters.stiffness
    holder = shelf_controller(arm) if _on_shelf(arm, period) else FeedforwardController(arm, known)
    return PredictiveController.of(arm, twin, holder)


def _factory(given: ControllerLike, run: Run | None, twin: Twin | None, period: float) -> Factory:
    if given == PREDICTIVE and twin is not None:
        return lambda arm: _predictive(arm, twin, period)
    if isinstance(given, str) and given in RIVALS:
        return partial(_geared, given, run=run, twin=twin, period=period)
    if isinstance(given, str) and not given.endswith(".onnx"):
        file = run.folder.policy if run is not None and run.folder.policy.exists() else None
        return lambda arm: make_controller(given, arm, policy=file, **_beliefs(twin))
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
    """Return a controller under the gains that the search of this run found; FileError where there was none.

    ContractError for a policy that was trained for others.
    """
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
        controller = make_controller(inner, arm, policy=run.folder.policy, **_beliefs(stiffer))
    return Geared(controller, found.alone if name == GEARED else found.under)


def _beliefs(twin: Twin | None) -> dict[str, Array]:
    """Return what controllers believe of the servos: what the twin says of them, nothing without one."""
    if twin is None:
        return {}
    return {"stiffness": twin.parameters.stiffness, "friction": twin.parameters.coulomb}


def _itself(controller: Controller, arm: Arm) -> Controller:  # noqa: ARG001 - it was made for its arm
    """Return the controller again and again: every motion starts with its `reset`."""
    return controller
