"""The worked example of docs/robots.md, installed as a package of its own: its arm goes through the whole chain."""

import dataclasses
import importlib
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.cli import main
from rejoint.control.robot import Robot
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import read_log
from rejoint.robots import open_robot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.training import presets
from rejoint.training.presets import DEFAULT, PpoSettings
from rejoint.training.task import TaskSettings
from rejoint.twin.file import write_twin
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.twin import HeldOut, PredictionError, Twin

ADDRESS = "swing://one"
EXAMPLE = Path(__file__).parents[2] / "examples" / "robot_family"
ARM = mycobot280()
SMALL = dataclasses.replace(
    DEFAULT,
    task=TaskSettings(hold_steps=8),
    ppo=PpoSettings(
        rollout=8, agents=16, iterations=2, mini_batches=2, epochs=2, actor_layers=(16,), critic_layers=(16,)
    ),
)


def install(folder: Path) -> None:
    """Write into ``folder`` what an installer leaves of the example's metadata."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8"
    )
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {what}\n" for name, what in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("".join(lines), encoding="utf-8")


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


def rejoint(capsys, monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["rejoint", *map(str, words), "--json"])
    with pytest.raises(SystemExit) as stopped:
        main()
    said = capsys.readouterr()
    assert stopped.value.code == 0, said.err
    return json.loads(said.out.splitlines()[-1])


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


def test_it_is_diagnosed_deployed_and_repaired(line, tmp_path, capsys, monkeypatch):
    folder, lost = RunFolder(tmp_path / "run"), line.lost
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n180,30,210\n")
    rejoint(capsys, monkeypatch, "diagnose", ADDRESS, "--run", folder.path)
    assert line.lost - lost > 100
    targets = read_log(folder.log("targets"))
    assert targets.robot == ADDRESS
    assert json.loads(folder.diagnosis.read_text())["condition"] == "bad", "its line ends at a worn arm"
    deployed = rejoint(
        capsys, monkeypatch, "deploy", ADDRESS, folder.path, "--controller", "integrator", "--targets", points
    )
    assert max(deployed["error_mm"]) < 5.0
    write_twin(folder.twin, known_twin())
    monkeypatch.setitem(presets.PRESETS, "default", SMALL)
    done = rejoint(
        capsys,
        monkeypatch,
        "repair",
        ADDRESS,
        "--run",
        folder.path,
        "--targets",
        points,
        "--controllers",
        "integrator,policy",
    )
    assert done["recommended"]["controller"] in ("integrator", "policy")
    assert {row["controller"] for row in json.loads(folder.comparison.read_text())["rows"]} == {"integrator", "policy"}
    assert ADDRESS in folder.report.read_text(encoding="utf-8")


def known_twin():
    """What an identification would find: here the stiffness is known."""
    belief = prior(ARM)
    error = PredictionError(joints=(0.01,) * 6, joint=0.01, tcp=1e-3)
    stiffness = load_wear("worn", ARM).position_gain
    return Twin(
        arm=ARM.name,
        joint_names=ARM.joint_names,
        parameters=dataclasses.replace(nominal_parameters(ARM), stiffness=stiffness),
        covariance=np.diag((0.1 * belief.sigma) ** 2),
        lower=belief.lower,
        upper=belief.upper,
        narrowing=np.full(len(belief.mean), 0.1),
        identified=np.ones(len(belief.mean), dtype=bool),
        held_out=HeldOut(seconds=30.0, no_twin=error, healthy_twin=error, twin=error),
        fit_seconds=1.0,
        notes=(),
    )
