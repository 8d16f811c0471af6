"""What the stages that drive an arm share: its journal, the guard's limits, the controllers by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.loaded import bare
from rejoint.control.bands import standing_bands
from rejoint.control.catalogue import POLICY, PREDICTIVE, contenders, make_controller
from rejoint.control.comparison.recommend import recommend
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller, heeds_turn
from rejoint.control.correction import Modelled
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.gainsearch import GainsFound
from rejoint.control.geared import GEARED, GEARED_POLICY, GEARED_PREDICTIVE, GEARED_PUSH, RIVALS, Geared, inner_name
from rejoint.control.guard import GuardLimits
from rejoint.control.lines import servo_lines
from rejoint.control.playback import Playback
from rejoint.control.recording import recording_of
from rejoint.control.robot import Robot
from rejoint.control.servogains import ServoGains, differing, gains_in_force, in_words, stiffness_under
from rejoint.control.shelf import SHELF, shelf_controller, shelf_policy
from rejoint.control.start import Stance
from rejoint.logs.journal import Journal
from rejoint.logs.runlog import read_log, write_log
from rejoint.robots import place_of
from rejoint.robots.own import unloaded
from rejoint.runs.given import CalibrationLike, Period, as_calibration, as_policy, unfit
from rejoint.runs.run import Run
from rejoint.system.errors import AddressError, ContractError, FileError, InputError
from rejoint.system.files import read_json, unused

if TYPE_CHECKING:
    from rejoint.control.policy import Policy
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin

ControllerLike: TypeAlias = "str | Path | Policy | Controller | Callable[[Arm], Controller]"
"""The name of a controller, a policy or its file, a controller, or what makes one for an arm"""

Controllers: TypeAlias = "Sequence[ControllerLike] | Mapping[str, ControllerLike]"
"""Controllers, or controllers by the name that they are to have in tables"""

Factory = Callable[[Arm], Controller]


def start_journal(run: Run, name: str, robot: Robot, label: str, rows: int = 0) -> Journal:
    """Start the journal of a run log whose name ends with the time; no log takes the place of another."""
    path = unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))
    return Journal.begin(
        path, arm=run.arm.name, joint_names=run.arm.joint_names, robot=robot.address, label=label, rows=rows
    )


@contextmanager
def kept_if_stopped(run: Run | None, name: str) -> Iterator[None]:
    """Keep what an arm did in a motion that ends early, and that no journal keeps, as a log that the error names."""
    try:
        yield
    except BaseException as error:
        partial = recording_of(error)
        if run is not None and partial is not None and len(partial.time):
            part = "begin" if partial.controller == Playback.name else partial.controller
            path = unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))
            try:
                write_log(path, partial.log(0, f"{name}/{part}/stopped"))
            except FileError as full:  # the first error is the one to report
                error.add_note(f"What was recorded until then is lost: {full}")
            else:
                error.add_note(f"What was recorded until then: {path}")
        raise


def guard_limits(run: Run | None, arm: Arm, robot: str) -> GuardLimits:
    """Return what the guard allows, and, if ``robot`` is the run's own, what its diagnosis tells of its joints.

    That is at which pushes they stand, and the lines of load over error of servos that tell loads. One that tells the
    gains of its own loop tells as load what that loop makes of its reading: from a dead encoder as from a live one.
    """
    limits, arm = GuardLimits.of(arm), bare(arm)  # the logs are of an empty hand
    paths = [] if run is None else [run.folder.log(name) for name in ("excitation", "targets")]
    if run is None or not _is_own(run, robot) or not all(path.exists() for path in paths):
        return limits
    logs = [read_log(path) for path in paths]
    told = run.diagnosis
    gains = None if told is None else told.servo_gains
    lines = servo_lines(arm, logs) if gains is None else None  # else the load is the loop's, and fits any reading
    return replace(limits, bands=standing_bands(arm, logs), servos=lines, gains=gains)


def _is_own(run: Run, robot: str) -> bool:
    """Whether ``robot`` may be the arm that a run measured: a real one has many addresses, a virtual one has one."""
    if unloaded(robot) == unloaded(run.robot):
        return True
    try:
        return not any(place_of(address).virtual for address in (run.robot, robot))
    except AddressError:  # a robot that was opened by other means
        return False


def stance_of(twin: Twin | None, run: Run | None) -> Stance | None:
    """Return where an arm is expected to stand at rest, as far off as in the diagnosis of its ``run``.

    None without a twin.
    """
    if twin is None:
        return None
    stance = _expected(twin)
    path = None if run is None else run.folder.log("targets")
    if run is None or path is None or not path.exists():
        return stance
    log, then = read_log(path), _expected(run.twin or twin)  # its servos had the gains of the diagnosis
    rests = np.append(np.flatnonzero((log.target[1:] != log.target[:-1]).any(axis=-1)), len(log) - 1)
    return replace(stance, off=then.away(bare(run.arm), log.position[rests], log.command[rests]).max(axis=0))


def _expected(twin: Twin) -> Stance:
    return Stance(stiffness=twin.parameters.stiffness, offset=twin.parameters.offset)


def twin_in_force(run: Run, robot: Robot) -> Twin | None:
    """Return the twin of a run, its servos as stiff as they are under the gains that those of ``robot`` have now."""
    twin, diagnosis = run.twin, run.diagnosis
    if twin is None or diagnosis is None:
        return twin
    return twin_under(twin, diagnosis.servo_gains, gains_in_force(robot))


def twin_under(twin: Twin, before: ServoGains | None, now: ServoGains | None) -> Twin:
    """Return a ``twin`` that was fitted under the gains ``before``, its servos as stiff as under those ``now``.

    The rest of a servo is left as it is: damping is its motor's back-EMF and D, friction what its startup force leaves.
    """
    stiffness = stiffness_under(twin.parameters.stiffness, before, now)
    return replace(twin, parameters=replace(twin.parameters, stiffness=stiffness))


def tuned_gains(run: Run | None) -> GainsFound | None:
    """Return what the search for better gains of a run found; None where there was none."""
    if run is None or not run.folder.gains.exists():
        return None
    return read_json(run.folder.gains, GainsFound)


def trained_for_tuned(run: Run | None) -> bool:
    """Whether the policy of a run was trained for the gains that its search found."""
    found, policy = tuned_gains(run), None if run is None else run.policy
    gains = None if policy is None else policy.contract.servo_gains
    return found is not None and gains is not None and not differing(gains, found.under)


def correction_of(
    given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str, targets: Array | None = None
) -> Callable[[Arm], Modelled] | None:
    """Return what makes the correction of each motion; None where nothing is to be corrected.

    That is what is ``given``, or, if ``robot`` is the run's own, what its calibration says. ContractError where that is
    of another arm; InputError where it shifts the tool at rest, or one of the ``targets`` (..., 3) [m], by more than
    lies behind any worn arm's encoders: better known before the arm moves than when it is aimed.
    """
    calibration = calibration_of(given, run, arm, robot)
    if calibration is None:
        return None
    places = tcp_position(arm, arm.rest)[None]
    if targets is not None:
        places = np.concatenate([places, targets.reshape(-1, 3)])
    rest, every = np.broadcast_to(arm.rest, (len(places), arm.joints)), np.ones(len(places), dtype=bool)
    Modelled(arm, calibration.displacement).aim(places, rest, every)
    return partial(Modelled, displacement=calibration.displacement)


def calibration_of(given: CalibrationLike | None, run: Run | None, arm: Arm, robot: str) -> Calibration | None:
    """Return the calibration that `correction_of` corrects by; None where nothing is to be corrected."""
    found = as_calibration(given, run if run is not None and _is_own(run, robot) else None, arm)
    return found if found is not None and found.used else None


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
            raise InputError(
                f"{name} brings the tool to its place and does not turn it; for targets with an orientation take "
                f"{FeedforwardController.name}, integrator or default"
            )
    return factories


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
