"""What a load at the tool costs worn arms, told and untold: holds by three controllers, paths by the tracker, in mm.

    python -m benchmarks payload
    python -m benchmarks payload --load 0.05 --seeds 60007,60015 --controllers feedforward --cases empty,told

Each arm is diagnosed and identified with an empty hand, or its twin is in ``FOLDER/SEED/twin.toml``. Only targets that
are not said to be too heavy count; of the others it is printed how many were missed by more than 2 mm. As before every
motion of the product, the arm first goes to its rest posture: one that is put there has never moved, and a weak joint
may stick there for good (arm 50000 with its load missed the first target by 17 mm, after `begin` by 1.3 mm).
"""

from collections.abc import Callable
from itertools import product
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.frame import NARROW
from rejoint.arms import Arm, Array, gravity_torque, mycobot280
from rejoint.arms.inertia import loaded
from rejoint.arms.postures import find_postures
from rejoint.control.comparison.protocols import metrics_of
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import shelf_controller
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import judge
from rejoint.control.moving.reference import LEAD_IN, PathReference, standard_path
from rejoint.control.moving.tracker import PathPostures, Tracker
from rejoint.control.robot import Controller
from rejoint.control.start import begin, move
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.session.context import believed_motors, heavy, noticed_load
from rejoint.system.errors import InputError
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.evaluate import planned
from rejoint_lab.research.evaluation.family import FAMILY_SIZE, own_twin

LOAD = 0.1  # [kg]
SEEDS = range(50000, 50008)  # of worn arms, those of family 4
DWELL = 8.0  # [s]
PATH = "circle-8s"
CONTROLLERS: dict[str, Callable[[Arm, Twin], Controller]] = {
    "feedforward": lambda arm, twin: FeedforwardController(arm, twin.parameters.stiffness),
    "shelf": lambda arm, _: shelf_controller(arm),
    "predictive": lambda arm, twin: planned(arm, [twin]),
}
CASES = {"empty": (False, False), "untold": (True, False), "told": (True, True)}
"""Whether there is a load, and whether that is told"""


def main(
    seeds: str = ",".join(map(str, SEEDS)),
    twins: FilePath | None = None,
    load: float = LOAD,
    controllers: str = ",".join(CONTROLLERS),
    cases: str = ",".join(CASES),
) -> None:
    """Print a row for each arm, controller and case, and the mean over the arms; ``load`` [kg]."""
    names, chosen = controllers.split(","), cases.split(",")
    arm, rows, judged = mycobot280(), list[tuple[str, str, list[float]]](), np.zeros((2, 2), int)
    targets = draw_targets(arm, sets=1, seed=3)
    postures = find_postures(arm, targets[0], np.broadcast_to(arm.rest, (targets.shape[1], arm.joints)), None)
    heads = f"{'settled':>8} {'time s':>7} {'seems g':>8} {'too heavy':>10} {'joint3 %':>8} {'joint4 %':>8} {PATH:>10}"
    print(f"{'arm':>6} {'driven by':>11} {'case':>7} {heads}")
    with TemporaryDirectory() as folder:
        for seed in map(int, seeds.split(",")):
            place = RunFolder((twins or FilePath(folder)) / str(seed))
            twin = own_twin(arm, seed, place, seed // FAMILY_SIZE - 1)
            too_heavy = np.array([*map(bool, heavy(loaded(arm, load), postures, believed_motors(arm, twin)))])
            light = ~too_heavy
            needs = {case: 100.0 * _needed(arm, seed, load * CASES[case][0], postures) for case in chosen}
            for case, name in product(chosen, names):
                true, told = (load * given for given in CASES[case])
                settled, time, seems = _hold(arm, seed, twin, CONTROLLERS[name], targets, true, told)
                row = [1e3 * settled[light].mean(), time[light].mean()] if light.any() else [np.nan] * 2
                rows.append((name, case, row))
                first = name == names[0]
                missed = f"{1e3 * _follow(arm, seed, twin, true, told):10.2f}" if first else ""
                print(
                    f"{seed:>6} {name:>11} {case:>7} {row[0]:8.2f} {row[1]:7.2f} {1e3 * seems:8.0f} "
                    f"{too_heavy.sum():10d} {needs[case][2]:8.0f} {needs[case][3]:8.0f} {missed}",
                    flush=True,
                )
                if case == "told" and first:
                    for said, off in zip(too_heavy, settled > 2e-3, strict=True):
                        judged[int(said), int(off)] += 1
    for name, case in product(names, chosen):
        own = np.array([row for one, other, row in rows if (one, other) == (name, case)])
        print(f"{'mean':>6} {name:>11} {case:>7} {np.nanmean(own[:, 0]):8.2f} {np.nanmean(own[:, 1]):7.2f}")
    for said, name in enumerate(("not said to be too heavy", "said to be too heavy")):
        print(f"{name}: {judged[said].sum()} targets, {judged[said, 1]} of them missed by more than 2 mm when told")


def _robot(arm: Arm, seed: int, true: float, told: float) -> tuple[EmulatedRobot, Array]:
    """Return a robot that stands at rest, and the command (1, n) [rad] in force."""
    described = loaded(arm, told)
    bodies = None if described is arm else [arm]
    wear = load_wear(f"worn?seed={seed}", arm)
    robot = EmulatedRobot(described, [wear], seed=seed, payload=true, bodies=bodies)
    return robot, begin(robot).command[-1]


def _hold(
    arm: Arm, seed: int, twin: Twin, make: Callable[[Arm, Twin], Controller], targets: Array, true: float, told: float
) -> tuple[Array, Array, float]:
    """Settled errors (K,) [m] and times (K,) [s] to stay within 2 mm, and the mass [kg] that seems to be untold."""
    robot, sent = _robot(arm, seed, true, told)
    recording = run(robot, make(robot.arm, twin), targets, Schedule(dwell=DWELL, sent=sent))
    holds = metrics_of(arm, recording, targets, Protocol(hold=DWELL))
    seems, _ = noticed_load(robot.arm, twin, recording.log(0, "hold")) or (np.nan, np.nan)
    return holds["settled"][0], holds[Protocol().stay_names[NARROW]][0], seems


def _needed(arm: Arm, seed: int, load: float, postures: Array) -> Array:
    """Return the share (n,) of its motors that an arm needs to go on moving, at the posture where that is largest."""
    wear, weight = load_wear(f"worn?seed={seed}", arm), np.abs(gravity_torque(loaded(arm, load), postures))
    return ((weight * (1.0 + wear.load_friction) + wear.coulomb) / wear.torque_limit).max(axis=0)


def _follow(arm: Arm, seed: int, twin: Twin, true: float, told: float) -> float:
    """Root mean square error [m] along a path that is known ahead."""
    path = standard_path(PATH, arm)
    robot, sent = _robot(arm, seed, true, told)
    servos = twin.parameters.repeat(1)
    try:
        home = path.home(robot.arm, believed_motors(robot.arm, twin))
    except InputError:  # too heavy
        return np.nan
    sent = move(robot, PathPostures(robot.arm, path.place[:1], home=home).last[0], sent=sent, settle=0.5).command[-1]
    schedule = Schedule(dwell=LEAD_IN + path.duration, sent=sent)
    recording = run(robot, Tracker(robot.arm, servos), PathReference(robot.arm, [path], home), schedule)
    return judge(arm, recording, path).encoder.rms
