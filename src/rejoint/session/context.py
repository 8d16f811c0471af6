"""What drives an arm, and what is known of it: controllers, limits, rest posture, twin, gains, correction, payload."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeGuard, cast

import numpy as np

from rejoint.arms import Arm, Array, Index, Motors, gravity_torque, position_kinematics, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.postures import too_heavy
from rejoint.arms.workspace import length_size, torque_size
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
from rejoint.control.controllers.classical import NOMINAL_PERIOD
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import Policy, check_controller_period
from rejoint.control.correction import Modelled
from rejoint.control.guard import GuardLimits
from rejoint.control.monitor import standing_bands
from rejoint.control.moving.tracker import joint_weights
from rejoint.control.robot import Controller, heeds_turn
from rejoint.control.servogains import (
    GEARED,
    GEARED_POLICY,
    GEARED_PREDICTIVE,
    RIVALS,
    ServoGains,
    differing,
    geared,
    in_words,
    inner_name,
    stiffness_under,
)
from rejoint.control.start import Stance
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.logs.runlog import RunLog
from rejoint.robots import place_of
from rejoint.runs.run import Run
from rejoint.session.inputs import ControllerLike, Period, laden
from rejoint.system.errors import AddressError, ContractError, FileError, InputError
from rejoint.twin.parameters import back_emf, lifting_torque
from rejoint.twin.twin import Twin

STILL, STOOD = 0.4, np.radians(1.0)
"""[s] at the end of a visit, and [rad] that joints of a standing arm move in them (chosen)"""
ALONE, LEAST = 0.08, 0.013
"""[kg] of a myCobot 280: standard error of one posture's estimate (measured), and of many (chosen)"""


def heavy(arm: Arm, postures: Array, motors: Motors) -> list[str]:
    """Say which of the ``motors`` may not lift each of K ``postures`` (K, n) [rad]; empty where they do.

    Midway between what they lift and what they hold (``benchmarks payload``).
    """
    lifted, midway = (
        np.where(joint_weights(arm) <= 1.0, torque, np.inf)
        for torque in (motors.usable, 0.5 * (motors.usable + motors.limit))
    )
    return [
        "" if too_heavy(arm, posture, midway)[0] is None else too_heavy(arm, posture, lifted)[1] for posture in postures
    ]


def believed_motors(arm: Arm, twin: Twin) -> Motors:
    """Motors of a twin, perhaps with limits in doubt."""
    own, limit, lifting = twin.parameters, twin.parameters.torque_limit, lifting_torque(twin.parameters)
    late, emf = float(own.delay) + 0.5 * NOMINAL_PERIOD, back_emf(arm, own)
    doubt = twin.interval[1].torque_limit / limit
    return Motors(limit, lifting, own.damping, own.coulomb, own.armature, own.stiffness, late, emf, doubt)


def noticed_load(arm: Arm, twin: Twin, log: RunLog) -> tuple[float, float] | None:
    """Estimate an unreported mass [kg] at the tool and its standard error; None without a visit to a target."""
    rows, own = _ends(log), twin.parameters
    position = log.position[rows]
    torque = own.stiffness * (log.command[rows] + own.offset - position)
    missing = torque - gravity_torque(arm, position)
    lever = -position_kinematics(arm, position)[1].mT @ GRAVITY  # [m^2/s^2]: torque per mass
    free = np.abs(torque) < 0.9 * own.torque_limit  # at its limit a motor gives less than its stiffness says
    # Friction holds anything between plus and minus its size, all equally likely.
    least = 0.02 * np.abs(gravity_torque(arm, position)).max(initial=0.0)
    doubt = np.maximum(own.coulomb, least) / np.sqrt(3.0)
    weight = np.where(free, 1.0 / doubt, 0.0)
    total = ((lever * weight) ** 2).sum()
    if total <= 0.0:
        return None
    scale = torque_size(arm) / length_size(arm)  # of masses; joints stick to one side, and share it in a posture
    doubtful = max(1.0 / np.sqrt(total), scale * ALONE / len(rows), scale * LEAST)
    return float((lever * weight**2 * missing).sum() / total), float(doubtful)


def _ends(log: RunLog) -> Index:
    """Rows at the ends of visits at which the arm stands. The last row of each already has the next command."""
    ends = np.array([visit[-2] for visit in log.visits() if len(visit) > 1], dtype=int)
    before = np.searchsorted(log.time, log.time[ends] - STILL)
    return ends[(np.abs(log.position[ends] - log.position[before]) < STOOD).all(axis=1)]


