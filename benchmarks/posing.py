"""What is left of poses at rest and along a path by the encoders, on worn arms that nothing was chosen on.

    python -m benchmarks posing
    python -m benchmarks.posing --arms 3 --twins FOLDER

A myCobot 280 is asked for whole orientations and for directions, an SO-101, which has five joints, for directions.
Contenders: the inverse kinematics sent once; the integrator; the inverse of the twin (the feed-forward, which believes
its stiffness) with an integral of place and orientation; the law behind `rejoint serve`, which brings joints to
postures; and the same feed-forward sent to the places alone. Each myCobot is diagnosed and identified first, or its
twin is in ``FOLDER/SEED/twin.toml``; an SO-101 goes by what is assumed of servos of its size.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, mycobot280, so101, solve_position
from rejoint.arms.orientation import WEIGHT, Orientation, tool_axis
from rejoint.arms.posing import NEAR, TURNED, find_postures, missed_pose
from rejoint.arms.rotations import rotation_about
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.default import DefaultController
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.goal import Goal
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, follow, run
from rejoint.control.moving.drive import approach, judge
from rejoint.control.moving.path import Path
from rejoint.control.moving.posture import PathPostures
from rejoint.control.moving.routes import LEAD_IN, Ahead, Routes
from rejoint.control.moving.tracker import Tracker
from rejoint.control.posture import PostureController, Wanted
from rejoint.control.robot import JointState, Mask
from rejoint.control.start import begin
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.identification import identify_arm
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.runs.stages.pathdrive import servos_of
from rejoint.system.progress import no_progress
from rejoint.twin.file import read_twin
from rejoint.twin.twin import Twin

SEEDS = range(10006, 10016)  # of worn arms; the weight of orientations was chosen on 10000 to 10005
COUNT, DWELL, TILT = 6, 6.0, np.radians(25.0)  # poses, [s] for each, [rad] by which they differ from where points are
LENGTH = 8.0  # [s] of the path


class Postures:
    """Brings the joints to the postures of poses, by the law behind `rejoint serve`."""

    name = "posture"

    def __init__(self, arm: Arm, twin: Twin | None) -> None:
        self._goal = Goal(arm)
        known = {} if twin is None else {"stiffness": twin.parameters.stiffness, "offset": twin.parameters.offset}
        self._inner = PostureController(arm, self, **known)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for new poses."""
        self._goal.reset(inputs, where)

    def advance(self, state: JointState) -> Wanted:
        """Return the postures of the poses; the guard says how fast they are gone to."""
        return Wanted(posture=self._goal.position, arrived=np.ones(len(state.time), dtype=bool))

    def command(self, inputs: ControlInput) -> Array:
        """Return what is to be sent (B, n) [rad]."""
        return self._inner.command(inputs)


def inverse_of_twin(arm: Arm, twin: Twin | None) -> Controller:
    return FeedforwardController(arm, None if twin is None else twin.parameters.stiffness)


CONTENDERS: dict[str, Callable[[Arm, Twin | None], Controller]] = {
    "sent once": lambda arm, _: DefaultController(arm),
    "integrator": lambda arm, _: IntegratorController(arm),
    "inverse of the twin": inverse_of_twin,
    "posture law": Postures,
    "the same, place alone": inverse_of_twin,
}


def poses(arm: Arm, whole: bool, seed: int = 1) -> tuple[Array, Orientation]:
    """Places (1, K, 3) [m] that are drawn, with the orientation that a point has there, turned by up to `TILT`."""
    rng, places, rotations = np.random.default_rng(seed), list[Array](), list[Array]()
    while len(places) < COUNT:
        place = arm.targets.sample(rng, (1,))
        axis = rng.normal(size=3)
        tilt = rotation_about(axis / np.linalg.norm(axis), rng.uniform(0.0, TILT))
        rotation = tilt @ frames(arm, solve_position(arm, place, arm.rest[None]).q).tcp_rotation[0]
        turn = asked(arm, rotation[None], whole)
        posture = find_postures(arm, place, arm.rest[None], turn)
        off, angle = missed_pose(arm, posture, place, turn)
        if off[0] < NEAR and angle[0] < TURNED and not collides(arm, frames(arm, posture))[0]:
            places.append(place[0])
            rotations.append(rotation)
    return np.array(places)[None], asked(arm, np.array(rotations)[None], whole)


def asked(arm: Arm, rotation: Array, whole: bool) -> Orientation:
    shape = rotation.shape[:-2]
    return Orientation(
        rotation=rotation, whole=np.full(shape, whole), weight=np.full(shape, WEIGHT), axis=tool_axis(arm)
    )


