"""Whether braking gently presses a base joint that floats to one flank of its play, and whether it stays there.

    python -m benchmarks.braking --arms 40

While a motor brakes, the link runs ahead of it to the front flank, and bounces there; where it brakes long enough the
link comes to rest at the flank. So the controllers of emulated worn arms are sent beside the target, turned about joint
1, and see their arm turned back; then joint 1 alone covers the rest on a parabola in time, which a tracker of its own
holds it to. Printed per variant: where the link of joint 1 lies when the motor has stopped and at the end, mean and
standard deviation in units of half its play, and the latter within an arm; how much of what varies within an arm the
inertia about joint 1 explains, which goes with the posture; angle by which the encoders miss the target about joint 1
[deg], mean and standard deviation; encoder error [mm].
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.approach import within
from rejoint.arms import Arm, Array, frames, mycobot280, tcp_position
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Mask
from rejoint.research.evaluation.calibrating import CONDITIONS, open_condition
from rejoint.research.evaluation.family import ArmFamily

TARGETS = 4
BEGIN = 1.5
"""[s] after which the braking begins: the controllers have come near"""
AFTER = 0.1
"""[s] for which the joint is tracked beyond its end"""
HOLD = 6.0
"""[s] at each target; errors are means over the last half second"""
RATE, AHEAD, LAG = 2.0, 0.04, 0.02
"""[1/s] of the tracker's integral, [s] by which its command leads the speed, [s] that readings are old"""
RELAX = 0.7
"""share of the command's lead that is left once it stands"""


@dataclass(frozen=True)
class Braking:
    """``way`` [deg] on which joint 1 brakes, ``seconds`` that it takes, and ``side`` from which it comes."""

    way: float = 0.0
    seconds: float = 1.4
    side: float = -1.0


VARIANTS = (
    Braking(), Braking(20.0, 1.4, -1.0), Braking(20.0, 1.4, 1.0), Braking(20.0, 2.0, -1.0), Braking(20.0, 2.0, 1.0),
    Braking(14.0, 1.0, -1.0), Braking(14.0, 1.0, 1.0),
)  # fmt: skip


class Braked:
    """A controller whose joint 1 ends every motion by braking on a parabola."""

    def __init__(self, arm: Arm, inner: Controller, how: Braking) -> None:
        self._arm, self._inner, self._how, self.name = arm, inner, how, inner.name
        self._away = how.side * np.radians(how.way)
        self._state, self._goal, self._start, self._lead, self._last = np.zeros((5, 0))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Begin beside the target."""
        if len(self._state) != len(where):
            self._state, self._goal, self._start, self._lead, self._last = np.zeros((5, len(where)))
        self._state = np.where(where, 0.0, self._state)
        self._inner.reset(self._seen(inputs), where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the commands (B, n) [rad]: of the controller, and of the tracker for joint 1 once it brakes."""
        time, first = inputs.since_target, inputs.state.position[:, 0]
        begins = (self._state == 0.0) & (time >= BEGIN)
        turn = azimuth(inputs.target) - azimuth(tcp_position(self._arm, inputs.state.position))
        self._goal = np.where(begins, first + turn, self._goal)
        self._start = np.where(begins, first - self._goal, self._start)
        self._lead = np.where(begins, inputs.sent[:, 0] - first, self._lead)
        self._state = np.where(begins, 1.0, self._state)
        wanted = self._inner.command(self._seen(inputs))
        wanted[:, 0] += np.where(self._state == 0.0, self._away, 0.0)
        left = np.clip(1.0 - (time - BEGIN) / self._how.seconds, 0.0, 1.0)
        place, speed = self._goal + self._start * left**2, -2.0 * self._start * left / self._how.seconds
        off = place - speed * (LAG + AHEAD) - first
        self._lead = self._lead + RATE * np.clip(time - self._last, 0.0, 0.1) * off * (self._state == 1.0)
        self._last = time
        tracked = place + self._lead + AHEAD * speed
        stands = (self._state == 1.0) & (time >= BEGIN + self._how.seconds + AFTER)
        held = np.where(stands, first + RELAX * (inputs.sent[:, 0] - first), inputs.sent[:, 0])
        self._state = np.where(stands, 2.0, self._state)
        wanted[:, 0] = np.select([self._state == 0.0, self._state == 1.0], [wanted[:, 0], tracked], held)
        return wanted

    def _seen(self, inputs: ControlInput) -> ControlInput:
        """Return what the controller is to see: the arm turned back, and while joint 1 brakes, at its goal."""
        position, sent = inputs.state.position.copy(), inputs.sent.copy()
        away = np.select([self._state == 0.0, self._state == 1.0], [self._away, position[:, 0] - self._goal], 0.0)
        position[:, 0] -= away
        sent[:, 0] -= away
        return replace(inputs, state=replace(inputs.state, position=position), sent=sent)


