"""The last millimetres by what is seen: joints that stick are shaken loose a little, and pulled to where the tool fits.

Near its aim a worn joint stands until its command has led by degrees, and then jumps by a millimetre. A controller
cannot bring such an arm closer than that, however well it sees. Here a controller drives as far as it can; then the
commands of a few joints swing by as little as just makes them move (dither; chosen: dry friction holds a joint that
stands, but in one that swings it acts against either direction by turns, so that a small pull moves it a little in each
swing). So shaken, they follow small commands smoothly, and an integrator takes out what is seen to be missing. Then the
swing fades and the command stays.

Only as few joints move as can take the tool in every direction, those nearest to the tool: a joint at the base carries
no weight, so its link coasts in the play of its gear for a second, and shakes the whole arm.

Worn emulated arms that nothing was chosen on come to 0.5 mm (95th percentile 1.1 and 1.5 on two times 18 arms) 3 s
after a target was set and to 0.4 (1.0) after 4 s, by the model alone to 1.5 (3.1) and 1.3 (2.7): `python -m
benchmarks.seeing --arms 18 --first 1010 --policy FILE`, and from 1200 on. Control periods of 45 ms and controllers that
arrive late leave more.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, position_kinematics
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.law import limit_lead, limit_position
from rejoint.control.robot import Mask
from rejoint.control.seeing import Seen

TAKE_OVER = 0.006
"""[m] of what is missing from which a joint motion of a few degrees does (chosen)"""
SLOW = np.radians(1.5)
"""[rad] that no reading may have changed by in `LOOK` when the controller is relieved (chosen: 15 deg/s)"""
AT_REST = np.radians(0.1)
"""[rad] the same of an arm that stands (chosen: one encoder count)"""
STRANDED, STRANDED_AT = 1.0, 0.015
"""[s] after which, and [m] within which, a controller is relieved where the arm stands (chosen)"""
LOOK = 5
"""cycles (chosen: a tenth of a second)"""
CALM = 0.35e-3
"""[m] of what is missing below which the shaking ends (chosen: noise of the averaged sightings is half of that)"""
RELAX = 0.5
"""[s] of shaking after which twice as much is good enough (chosen)"""
MOST_CALM = 0.6e-3
"""[m] and more never is (chosen: what is promised)"""
OFF = 0.6e-3
"""[m] of what is missing from which an arm that was at rest is moved again (chosen: `MOST_CALM`)"""
AGREED = 2
"""sightings whose mean must say so (chosen: noise of what was averaged already is a third of that)"""
QUIET = 0.1
"""[s] at rest before that is asked: sightings from before are still under way (chosen: pictures come about so late)"""
RATE = 6.0
"""[1/s] of what is missing, that the command moves by (chosen: 9 swings on worn arms, 3 takes too long)"""
AHEAD = 0.5
"""share of what is missing by which the command leads beyond (chosen)"""
DAMPING = 0.01
"""[m] of the least squares (chosen: a third of the least lever that is used)"""
STEP = np.radians(10.0)
"""[rad] largest element of a joint motion that is asked for (chosen)"""
LEAD = np.radians(12.0)
"""[rad] farthest that a command is from the reading (chosen: what holds a worn arm up and moves it; 8 is too little for
some, and the guard allows 20)"""
FADE = 0.2
"""[s] in which the swing ends (chosen: two swings)"""
HALF_SWING = 0.05
"""[s] (chosen: 10 Hz; a joint hardly follows it, and its command has the time to turn round under the guard)"""
FIRST, WIDEST = np.radians(1.2), np.radians(2.0)
"""[rad] amplitude of the commands at first, and at most (chosen: worn joints of emulated arms need 0.6 to 2)"""
WIDER, NARROWER = 1.5, 0.8
"""factors on it where a reading stands, and where it swings by more than `SWING` (chosen)"""
SWING = 4.5
"""encoder counts (chosen: the tool swings by half a millimetre)"""
STUCK = 3
"""swings at the widest amplitude after which a joint that stands is left alone (chosen)"""
LEAST_LEVER = 0.05
"""of the longest lever, by which the chosen joints move the tool in the worst direction (chosen)"""


class Finishing:
    """Drives one arm by a controller, and the last millimetres by what is seen.

    It takes `seen` for what is missing; where that has seen nothing of late the controller goes on by the model.
    """

    def __init__(self, arm: Arm, controller: Controller, seen: Seen) -> None:
        self._arm, self._controller, self._seen = arm, controller, seen
        self.state = "far"
        """``far``: the controller drives; ``fine``; ``hold``"""
        self._amplitude = np.full(arm.joints, FIRST)
        self._told: deque[tuple[float, Array]] = deque(maxlen=12)
        self._aim = np.full(3, np.nan)
        self._begin_target()

    @property
    def name(self) -> str:
        """Name of the controller."""
        return self._controller.name

    @property
    def contract(self) -> object:
        """That of a policy, which is checked before anything moves; None of other controllers."""
        return getattr(self._controller, "contract", None)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Begin with a new target; an aim that a sighting has changed a little is not one."""
        change = float(np.linalg.norm(inputs.target[0] - self._aim))
        self._aim = inputs.target[0].copy()
        if inputs.since_target[0] > 0.0 and 0.0 < change < TAKE_OVER:
            return
        self._begin_target()
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the wanted joint positions (1, n) [rad]."""
        now, position = float(inputs.state.time[0]), inputs.state.position[0]
        self._told.append((now, position.copy()))
        missing = self._seen.missing(inputs)
        if missing is None:
            return self._base[None].copy() if self.state == "hold" else self._far(inputs, None)
        if self.state == "hold" and self._is_off(now, missing):
            self._begin("fine", now, inputs)
        if self.state == "hold":
            return self._base[None].copy()
        return self._fine(position, now, missing) if self.state == "fine" else self._far(inputs, missing)

    def _begin_target(self) -> None:
        self.state = "far"
        self._told.clear()
        self._alone = np.zeros(self._arm.joints, dtype=bool)  # joints that stay stuck

    def _begin(self, state: str, now: float, inputs: ControlInput) -> None:
        """Begin to shake, or to hold, from the command in force."""
        self.state, self._since, self._time = state, now, now
        self._base = inputs.sent[0].copy()
        self._cycles, self._looked = 0, self._seen.used
        self._good, self._fading = 0, np.nan
        self._recent: deque[Array] = deque(maxlen=AGREED)
        self._moving, self._renew = np.zeros(self._arm.joints, dtype=bool), True
        self._standing = np.zeros(self._arm.joints, dtype=int)

    def _far(self, inputs: ControlInput, missing: Array | None) -> Array:
        """Let the controller drive, until the tool is seen near its target."""
        now = float(inputs.state.time[0])
        if self.state == "fine":  # the tool is hidden: by the model again
            self.state = "far"
            self._controller.reset(inputs, np.ones(1, dtype=bool))
        if missing is None or len(self._told) < LOOK:
            return self._controller.command(inputs)
        moved = float(np.abs(self._told[-1][1] - self._told[-LOOK][1]).max())
        off = float(np.linalg.norm(missing))
        if off < CALM and moved < AT_REST:
            self._begin("hold", now, inputs)
            return self._base[None].copy()
        stranded = moved < AT_REST and off < STRANDED_AT and float(inputs.since_target[0]) > STRANDED
        if stranded or (off < TAKE_OVER and moved < SLOW):
            self._begin("fine", now, inputs)
            return self._fine(inputs.state.position[0], now, missing)
        return self._controller.command(inputs)

    def _is_off(self, now: float, missing: Array) -> bool:
        """Whether a few sightings of the arm at rest agree that it is to be moved again."""
        if now - self._since > QUIET and self._seen.used != self._looked:
            self._recent.append(missing)
        self._looked = self._seen.used
        return len(self._recent) == AGREED and float(np.linalg.norm(np.mean(self._recent, axis=0))) > OFF

    def _fine(self, position: Array, now: float, missing: Array) -> Array:
        """Shake and pull."""
        jacobian = position_kinematics(self._arm, position[None])[1][0]
        if self._renew:
            self._moving, self._renew = self._choose(jacobian), False
        part = jacobian * self._moving
        motion = clip_norm(part.T @ np.linalg.solve(part @ part.T + DAMPING**2 * np.eye(3), missing), STEP)
        elapsed, self._time = now - self._time, now
        swing = self._swing()
        self._recent.append(missing)
        self._watch(now, swing)
        share = 1.0 if np.isnan(self._fading) else max(0.0, 1.0 - (now - self._fading) / FADE)
        if share == 1.0:
            self._base = self._base + RATE * min(elapsed, HALF_SWING) * motion
        self._base = limit_position(self._arm, limit_lead(self._base, position, LEAD))
        if share == 0.0:
            self.state, self._since = "hold", now
            self._recent.clear()
            return self._base[None].copy()
        self._cycles += 1
        odd = np.arange(self._arm.joints) % 2  # neighbours swing one after the other
        side = 1.0 - 2.0 * ((self._cycles + (1 - odd) * (swing // 2)) // swing % 2)
        wanted: Array = self._base + AHEAD * share * motion + share * side * self._amplitude * self._moving
        return wanted[None]

    def _swing(self) -> int:
        """Cycles of half a swing."""
        period = (self._told[-1][0] - self._told[0][0]) / max(len(self._told) - 1, 1)
        return int(np.clip(round(HALF_SWING / max(period, 1e-3)), 1, 4))

    def _watch(self, now: float, swing: int) -> None:
        """Suit the amplitudes to what readings do, once a swing, and tell whether the tool is near enough."""
        if not np.isnan(self._fading):
            return
        if self._cycles % (2 * swing) == 0 and len(self._told) > 2 * swing and self._cycles:
            self._suit(np.stack([one for _, one in self._told])[-2 * swing - 1 :])
        if self._seen.used == self._looked:
            return
        self._looked = self._seen.used
        enough = min(CALM * (1.0 + (now - self._since) / RELAX), MOST_CALM)
        near = float(np.linalg.norm(np.mean(self._recent, axis=0))) < enough
        self._good = self._good + 1 if near else 0
        if self._good >= 2:
            self._fading = now

    def _suit(self, readings: Array) -> None:
        """Shake joints (T, n) [rad] more that stand, and less that swing widely; leave alone what does not move."""
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
        """Joints (n,) nearest to the tool that can take it in every direction; all, where some cannot."""
        n = self._arm.joints
        longest = float(np.linalg.norm(jacobian, axis=0).max())
        for number in range(1, 2**n):  # bit i is the i-th joint from the tool: lower numbers are nearer to it
            mask = (number >> np.arange(n - 1, -1, -1)) & 1 == 1
            if mask.sum() < 3 or (mask & self._alone).any():
                continue
            if float(np.linalg.svd(jacobian[:, mask], compute_uv=False)[-1]) >= LEAST_LEVER * longest:
                return np.asarray(mask)
        return np.ones(n, dtype=bool)
