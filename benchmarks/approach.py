"""Whether a last slow approach from one side tells where a base joint that floats in its play comes to lie.

    python -m benchmarks.approach --arms 24

Emulated worn arms are calibrated from ten touch points and sent to four fresh targets each. Once the controller has
settled, its target is turned about joint 1 beyond the place (by the play and a margin) and comes back slowly, always
from the same side. All variants hold each target for as long: the controller takes out what is left on the encoders
meanwhile, which is worth as much as an approach. Printed per variant: seconds until the target stands; mean and
standard deviation of where the link of joint 1 lies, in units of half its play, and the latter within an arm; encoder
error; true error, mean / 95th percentile; the same with the mean place of the link taken out by the true play, which is
the best that an aim could make of the approach; and the true error where arms were also measured as they are driven
[mm].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import typer

from benchmarks.frame import cell
from rejoint.arms import Arm, Array, mycobot280, solve_position, tcp_position
from rejoint.control.catalogue import make_controller
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Mask
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.postures import suggest
from rejoint.research.evaluation.calibrating import CONDITIONS, SIGMA, measure, open_condition
from rejoint.research.evaluation.family import ArmFamily
from rejoint.robots.emulated import EmulatedRobot

POINTS, TARGETS = 10, 4
SETTLED = 3.0
"""[s] after which the approach begins"""
OUT = np.radians(10.0)
"""[rad/s] at which the target goes beyond"""
WAIT = 1.0
"""[s] for which it stays there"""
HOLD = 12.5
"""[s] at each target, for any variant: that of the slowest and 4 s of rest; errors are means over the last second"""


@dataclass(frozen=True)
class Approach:
    """A way to come to the place; ``beyond`` [deg], ``speed`` [deg/s] on the way back, ``side`` of joint 1."""

    beyond: float = 0.0
    speed: float = 1.0
    side: float = -1.0

    @property
    def seconds(self) -> float:
        """Time after which the target stands still."""
        return SETTLED + (np.radians(self.beyond) / OUT + WAIT + self.beyond / self.speed if self.beyond else 0.0)

    def turn(self, time: Array) -> Array:
        """Return by how much (B,) [rad] the target is turned about joint 1 at ``time`` (B,) [s] since it was set."""
        most = np.radians(self.beyond)
        back = SETTLED + most / OUT + WAIT
        out = np.clip((time - SETTLED) * OUT, 0.0, most)
        return self.side * (out - np.clip((time - back) * np.radians(self.speed), 0.0, most))

    def came(self, position: Array, before: Array) -> Array:
        """Return where the encoders at ``position`` (..., n) [rad] came from, in place of ``before`` (..., n) [rad]."""
        came = np.array(np.broadcast_to(before, position.shape))
        if self.beyond:
            came[..., 0] = position[..., 0] + self.side * np.radians(self.beyond)
        return came


VARIANTS = (
    Approach(),
    *(Approach(beyond, speed, side) for beyond, speed in ((2, 0.5), (3, 1)) for side in (-1.0, 1.0)),
)


class Approaching:
    """A controller whose target is turned about the base's axis for a while."""

    def __init__(self, inner: Controller, approach: Approach) -> None:
        self._inner, self._approach, self.name = inner, approach, inner.name

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Begin with a new target."""
        self._inner.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the command of the controller for the turned target."""
        return self._inner.command(
            replace(inputs, target=turned(inputs.target, self._approach.turn(inputs.since_target)))
        )


