"""How results look: tables of eighty columns, and JSON that holds results and no traces."""

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from rejoint.arms import so101
from rejoint.cli import app
from rejoint.cli.console import results_of
from rejoint.logs.runlog import RunLog
from rejoint.twin.judgement import Judgement, PredictionError
from rejoint.twin.parameters import prior, unpack
from rejoint.twin.twin import HeldOut, Twin

ARM = so101()


def a_log(label: str, rows: int) -> RunLog:
    time = 0.02 * np.arange(rows)
    command = 0.4 * np.sin(np.outer(time, [0.9, 1.1, 1.3, 1.7, 2.1]))
    return RunLog.of(time, command, 0.97 * np.roll(command, 3, axis=0), arm=ARM, label=label)


def a_twin() -> Twin:
    belief, error = prior(ARM), PredictionError(joints=(0.0,) * 5, joint=0.0, tcp=0.0)
    return Twin(
        arm=ARM.name,
        joint_names=ARM.joint_names,
        parameters=unpack(belief.mean, ARM.joints),
        covariance=np.diag(belief.sigma**2),
        lower=belief.lower,
        upper=belief.upper,
        narrowing=np.ones(len(belief.mean)),
        identified=np.zeros(len(belief.mean), dtype=bool),
        fit_seconds=1.0,
        held_out=HeldOut(seconds=1.0, no_twin=error, healthy_twin=error, twin=error),
    )


def test_json_holds_results_and_names_the_file_of_the_traces(tmp_path: Path):
    for label in ("one", "two"):
        (tmp_path / "logs").mkdir(exist_ok=True)
        a_log(label, 1500).save(tmp_path / "logs" / f"{label}.parquet")
    a_twin().save(tmp_path / "twin.toml")
    words = ["replay", str(tmp_path / "twin.toml"), "--logs", str(tmp_path / "logs"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    last = done.stdout.splitlines()[-1]
    assert len(last) < 10_000
    told = json.loads(last)
    assert set(told) == {*Judgement.__dataclass_fields__, "page"}
    traces = json.loads(Path(told["worst"]["traces"]).read_text())
    assert traces["worst"]["motion"] == told["worst"]["motion"]
    assert len(traces["worst"]["time"]) == 1500
    assert traces["mean"] == told["mean"]


def test_results_lose_only_their_traces():
    found = results_of({"a": [{"outcomes": [1] * 9, "b": (2, None)}], "c": np.arange(2.0), "d": Path("x")}, "outcomes")
    assert found == {"a": [{"b": [2, None]}], "c": [0.0, 1.0], "d": "x"}
