"""An arm is looked at before it is moved, and moved slowly then."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rejoint.arms import gravity_torque, load_arm, mycobot280
from rejoint.control.loop import say_faulty
from rejoint.control.robot import JointState
from rejoint.control.start import Stance, begin, check_ready, look_at_servos
from rejoint.logs.runlog import RunLog
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from rejoint.session.context import stance_of
from rejoint.system.errors import NotReadyError
from rejoint_lab.plant.wear import load_wear
from standin import StandIn

ARM = mycobot280()


class Standing(StandIn):
    """One arm that stands where it is put, on a clock that goes on."""

    def __init__(self, position=ARM.rest, drift=0.0, **health):
        super().__init__(period=0.04, start=position)
        self.drift, self.health, self.sent = drift, health, []

    def read(self):
        self.time = self.time + 0.01
        self.position = self.position + self.drift
        return super().read(**self.health)

    def moved(self, command):
        self.sent.append(command[0].copy())
        return command.copy()


def heat(joint, degrees):
    return np.where(np.arange(6) == joint, degrees, 30.0)[None]


@pytest.mark.parametrize(
    ("robot", "why"),
    [
        (Standing(np.where(np.arange(6) == 1, ARM.upper + 0.2, ARM.rest)), "joint2 stands at .* outside its limits"),
        (Standing(drift=np.eye(6)[3] * 0.1), "joint4 is moving by itself"),
        (Standing(temperature=heat(2, 62.0)), "joint3 is at 62 deg C, limit 60"),
        (Standing(temperature=heat(2, 255.0)), "not believed"),
        (Standing(fault=np.eye(6, dtype=bool)[4:5]), "joint5 reports a servo fault"),
    ],
)
def test_an_arm_in_no_state_to_be_driven_is_not_moved(robot, why):
    with pytest.raises(NotReadyError, match=why):
        begin(robot)
    assert robot.sent == []


class Crossed(Standing):
    """Tells ``told(q)`` of where it is, and its servos take 5 degrees in a period, as in an arm of full speed."""

    def __init__(self, told, position):
        super().__init__(position)
        self.told = told

    def read(self):
        state = super().read()
        return replace(state, position=self.told(state.position))

    def moved(self, command):
        return self.position + np.clip(super().moved(command) - self.position, -np.radians(5.0), np.radians(5.0))


def reversed_in(joint):
    return lambda q: np.where(np.arange(6) == joint, -q, q)


@pytest.mark.parametrize(
    ("told", "start_deg", "joint"),
    [
        (reversed_in(1), [0.0, -60.0, -60.0, 0.0, 0.0, 0.0], "joint2"),
        (reversed_in(0), [0.0, 0.0, -60.0, 0.0, 0.0, 0.0], "joint1"),
        (lambda q: q[:, [0, 2, 1, 3, 4, 5]], [0.0, -20.0, -60.0, 0.0, 0.0, 0.0], "joint[23]"),
    ],
    ids=["turned round", "turned round, from where that does not show", "exchanged"],
)
def test_a_joint_that_goes_where_it_is_not_sent_is_stopped_at_once(told, start_deg, joint):
    robot = Crossed(told, np.radians(start_deg))
    with pytest.raises(NotReadyError, match=f"{joint} was sent no farther than .* its reading is another joint's"):
        begin(robot)
    gone = np.degrees(np.abs(robot.position - np.radians(start_deg))).max()
    assert robot.stops == 1
    assert gone < 40.0


class Lying(Standing):
    """Its joint 2 has no torque."""

    def moved(self, command):
        return np.where(np.arange(6) == 1, self.position, super().moved(command))


def test_an_arm_that_lies_where_it_is_not_sent_is_not_driven():
    robot = Lying(ARM.rest + np.radians(25.0) * np.eye(6)[1])
    with pytest.raises(NotReadyError, match="joint2 is 25 deg from the rest posture"):
        begin(robot)
    begin(Lying(ARM.rest + np.radians(15.0) * np.eye(6)[1]))


@pytest.mark.parametrize("wear", ["worn?payload=0.25", "worn?seed=3&payload=0.25", "play-in-loop", "so101"])
def test_an_arm_may_sag_from_the_place_at_which_it_is_taken_over(wear):
    robot = open_robot(f"emulated:{wear}")
    for _ in range(2):
        begin(robot)


def test_the_first_motion_is_slow():
    robot = Standing(ARM.rest + 0.5)
    recording = begin(robot)
    steps = np.abs(np.diff([ARM.rest + 0.5, *robot.sent], axis=0)).max(axis=1)
    assert steps.max() <= 0.5 * 0.05 + 1e-9  # half a radian per second
    np.testing.assert_allclose(recording.command[-1, 0], ARM.rest)


@pytest.mark.parametrize("wear", [*(f"worn?seed={seed}" for seed in range(4)), "healthy", "play-in-loop", "worn"])
def test_worn_arms_stand_where_a_rough_twin_expects_them(wear):
    robot = open_robot(f"emulated:{wear}")
    found = load_wear(wear, ARM)
    for error in (0.8, 1.0, 1.25):
        begin(robot, stance=Stance(stiffness=error * found.position_gain, offset=np.zeros(6)))


def test_a_joint_may_stand_as_far_off_as_in_its_own_diagnosis_and_no_other_joint():
    weak = np.arange(6) == 3
    stance = Stance(stiffness=np.full(6, 8.0), offset=np.zeros(6), off=np.where(weak, np.radians(20.0), 0.0))
    command = ARM.rest[None]
    settled = Standing((command - gravity_torque(ARM, command) / 8.0)[0]).read()
    for joint, away_deg, fine in ((3, 24.0, True), (3, 27.0, False), (2, 14.0, True), (2, 17.0, False)):
        state = replace(settled, position=settled.position - np.eye(6)[joint] * np.radians(away_deg))
        if fine:
            stance.check(ARM, state, command)
        else:
            with pytest.raises(NotReadyError, match=f"joint{joint + 1} stands .* {25 if joint == 3 else 15} at most"):
                stance.check(ARM, state, command)


def test_a_run_tells_how_far_its_arm_stood_off_in_its_diagnosis(tmp_path):
    twin = SimpleNamespace(parameters=SimpleNamespace(stiffness=np.full(6, 8.0), offset=np.zeros(6), compensation=0.0))
    run = Run.create(tmp_path, "emulated:worn", ARM)
    assert stance_of(None, run) is None
    assert np.all(stance_of(twin, run).off == 0.0)
    rows = np.repeat([[0.2, 0.0, 0.2], [0.15, 0.05, 0.2]], 3, axis=0)
    position = np.tile(ARM.rest, (6, 1))
    command = position + gravity_torque(ARM, position) / 8.0
    command[1, 3] += np.radians(20.0)  # where the first target ends; on the way to the next one it does not count
    command[2:4, 2] += np.radians(50.0)
    log = RunLog.of(0.6 * np.arange(6.0), command, position, arm=ARM, label="targets", target=rows, true_tcp=rows)
    log.save(run.folder.log("targets"))
    np.testing.assert_allclose(np.degrees(stance_of(twin, run).off), [0.0, 0.0, 0.0, 20.0, 0.0, 0.0], atol=1e-9)


def test_virtual_time_is_not_waited_for():
    check_ready(open_robot("emulated:worn", count=3))


def test_a_servo_that_starves_is_told_from_one_that_is_blocked():
    names, both, first = ("shoulder", "elbow"), np.array([True, True]), np.array([True, False])
    sags = "the supply sags to 8.5 V from 12.1 V"
    starved = say_faulty(names, both, (sags, sags))
    assert starved.startswith(f"shoulder, elbow report a servo fault ({sags}); look at its supply")
    assert say_faulty(names, both, (f"voltage, {sags}", "")) == starved.replace(sags, f"voltage; {sags}")
    blocked = say_faulty(names, both, ("voltage", "overload"))
    assert blocked.endswith("(voltage; overload); free the arm and clear the fault")
    assert say_faulty(names, first) == "shoulder reports a servo fault; free the arm and clear the fault"


@pytest.mark.parametrize(
    ("away", "volts", "named"),
    [
        (1.0, (12.0, 12.0, 5.0, 5.0, 5.0), set()),
        (4.0, (12.0, 12.0, 5.0, 5.0, 5.0), {"beyond its limit"}),
        (0.0, (12.0, 12.0, 5.0, 3.9, 5.0), {"supply"}),
    ],
)
def test_servos_are_judged_as_the_start_does_and_each_kind_by_its_own_supply(away, volts, named):
    arm = load_arm("koch")
    position = arm.rest.copy()
    position[0] = arm.upper[0] + np.radians(away)
    state = JointState(time=np.zeros(1), position=position[None], age=np.zeros(1), voltage=np.array([volts]))
    found = list(look_at_servos(arm, state))
    assert {symptom.found.partition(":")[0] for symptom in found if symptom.fix} == named
