"""How near worn arms of a family come to joint goals anywhere, and to those of a hand that leads them.

    python -m benchmarks joints --arms 3 --goals 10

Every arm is diagnosed, identified and calibrated in `--out` first, which takes minutes, or found there. Goals are drawn
in 95 % of the joints' ranges, 5 mm clear of what the arm could touch. `Session.move_joints` goes to them, then
`send_joints` receives them from a hand that rests and jitters by 0.1 degrees. Joints whose true motor cannot hold the
goal are counted apart, and so are ways of the hand that take more than 90 % of a true motor's torque, with friction at
rest. The true tool of the streamed arm is compared with that of a healthy one that gets the same
goals as they are.
"""

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

import rejoint
from rejoint.arms import Arm, Array, JointTrajectory, gravity_torque, load_arm, plan, tcp_position
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.session.session import Session
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import ArmFamily

KINDS = ("mycobot280", "so101")
RESTS = 20.0
"""[s] that an arm is given for a goal"""
MOST = 0.9
"""Share of a motor's torque"""


def clear(arm: Arm, seed: int) -> Iterator[Array]:
    """Joint positions (n,) [rad] anywhere in the workspace, 5 mm clear of what the arm could touch."""
    rng, limits = np.random.default_rng(seed), GuardLimits.of(arm)
    while True:
        goal = rng.uniform(0.95 * arm.lower, 0.95 * arm.upper)
        if (clear_by(limits, goal) > 0.005).all():
            yield goal


def prepare(address: str, arm: Arm, run: Path) -> None:
    """Make a run with a twin and a calibration; without the latter where the guard ends it."""
    if not (run / "twin.toml").exists():
        rejoint.diagnose(address, run=run, arm=arm)
        rejoint.identify(run=run)
    if not (run / "calibration.toml").exists():
        try:
            rejoint.calibrate(address, run=run)
        except rejoint.GuardTripError as error:
            print(f"{run.name}: not calibrated: {error}")


def moved(session: Session, goals: Array) -> Array:
    """Joint errors (K, n) [deg] by the encoders after `move_joints`."""
    errors = []
    for goal in goals:
        try:
            session.move_joints(goal, within_rad=np.radians(0.1), timeout_s=RESTS)
        except rejoint.NotReachedError:
            pass
        except rejoint.GuardTripError as error:
            print(error)
        errors.append(np.degrees(session.state.joints_rad - goal))
    return np.array(errors)


def hand_way(arm: Arm, start: Array, goal: Array) -> JointTrajectory:
    """Way of a hand, which moves at half of the arm's speed."""
    return plan(replace(arm, max_speed=0.5 * arm.max_speed), start, goal)


def streamed(session: Session, robot: EmulatedRobot, goals: Array) -> Array:
    """Distances (2, K) [mm] of a tool from where the hand has it: as the stream sees it, and truly."""
    rng, errors, hand = np.random.default_rng(0), [], session.shown_joints()
    for goal in goals:
        way, hand = hand_way(session.arm, hand, goal), goal
        session.hold()
        began = session.state.time_s
        while (since := session.state.time_s - began) < way.duration + RESTS:
            try:
                session.send_joints(way.at(since) + np.radians(rng.uniform(-0.1, 0.1, len(goal))))
            except rejoint.GuardTripError as error:
                print(error)
            time.sleep(0.002)
        place = tcp_position(session.arm, goal)
        seen = tcp_position(session.arm, session.shown_joints())
        errors.append([1e3 * np.linalg.norm(one - place) for one in (seen, robot.true_tcp()[0])])
    session.stop()
    return np.array(errors).T


def healthy(arm: Arm, goals: Array) -> Array:
    """Return true distances (K,) [mm] of a healthy arm that is sent ``goals`` (K, n) [rad] as they are."""
    robot = EmulatedRobot(arm, [load_wear("healthy", arm)] * len(goals), seed=0)
    sent, most = robot.read().position, 0.02 * arm.max_speed
    for _ in range(500):
        sent = sent + np.clip(goals - sent, -most, most)
        robot.step(sent)
    return 1e3 * np.linalg.norm(robot.true_tcp() - tcp_position(arm, goals), axis=-1)


def light(robot: EmulatedRobot, goals: Array) -> Array:
    """Whether the true motors of the arm carry it along a hand's ways (K,) to ``goals`` (K, n) [rad], from rest."""
    arm, hand, found = robot.arm, robot.arm.rest, []
    most, sticks = (robot.plant.joints[name][0] for name in ("torque_limit", "stiction"))
    for goal in goals:
        way, hand = hand_way(arm, hand, goal), goal
        torque = np.abs(gravity_torque(arm, way.at(np.linspace(0.0, way.duration, 50)))) + sticks
        found.append((torque <= MOST * most).all())
    return np.array(found)


def main(arms: int = 3, goals: int = 10, family: int = 40, out: Path = Path("runs/joints")) -> None:
    """Print joint errors after motions, and tool errors of streams, beside those of healthy arms."""
    for kind in KINDS:
        arm, found, tools, sound = load_arm(kind), list[Array](), list[Array](), list[Array]()
        held, carried = list[Array](), list[Array]()
        for i in range(arms):
            seed = ArmFamily(seed=family).wear_seeds[i]
            address, run = f"emulated:worn?seed={seed}", out / f"{kind}-{seed}"
            prepare(address, arm, run)
            robot = EmulatedRobot(arm, [load_wear(f"worn?seed={seed}", arm)], address=address, seed=seed)
            wanted = np.array([*islice(clear(arm, seed), goals)])
            held.append(np.abs(gravity_torque(arm, wanted)) <= robot.plant.joints["torque_limit"][0])
            carried.append(light(robot, wanted))
            with rejoint.connect(robot, run=run) as session:
                found.append(np.abs(moved(session, wanted)))
                tools.append(streamed(session, robot, wanted))
            sound.append(healthy(arm, wanted))
        joints, tool = (np.concatenate(found), np.concatenate(held)), (np.hstack(tools), np.concatenate(sound))
        report(kind, *joints, *tool, np.concatenate(carried))


def report(kind: str, errors: Array, held: Array, tools: Array, sound: Array, carried: Array) -> None:
    """Print one kind of arm: joint errors (K, n) [deg], tool errors (2, K) and (K,) [mm]."""
    for name, joints in (("held", held), ("too heavy for the motor", ~held)):
        if joints.any():
            print(
                f"{kind} move_joints, {name}: {errors[joints].mean():.3f} deg per joint, largest "
                f"{errors[joints].max():.2f}, over 0.5 deg {(errors[joints] > 0.5).sum()} of {joints.sum()}"
            )
    for what, some in (("", carried), (", too heavy", ~carried)):
        for name, size in (("as the stream sees it", tools[0]), ("true", tools[1]), ("healthy, true", sound)):
            if some.any():
                print(
                    f"{kind} send_joints{what}, {name}: {np.median(size[some]):.2f} mm, largest {size[some].max():.2f}"
                )
        worse = (tools[1] <= sound + 1.0)[some].sum()
        print(f"{kind} send_joints{what}: at most 1 mm worse than healthy {worse} of {some.sum()}")
