"""Fig. 12: reward and steps over the training, with and without wear."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from rejoint.arms import Arm, Array
from rejoint.control.policy import load_policy
from rejoint.pages.html import BLUE, ORANGE, RED
from rejoint.pages.report.figures import WIDE, Series, canvas, heading, legend
from rejoint.research.reproduction.experiment import Bench, Drawing, Experiment, Findings, Number
from rejoint.research.reproduction.trainings import HEALTHY, WORN, healthy_ranges, play, worn_ranges
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, write_json
from rejoint.training.presets import PAPER
from rejoint.training.ranges import Ranges

CONVERGED = -5.0
"""Reward reached in Fig. 12 of Park et al. 2024"""
LAST = 3
"""Averaged last policies; chosen"""


@dataclass(frozen=True, kw_only=True)
class Course:
    """Policies of one training on fixed arms."""

    updates: tuple[int, ...]
    """(K,) of the policies"""
    reward: tuple[float, ...]
    """mean over the episodes"""
    steps: tuple[float, ...]
    reached: tuple[float, ...]
    """share of the episodes"""
    collided: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Condition:
    label: str
    trainings: tuple[str, ...]
    arms: str
    ranges: Callable[[Arm], Ranges]


WITH = _Condition(label="with Real2Sim ranges", trainings=WORN, arms="worn", ranges=worn_ranges)
WITHOUT = _Condition(label="without, on the worn arms", trainings=HEALTHY, arms="worn", ranges=worn_ranges)
AT_HOME = _Condition(label="without, on its own normal arm", trainings=HEALTHY, arms="healthy", ranges=healthy_ranges)
CONDITIONS = (WITH, WITHOUT, AT_HOME)


def run(bench: Bench) -> Findings:
    """Evaluate the policies of all trainings on the same arms."""
    jobs = [(condition, name) for condition in CONDITIONS for name in condition.trainings]
    courses: dict[str, list[Course]] = {condition.label: [] for condition in CONDITIONS}
    for done, (condition, name) in enumerate(jobs):
        bench.on_progress(done / len(jobs), f"policies of {name} on {condition.arms} arms")
        courses[condition.label].append(course(bench, name, condition))
    cycles = PAPER.ppo.rollout * np.array(courses[WITH.label][0].updates)
    own, other, home = (courses[condition.label] for condition in CONDITIONS)
    numbers = (
        _number("reward per episode at the end, with", own, "reward", "", "above -5.00"),
        _after("time steps until the mean reward stays above -5.00, with", stays_above(cycles, own, CONVERGED), "2000"),
        _number("reward per episode at the end, without", other, "reward", ""),
        _after("time steps until its mean reward is highest", peak(cycles, other), "1000, falling then"),
        _number("steps per episode at the end, with", own, "steps", "", "below 400"),
        _number("the same, without", other, "steps", "", "rising from about 1200 time steps on"),
        _number("targets reached, with", own, "reached", " %"),
        _number("targets reached, without", other, "reached", " %"),
        _number("targets reached, without, on its own normal arm", home, "reached", " %"),
        _number("episodes that end in a collision, with", own, "collided", " %"),
    )
    drawing = _figure(bench, cycles, courses)
    return Findings(
        text=(_what(bench), _verdict(cycles, own, other)), numbers=numbers, readings=_READINGS, drawings=(drawing,)
    )


def course(bench: Bench, name: str, condition: _Condition) -> Course:
    """Evaluate the policies of a training."""
    folder = bench.training(name)
    path = folder.path / f"course-{condition.arms}.json"
    if path.exists():
        return read_json(path, Course)
    files = {int(file.stem.rpartition("-")[2]): file for file in sorted(folder.outputs.folder.glob("policy-*.onnx"))}
    if not files:
        raise FileError(
            folder.outputs.folder, "no policies of the training's course", "delete the training, run it again"
        )
    last = max(files) + bench.scale.snapshot_every
    files[last] = folder.policy
    assert folder.outputs.snapshot(0) == files[0]  # noqa: S101 - the untrained policy is always kept
    episodes = [
        play(
            load_policy(file, bench.arm),
            condition.ranges(bench.arm),
            bench.scale.judged,
            seed=bench.seed,
            threads=bench.threads,
        )
        for file in files.values()
    ]
    found = Course(
        updates=tuple(files),
        **{
            key: tuple(float(getattr(one, key).mean()) for one in episodes)
            for key in ("reward", "steps", "reached", "collided")
        },
    )
    write_json(path, found)
    return found


def at_end(courses: list[Course], key: str) -> Array:
    """Means (seeds,) of the last policies."""
    return np.array([np.mean(getattr(one, key)[-LAST:]) for one in courses])


def separates(own: list[Course], other: list[Course]) -> bool:
    """Whether every training with wear ends better than those without."""
    better = at_end(own, "reward").min() > at_end(other, "reward").max()
    return bool(better and at_end(own, "steps").max() < at_end(other, "steps").min())


def stays_above(cycles: Array, courses: list[Course], level: float) -> float | None:
    """First of ``cycles`` (K,) with a mean reward lastingly above ``level``."""
    below = np.flatnonzero(np.mean([one.reward for one in courses], axis=0) <= level)
    first = 0 if not len(below) else int(below[-1]) + 1
    return float(cycles[first]) if first < len(cycles) else None


def peak(cycles: Array, courses: list[Course]) -> float:
    """Which of ``cycles`` (K,) has the highest reward."""
    return float(cycles[np.argmax(np.mean([one.reward for one in courses], axis=0))])


def _after(what: str, cycles: float | None, paper: str) -> Number:
    return Number(what=what, ours="never" if cycles is None else f"{cycles:.0f}", paper=f"about {paper}", value=cycles)


def _number(what: str, courses: list[Course], key: str, unit: str, paper: str = "") -> Number:
    values = at_end(courses, key) * (100.0 if unit == " %" else 1.0)
    return Number.of(what, values.mean(), f"{{:.3g}}{unit} ({values.min():.3g} to {values.max():.3g})", paper)


def _what(bench: Bench) -> str:
    return (
        "Three trainings with the paper's range of P and D, and three without it: on the one pair that its section "
        f"IV-C gives for a normal arm, all else equal. Every {bench.scale.snapshot_every * PAPER.ppo.rollout} time "
        f"steps the policy was judged, without exploration, on {bench.scale.judged} arms that no training has seen, "
        "one episode each; both kinds on the same worn arms, and those without the range on their own normal arm too. "
        "Curves are means over the seeds, bands reach from the worst to the best seed."
    )


def _verdict(cycles: Array, own: list[Course], other: list[Course]) -> str:
    reward = np.mean([one.reward for one in other], axis=0)
    falls = reward.max() - reward[-LAST:].mean() > 0.1 * np.ptp(reward) + 1e-9
    fall = "falls" if falls else "does not fall again"
    later = f"the reward on worn arms is highest after {peak(cycles, other):.0f} time steps and then {fall}"
    if separates(own, other):
        how = "The curves separate as in Fig. 12: every seed with the range ends above every seed without it;"
    else:
        how = "The curves do not separate as in Fig. 12: some seed without the range ends as well as one with it;"
    return f"{how} without it, {later}."


_READINGS = (
    "\N{LEFT DOUBLE QUOTATION MARK}Without considering P and D\N{RIGHT DOUBLE QUOTATION MARK} is not said to be any "
    "values in particular. The pair of a normal arm was taken, as a twin that was never fitted to the worn arm has "
    "it. The paper's red curve cannot be such a training seen on its own arms, where the task is easy (dashed); on "
    "worn arms it can.",
    "The paper does not say on which arms its curves were taken, nor whether exploration was on. Here the policy that "
    "would be deployed is judged.",
    "Steps per episode below 400 (Fig. 12) contradict an episode of at most 250 (Table 3); 250 was taken.",
)


def _figure(bench: Bench, cycles: Array, courses: dict[str, list[Course]]) -> Drawing:
    looks = {WITH.label: BLUE, WITHOUT.label: RED, AT_HOME.label: ORANGE}
    panels = []
    for key, name in (("reward", "reward per episode"), ("steps", "time steps per episode")):
        curves = []
        for label, found in courses.items():
            values = np.array([getattr(one, key) for one in found])
            curves.append(
                Series(
                    label=label,
                    look=looks[label],
                    value=values.mean(axis=0),
                    low=values.min(axis=0),
                    high=values.max(axis=0),
                )
            )
        panels.append((name, curves))
    return bench.draw(
        over_training(cycles, panels),
        key="fig-12",
        alt="Reward rises and steps fall with the range of the worn arm, not without it.",
        caption="Fig. 12. Policies on their way, judged on arms they have not met; three seeds each.",
    )


def over_training(steps: Array, panels: Sequence[tuple[str, Sequence[Series]]]) -> Figure:
    """Draw curves with bands over ``steps`` (K,); a panel per group."""
    figure, grid = canvas((WIDE, 3.5), 1, len(panels))
    for axes, (name, curves) in zip(grid[0], panels, strict=True):
        for curve in curves:
            look = curve.look
            axes.plot(steps, curve.value, color=look.colour, linestyle=look.dash, linewidth=1.8, label=curve.label)
            axes.fill_between(steps, curve.low, curve.high, color=look.colour, alpha=0.18, linewidth=0)
        axes.set(xlabel="time steps of each agent", xlim=(steps[0], steps[-1]))
        heading(axes, name)
    legend(figure, grid[0, 0], [curve.label for curve in panels[0][1]])
    return figure


FIG_12 = Experiment(
    name="fig-12",
    title="Fig. 12: training with and without the ranges of the worn arm",
    about="reward and steps per episode over the training, three seeds each way",
    trainings=(*WORN, *HEALTHY),
    run=run,
)
