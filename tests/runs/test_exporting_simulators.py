"""What was learned about servos leaves for other programs: MuJoCo, Isaac Lab and LeRobot."""

import json
import sys
import types
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_gains import found_by

from madetwin import made_twin
from rejoint.arms import gravity_torque, mycobot280, so101
from rejoint.diagnosis.excitation import record
from rejoint.logs.exclusions import velocity
from rejoint.logs.runlog import RunLog
from rejoint.robots import open_robot
from rejoint.runs.exports import export_run
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError
from rejoint.twin.identify import EXCITATION_WINDOW, HOLD_OUT, identify
from rejoint.twin.parameters import TwinParameters, nominal_parameters, prior
from rejoint.twin.replay import VELOCITY, Replay, Window, cut

LEAD = 40
"""Rows before a window, for references and commands on their way"""


def predicted(path, window):
    """Positions (rows, n) [rad] of a window by MuJoCo alone, from the measured state at its begin."""
    model, log = mujoco.MjModel.from_xml_path(str(path)), window.log
    data, n = mujoco.MjData(model), len(log.joint_names)
    first, speed, found = max(window.first - LEAD, 0), velocity(log.time, log.position, VELOCITY), []
    data.time, data.act[:n] = log.time[first], log.command[first]
    data.qpos[:], data.ctrl[:] = log.position[first], log.command[first]
    for row in range(first, window.last):
        if row == window.first:
            data.qpos[:], data.qvel[:] = log.position[row], speed[row]
        while data.time < log.time[row] - 0.5 * model.opt.timestep:
            mujoco.mj_step(model, data)
        if row >= window.first:
            found.append(data.qpos.copy())
        data.ctrl[:] = log.command[row]
    return np.array(found)


def rms(paths, measured):
    return np.sqrt(np.mean((np.concatenate(paths) - measured) ** 2))


@pytest.mark.parametrize("address", ["emulated:worn", "emulated:so101"])
def test_mujoco_alone_predicts_what_the_twin_predicts(address, tmp_path, few_targets):
    robot = open_robot(address)
    arm, logs = robot.arm, [one.excitation for one in record(robot, seed=0)]
    twin = identify(arm, logs)
    run = Run.create(tmp_path, address, arm)
    twin.save(run.folder.twin)
    path, _ = export_run(run, "mjcf")
    windows = cut(logs, EXCITATION_WINDOW)[HOLD_OUT - 1 :: HOLD_OUT]
    replay = Replay(arm, windows)
    measured = replay.measured
    p, load = twin.parameters, np.abs(gravity_torque(arm, measured)).max(axis=0)
    # A weaker joint breaks loose, or does not, by the least difference.
    starts = p.torque_limit > load + p.stiction * p.coulomb
    assert starts.sum() >= arm.joints - 1
    ours = rms(replay.predict(p.repeat(1))[..., starts], measured[:, starts])
    alone = [predicted(path, window)[:, starts] for window in windows]
    assert rms(alone, measured[:, starts]) < 1.1 * ours


def unreached(arm):
    """The torque limits of a fit to motion that does not reach them."""
    return np.exp(prior(arm).upper[prior(arm).layout.at("torque_limit")])


@pytest.mark.parametrize("share", [0.9, -0.5])
def test_mujoco_gets_the_gravity_that_does_not_show_and_no_limit_that_no_motion_reached(share, tmp_path):
    arm, time = mycobot280(), np.arange(0.0, 8.0, 0.02)
    parameters = replace(nominal_parameters(arm), coulomb=0.01, compensation=share, torque_limit=unreached(arm))
    run = Run.create(tmp_path, "emulated:worn", arm)
    made_twin(arm, parameters).save(run.folder.twin)
    path, _ = export_run(run, "mjcf")
    command = arm.rest + 0.4 * np.sin(np.multiply.outer(time, np.linspace(0.5, 1.5, arm.joints)))
    log = RunLog.of(time, command, command, arm=arm.name)
    replay = Replay(arm, [Window(log=log, first=0, last=len(time))])
    ours, without = replay.predict(TwinParameters.stacked([parameters, replace(parameters, compensation=0.0)]))
    assert rms([predicted(path, replay.windows[0])], ours) < 0.2 * rms([without], ours)
    assert not mujoco.MjModel.from_xml_path(str(path)).actuator_forcelimited.any()


def test_isaac_lab_gets_the_servos_of_the_twin(tmp_path, monkeypatch):
    arm = so101()
    parameters = replace(nominal_parameters(arm), stiction=1.5, delay=0.021, offset=0.01)
    limits = parameters.torque_limit * [1.0, 1.0, 1.0, 1.0, np.inf]
    run = Run.create(tmp_path, "emulated:so101", arm)
    with pytest.raises(FileError, match="rejoint identify"):
        export_run(run, "isaaclab")
    made_twin(arm, replace(parameters, torque_limit=np.minimum(limits, unreached(arm)))).save(run.folder.twin)
    stub = types.ModuleType("isaaclab.actuators")
    stub.DelayedPDActuatorCfg = SimpleNamespace
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", stub)
    found = {}
    exec(export_run(run, "isaaclab")[0].read_text(), found)
    servos = found["ACTUATORS"]["arm"]
    assert servos.joint_names_expr == list(arm.joint_names)
    assert servos.min_delay == servos.max_delay == round(0.021 / found["PHYSICS_STEP"])
    same = {"stiffness": "stiffness", "damping": "damping", "armature": "armature"}
    for theirs, ours in (same | {"dynamic_friction": "coulomb"}).items():
        values = dict(zip(arm.joint_names, getattr(parameters, ours), strict=True))
        assert getattr(servos, theirs) == pytest.approx(values, rel=1e-4)
    assert list(servos.effort_limit.values()) == pytest.approx(limits, rel=1e-4)
    assert servos.friction == pytest.approx(
        {name: 1.5 * one for name, one in servos.dynamic_friction.items()}, rel=1e-4
    )
    assert set(found["OFFSET"].values()) == {0.01}


def test_gains_that_were_found_leave_in_the_words_of_lerobot(tmp_path):
    run = Run.create(tmp_path, "emulated:so101", so101())
    with pytest.raises(InputError, match="rejoint gains ROBOT"):
        export_run(run, "lerobot")
    with pytest.raises(InputError, match="mycobot280 has none"):
        export_run(Run.create(tmp_path / "other", "emulated:worn", mycobot280()), "lerobot")
    alone = found_by(run).alone
    motors = json.loads(export_run(run, "lerobot")[0].read_text())
    assert [motors[name]["P_Coefficient"] for name in run.arm.joint_names] == [*alone["p"]]
    assert [motors[name]["I_Coefficient"] for name in run.arm.joint_names] == [*alone["i"]]
    assert motors["shoulder_lift"]["Minimum_Startup_Force"] == alone["startup"][1] + 256 * alone["limit"][1]