def guard_limits(run: Run | None, arm: Arm, robot: str) -> GuardLimits:
    """Guard's limits, with friction bands if ``robot`` is the run's own."""
    limits = GuardLimits.of(arm)
    if run is None or not is_own(run, robot):
        return limits
    if zeros_of(run.robot) != zeros_of(robot) or (told := run.diagnosis) is None:
        return limits
    paths = [run.folder.log(name) for name in ("excitation", "targets")]
    if not all(path.exists() for path in paths):
        return limits
    own = laden(run)
    bands = standing_bands(own, [RunLog.load(path) for path in paths], *told.measurement.balance(own))
    return replace(limits, bands=bands, gains=told.servo_gains)


def is_own(run: Run, robot: str) -> bool:
    """Whether ``robot`` is at the address of a run's own robot."""
    try:
        own, here = place_of(run.robot), place_of(robot)
    except AddressError:  # a robot that was opened by other means
        return robot == run.robot
    return own.unloaded == here.unloaded or not (own.virtual or here.virtual)


def zeros_of(robot: str) -> str:
    """Fingerprint of the zeros in an address; empty without any."""
    with suppress(AddressError):
        return str(getattr(place_of(robot).detail, "zeros", ""))
    return ""


def stance_of(twin: Twin | None, run: Run | None) -> Stance | None:
    """Return the expected rest posture, as far off as in the diagnosis of ``run``; None without a twin."""
    if twin is None:
        return None
    stance = _expected(twin)
    if run is None or not (path := run.folder.log("targets")).exists():
        return stance
    log, then = RunLog.load(path), _expected(run.twin or twin)  # its servos had the gains of the diagnosis
    rests = _ends(log)
    off = then.away(laden(run), log.position[rests], log.command[rests])
    return replace(stance, off=off.max(axis=0, initial=0.0))


def _expected(twin: Twin) -> Stance:
    own = twin.parameters
    return Stance(stiffness=own.stiffness, offset=own.offset, compensation=own.compensation)


def twin_under(twin: Twin, before: ServoGains | None, now: ServoGains | None) -> Twin:
    """Return a ``twin`` fitted under the gains ``before``, made as stiff as ``now``."""
    stiffness = stiffness_under(twin.parameters.stiffness, before, now)
    return replace(twin, parameters=replace(twin.parameters, stiffness=stiffness))


def correction_of(calibration: Calibration | None, arm: Arm, targets: Array | None = None) -> Modelled | None:
    """Return the correction by a ``calibration``, or None.

    InputError where it shifts ``targets`` (..., 3) [m], by default the tool at rest, too far.
    """
    if calibration is None:
        return None
    calibration.aim(tcp_position(arm, arm.rest) if targets is None else targets, arm.rest)
    return Modelled(arm, calibration.displacement)


def quick_note(run: Run | None) -> str:
    """Remark on a run of a quick try, or nothing."""
    return f"{run.path} is a quick try, which is no result." if run is not None and run.folder.quick.exists() else ""


Controllers: TypeAlias = "Sequence[ControllerLike] | Mapping[str, ControllerLike] | ControllerLike"
"""Controllers, a mapping from their names, or a single one"""

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
    for one in given if isinstance(given, Iterable) and not isinstance(given, str) else (given,):
        name = name_of(one)
        taken = sum(other == name or other.startswith(f"{name}-") for other in found)
        found[f"{name}-{taken + 1}" if name in found else name] = one
    return found


