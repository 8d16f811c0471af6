"""Files that are damaged, too large or something else: one error that names the file, never another result."""

import os
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from torch import nn

from madetwin import made_twin
from rejoint.arms import load_arm, mycobot280, write_arm_toml
from rejoint.control.controllers.policy import load_policy
from rejoint.control.targets import read_targets
from rejoint.logs import runlog
from rejoint.logs.runfolder import FORMAT, RunInfo, read_info
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.page import read_curves
from rejoint.runs.run import Run
from rejoint.system.errors import ContractError, FileError, InputError
from rejoint.system.files import read_json, write_json
from rejoint.training.learner import CurvePoint
from rejoint.training.train import TrainingOptions, export_policy, know_stiffness, policy_contract, write_curves
from rejoint.twin.judge import read_published
from rejoint.twin.parameters import pack, prior, unpack
from rejoint.twin.twin import read_twin
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
OPTIONS = TrainingOptions(agents=8, iterations=4)
ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "docs" / "published" / "so-arm100-mjcf.toml"
PROFILE = ROOT / "src" / "rejoint_lab" / "plant" / "profiles" / "worn.toml"
INFO = RunInfo(robot="emulated:worn", arm="mycobot280", seed=3, version="1", created="now")


@dataclass(frozen=True)
class Kind:
    """A kind of file: how it is made, read, and what counts as the same."""

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], Any]
    sealed: bool = True
    """whether any change of what matters must be noticed; else only that nothing but the known errors comes"""
    deep: bytes = b""
    """what is nested too deep"""


def log():
    rng = np.random.default_rng(1)
    return RunLog(
        arm="planar",
        joint_names=("a", "b"),
        robot="emulated:worn",
        label="hold/0",
        time=np.cumsum(np.full(40, 0.025)),
        position=rng.normal(size=(40, 2)),
        command=rng.normal(size=(40, 2)),
        target=np.full((40, 3), np.nan),
        true_tcp=rng.normal(size=(40, 3)),
        extra={"segments": "[[0.0, 1.5]]"},
    )


def plain_log(path):
    found = RunLog.load(path)
    return {
        name: np.array(value).tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(found).items()
        if name not in ("target",)
    }


def make_twin(path):
    made_twin(ARM, unpack(prior(ARM).mean), fit_seconds=98.5, notes=("one",)).save(path)


def plain_twin(path):
    twin = read_twin(path, ARM)
    plain = [pack(twin.parameters), twin.covariance, twin.lower, twin.upper, twin.narrowing, twin.held_out.twin.tcp]
    return [np.asarray(array).tolist() for array in plain], twin.fit_seconds, twin.held_out.seconds, twin.notes


def make_policy(path):
    torch.manual_seed(0)
    recipe = know_stiffness(OPTIONS.recipe, ARM, None)
    contract = policy_contract(ARM, None, recipe, 0)
    export_policy(path, nn.Sequential(nn.Linear(contract.observation_size, 16), nn.ELU(), nn.Linear(16, 6)), contract)


def plain_policy(path):
    return msgspec.to_builtins(load_policy(path, ARM).contract)


def make_curves(path):
    point = dict.fromkeys(CurvePoint.__annotations__, 0.5)
    write_curves(path, [CurvePoint(**point | {"step": k}) for k in range(9)])


KINDS = (
    Kind("log.parquet", lambda path: log().save(path), plain_log),
    Kind("curves.parquet", make_curves, lambda path: read_curves(path).error_mm.tolist(), sealed=False),
    Kind("twin.toml", make_twin, plain_twin, deep=b"a = " + b"[" * 200_000),
    Kind("run.json", lambda path: write_json(path, INFO), read_info, deep=b'{"a":' + b"[" * 200_000),
    Kind("policy.onnx", make_policy, plain_policy),
    Kind("targets.csv", lambda path: path.write_text("x,y,z\n170,0,200\n180,30,210\n"),
         lambda path: read_targets(path, ARM)[0].shape, sealed=False, deep=b"x,y,z\n" + b'"' * 200_000),
    Kind("arm.toml", lambda path: write_arm_toml(path, ARM), lambda path: load_arm(str(path)).name, sealed=False,
         deep=b"name = " + b"[" * 200_000),
    Kind("published.toml", lambda path: path.write_bytes(PUBLISHED.read_bytes()),
         lambda path: read_published(path, load_arm("so101")).name, sealed=False, deep=b"a = " + b"[" * 200_000),
    Kind("wear.toml", lambda path: path.write_bytes(PROFILE.read_bytes()), lambda path: load_wear(str(path), ARM),
         sealed=False, deep=b"a = " + b"[" * 200_000),
)  # fmt: skip

