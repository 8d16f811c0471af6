"""Which fit to trust: the answer follows from the numbers, and the figures show them."""

import dataclasses

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from rejoint.logs.runfolder.folder import RunFolder, RunInfo
from rejoint.pages.report import palette, prediction
from rejoint.pages.report.figures import Series
from rejoint.pages.report.page import write_report
from rejoint.pages.report.replay import CAVEAT, write_replay
from rejoint.pages.report.trust import answer, gap, scores
from rejoint.system.files import read_json, write_json
from rejoint.twin.file import write_twin
from rejoint.twin.judgement import NO_TWIN, Error, Errors, Judgement, MotionErrors, Trace
from rejoint.twin.repeatability import Repeatability

JOINTS = tuple(f"joint{i}" for i in range(1, 7))


def error(mm):
    return None if mm is None else Error(joint=mm * 1e-4, joints=(mm * 1e-4,) * 6, tcp=mm * 1e-3)


def mean(values):
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def judgement_of(free, contact=None, own=True):
    """A judgement with these errors [mm] of the tool: prediction -> motions; None where there are no such rows."""
    contact = contact or {name: [None] * len(values) for name, values in free.items()}
    count = len(next(iter(free.values())))
    motions = tuple(
        MotionErrors(
            motion=f"motion {k}", seconds=30.0, contact_seconds=5.0, left_out_seconds=0.0,
            errors={name: Errors(free=error(free[name][k]), contact=error(contact[name][k]), all=error(free[name][k]))
                    for name in free},
        )
        for k in range(count)
    )  # fmt: skip
    time = np.linspace(0.0, 30.0, 300)
    repeats = Repeatability(tcp=0.8e-3, lowest=0.5e-3, highest=1.2e-3, joint=1e-3, motions=("motion 0",), seconds=12.0)
    return Judgement(
        arm="mycobot280", joint_names=JOINTS, table_height=-0.03, motions=motions,
        mean={n: Errors(free=error(mean(free[n])), contact=error(mean(contact[n])), all=error(mean(free[n])))
              for n in free},
        repeatability=repeats if own else None,
        worst=Trace(
            motion="motion 2", time=tuple(time.tolist()), contact=tuple((time > 20.0).tolist()),
            tcp={name: tuple((1e-3 * values[-1] * (1 + np.sin(time) ** 2)).tolist()) for name, values in free.items()},
            joints=tuple(tuple((1e-3 * (i + 1) * np.cos(time)).tolist()) for i in range(6)),
        ),
    )  # fmt: skip


CLEAR = {
    NO_TWIN: [24.0, 28.0, 20.0, 26.0], "fitted twin": [2.0, 3.0, 1.0, 2.0], "healthy twin": [17.0, 19.0, 15.0, 18.0],
    "a <maker>": [22.0, 27.0, 18.0, 25.0],
}  # fmt: skip


def test_the_best_is_named_with_its_error_and_the_others():
    first, others, worst, *_ = answer(judgement_of(CLEAR))
    assert first.startswith("Trust “fitted twin”: it predicts the tool within 2.00\N{NO-BREAK SPACE}mm in free space")
    assert "mean of 4 motions, 95 %: 1.25 to 2.75" in first
    assert "healthy twin 17.2" in others
    assert "no twin 24.5" in others
    assert others.index("healthy") < others.index("maker") < others.index("no twin")
    assert "worst in motion 1 (3.0" in worst
    assert not any("not measurably worse" in line for line in answer(judgement_of(CLEAR)))


def test_what_differs_no_more_than_by_chance_is_said():
    close = CLEAR | {"rival": [2.5, 2.0, 1.8, 1.9]}
    lines = answer(judgement_of(close))
    assert any(line == "“rival” is not measurably worse in these motions." for line in lines)
    found = {score.name: score for score in scores(judgement_of(close))}
    apart = gap(found["fitted twin"], found["rival"])
    assert apart.low < np.mean([0.5, -1.0, 0.8, -0.1]) == pytest.approx(apart.value)
    assert apart.high > 0.0
    assert gap(found["fitted twin"], found["healthy twin"]).low > 12.0


def test_a_twin_that_is_worse_than_none_is_not_trusted():
    lines = answer(judgement_of({NO_TWIN: [5.0, 6.0, 4.0], "fitted twin": [9.0, 8.0, 11.0]}))
    assert lines[0].startswith("Trust none of them: the command alone predicts better, within 5.00")


def test_free_space_and_contact_are_told_apart():
    contact = {NO_TWIN: [30.0, None, 20.0, None], "fitted twin": [12.0, None, 14.0, None]}
    contact |= {"healthy twin": [8.0, None, 9.0, None], "a <maker>": [25.0, None, 25.0, None]}
    lines = answer(judgement_of(CLEAR, contact))
    assert lines[0].startswith("Trust “fitted twin”")
    assert any("On the table (20 s) “healthy twin” is closest, within 8.50" in line for line in lines)
    assert any("touches nothing" in line for line in answer(judgement_of(CLEAR)))


