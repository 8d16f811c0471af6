"""Which fit to trust: the answer follows from the numbers, and the figures show them."""

import numpy as np

from rejoint.pages.report.page import CAVEAT, write_replay
from rejoint.pages.report.tables import answer
from rejoint.system.files import read_json
from rejoint.twin.judgement import (
    NO_TWIN,
    Errors,
    Judgement,
    MotionErrors,
    PredictionError,
    Trace,
    smaller,
)

JOINTS = tuple(f"joint{i}" for i in range(1, 7))


def error(mm):
    return None if mm is None else PredictionError(joint=mm * 1e-4, joints=(mm * 1e-4,) * 6, tcp=mm * 1e-3)


def mean(values):
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def judgement_of(free, contact=None):
    """A judgement with these errors [mm] of the tool: prediction -> motions; None where there are no such rows."""
    contact = contact or {name: [None] * len(values) for name, values in free.items()}
    count = len(next(iter(free.values())))
    motions = tuple(
        MotionErrors(
            motion=f"motion {k}",
            seconds=30.0,
            contact_seconds=5.0,
            left_out_seconds=0.0,
            errors={
                name: Errors(free=error(free[name][k]), contact=error(contact[name][k]), all=error(free[name][k]))
                for name in free
            },
        )
        for k in range(count)
    )
    time = np.linspace(0.0, 30.0, 300)
    return Judgement(
        arm="mycobot280",
        joint_names=JOINTS,
        table_height=-0.03,
        motions=motions,
        mean={
            n: Errors(free=error(mean(free[n])), contact=error(mean(contact[n])), all=error(mean(free[n])))
            for n in free
        },
        worst=Trace(
            motion="motion 2",
            time=tuple(time.tolist()),
            contact=tuple((time > 20.0).tolist()),
            tcp={name: tuple((1e-3 * values[-1] * (1 + np.sin(time) ** 2)).tolist()) for name, values in free.items()},
            joints=tuple(tuple((1e-3 * (i + 1) * np.cos(time)).tolist()) for i in range(6)),
        ),
    )


CLEAR = {
    NO_TWIN: [24.0, 28.0, 20.0, 26.0],
    "fitted twin": [2.0, 3.0, 1.0, 2.0],
    "healthy twin": [17.0, 19.0, 15.0, 18.0],
    "a <maker>": [22.0, 27.0, 18.0, 25.0],
}


def test_what_differs_no_more_than_by_chance_is_said():
    close = CLEAR | {"rival": [2.5, 2.0, 1.8, 1.9]}
    lines = answer(judgement_of(close))
    assert any(line == "“rival” is not measurably worse in these motions." for line in lines)
    assert not smaller(np.array(close["fitted twin"]), np.array(close["rival"]))
    assert smaller(np.array(close["fitted twin"]), np.array(close["healthy twin"]))
    assert not any("not measurably" in line for line in answer(judgement_of({k: v[:2] for k, v in CLEAR.items()})))


def test_a_twin_that_is_worse_than_none_is_not_trusted():
    lines = answer(judgement_of({NO_TWIN: [5.0, 6.0, 4.0], "fitted twin": [9.0, 8.0, 11.0]}))
    assert lines[0].startswith("Trust none of them: the command alone predicts better, within 5.00")


def test_a_page_of_a_replay_is_self_contained_and_warns(tmp_path):
    found = judgement_of(CLEAR)
    path = write_replay(tmp_path / "out", found, twin="twin.toml", logs="logs")
    page = path.read_text(encoding="utf-8")
    assert CAVEAT in page
    assert "src=" not in page
    assert read_json(tmp_path / "out" / "replay.json", Judgement) == found
