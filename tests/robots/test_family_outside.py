"""The worked example of docs/robots.md, installed as a package of its own: its arm goes through the whole chain."""

import dataclasses
import importlib
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from madetwin import made_twin
from rejoint.arms import mycobot280
from rejoint.control.robot import Robot
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.robots import open_robot
from rejoint.training import task
from rejoint.twin.parameters import nominal_parameters
from rejoint_lab.plant.wear import load_wear
from training.test_train import SMALL

ADDRESS = "swing://one"
EXAMPLE = Path(__file__).parents[2] / "examples" / "robot_family"
ARM = mycobot280()
FEW = dataclasses.replace(SMALL, ppo=dataclasses.replace(SMALL.ppo, agents=16, iterations=2))


def install(folder):
    """Write into ``folder`` what an installer leaves of the example's metadata."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {what}\n" for name, what in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("".join(lines))


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """The example, installed; yields the simulated line, which counts what it loses."""
    place = tmp_path_factory.mktemp("site-packages")
    install(place)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        patch.syspath_prepend(str(place))
        yield importlib.import_module("swing_simulated").Line
    for name in ("swing_arm", "swing_simulated"):
        sys.modules.pop(name, None)


def test_it_is_opened_like_any_robot_and_lost_answers_are_asked_for_again(line):
    lost = line.lost
    robot = open_robot(ADDRESS, period=(0.02, 0.02))
    assert isinstance(robot, Robot)
    state = robot.read()
    assert (state.load.shape, state.voltage.shape) == ((1, 6), (1, 6))
    times, goal = [], state.position + 0.1
    for k in range(200):
        state = robot.step(goal + 0.05 * np.sin(0.1 * k))
        times.append(state.time[0])
    robot.stop()
    robot.close()
    periods = np.diff(times)
    assert line.lost - lost >= 4
    assert np.median(periods) == pytest.approx(0.02)
    assert periods.max() >= 0.1, "the line's own patience, once for each"
    assert np.abs(state.position - goal).max() < 0.2


def test_it_is_diagnosed_deployed_and_repaired(line, tmp_path, cli, monkeypatch, few_targets):
    folder, lost = RunFolder(tmp_path / "run"), line.lost
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n180,30,210\n")
    cli("diagnose", ADDRESS, "--run", folder.path)
    assert line.lost - lost > 50
    targets = RunLog.load(folder.log("targets"))
    assert targets.robot == ADDRESS
    assert json.loads(folder.diagnosis.read_text())["condition"] == "bad", "its line ends at a worn arm"
    deployed = cli("deploy", ADDRESS, folder.path, "--controller", "integrator", "--targets", points, "--json")
    assert max(deployed.last["error_mm"]) < 5.0
    known = dataclasses.replace(nominal_parameters(ARM), stiffness=load_wear("worn", ARM).position_gain)
    made_twin(ARM, known).save(folder.twin)
    monkeypatch.setitem(task.PRESETS, "default", FEW)
    words = ("--run", folder.path, "--targets", points, "--controllers", "integrator,policy", "--json")
    assert cli("repair", ADDRESS, *words).last["recommended"]["controller"] in ("integrator", "policy")
    assert {row["controller"] for row in json.loads(folder.comparison.read_text())["rows"]} == {"integrator", "policy"}
    assert ADDRESS in folder.report.read_text()
