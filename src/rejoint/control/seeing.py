"""Visual servoing of the last millimetres.

Detections, with the encoders at their times, measure the tool error. Worn joints stick and jump by a millimetre, so
those nearest to the tool dither while an integrator removes the error. Results: `python -m benchmarks seeing`.
Constants without a source are chosen.
"""

from collections import deque
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.linalg import norm

from rejoint.arms import Arm, Array, Mask, clip_norm, dls, position_kinematics, tcp_position
from rejoint.control.controllers.classical import limit_lead, limit_position
from rejoint.control.correction import Modelled, most_shift, rms
from rejoint.control.robot import ControlInput, Controller, JointState, Robot, part_of
from rejoint.system.errors import InputError
from rejoint.system.numbers import interpolated
from rejoint.system.records import entity

NOISE = 0.3e-3
"""[m] least and default deviation of a coordinate"""
UNKNOWN = 3e-3
"""[m] error of the model before a detection"""
DRIFT = 0.2e-3
"""[m/sqrt(s)] drift of that"""
RATTLE = 12e-3
"""[rad/sqrt(s)] wander of a loose link"""
ALONG = 0.1
"""change of the shift over the tool's motion"""
NEAR = 0.015
"""[m] error within which detections count"""
CHANGE = 2e-4
"""[m] smallest change of a target"""
JUMP = 0.015
"""[m] of a rejected detection from the model"""
HISTORY = 64
"""Stored readings"""
SHIFTED, ALIKE = 3e-3, 3
"""[m] common offset at so many targets of a moved camera or board"""
ENOUGH = 2
"""detections before the fine motion"""
FRESH = 0.6
"""[s] age of a new detection"""


@entity
class Sighting:
    """A detection of the tool."""

    time: float
    """[s] of the image"""
    place: Array
    """(3,) [m] TCP in the base frame"""
    sigma: float = np.nan
    """[m] deviation of a coordinate; NaN: unknown"""


class Eye(Protocol):
    """Detects the tool at its own rate; never waits."""

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection at robot time ``now`` [s]."""


@dataclass(eq=False)
class Seen(Modelled):
    """Corrects targets of one arm by the model, then by detections."""

    _: KW_ONLY
    eye: Eye

    def __post_init__(self) -> None:
        super().__post_init__()
        self.used = 0
        """accepted detections"""
        self.visits: list[tuple[int, float | None]] = []
        """per target: accepted detections, and averaged error [m]"""
        self.beyond: dict[int, Array] = {}
        """(3,) [m] by number of the target: detection minus model"""
        self._target = np.full(3, np.nan)
        self._count = 0  # sightings believed at this target
        self._last = self._believed = -np.inf  # [s] of the newest sighting that was looked at, and believed
        self.readings: deque[tuple[float, Array]] = deque(maxlen=HISTORY)
        """times [s] and positions (n,) [rad], the newest last"""

    def began(self, target: Array, aim: Array) -> None:
        """Begin at a target (1, 3) [m], without detections."""
        self._target, self._aim, self._count = target[0], aim[0], 0
        # [m] shift beyond the model; place by the encoders, at the last sighting
        self._extra = self._place = np.zeros(3)
        self._spread = UNKNOWN**2 * np.eye(3)  # [m^2] its covariance
        self.visits.append((0, None))

    def again(self, state: JointState) -> Array | None:
        """Correct by the newest detection."""
        now, position, target = state.time[0], state.position[0], self._target
        self.readings.append((now, position))
        if not np.isfinite(target).all():
            return None
        seen = self.eye.sighting(now)
        if seen is None or seen.time <= self._last or not self.readings[0][0] <= seen.time <= now:
            return None
        self._last = seen.time
        times, positions = map(np.array, zip(*self.readings, strict=True))
        then = interpolated(seen.time, times, positions)
        away = norm(self._aim - tcp_position(self.arm, then))
        unknown = seen.place - self.tool(then)
        if away > NEAR or norm(unknown) > JUMP:
            return None
        self._count += 1
        self._learn(unknown, then, seen)
        self.used += 1
        self.beyond[len(self.visits)] = self._extra
        left = target - self.tool(then) - self._extra
        self.visits[-1] = self._count, float(norm(left))
        fresh = target - self.shift(position) - self._extra
        if norm(fresh - self._aim) <= CHANGE or norm(fresh - target) >= most_shift(self.arm):
            return None
        self._aim = fresh
        return fresh[None]

    def missing(self, state: JointState) -> Array | None:
        """Error (3,) [m] by detections; None without news."""
        position, now = state.position[0], state.time[0]
        if self._count < ENOUGH or now - self._believed > FRESH:
            return None
        return self._target - self.tool(position) - self._extra

    def shifted(self) -> float | None:
        """Return common offset [m] from the model, or None: without a calibration all of the sag is seen."""
        if len(self.beyond) < ALIKE or not self.displacement.play.any():
            return None
        found = np.array(list(self.beyond.values()))
        side = found.mean(axis=0)
        far = float(norm(side))
        return far if far > max(SHIFTED, 2.0 * rms(norm(found - side, axis=1))) else None

    def _learn(self, unknown: Array, then: Array, seen: Sighting) -> None:
        place, jacobian = position_kinematics(self.arm, then)
        if self._count > 1:
            floats = self.displacement.floats(self.arm, then)
            wander, moved = RATTLE * jacobian * floats, ALONG * norm(place - self._place)
            change = DRIFT**2 * np.eye(3) + wander @ wander.T
            self._spread = self._spread + (seen.time - self._believed) * change + moved**2 * np.eye(3)
        noise = np.fmax(seen.sigma, NOISE)  # NaN: not known
        share = self._spread @ np.linalg.inv(self._spread + noise**2 * np.eye(3))
        self._extra = self._extra + share @ (unknown - self._extra)
        self._spread = self._spread - share @ self._spread
        self._place, self._believed = place, seen.time


TAKE_OVER = 0.006
"""[m] error of small joint motions"""
SLOW = np.radians(1.5)
"""[rad] per `LOOK` at the take-over"""
AT_REST = np.radians(0.1)
"""[rad] per `LOOK` at rest"""
STRANDED, STRANDED_AT = 1.0, 0.015
"""[s] and [m] at rest before a take-over"""
LOOK = 5
"""cycles (chosen: a tenth of a second)"""
CALM = 0.35e-3
"""[m] error at which the dither ends"""
RELAX = 0.5
"""[s] of dither after which twice that is enough"""
MOST_CALM = 0.6e-3
"""[m] largest (chosen: the promise)"""
OFF = 0.6e-3
"""[m] error that ends the rest"""
AGREED = 2
"""detections in their mean"""
QUIET = 0.1
"""[s] at rest before"""
RATE = 6.0
"""[1/s] of the integrator"""
AHEAD = 0.5
"""share of the error in the command"""
DAMPING = 0.01
"""[m] of the least squares"""
STEP = np.radians(10.0)
"""[rad] largest wanted joint motion"""
LEAD = np.radians(12.0)
"""[rad] largest following error"""
FADE = 0.2
"""[s] of the swing's end"""
HALF_SWING = 0.05
"""[s] (chosen: 10 Hz)"""
FIRST, WIDEST = np.radians(1.2), np.radians(2.0)
"""[rad] first and largest amplitude"""
WIDER, NARROWER = 1.5, 0.8
"""factors on it, stationary and swinging"""
SWING = 4.5
"""encoder counts (chosen: half a millimetre at the tool)"""
STUCK = 3
"""widest swings before giving a joint up"""
LEAST_LEVER = 0.05
"""smallest singular value over longest lever"""


