"""Payloads and tools: told to everything that computes, refused by no policy, noticed where nobody told."""

from dataclasses import replace

import numpy as np
import pytest

import rejoint
from hearing import Hears
from madetwin import made_calibration
from rejoint.arms import (
    Displacement,
    gravity_torque,
    mycobot280,
    position_kinematics,
    solve_position,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.inertia import Payload, bare, loaded
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.postures import find_postures
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.diagnosis.calibration.calibration import write_calibration
from rejoint.robots import open_robot, place_of
from rejoint.runs.run import Run
from rejoint.session.context import guard_limits
from rejoint.session.inputs import as_calibration
from runs.test_connect import a_twin
from runs.test_exporting import write_policy
from standin import inputs_of, state_of

ARM = mycobot280()
TARGETS = [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21], [0.16, -0.05, 0.22]]


@pytest.fixture
def run(tmp_path):
    path = Run.create(tmp_path / "run", "emulated:worn", ARM).path
    a_twin().save(path / "twin.toml")
    return path


def test_a_payload_pulls_on_joints_by_its_lever_and_a_tool_moves_the_tip():
    posture = ARM.rest + 0.2
    torque = gravity_torque(loaded(ARM, 0.1), posture) - gravity_torque(ARM, posture)
    np.testing.assert_allclose(torque, -0.1 * position_kinematics(ARM, posture)[1].T @ GRAVITY, atol=1e-12)
    away = loaded(ARM, Payload(mass=0.1, com=(0.0, 0.0, 0.05)), [0.0, 0.02, 0.08])
    pose = tcp_pose(ARM, posture)
    np.testing.assert_allclose(tcp_position(away, posture), pose[:3, 3] + pose[:3, :3] @ [0.0, 0.02, 0.08])
    levers = position_kinematics(loaded(ARM, tool=[0.0, 0.0, 0.05]), posture)[1]
    torque = gravity_torque(away, posture) - gravity_torque(ARM, posture)
    np.testing.assert_allclose(torque, -0.1 * levers.T @ GRAVITY, atol=1e-12)
    assert bare(away) is ARM
    assert loaded(ARM) is ARM
    for payload, tool in ((-0.1, None), (20.0, None), (None, [0.0, 80.0, 0.0]), (None, [0.1])):
        with pytest.raises(rejoint.InputError, match="expected"):
            loaded(ARM, payload, tool)


def test_an_emulated_arm_carries_what_its_address_says_whatever_was_told():
    stands = {}
    for address, told in (("emulated:worn", 0.0), ("emulated:worn?payload=0.1", 0.0), ("emulated:worn", 0.1)):
        robot = open_robot(address, arm=loaded(ARM, told))
        for _ in range(80):
            state = robot.step(ARM.rest[None])
        stands[address, told] = state.position[0]
    empty = stands["emulated:worn", 0.0]
    np.testing.assert_array_equal(stands["emulated:worn", 0.1], empty)
    assert np.abs(stands["emulated:worn?payload=0.1", 0.0] - empty).max() > np.radians(0.5)
    assert place_of("emulated:worn?payload=0.1&seed=3").detail.profile == "worn?seed=3"
    assert place_of("emulated:worn?seed=3&payload=0.2").unloaded == "emulated:worn?seed=3"
    with pytest.raises(rejoint.AddressError, match="mass in kg"):
        place_of("emulated:worn?payload=much")


def test_an_untold_load_is_noticed_and_a_told_one_is_not(run):
    def noticed(address, targets, **given):
        said, settings = [], rejoint.Settings(controller="feedforward", **given)
        rejoint.deploy(address, targets, run=run, settings=settings, observer=Hears(message=said.append))
        return any("hand carried" in line for line in said)

    near = [[0.13, 0.1, 0.2], [0.1, 0.13, 0.22], [0.13, -0.1, 0.2], [0.14, 0.02, 0.2], [0.1, -0.12, 0.22]]  # lifted
    assert noticed("emulated:worn?payload=0.1", near, dwell=6.0)
    assert not noticed("emulated:worn?payload=0.1", near, dwell=6.0, payload=0.1)
    assert not noticed("emulated:worn", TARGETS, dwell=3.0)
    assert not noticed("emulated:worn", [[0.13, 0.1, 0.1]], dwell=3.0), "friction seems to carry 160 g of this arm"


def test_a_told_load_raises_commands_by_what_a_servo_gives_way():
    state = state_of(ARM.rest)
    target = np.array(TARGETS[:1])
    inputs = inputs_of(state, target, find_postures(ARM, target, ARM.rest[None], None), ARM.rest[None])
    commands = []
    for arm in (ARM, loaded(ARM, 0.1)):
        controller = FeedforwardController(arm, 7.0)
        controller.reset(inputs, np.ones(1, dtype=bool))
        commands.append(controller.command(inputs)[0])
    posture = solve_position(ARM, target, ARM.rest[None]).q[0]
    expected = -0.1 * position_kinematics(ARM, posture)[1].T @ GRAVITY / 7.0
    np.testing.assert_allclose(commands[1] - commands[0], expected, atol=1e-9)
    assert np.abs(expected).max() > np.radians(1.0)


def test_a_load_that_no_motor_lifts_is_refused_before_anything_moves(run):
    with rejoint.connect("emulated:worn", run=run, settings=rejoint.Settings(payload=0.4)) as arm:
        with pytest.raises(rejoint.InputError, match=r"too heavy: joint3 needs .* per cent .* the nearest place"):
            arm.move_to([0.2, 0.0, 0.12], timeout_s=0.5)
        assert arm.state.time_s == 0.0
    settings = rejoint.Settings(controller="feedforward", payload=0.1)
    with pytest.raises(rejoint.InputError, match="address"):
        rejoint.deploy(open_robot("emulated:worn"), TARGETS, run=run, settings=settings)


def test_a_policy_drives_its_arm_with_a_told_load_and_guard_and_calibration_are_those_of_the_arm(run):
    policy = write_policy(run / "policy.onnx", ARM)
    told = loaded(ARM, 0.1, [0.0, 0.0, 0.03])
    assert policy.controller(told).arm is told
    about = Run.open(run)
    assert guard_limits(about, told, "emulated:worn?payload=0.1").arm is told
    with pytest.raises(rejoint.ContractError, match="another"):
        policy.controller(replace(ARM, mass=told.mass))


def test_a_calibrated_arm_takes_a_tool_and_a_payload_and_aims_by_them(run):
    askew = replace(Displacement.none(ARM), offset=np.array([0.0, 0.01, -0.01, 0.0, 0.0, 0.0]))
    own = made_calibration(ARM, askew)
    write_calibration(run / "calibration.toml", own)
    told = loaded(ARM, 0.1, [0.0, 0.0, 0.05])
    for given in (None, own):
        found = as_calibration(given, Run.open(run), told)
        assert found.arm is told, "it says where this tool is"
        assert np.linalg.norm(found.tool(ARM.rest) - tcp_position(told, ARM.rest + askew.offset)) < 1e-9
    done = rejoint.deploy(
        "emulated:worn",
        TARGETS[:1],
        run=run,
        settings=rejoint.Settings(controller="feedforward", dwell=2.0, tool=[0.0, 0.0, 0.02]),
    )
    shift = done.log.aim[-1] - done.log.target[-1]
    assert 1e-3 < np.linalg.norm(shift) < 5e-3
    own.require(told)
    with pytest.raises(rejoint.ContractError, match="differ in tip"):
        own.require(replace(ARM, tip=told.tip))
