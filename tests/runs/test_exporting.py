"""The controller of a run as files: other runtimes compute the same commands, and a stub of ROS drives an arm."""

import importlib
import json
import os
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import onnxruntime
import pytest
import torch
from ruamel.yaml import YAML
from torch import nn

from commandline import JUDGE, python
from rejoint.arms import mycobot280, so101, tcp_position
from rejoint.control.controllers.catalogue import shelf_controller
from rejoint.control.controllers.feedforward import CommandLaw, FeedforwardController
from rejoint.control.controllers.observation import layout_slots
from rejoint.control.controllers.policy import Policy
from rejoint.control.loop import Schedule, run
from rejoint.robots import open_robot
from rejoint.runs.exports import export_run
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.training.task import DEFAULT
from rejoint.training.train import export_policy, policy_contract

ARM = mycobot280()
BOUND = 1e-5
"""[rad] by which other runtimes may differ"""


def write_policy(path, arm):
    """A policy with a random network, which does something in every cycle."""
    n = arm.joints
    law = CommandLaw(anchor="goal", stiffness=(7.0,) * n, load_penalty=3.0, decay_start=1.0)
    size = sum(slot.size for slot in layout_slots("residual", n))
    torch.manual_seed(1)
    network = nn.Sequential(nn.Linear(size, 16), nn.ELU(), nn.Linear(16, n), nn.Tanh())
    contract = replace(policy_contract(arm, None, DEFAULT, 0), law=law)
    export_policy(path, network, contract)
    return Policy.load(path)


STARTED = 10
"""cycles after which all joints move, and the joint monitor bounds no command"""


def begun(file):
    session = onnxruntime.InferenceSession(file.read_bytes(), providers=["CPUExecutionProvider"])
    return session, np.zeros((1, session.get_inputs()[3].shape[1]), np.float32)


def differences(file, recording):
    """How far (T,) [rad] commands of a file are from recorded ones that guard and monitor left alone."""
    session, memory = begun(file)
    time, n = recording.time[:, 0], recording.position.shape[-1]
    found = []
    for k in range(len(time) - 1):  # in the last row nothing is decided any more
        feed = {
            "joint_pos": recording.position[k],
            "target": recording.aim[k + 1],  # a new one comes with its command
            "period": [[time[k] - time[max(k - 1, 0)]]],
            "state_in": memory,
        }
        if k:
            memory[0, :n] = recording.command[k - 1, 0]  # what the guard left of it
        command, memory = session.run(None, {name: np.asarray(value, np.float32) for name, value in feed.items()})
        if k >= STARTED and not recording.reasons[k, 0]:
            found.append(np.abs(command[0] - recording.command[k, 0]).max())
    return np.array(found)


@pytest.mark.parametrize(("arm", "address"), [(ARM, "emulated:worn"), (so101(), "emulated:so101")])
def test_onnx_runtime_commands_what_our_controller_commands(arm, address, tmp_path):
    about = Run.create(tmp_path, address, arm)
    targets = arm.targets.sample(np.random.default_rng(0), (1, 2))
    policy = write_policy(about.folder.policy, arm)
    given = ((None, policy.controller(arm)), (None, shelf_controller(arm)), ("feedforward", FeedforwardController(arm)))
    for name, controller in given:
        recording = run(open_robot(address, arm=arm), controller, targets, Schedule(dwell=2.5))
        file, _ = export_run(about, "onnx", controller=name)
        found = differences(file, recording)
        assert len(found) > 60
        assert found.max() < BOUND
        about.folder.policy.unlink(missing_ok=True)  # then the run takes the generic policy
    with pytest.raises(InputError):
        export_run(about, "onnx", controller="integrator")


class StubNode:
    """As much of `rclpy.node.Node` as the node that is written needs."""

    def __init__(self, name):
        self.name, self.subscriptions, self.sent, self.said, self.time = name, {}, [], [], 0.0

    def declare_parameter(self, name, value):  # noqa: ARG002
        return SimpleNamespace(value=value)

    def create_publisher(self, kind, topic, depth):  # noqa: ARG002
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message.data)))

    def create_subscription(self, kind, topic, callback, quality):  # noqa: ARG002
        self.subscriptions[topic] = callback

    def create_timer(self, period, callback):
        self.timer = (period, callback)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(1e9 * self.time)))

    def get_logger(self):
        return SimpleNamespace(error=self.said.append, warning=self.said.append)


@pytest.fixture
def ros(monkeypatch):
    """A stub of ROS 2."""
    stubs = {
        "rclpy": {"init": None, "spin": None},
        "rclpy.node": {"Node": StubNode},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "geometry_msgs": {},
        "sensor_msgs": {},
        "std_msgs": {},
        "geometry_msgs.msg": {"PointStamped": SimpleNamespace},
        "sensor_msgs.msg": {"JointState": SimpleNamespace},
        "std_msgs.msg": {"Float64MultiArray": SimpleNamespace},
    }
    for name, content in stubs.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)