EXPECTED = (FileError, ContractError, InputError)
"""Each ends the command with exit code 2 and one line"""


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.name)
def whole(request, tmp_path_factory):
    """A kind of file, a good one's bytes, and what is read from it."""
    path = tmp_path_factory.mktemp("whole") / request.param.name
    request.param.make(path)
    return request.param, path.read_bytes(), request.param.read(path)


def judge(kind, path, good):
    """Return whether a damaged file was refused; what else is right is to read the same."""
    try:
        found = kind.read(path)
    except EXPECTED as error:
        assert "\n" not in str(error)  # noqa: PT017 - either outcome is right, a third is not
        assert path.name in str(error) or isinstance(error, ContractError)  # noqa: PT017 - or it is read
        return True
    assert not kind.sealed or found == good
    return False


def test_a_damaged_file_is_refused_or_read_as_it_was(whole, tmp_path):
    kind, data, good = whole
    rng, path = random.Random(11), tmp_path / kind.name
    refused = 0
    for _ in range(60):
        bad = bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 4))):
            bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
        path.write_bytes(bad)
        refused += judge(kind, path, good)
    assert refused > (20 if kind.sealed else 0)


def test_a_truncated_file_is_refused(whole, tmp_path):
    kind, data, good = whole
    path = tmp_path / kind.name
    for length in [0, 1, *np.linspace(2, len(data.rstrip()) - 1, 25).astype(int)]:
        path.write_bytes(data[:length])
        assert judge(kind, path, good) or not kind.sealed
    path.write_bytes(b"")
    assert judge(kind, path, good)


def test_what_is_no_such_file_is_refused_unread(whole, tmp_path):
    kind, data, good = whole
    path = tmp_path / kind.name
    assert judge(kind, path, good)  # nothing there
    path.mkdir()
    assert judge(kind, path, good)
    path.rmdir()
    os.mkfifo(path)  # opened, it would wait for ever
    assert judge(kind, path, good)
    path.unlink()
    with path.open("wb") as file:  # takes no space
        file.write(data)
        file.truncate(20_000_000_000)
    with pytest.raises(EXPECTED, match=r"20\.0 GB large, expected at most"):
        kind.read(path)
    for text in (b"\xff\xfe\x00\x81" * 20, "größer".encode("utf-16"), b"\0" * 4096, kind.deep):
        path.write_bytes(text)
        assert judge(kind, path, good)


def test_a_small_log_that_unfolds_to_a_huge_one_is_refused(tmp_path, monkeypatch):
    path, rows = tmp_path / "log.parquet", 100_000
    pq.write_table(pa.table({f"c{k}": np.zeros(rows) for k in range(3)}), path)
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(runlog, "VALUES_MOST", 200_000)
    with pytest.raises(FileError, match="300000 numbers, expected at most 200000"):
        RunLog.load(path)


def test_a_folder_of_another_version_is_named(tmp_path):
    run = Run.create(tmp_path, "emulated:worn", ARM)
    assert read_json(run.folder.info, dict[str, Any])["format"] == FORMAT
    newer = {"format": FORMAT + 1, "version": "9.9", "robots": ["a", "b"]}
    write_json(run.folder.info, newer)
    with pytest.raises(FileError, match=r"run\.json: a run folder of format 3, made by rejoint 9\.9"):
        Run.open(run.folder.path)


def test_a_run_s_own_arm_is_the_one_that_it_was_begun_with(tmp_path):
    run = Run.create(tmp_path, "emulated:worn", replace(ARM, floor=0.01))
    assert Run.open(run.folder.path).arm.floor == 0.01
    text = run.folder.description.read_text()
    run.folder.description.write_text(text.replace("mass_kg = 0.", "mass_kg = 1.", 1))
    with pytest.raises(FileError, match=r"arm\.toml: damaged or changed since the run was begun"):
        Run.open(run.folder.path)
