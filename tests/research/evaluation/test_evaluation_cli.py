import json
from functools import partial
from pathlib import Path

import pytest

from commandline import run_cli
from runs.test_connect import a_twin


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    return partial(run_cli, capsys=capsys, monkeypatch=monkeypatch)


def test_a_family_is_evaluated_and_resumed(cli, tmp_path: Path):
    words = (
        "evaluate", "--family", "--arms", "2", "--targets", "1", "--variants", "worn", "--controllers", "integrator",
        "--no-crossing", "--threads", "1", "--out", str(tmp_path), "--json",
    )  # fmt: skip
    code, out, err = cli(*words)
    assert code == 0, err
    row = json.loads(out.splitlines()[-1])["rows"][0]
    assert 0.0 < row["settled"]["mean"]["value"] < 0.005
    assert row["cycle_time"] is None
    kept = tmp_path / "outcomes" / "worn--integrator.parquet"
    before = kept.stat().st_mtime_ns
    assert cli(*words)[1].splitlines()[-1] == out.splitlines()[-1]
    assert kept.stat().st_mtime_ns == before


def test_targets_anywhere_are_held_by_controllers_that_know_each_arm_by_its_twin(cli, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("rejoint.research.evaluation.evaluate.own_twin", lambda *_: a_twin())
    code, out, err = cli(
        "evaluate", "--family", "--arms", "2", "--targets", "1", "--variants", "anywhere", "--controllers",
        "feedforward,predictive", "--no-crossing", "--threads", "1", "--out", str(tmp_path), "--json",
    )  # fmt: skip
    assert code == 0, err
    rows = json.loads(out.splitlines()[-1])["rows"]
    assert [row["controller"] for row in rows] == ["feedforward", "predictive"]
    assert all(row["settled"]["mean"]["value"] < 0.002 for row in rows)


def test_calibrations_are_tried_in_the_target_region_and_anywhere(cli, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("rejoint.research.evaluation.evaluate.own_twin", lambda *_: a_twin())
    code, out, err = cli(
        "evaluate", "--family", "--calibrate", "--arms", "1", "--targets", "2", "--variants", "worn", "--threads", "1",
        "--out", str(tmp_path), "--json",
    )  # fmt: skip
    assert code == 0, err
    rows = json.loads(out.splitlines()[-1])["rows"]
    error = {(row["where"], row["points"]): row["error"]["value"] for row in rows}
    for where in ("target region", "anywhere"):
        assert error[where, 20] < 0.5 * error[where, 0]