def test_a_node_drives_an_arm_to_its_target_and_is_silent_without_joint_states(ros, tmp_path, monkeypatch):
    about = Run.create(tmp_path, "emulated:worn", ARM)
    folder, _ = export_run(about, "ros2")
    needs = {one.text for one in ElementTree.parse(folder / "package.xml").iter("exec_depend")}
    launch = (folder / "launch/controller.launch.py").read_text()
    used = {line.split()[1].partition(".")[0] for line in launch.splitlines() if line.startswith("from ")}
    assert used | {"controller_manager", "rclpy"} <= needs
    parameters = YAML(typ="safe").load((folder / "config/controllers.yaml").read_text())
    assert parameters["rejoint_forward"]["ros__parameters"]["joints"] == list(ARM.joint_names)
    for script in folder.rglob("*.py"):
        compile(script.read_text(), str(script), "exec")
    assert not [
        path for path in folder.rglob("*") if path.is_file() and path.suffix != ".onnx" and b"@P" in path.read_bytes()
    ]
    monkeypatch.syspath_prepend(str(folder))
    node = importlib.import_module("rejoint_mycobot280.node").ControllerNode()

    robot, target = open_robot("emulated:worn", arm=ARM), np.array([0.18, 0.03, 0.21])
    point, header = SimpleNamespace(x=target[0], y=target[1], z=target[2]), SimpleNamespace(frame_id="base_link")
    _, timer = node.timer
    timer()
    assert not node.sent, "nothing is known yet"
    node.subscriptions["/rejoint/target"](SimpleNamespace(header=header, point=point))
    state, order = robot.read(), [3, 1, 2, 0, 5, 4]
    for _ in range(300):
        node.time = float(state.time[0])
        names, places = [ARM.joint_names[j] for j in order], state.position[0, order]
        node.subscriptions["/joint_states"](SimpleNamespace(name=names, position=places))
        timer()
        topic, data = node.sent[-1]
        step = np.clip(np.array(data) - state.position[0], -0.5, 0.5)
        state = robot.step((state.position[0] + step)[None])
    assert topic == "/rejoint_forward/commands"
    assert np.linalg.norm(tcp_position(ARM, state.position[0]) - target) < 3e-3, "a sent target is missed by 20 mm"
    for named, told in ((ARM.joint_names, []), (ARM.joint_names, [np.nan, *places[1:]]), (["gripper"], [0.1])):
        node.subscriptions["/joint_states"](SimpleNamespace(name=list(named), position=told))
    node.subscriptions["/rejoint/target"](SimpleNamespace(header=header, point=SimpleNamespace(x=np.nan, y=0.0, z=0.2)))
    assert "finite numbers in metres; ignored" in node.said[-1]
    timer()
    assert np.isfinite(node.sent[-1][1]).all()
    memory = node.controller.memory.copy()
    with pytest.raises(ValueError, match="expected finite numbers"):
        node.controller.command(state.position[0], (np.nan, 0.0, 0.2), 0.036)
    np.testing.assert_array_equal(node.controller.memory, memory)
    count = len(node.sent)
    node.time += 1.0
    timer()
    assert len(node.sent) == count
    assert "no fresh joint state" in node.said[-1]
    header.frame_id = "camera"
    node.subscriptions["/rejoint/target"](SimpleNamespace(header=header, point=point))
    assert "expected base_link" in node.said[-1]
    assert json.dumps(node.target) == json.dumps(tuple(target))


@pytest.mark.skipif(not (JUDGE / "leapp").is_dir(), reason=f"LEAPP is not in {JUDGE}: `make judge` puts it there")
def test_the_reader_of_nvidia_runs_the_bundle(tmp_path):
    about = Run.create(tmp_path / "run", "emulated:worn", ARM)
    policy = write_policy(about.folder.policy, ARM)
    file, _ = export_run(about, "onnx")
    target = ARM.targets.sample(np.random.default_rng(0), (1, 1))
    recording = run(open_robot("emulated:worn", arm=ARM), policy.controller(ARM), target, Schedule(dwell=2.0))
    period = np.diff(recording.time[:, 0], prepend=recording.time[0, 0])[:, None]
    rows = np.concatenate([recording.position[:, 0], np.repeat(target[0], len(period), axis=0), period], axis=1)
    np.save(tmp_path / "states.npy", rows.astype(np.float32))
    script = Path(__file__).with_name("leapp_judge.py")
    words = (script, file.with_suffix(".yaml"), tmp_path / "states.npy", tmp_path / "out.npy")
    python(*words, env=os.environ | {"PYTHONPATH": str(JUDGE)}, timeout=120)
    session, memory = begun(file)
    for row, command in zip(rows.astype(np.float32), np.load(tmp_path / "out.npy"), strict=True):
        feed = {"joint_pos": row[None, :-4], "target": row[None, -4:-1], "period": row[None, -1:], "state_in": memory}
        expected, memory = session.run(None, feed)
        assert np.allclose(command, expected[0], atol=1e-6)