@dataclass(frozen=True, eq=False)
class ControllerMaker:
    """Makes controllers of an arm by name."""

    arm: Arm
    period: Period | None = None
    """[s] None: not known yet"""
    run: Run | None = None
    twin: Twin | None = None
    """gives the feed-forward its stiffness"""

    @property
    def usual(self) -> float:
        """Middle of the control periods [s]; NaN: not known yet."""
        return np.nan if self.period is None else sum(self.period) / 2

    @property
    def suits_shelf(self) -> bool:
        """Whether a generic policy suits arm and control period."""
        try:
            check_controller_period(shelf_policy(self.arm), self.usual)
        except ContractError:
            return False
        return True

    @property
    def policy_file(self) -> Path | None:
        """Policy of the run."""
        return self.run.folder.policy if self.run is not None and self.run.folder.policy.exists() else None

    @property
    def trained_for_tuned(self) -> bool:
        """Whether the policy of the run was trained for its tuned gains."""
        found, policy = (None, None) if self.run is None else (self.run.gains, self.run.policy)
        gains = None if policy is None else policy.contract.servo_gains
        return found is not None and gains is not None and not differing(gains, found.under)

    def choice(self) -> tuple[str, str]:
        """Return the controller that drives by default, and why: the run's recommendation, else the `fallback`."""
        if self.run is not None and (comparison := self.run.comparison) is not None:
            return recommend(comparison).controller, f"{self.run.path} recommends it"
        return self.fallback("has no comparison yet")

    def fallback(self, lacks: str) -> tuple[str, str]:
        """Return the run's policy, which ``lacks`` a recommendation, else a generic one or feed-forward, and why."""
        run, without = self.run, "without a run"
        if run is not None:
            if self.policy_file is not None:
                own = GEARED_POLICY if self.trained_for_tuned else POLICY
                return own, f"the policy of {run.path}, which {lacks}"
            without = f"{run.path} has no policy yet, and {lacks}"
        if self.suits_shelf:
            return SHELF, f"the policy that comes with rejoint; {without}"
        return FeedforwardController.name, f"no policy suits this arm; {without}"

    def contenders(self, *, real: bool, posed: bool) -> tuple[str, ...]:
        """Name the controllers compared by default; a real arm gets the generic policy until it has its own."""
        tuned = self.run is not None and self.run.gains is not None
        own = self.policy_file is not None and not posed
        geared = own and self.trained_for_tuned
        left_out = {
            SHELF: posed or (real and own) or not self.suits_shelf,
            POLICY: geared or not own,
            PREDICTIVE: posed or tuned or self.twin is None,
            **dict.fromkeys(RIVALS, not tuned),
            GEARED_POLICY: not geared,
            GEARED_PREDICTIVE: posed or not tuned or self.twin is None,
        }
        return tuple(name for name in (*CONTROLLERS, *RIVALS) if not left_out.get(name))

    def factories(self, given: Controllers, *, real: bool = False, posed: bool = False) -> dict[str, Factory]:
        """Return factories by name; default: the `contenders` for a ``real`` arm or virtual time.

        ``posed`` targets need controllers that turn the tool.
        """
        asked = given or self.contenders(real=real, posed=posed)
        factories = {name: self._factory(one) for name, one in named(asked).items()}
        for name, make in factories.items():
            cause: Exception | None = None
            try:
                controller: object = make(self.arm)
            except (TypeError, AttributeError) as error:  # as of a class, or of a function of the inputs
                controller = cause = error
            if isinstance(controller, type) or not isinstance(controller, Controller):
                raise InputError(
                    f"controller {name}: expected its name, an object with name, reset and command, or a function of "
                    f"an Arm that returns one; got {controller!r}"
                ) from cause
            check_controller_period(controller, self.usual)
            if posed and not heeds_turn(controller):
                raise _turns_nothing(name)
        return factories

    def require_possible(self, given: Controllers, *, tunable: bool, posed: bool) -> None:
        """Refuse what `factories` would, before the run has twin, policy and gains."""
        for name, one in named(given).items():
            if one in RIVALS and not tunable:
                raise InputError(f"{one} needs servo gains that can be tuned; an SO-101 on its own bus has them")
            if one not in (POLICY, PREDICTIVE, *RIVALS):
                self.factories({name: one}, posed=posed)
            elif posed and inner_name(str(one)) in (POLICY, PREDICTIVE):
                raise _turns_nothing(name)

    def _factory(self, given: ControllerLike) -> Factory:
        if is_name(given):
            return partial(self._by_name, given)
        one = Policy.load(given) if isinstance(given, Path | str) else given
        if hasattr(one, "controller"):
            return one.controller
        if not callable(one) or (hasattr(one, "reset") and not isinstance(one, type)):
            return lambda _: cast(Controller, one)
        return one

    def _by_name(self, name: str, arm: Arm) -> Controller:
        if name in RIVALS:
            return self._geared(name, arm)
        stiffness = None if self.twin is None else self.twin.parameters.stiffness
        if name == PREDICTIVE and self.twin is not None:
            from rejoint.twin.predictive import PredictiveController

            holder = shelf_controller(arm) if self.suits_shelf else FeedforwardController(arm, stiffness)
            return PredictiveController.of(arm, [self.twin], holder)
        return make_controller(name, arm, policy=self.policy_file, stiffness=stiffness)

    def _geared(self, name: str, arm: Arm) -> Controller:
        run = self.run
        if run is None or (found := run.gains) is None:
            where = "RUN" if run is None else str(run.path)
            raise FileError(f"{where}/gains.json", "no such file", f"run `rejoint gains ROBOT {where}` first")
        if name == GEARED_POLICY and not self.trained_for_tuned:
            raise ContractError(
                f"{run.path} has no policy for the gains that its search found ({in_words(found.under)}); train one "
                f"with: rejoint train {run.path}"
            )
        stiffer = None if self.twin is None else twin_under(self.twin, found.found, found.under)
        inner = replace(self, twin=stiffer)._by_name(inner_name(name), arm)
        return geared(inner, found.alone if name == GEARED else found.under)


def _turns_nothing(name: str) -> InputError:
    return InputError(
        f"{name} brings the tool to its place and does not turn it; for targets with an orientation take "
        f"{FeedforwardController.name}, integrator or default"
    )