def azimuth(place: Array) -> Array:
    """Return the angle (...) [rad] of places (..., 3) about the axis of joint 1."""
    return np.arctan2(place[..., 1], place[..., 0])


def inertia(arm: Arm, position: Array) -> Array:
    """Return the inertia (M,) [kg m^2] of all links about joint 1, as points, at ``position`` (M, n) [rad]."""
    f = frames(arm, position)
    com = f.position + np.einsum("mnij,nj->mni", f.rotation, arm.com)
    return np.asarray((arm.mass * (com[..., :2] ** 2).sum(axis=-1)).sum(axis=-1))


def tried(how: Braking, controller: str, family: ArmFamily) -> str:
    """Drive all arms, and say where their links lay."""
    arm = mycobot280()
    robot, link = open_condition(arm, CONDITIONS[0], family, 1), []
    inner = make_controller(controller, arm)
    driver = Braked(arm, inner, how) if how.way else inner
    targets = draw_targets(arm, sets=family.arms, count=TARGETS, seed=9 + family.seed)
    driven = run(robot, driver, targets, Schedule(dwell=HOLD, keep_going=True), on_cycle=lambda _: link.append(
        (robot.plant.qpos[:, 1] / (0.5 * robot.plant.joints["play"][:, 0])).copy()
    ))  # fmt: skip
    places, shape = np.array(link), targets.shape[:2]
    stopped, lie, beside, off, heavy = (np.full(shape, np.nan) for _ in range(5))
    for i, k in np.ndindex(*shape):
        rows = np.flatnonzero(driven.active[:, i] & (driven.target_index[:, i] == k))
        since, first = driven.since_target[rows, i], driven.position[rows, i, 0]
        moved = np.flatnonzero((np.diff(first) != 0.0) & (since[1:] < BEGIN + how.seconds + 2 * AFTER))
        last = rows[since > HOLD - 0.5]
        if not len(last) or not len(moved):
            continue
        place = tcp_position(arm, driven.position[last, i]).mean(axis=0)
        stopped[i, k], lie[i, k] = places[rows[moved[-1] + 1], i], places[last, i].mean()
        beside[i, k] = np.degrees(azimuth(place) - azimuth(targets[i, k]))
        off[i, k] = 1e3 * np.linalg.norm(place - targets[i, k])
        heavy[i, k] = inertia(arm, driven.position[last[-1:], i])[0]
    apart = [(value - np.nanmean(value, axis=1, keepdims=True)).ravel() for value in (lie, heavy)]
    known = np.isfinite(apart[0])
    explained = np.corrcoef(apart[0][known], apart[1][known])[0, 1] ** 2
    return (
        f"{how.way:3g} {how.seconds:3g} {how.side:+g}: {np.nanmean(stopped):+.2f}, {np.nanstd(stopped):.2f} | "
        f"{np.nanmean(lie):+.2f}, {np.nanstd(lie):.2f}, {within(lie):.2f} | {explained:.0%} | "
        f"{np.nanmean(beside):+.2f}, {np.nanstd(beside):.2f} | {np.nanmean(off):.2f}"
    )


def main() -> None:
    """Print a row for each variant."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.braking", description="Braking joint 1 gently.")
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--family", type=int, default=0)
    parser.add_argument("--controller", default="feedforward")
    options, _ = parser.parse_known_args()
    print("way deg, s, side: link as the motor stops | at the end, within | by inertia | deg beside | encoders mm")
    for how in VARIANTS:
        print(tried(how, options.controller, ArmFamily(arms=options.arms, seed=options.family)), flush=True)


if __name__ == "__main__":
    main()
