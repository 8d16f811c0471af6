"""Fig. 12 from made-up courses of trainings, whose every number is known."""

import numpy as np
import pytest
from sketchbook import Sketchbook

from rejoint.arms import mycobot280
from rejoint.research.reproduction import curves
from rejoint.research.reproduction.curves import AT_HOME, FIG_12, WITH, WITHOUT, Course
from rejoint.research.reproduction.experiment import QUICK
from rejoint.research.reproduction.trainings import HEALTHY, WORN
from rejoint.system.files import write_json
from rejoint.training.presets import PAPER

UPDATES = (0, 5, 10, 15, 20)
CYCLES = PAPER.ppo.rollout * np.array(UPDATES)

# by (trainings, arms): reward and steps of the middle seed; the others are lower and higher by 1 and by 2
MADE = {
    (WORN, "worn"): ((-9.0, -6.0, 2.0, 5.0, 8.0), (250.0, 200.0, 90.0, 60.0, 30.0)),
    (HEALTHY, "worn"): ((-8.0, 0.0, -12.0, -16.0, -17.0), (250.0, 150.0, 180.0, 240.0, 240.0)),
    (HEALTHY, "healthy"): ((-9.0, 3.0, 4.0, 6.0, 8.0), (250.0, 100.0, 50.0, 40.0, 30.0)),
}
REACHED = {"worn": (0.0, 0.1, 0.2, 0.3, 0.4), "healthy": (0.0, 0.5, 0.9, 0.9, 0.6)}


@pytest.fixture
def bench(tmp_path):
    made = Sketchbook(folder=tmp_path, arm=mycobot280(), seed=0, scale=QUICK)
    for (names, arms), (reward, steps) in MADE.items():
        for i, name in enumerate(names):
            write(made, name, arms, np.array(reward) + i - 1, np.array(steps) + 2 * (i - 1), REACHED[arms])
    return made


def write(bench, name, arms, reward, steps, reached):
    course = Course(
        updates=UPDATES, reward=tuple(reward.tolist()), steps=tuple(steps.tolist()), reached=reached,
        collided=(0.5, 0.4, 0.3, 0.2, 0.1),
    )  # fmt: skip
    write_json(bench.training(name).path / f"course-{arms}.json", course)


def by_name(findings):
    return {number.what: number for number in findings.numbers}


def test_every_number_of_fig_12_worked_by_hand(bench):
    findings = FIG_12.run(bench)
    ours = {what: number.ours for what, number in by_name(findings).items()}
    assert ours == {
        "reward per episode at the end, with": "5 (4 to 6)",
        "time steps until the mean reward stays above -5.00, with": f"{CYCLES[2]}",
        "reward per episode at the end, without": "-15 (-16 to -14)",
        "time steps until its mean reward is highest": f"{CYCLES[1]}",
        "steps per episode at the end, with": "60 (58 to 62)",
        "the same, without": "220 (218 to 222)",
        "targets reached, with": "30 % (30 to 30)",
        "targets reached, without": "30 % (30 to 30)",
        "targets reached, without, on its own normal arm": "80 % (80 to 80)",
        "episodes that end in a collision, with": "20 % (20 to 20)",
    }
    for number in findings.numbers:
        assert number.value == pytest.approx(float(number.ours.split(" ")[0]))
    assert findings.text[1] == (
        "The curves separate as in Fig. 12: every seed with the range ends above every seed without it; without it, "
        f"the reward on worn arms is highest after {CYCLES[1]} time steps and then falls."
    )


def test_a_reward_that_never_stays_above_is_told_and_has_no_value(bench):
    for name in WORN:
        write(bench, name, "worn", np.full(5, -6.0), np.full(5, 250.0), REACHED["worn"])
    number = by_name(FIG_12.run(bench))["time steps until the mean reward stays above -5.00, with"]
    assert (number.ours, number.value) == ("never", None)


def test_one_seed_that_does_not_end_above_the_others_is_told(bench):
    reward, steps = MADE[WORN, "worn"]
    write(bench, WORN[1], "worn", np.array(reward) - 30, np.array(steps), REACHED["worn"])
    assert FIG_12.run(bench).text[1].startswith("The curves do not separate as in Fig. 12")


def test_one_reward_changes_the_numbers_that_it_enters_and_no_other(bench):
    before = by_name(FIG_12.run(bench))
    reward, steps = (np.array(values) for values in MADE[WORN, "worn"])
    reward[-1] += 3.0  # of the middle one of three seeds, one of three policies: a third of a third of 3
    write(bench, WORN[1], "worn", reward, steps, REACHED["worn"])
    after = by_name(FIG_12.run(bench))
    changed = [what for what in before if before[what] != after[what]]
    assert changed == ["reward per episode at the end, with"]
    assert after[changed[0]].value == pytest.approx(5.0 + 1 / 3)


def test_the_figure_draws_the_mean_and_the_range_of_the_seeds(bench):
    FIG_12.run(bench)
    panels = bench.figures["fig-12"].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["reward per episode", "time steps per episode"]
    conditions = dict(zip(MADE, (WITH, WITHOUT, AT_HOME), strict=True))
    for k, (axes, half) in enumerate(zip(panels, (1.0, 2.0), strict=True)):
        lines = {line.get_label(): line for line in axes.lines}
        assert set(lines) == {condition.label for condition in conditions.values()}
        for band, (made, condition) in zip(axes.collections, conditions.items(), strict=True):
            expected = np.array(MADE[made][k])
            np.testing.assert_array_equal(lines[condition.label].get_xdata(), CYCLES)
            np.testing.assert_allclose(lines[condition.label].get_ydata(), expected)
            edge = band.get_paths()[0].vertices
            for x, value in zip(CYCLES, expected, strict=True):
                ends = edge[edge[:, 0] == x, 1]
                assert (ends.min(), ends.max()) == pytest.approx((value - half, value + half))


def course(reward, steps):
    return Course(
        updates=(0, 1, 2), reward=(-9.0, *reward), steps=(250.0, *steps), reached=(0.0,) * 3, collided=(0.0,) * 3
    )


def test_separation_needs_every_seed(monkeypatch):
    monkeypatch.setattr(curves, "LAST", 2)
    good, bad = course((5.0, 7.0), (40.0, 20.0)), course((-8.0, -6.0), (240.0, 250.0))
    np.testing.assert_allclose(curves.at_end([good, bad], "reward"), [6.0, -7.0])
    cycles = np.array([0, 100, 200])
    assert curves.stays_above(cycles, [good], -5.0) == 100
    assert curves.stays_above(cycles, [bad], -5.0) is None
    assert curves.peak(cycles, [good, bad]) == 200  # means of -1.5 and 0.5
    assert curves.separates([good, good], [bad, bad])
    assert not curves.separates([bad, bad], [good, good])
    assert not curves.separates([good, bad], [bad, bad])
    assert not curves.separates([good], [course((-8.0, -6.0), (20.0, 30.0))])  # worse reward, but no longer