def held(arm: Arm, seed: int, make: Controller, places: Array, turns: Orientation, *, alone: bool) -> Array:
    """Errors (2, K) in the last second at each pose: of the place [mm], of the orientation [deg]."""
    robot = EmulatedRobot(arm, [load_wear(f"worn?seed={seed}", arm)], seed=seed)
    schedule = Schedule(dwell=DWELL, sent=begin(robot).command[-1])
    found = run(robot, make, places, schedule, turns=None if alone else turns)
    seen = frames(arm, found.position[:, 0])
    index = found.target_index[:, 0]
    off = np.linalg.norm(found.target[:, 0] - seen.tcp_position, axis=-1)
    angle = turns[0][index].angle(seen.tcp_rotation)
    last = found.since_target[:, 0] > DWELL - 1.0
    return np.array([[s * e[last & (index == k)].mean() for k in range(COUNT)] for s, e in
                     ((1e3, off), (np.degrees(1.0), angle))])  # fmt: skip


def followed(arm: Arm, seed: int, twin: Twin, *, turned: bool) -> tuple[float, float]:
    """Root mean square errors [mm], [deg] along a circle on which the tool swings by ten degrees, known ahead."""
    time = np.linspace(0.0, LENGTH, 81)
    round_once = 2.0 * np.pi * time / LENGTH
    centre = 0.5 * (arm.targets.lower + arm.targets.upper)
    wave = np.stack([0.03 * np.cos(round_once), 0.03 * np.sin(round_once), 0.0 * time], axis=-1)
    swing = np.stack([0.17 * np.sin(round_once), 0.17 * np.cos(round_once), -np.ones_like(time)], axis=-1)
    path = Path(time=time, place=centre + wave, direction=swing if turned else None).on(arm)
    robot = EmulatedRobot(arm, [load_wear(f"worn?seed={seed}", arm)], seed=seed)
    tracker = Tracker(arm, servos_of(twin))
    posture = PathPostures(arm, path.place[:1], path.turn_at(np.zeros(1)), tracker.home).last[0]
    sent = approach(robot, posture, begin(robot).command[-1]).command[-1]
    guide = Ahead(path=path)
    schedule = Schedule(dwell=LEAD_IN + LENGTH, sent=sent)
    done = judge(arm, follow(robot, tracker, Routes([guide]), schedule), guide)
    return 1e3 * done.encoder.rms, float(np.degrees(np.nan if done.turned is None else done.turned))


def show(title: str, name: str, found: list[Array]) -> None:
    errors = np.concatenate(found, axis=-1)
    cells = "  ".join(f"{np.mean(e):5.2f} {np.median(e):5.2f} {np.quantile(e, 0.95):5.2f}" for e in errors)
    print(f"{title:<24} {name:<22} {cells}", flush=True)


def main(arms: int = len(SEEDS), twins: FilePath | None = None) -> None:
    """Print means, medians and 95th percentiles over arms and poses."""
    arm, small, seeds = mycobot280(), so101(), list(SEEDS)[:arms]
    print(f"{'poses':<24} {'driven by':<22} {'mm: mean, median, p95':<18}  deg: the same")
    with TemporaryDirectory() as folder:
        known: dict[int, Twin] = {}
        for seed in seeds:
            place = RunFolder((twins or FilePath(folder)) / str(seed))
            if not place.twin.exists():
                identify_arm(arm, seed, place, seed, no_progress)
            known[seed] = read_twin(place.twin, arm)
    for title, own, whole in (
        ("mycobot280, whole", arm, True), ("mycobot280, direction", arm, False), ("so101, direction", small, False),
    ):  # fmt: skip
        places, turns = poses(own, whole)
        for name, make in CONTENDERS.items():
            alone = name.endswith("alone")
            found = [
                held(own, seed, make(own, known[seed] if own is arm else None), places, turns, alone=alone)
                for seed in seeds
            ]
            show(title, name, found)
    for turned in (True, False):
        rms = [np.array(followed(arm, seed, known[seed], turned=turned))[:, None] for seed in seeds]
        show("mycobot280, along a path", "tracker" if turned else "tracker, place alone", rms)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Poses on worn arms.")
    parser.add_argument("--arms", type=int, default=len(SEEDS))
    parser.add_argument("--twins", type=FilePath, help="folder of twins by seed; by default they are identified")
    options = parser.parse_args()
    main(options.arms, options.twins)