class Finishing:
    """Drives by a controller, then by detections."""

    def __init__(self, arm: Arm, controller: Controller, seen: Seen) -> None:
        self._arm, self._controller, self._seen = arm, controller, seen
        self.name, self.contract = controller.name, getattr(controller, "contract", None)
        self._amplitude = np.full(arm.joints, FIRST)
        self._aim = np.full(3, np.nan)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Begin a new target; small changes are none."""
        change = norm(inputs.target[0] - self._aim)
        self._aim = inputs.target[0]
        if inputs.since_target[0] > 0.0 and 0.0 < change < TAKE_OVER:
            return
        self.state = "far"
        self._alone = np.full(self._arm.joints, False)  # joints that stay stuck
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Commands (1, n) [rad]."""
        missing = self._seen.missing(inputs.state)
        if self.state == "hold":
            if missing is None or not self._is_off(inputs, missing):
                return self._base[None]
            self._begin("fine", inputs)
        if self.state == "fine" and missing is not None:
            return self._fine(inputs, missing)
        return self._far(inputs, missing)

    def _begin(self, state: str, inputs: ControlInput) -> None:
        self.state, self._since = state, inputs.state.time[0]
        self._time = self._since  # [s] of the last command
        self._base = inputs.sent[0]
        self._cycles, self._looked = 0, self._seen.used
        self._good, self._fading = 0, np.inf
        self._recent: deque[Array] = deque(maxlen=AGREED)
        self._moving, self._renew = np.full(self._arm.joints, False), True
        self._standing = np.zeros(self._arm.joints, dtype=int)

    def _far(self, inputs: ControlInput, missing: Array | None) -> Array:
        if self.state == "fine":  # the tool is hidden: by the model again
            self.state = "far"
            self._controller.reset(inputs, np.full(1, True))
        readings = self._seen.readings
        if missing is None or len(readings) < LOOK:
            return self._controller.command(inputs)
        moved = np.abs(readings[-1][1] - readings[-LOOK][1]).max()
        off = norm(missing)
        if off < CALM and moved < AT_REST:
            self._begin("hold", inputs)
            return self._base[None]
        stranded = moved < AT_REST and off < STRANDED_AT and inputs.since_target[0] > STRANDED
        if stranded or (off < TAKE_OVER and moved < SLOW):
            self._begin("fine", inputs)
            return self._fine(inputs, missing)
        return self._controller.command(inputs)

    def _is_off(self, inputs: ControlInput, missing: Array) -> bool:
        if inputs.state.time[0] - self._since > QUIET and self._seen.used != self._looked:
            self._recent.append(missing)
        self._looked = self._seen.used
        return len(self._recent) == AGREED and float(norm(np.mean(self._recent, axis=0))) > OFF

    def _fine(self, inputs: ControlInput, missing: Array) -> Array:
        now, position = inputs.state.time[0], inputs.state.position[0]
        jacobian = position_kinematics(self._arm, position)[1]
        if self._renew or _least_lever(jacobian, self._moving) < 0.5 * LEAST_LEVER:  # on the way they came into line
            self._moving, self._renew = self._choose(jacobian), False
        motion = clip_norm(dls(jacobian * self._moving, missing, DAMPING), STEP)
        elapsed, self._time = now - self._time, now
        readings = self._seen.readings
        period = (readings[-1][0] - readings[0][0]) / max(len(readings) - 1, 1)
        swing = int(np.clip(round(HALF_SWING / max(period, 1e-3)), 1, 4))
        self._recent.append(missing)
        self._watch(now, swing)
        share = np.clip(1.0 - (now - self._fading) / FADE, 0.0, 1.0)
        if share == 1.0:
            self._base = self._base + RATE * min(elapsed, HALF_SWING) * motion
        self._base = limit_position(self._arm, limit_lead(self._base, position, LEAD))
        if share == 0.0:
            self.state, self._since = "hold", now
            self._recent.clear()
            return self._base[None]
        self._cycles += 1
        odd = np.arange(self._arm.joints) % 2  # neighbours swing one after the other
        side = 1.0 - 2.0 * ((self._cycles + (1 - odd) * (swing // 2)) // swing % 2)
        return (self._base + AHEAD * share * motion + share * side * self._amplitude * self._moving)[None]

    def _watch(self, now: float, swing: int) -> None:
        if self._fading <= now:
            return
        if self._cycles % (2 * swing) == 0 and len(self._seen.readings) > 2 * swing and self._cycles:
            self._suit(np.stack([one for _, one in self._seen.readings])[-2 * swing - 1 :])
        if self._seen.used == self._looked:
            return
        self._looked = self._seen.used
        enough = min(CALM * (1.0 + (now - self._since) / RELAX), MOST_CALM)
        self._good = self._good + 1 if norm(np.mean(self._recent, axis=0)) < enough else 0
        self._fading = now if self._good >= 2 else np.inf

    def _suit(self, readings: Array) -> None:
        """Increase the swing of stationary joints (T, n) [rad], reduce wide ones, give up stuck ones."""
        counts = np.ptp(readings, axis=0) / self._arm.encoder_step
        stands = self._moving & (counts < 0.5)
        self._standing = np.where(stands & (self._amplitude >= WIDEST), self._standing + 1, 0)
        lost = self._standing >= STUCK
        if lost.any():
            self._alone, self._renew = self._alone | lost, True
            self._standing = np.where(lost, 0, self._standing)
        wider = np.where(stands, np.minimum(WIDER * self._amplitude, WIDEST), self._amplitude)
        self._amplitude = np.where(counts > SWING, NARROWER * wider, wider)

    def _choose(self, jacobian: Array) -> Mask:
        """Joints (n,) nearest to the tool that move it in every direction; else all."""
        n = self._arm.joints
        for number in range(1, 2**n):  # bit i is the i-th joint from the tool: lower numbers are nearer to it
            mask = (number >> np.arange(n - 1, -1, -1)) & 1 == 1
            if mask.sum() < 3 or (mask & self._alone).any():
                continue
            if _least_lever(jacobian, mask) >= LEAST_LEVER:
                return mask
        return np.full(n, True)


def _least_lever(jacobian: Array, joints: Mask) -> float:
    """Smallest singular value of some ``joints`` (n,) over the longest lever of all."""
    values = np.linalg.svd(jacobian[:, joints], compute_uv=False)
    return float(values[-1] / norm(jacobian, axis=0).max())


@runtime_checkable
class Simulated(Protocol):
    """A simulated robot, which brings the cameras that see it."""

    def eye(self, seed: int) -> Eye:
        """Detector of the tool; noise by ``seed``."""

    def camera(self, board: Any, carried: str, seed: int) -> Any:  # noqa: ANN401 - the camera's room knows both
        """Camera that sees the ``board``; the tool has ``carried``, which is ``board`` or ``camera``."""


def simulated(robot: Robot) -> Simulated:
    """Return the robot that brings its cameras; InputError without."""
    found = part_of(robot, Simulated)
    if found is None:
        raise InputError(
            f"camera emulated: it sees one arm that is emulated in this process, not {robot.address}; give the number "
            "of a camera, or emulated:WEAR as the robot"
        )
    return found
