"""The front door: light to import, complete, documented; every stage alone on arrays; the files of the commands."""

from pathlib import Path

import numpy as np
import pytest

import rejoint
from commandline import python
from hearing import Hears
from rejoint.arms import mycobot280
from rejoint.control.controllers.classical import IntegratorController
from rejoint.session.context import ControllerMaker

ARM = mycobot280()
TARGETS = [[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]]
HEAVY = ("torch", "mujoco", "numba", "matplotlib", "scipy", "pyarrow", "onnxruntime", "numpy", "typer", "rich")


def test_importing_it_loads_nothing_heavy():
    code = f"import sys, rejoint; print(sorted({set(HEAVY)!r} & set(sys.modules)), dir(rejoint)[:3])"
    assert python("-c", code).out.startswith("[] ['AddressError', 'Arm', ")


def test_every_name_is_there_for_python_and_for_type_checkers():
    for name in rejoint.__all__:
        found = getattr(rejoint, name)
        assert isinstance(found, str) or found is rejoint.Progress or found.__module__.startswith("rejoint."), name
    assert {"Arm", "repair", "__version__"} <= set(rejoint.__all__) <= set(dir(rejoint))
    with pytest.raises(AttributeError, match="no attribute 'repare'"):
        rejoint.repare  # noqa: B018


@pytest.fixture(scope="module")
def motion():
    """A worn arm that swings all its joints, as arrays from a loop of one's own."""
    robot = rejoint.open_robot("emulated:worn")
    state, rows = robot.read(), []
    while state.time[0] < 60.0:
        swing = np.sin(2 * np.pi * state.time[0] / np.array([11.0, 13.0, 17.0, 7.0, 9.0, 5.0]))
        rows.append((state.time[0], ARM.rest + 0.25 * swing * min(state.time[0] / 3.0, 1.0), state.position[0]))
        state = robot.step(rows[-1][1][None])
    time, command, position = (np.array(column) for column in zip(*rows, strict=True))
    return rejoint.RunLog.of(time, command, position, arm="mycobot280")


def test_every_stage_works_on_data_in_memory(motion, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen: list[float] = []
    found = rejoint.diagnose(motion, observer=Hears(progress=lambda share, _: seen.append(share)))
    assert found.diagnosis.condition in ("worn", "bad")
    assert seen == sorted(seen)
    assert seen[0] == 0.0
    twin = rejoint.identify([motion])
    predicted = rejoint.replay(twin, motion).positions[0]
    assert predicted.shape == motion.position.shape
    lag = np.sqrt(np.mean((motion.command - motion.position) ** 2))
    assert np.sqrt(np.mean((predicted - motion.position) ** 2)) < lag

    policy = rejoint.train(twin, quick=True)
    action = policy(np.zeros(policy.contract.observation_size))
    assert action.shape == (6,)
    np.testing.assert_array_equal(policy(np.zeros((2, policy.contract.observation_size))), [action, action])
    policy.save("policy.onnx")
    assert rejoint.Policy.load("policy.onnx").content == policy.content
    compared = rejoint.compare(
        "emulated:worn",
        ["integrator", policy],
        TARGETS[:1],
        plan=rejoint.TrialPlan(repetitions=1),
        settings=rejoint.Settings(twin=twin),
    )
    assert compared.comparison.controllers == ("integrator", "policy")
    assert set(compared.logs) == {
        f"{kind}-{name}-0-0" for kind in ("crossing", "hold") for name in ("integrator", "policy")
    }
    done = rejoint.deploy("emulated:worn", TARGETS, settings=rejoint.Settings(controller=policy, dwell=1.0))
    assert [len(visit.target) for visit in done.visits] == [3, 3]
    assert 2.0 < done.log.time[-1] - done.log.time[0] < 4.0, "two targets of a second each, and the ways there"
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"], "nothing else is written"


def test_an_open_robot_stays_open(monkeypatch):
    robot = rejoint.open_robot("emulated:worn")
    monkeypatch.setattr(type(robot), "close", lambda _: pytest.fail("closed"))
    assert (
        rejoint.deploy(robot, TARGETS[:1], settings=rejoint.Settings(controller="integrator", dwell=1.0)).log
        is not None
    )
    found = rejoint.compare(robot, ["integrator"], TARGETS[:1], plan=rejoint.TrialPlan(repetitions=1))
    assert found.comparison.controllers == ("integrator",)
    assert not found.comparison.batched


def test_controllers_come_in_every_form():
    own = IntegratorController(ARM)
    found = ControllerMaker(ARM, None).factories(["default", own, lambda arm: IntegratorController(arm)])
    assert list(found) == ["default", "integrator", "controller"]
    assert found["integrator"](ARM) is own
    assert isinstance(found["controller"](ARM), IntegratorController)
    assert list(ControllerMaker(ARM, None).factories([own, IntegratorController])) == ["integrator", "integrator-2"]
    assert list(ControllerMaker(ARM, None).factories({"mine": "integrator"})) == ["mine"]
    assert list(ControllerMaker(ARM, None).factories(own)) == ["integrator"]
    with pytest.raises(rejoint.InputError, match="known controllers"):
        ControllerMaker(ARM, None).factories(["magic"])


def test_a_command_and_its_function_write_the_same_files(motion, tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)
    motion.save(tmp_path / "logs" / "motion.parquet")
    cli("diagnose", "--logs", "logs", "--run", "command")
    run = rejoint.Run.plan("function", "logs:logs", ARM)
    assert rejoint.diagnose(Path("logs"), run=run).verdict == run.diagnosis.verdict
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n")
    few = ("--targets", points, "--repetitions", "1", "--controllers", "integrator")
    cli("compare", "emulated:worn", "command", *few)
    rejoint.compare("emulated:worn", ["integrator"], points, run="function", plan=rejoint.TrialPlan(repetitions=1))
    names = (
        "diagnosis.json",
        "comparison.json",
        "logs/crossing-integrator-0-0.parquet",
        "logs/hold-integrator-0-0.parquet",
    )
    for name in names:
        assert (tmp_path / "command" / name).read_bytes() == (tmp_path / "function" / name).read_bytes(), name
    with pytest.raises(rejoint.InputError, match="is a run of logs:logs"):
        rejoint.diagnose("emulated:worn", run="function")