def test_the_arms_own_repeatability_is_the_floor():
    assert any(
        "repeats a motion within 0.80" in line and "0.50 to 1.20" in line for line in answer(judgement_of(CLEAR))
    )
    assert any("is not known" in line for line in answer(judgement_of(CLEAR, own=False)))


def test_a_running_root_mean_square_worked_by_hand():
    time = np.arange(6.0)
    values = np.array([3.0, 4.0, 0.0, 0.0, 5.0, 1.0])
    expected = np.sqrt([(9 + 16) / 2, 25 / 3, 16 / 3, 25 / 3, 26 / 3, 26 / 2])
    np.testing.assert_allclose(prediction.running_rms(time, values, 2.0), expected)
    np.testing.assert_allclose(prediction.running_rms(time, values, 0.5), values)


def test_each_motion_has_its_mark_and_the_arm_its_band():
    one = Series(label="fitted", look=palette.BLUE, value=np.array([1.0, 2.0, np.nan]))
    own = Series(
        label="own", look=palette.GREY, value=np.array([0.8]), low=np.array([0.5]), high=np.array([1.2])
    )  # fmt: skip
    figure = prediction.per_motion(["a", "b", "c"], [one], own, "error [mm]")
    axes = figure.axes[0]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), one.value)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [0, 1, 2])
    assert axes.lines[1].get_xdata() == [0.8, 0.8]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b", "c"]
    assert axes.get_xscale() == "log"
    assert "[mm]" in axes.get_xlabel()


def test_squares_show_size_and_sign_of_a_correlation():
    matrix = np.array([[1.0, -0.49], [-0.49, 1.0]])
    axes = prediction.correlations(["a", "b"], ["one", "two"], matrix).axes[0]
    squares = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    sides = np.array([square.get_width() for square in squares]).reshape(2, 2)
    np.testing.assert_allclose(sides / sides[0, 0], [[1.0, 0.7], [0.7, 1.0]])
    assert [square.get_fill() and square.get_facecolor()[3] > 0 for square in squares] == [True, False, False, True]


def test_contact_is_shaded_where_it_was():
    time = np.linspace(0.0, 10.0, 101)
    shaded = (time > 2.0) & (time < 3.0)
    one = Series(label="fitted", look=palette.BLUE, value=np.ones(101))
    axes = prediction.tool_over_time(time, [one], shaded).axes[0]
    box = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    assert (box.x0, box.x1) == (pytest.approx(2.1), pytest.approx(3.0))
    residual = np.outer([1.0, -2.0], np.sin(time))
    figure = prediction.joints_over_time(time, ["a", "b"], residual, palette.BLUE, shaded)
    np.testing.assert_array_equal(figure.axes[1].lines[0].get_ydata(), residual[1])


@pytest.fixture
def folder(tmp_path, twin):
    """A run of logs alone: a twin and its judgement."""
    folder = RunFolder(tmp_path / "run")
    info = RunInfo(robot="logs:my logs", arm="mycobot280", seed=0, version="0.1.0", created="2026-11-20T06:00:00")
    write_json(folder.info, info)
    write_twin(folder.twin, twin)
    write_json(folder.judgement, judgement_of(CLEAR))
    return folder


def test_the_report_of_logs_alone_answers_the_question(folder):
    page = write_report(folder.path).read_text(encoding="utf-8")
    assert page.count("Trust “fitted twin”") == 2  # in the verdict, and in its section
    assert 'id="trust"' in page
    assert "a &lt;maker&gt;" in page
    assert "<maker>" not in page
    assert "rejoint identify --logs &#39;my logs&#39; --arm mycobot280" in page
    figures = {path.stem for path in folder.figures.iterdir()}
    assert {"prediction-free", "motions-free", "worst-tool", "worst-joints", "twin-correlations"} <= figures
    assert "motions-contact" not in figures


def test_a_page_of_a_replay_is_self_contained_and_warns(tmp_path):
    found = judgement_of(CLEAR)
    path = write_replay(tmp_path / "out", found, twin="twin.toml", logs="logs")
    page = path.read_text(encoding="utf-8")
    assert CAVEAT in page
    assert page.count("<svg") == 4
    assert "src=" not in page
    assert read_json(tmp_path / "out" / "replay.json", Judgement) == found
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 4


def test_a_run_without_a_judgement_has_no_such_section(folder):
    folder.judgement.unlink()
    page = write_report(folder.path).read_text(encoding="utf-8")
    assert 'id="trust"' not in page


def test_a_motion_without_free_space_is_left_out_of_its_figure(tmp_path):
    holes = {name: [None, *values[1:]] for name, values in CLEAR.items()}
    found = judgement_of(holes)
    assert "mean of 3 motions" in answer(found)[0]
    page = write_replay(tmp_path, dataclasses.replace(found, repeatability=None), twin="t", logs="l").read_text("utf-8")
    assert "none" in page
