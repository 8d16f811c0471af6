"""What the base installation does: it deploys, compares and diagnoses, and for the rest says what it lacks."""

import json
import re
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT, Base
from rejoint.control.comparison.result import Comparison
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.system.extras import EXTRAS
from rejoint.system.files import read_json

COMMANDS = (
    "repair", "diagnose", "identify", "train", "compare", "deploy", "report", "replay", "import", "export", "emulate",
    "research evaluate", "research reproduce", "board",
)  # fmt: skip


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    path.write_text("x,y,z\n170,0,200\n180,30,210\n")
    return path


def test_the_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    listed = subprocess.run(
        ["git", "ls-files", "src"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    kept = {name.removeprefix("src/") for name in listed if (ROOT / name).exists()}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == kept
    assert "rejoint/control/controllers/policies/mycobot280.onnx" in packed


def test_no_extra_is_there(base: Base) -> None:
    modules = [*(module for brought in EXTRAS.values() for module in brought), "pytest", "pandas"]
    found = base.python(f"import importlib.util as u; print([m for m in {modules!r} if u.find_spec(m)])")
    assert found.out.strip() == "[]", found.err


def test_every_command_has_help(base: Base) -> None:
    for name in COMMANDS:
        ended = base.rejoint(*name.split(), "--help")
        assert ended.code == 0, ended.err
        assert "Example" in ended.out


def test_it_deploys(base: Base, complete: RunFolder, arm_at: str, points: Path) -> None:
    words = ("deploy", arm_at, str(complete.path), "--targets", str(points), "--dwell", "4", "--json")
    ended = base.rejoint(*words)
    assert ended.code == 0, ended.err
    errors = json.loads(ended.out.splitlines()[-1])["error_mm"]
    assert len(errors) == 2
    assert max(errors) < 10.0  # what counts as reached; the same arm is about 20 mm off when a target is sent once
    log = RunLog.load(next(path for name, path in complete.logs().items() if name.startswith("deploy")))
    assert log.label == "deploy/policy"
    assert len(np.unique(log.target, axis=0)) == 2
    assert 8.0 < log.time[-1] - log.time[0] < 30.0  # two holds of 4 s each, and ways that wait for joints that lag
    assert np.isfinite(log.position).all()
    assert np.isfinite(log.command).all()


def test_it_deploys_before_anything_is_trained(base: Base, arm_at: str, points: Path) -> None:
    ended = base.rejoint("deploy", arm_at, "--targets", str(points), "--dwell", "4", "--json")
    assert ended.code == 0, ended.err
    told = json.loads(ended.out.splitlines()[-1])
    assert told["controller"] == "shelf"
    assert max(told["error_mm"]) < 5.0  # the same arm is about 20 mm off when a target is sent once


def test_it_compares(base: Base, complete: RunFolder, arm_at: str, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("x,y,z\n170,0,200\n")
    words = (
        "--targets",
        str(tmp_path / "one.csv"),
        "--repetitions",
        "1",
        "--controllers",
        "integrator,policy,predictive",
    )
    ended = base.rejoint("compare", arm_at, str(complete.path), *words)
    assert ended.code == 0, ended.err
    assert "Recommended: " in ended.out
    assert read_json(complete.comparison, Comparison).controllers == ("integrator", "policy", "predictive")


def test_it_judges_and_converts_logs(base: Base, complete: RunFolder) -> None:
    log = str(complete.log("excitation"))
    for words in (
        ("diagnose", "--logs", str(complete.path / "logs"), "--run", "judged"),
        ("export", log, "log.csv"),
        ("import", "log.csv", "imported", "--arm", "mycobot280"),
    ):
        ended = base.rejoint(*words)
        assert ended.code == 0, ended.err


@pytest.mark.parametrize(
    ("words", "extras"),
    [
        ("repair {arm} --run new", "train,report"),
        ("repair", "train,report"),
        ("identify {run}", "train"),
        ("identify --logs {run}/logs --run new", "train,report"),
        ("train {run}", "train"),
        ("train new --generic", "train"),
        ("report {run}", "report"),
        ("replay {run}/twin.toml --logs {run}/logs", "train,report"),
        ("research evaluate", "train,report"),
        ("research tune adaptive", "train"),
        ("research reproduce", "train,report"),
        ("emulate", "train"),
        ("board new.pdf", "camera"),
        ("calibrate {arm} new --measure camera=0", "camera"),
        ("diagnose emulated:worn", "train"),
        ("deploy emulated:worn {run}", "train"),
        ("compare emulated:worn {run}", "train"),
        ("diagnose {arm} --arm arm.urdf", "train"),
        ("export {run}/logs/excitation.parquet log.mcap", "logs"),
        ("import log.mcap new --arm koch", "logs"),
        ("deploy {arm} {run} --live", "live"),
    ],
)
def test_what_needs_more_says_so_in_a_line(
    words: str, extras: str, base: Base, complete: RunFolder, arm_at: str
) -> None:
    (base.home / "arm.urdf").write_text('<robot name="x"><link name="a"/></robot>')
    (base.home / "log.mcap").write_bytes(b"\x89MCAP0\r\n and nothing more")
    before = _files(complete.path)
    ended = base.rejoint(*words.format(arm=arm_at, run=complete.path).split())
    assert ended.code == 2
    assert "Traceback" not in ended.err
    assert len(ended.errors) == 1
    assert re.search(rf"pip install '[^']+\[{extras}\]'", ended.errors[0]), "it names what this was installed from"
    assert not (base.home / "new").exists()
    assert not (base.home / "runs").exists()
    assert _files(complete.path) == before


def _files(folder: Path) -> list[Path]:
    """Return what is in a run folder, without the lock that any command in it may leave."""
    return sorted(path for path in folder.rglob("*") if path.name != ".lock")