def turned(place: Array, angle: Array) -> Array:
    """Turn places (..., 3) about the axis of joint 1, which stands upright in the base, by ``angle`` (...) [rad]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = place[..., 0], place[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, place[..., 2]], axis=-1)


def aimed(arm: Arm, found: list[Calibration], targets: Array, approach: Approach) -> Array:
    """Aims (A, K, 3) [m] of the ``targets`` one after the other."""
    aims = targets.copy()
    for i, calibration in enumerate(found):
        posture = arm.rest
        for k, target in enumerate(targets[i] if calibration.used else ()):
            came = posture
            for _ in range(4):
                posture = solve_position(arm, aims[i, k], posture).q
                aims[i, k] = target - calibration.shift(posture, approach.came(posture, came))
    return aims


def measured_alike(arm: Arm, family: ArmFamily, controller: str, approach: Approach) -> list[Calibration]:
    """Calibrate all arms from postures that are come to as the targets are: by the controller, from the same side."""
    plan = suggest(arm, POINTS, visits=1, sigma=SIGMA)
    robot = open_condition(arm, CONDITIONS[0], family, 1)
    places = np.broadcast_to(tcp_position(arm, plan.postures), (family.arms, POINTS, 3)).copy()
    _, _, tool, position = held(robot, controller, approach, places)
    before = np.concatenate([np.broadcast_to(arm.rest, position[:, :1].shape), position[:, :-1]], axis=1)
    point = tool + np.random.default_rng([family.seed, 3]).normal(0.0, SIGMA, tool.shape)
    return [
        fit(
            arm,
            Measurements(
                position=position[i],
                approach=approach.came(position[i], before[i]),
                point=point[i],
                sigma=np.full(POINTS, SIGMA),
                posture=plan.posture,
            ),
        )
        for i in range(family.arms)
    ]


def held(robot: EmulatedRobot, controller: str, approach: Approach, aims: Array) -> tuple[Array, Array, Array, Array]:
    """Return where joint 1's link lies (A, K) by half its play, encoder errors (A, K), tools (A, K, 3), encoders."""
    link: list[Array] = []
    driven = run(
        robot,
        Approaching(make_controller(controller, robot.arm), approach),
        aims,
        Schedule(dwell=HOLD, keep_going=True),
        on_cycle=lambda _: link.append((robot.plant.link_position() - robot.plant.encoder())[:, 0]),
    )
    half, places = 0.5 * robot.plant.joints["play"][:, 0], np.array(link)
    shape = aims.shape[:2]
    lie, off, tool = np.full(shape, np.nan), np.full(shape, np.nan), np.full(aims.shape, np.nan)
    position = np.full((*shape, robot.arm.joints), np.nan)
    for i, k in np.ndindex(*shape):
        since, own = driven.since_target[:, i], driven.active[:, i] & (driven.target_index[:, i] == k)
        rows = np.flatnonzero(own & (since > HOLD - 1.0))
        if len(rows):
            lie[i, k] = places[rows, i].mean() / half[i]
            seen = tcp_position(robot.arm, driven.position[rows, i])
            off[i, k] = np.linalg.norm(seen - aims[i, k], axis=-1).mean()
            tool[i, k] = driven.true_tcp[rows, i].mean(axis=0)
            position[i, k] = driven.position[rows, i].mean(axis=0)
    return lie, off, tool, position


def main(arms: int = 24, family: int = 0, controller: str = "feedforward") -> None:
    """Print a row for each variant."""
    arm, drawn = mycobot280(), ArmFamily(arms=arms, targets=TARGETS, seed=family)
    print("beyond deg, deg/s, side: seconds | link mean, spread, within | encoders | true error | best of it | alike")
    measured = measure(open_condition(arm, CONDITIONS[0], drawn, 1), suggest(arm, POINTS, sigma=SIGMA), family)
    usual = [fit(arm, measured.first(i, POINTS)) for i in range(arms)]
    targets = draw_targets(arm, sets=arms, count=TARGETS, seed=9 + family)
    for one in VARIANTS:
        robot = open_condition(arm, CONDITIONS[0], drawn, 1)
        lie, off, tool, _ = held(robot, controller, one, aimed(arm, usual, targets, Approach()))
        best = turned(tool, -np.nanmean(lie) * 0.5 * robot.plant.joints["play"][:, :1])
        found = measured_alike(arm, drawn, controller, one)
        robot = open_condition(arm, CONDITIONS[0], drawn, 1)
        alike = held(robot, controller, one, aimed(arm, found, targets, one))[2]
        errors = (1e3 * np.linalg.norm(place - targets, axis=-1) for place in (tool, best, alike))
        within = np.sqrt(np.nanvar(lie, axis=1, ddof=1).mean())
        print(
            f"{one.beyond:3g} {one.speed:4g} {one.side:+g}: {one.seconds:5.1f} | {np.nanmean(lie):+.2f}, "
            f"{np.nanstd(lie):.2f}, {within:.2f} | {' | '.join(map(cell, (1e3 * off, *errors)))}",
            flush=True,
        )


if __name__ == "__main__":
    typer.run(main)
