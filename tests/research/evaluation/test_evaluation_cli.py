import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from commandline import run_cli


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
    assert 0.0 < row["settled"]["value"] < 0.005
    assert row["cycle_time"] is None
    kept = tmp_path / "outcomes" / "worn--integrator.parquet"
    before = kept.stat().st_mtime_ns
    assert cli(*words)[1].splitlines()[-1] == out.splitlines()[-1]
    assert kept.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("evaluate",), "--family"),
        (("evaluate", "--family", "--identification", "2"), "either"),
        (("evaluate", "--family", "--controllers", "nobody"), "no controller is called 'nobody'"),
        (("evaluate", "--family", "--controllers", "none"), "nobody takes part"),
        (("evaluate", "--family", "--variants", "rusty"), "no variant is called 'rusty'"),
        (("evaluate", "--family", "--policy", "nowhere.onnx"), "nowhere.onnx"),
        (("tune", "nobody"), "no rival is called 'nobody'"),
        (("tune", "adaptive", "--run", "nowhere"), "nowhere"),
    ],
)
def test_what_cannot_be_done_is_one_line(cli, words, told, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = cli(*words)
    assert code == 2
    assert told in err
    assert "Traceback" not in err


def test_tuned_gains_are_written_beside_others(cli, tmp_path: Path, monkeypatch):
    def bowl(arm, ranges, gains, make, settings, draw_seed):
        return sum(np.log(values) ** 2 for values in gains.values())

    monkeypatch.setattr("rejoint.research.rivals.tuning.candidate_costs", bowl)
    out = tmp_path / "gains.json"
    out.write_text('{"tuned-integrator": {"lead": 0.3}}')
    code, text, err = cli("tune", "adaptive", "--generations", "3", "--out", str(out), "--json")
    assert code == 0, err
    stored = json.loads(out.read_text())
    assert stored["tuned-integrator"] == {"lead": 0.3}
    assert stored["adaptive"] == json.loads(text.splitlines()[-1])["gains"]
    assert all(np.isfinite(value) and value > 0 for value in stored["adaptive"].values())
    code, text, err = cli("tune", "adaptive", "tuned-integrator", "--generations", "3", "--out", str(out), "--json")
    assert code == 0, err
    both = {one["rival"]: one["gains"] for one in json.loads(text.splitlines()[-1])}
    assert both == {name: json.loads(out.read_text())[name] for name in ("adaptive", "tuned-integrator")}
    assert both["adaptive"] == stored["adaptive"]  # each of them as alone
