"""Fig. 9: a healthy and a worn arm, open loop."""

from __future__ import annotations

from dataclasses import replace

from rejoint.arms import Array
from rejoint.control.classical import DefaultController
from rejoint.control.comparison.protocols import Columns, measure_holds, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.loop import run as drive
from rejoint.control.targets import draw_targets
from rejoint.pages.html import BLUE, RED
from rejoint.pages.report.figures import Series, error_per_target
from rejoint.research.reproduction.experiment import Bench, Drawing, Experiment, Findings, Number, likely
from rejoint.robots import open_robot
from rejoint.system.statistics import cluster, spread

DWELL = 5.0
"""[s] per target; chosen"""
PAPER_MM = {"healthy": 3.09, "worn": 22.7}
"""Park et al. 2024, section IV-B"""


def run(bench: Bench) -> Findings:
    """Move both arms to the same targets."""
    targets = draw_targets(bench.arm, sets=bench.scale.sets, count=bench.scale.targets, seed=bench.seed)
    arrivals = {}
    for step, profile in enumerate(PAPER_MM):
        bench.on_progress(step / len(PAPER_MM), f"{profile} arm, {targets.shape[0]} sets of targets")
        arrivals[profile] = _arrive(bench, profile, targets)
    worn = arrivals["worn"]["settled"]
    ratio = worn.mean() / arrivals["healthy"]["settled"].mean()
    numbers = (
        *(
            _error(f"{name} arm, mean error", one["settled"], f"{PAPER_MM[name]:g} mm")
            for name, one in arrivals.items()
        ),
        Number.of("worn over healthy", ratio, "{:.1f}", "7.34"),
        *(_error(f"{name} arm, mean error of the tool itself", one["settled_true"]) for name, one in arrivals.items()),
    )
    per_set = 1e3 * worn.mean(axis=1)
    text = (
        f"{targets.shape[0]} sets of {targets.shape[1]} targets in the paper's box; each target is sent once, as "
        f"joint angles of its inverse kinematics, and the error is the mean of the last second of {DWELL:g} s. "
        f"Between sets the worn arm's mean goes from {per_set.min():.1f} to {per_set.max():.1f} mm.",
        "The worn arm is a simulation whose wear was tuned until its error was that of the paper's arm, so the "
        "agreement of the worn mean is a fit and not a prediction.",
    )
    readings = (
        "The paper does not say how its error was measured. Its robot reports its own TCP, so encoder kinematics are "
        "taken, with the tool's true error beside: backlash and flex lie behind the encoders.",
    )
    return Findings(text=text, numbers=numbers, readings=readings, drawings=(_figure_9(bench, arrivals),))


def _arrive(bench: Bench, profile: str, targets: Array) -> Columns:
    protocol = Protocol(hold=DWELL)
    robot = open_robot(f"emulated:{profile}", arm=bench.arm, seed=bench.seed, count=len(targets), threads=bench.threads)
    try:
        plan = schedule("hold", protocol, keep_going=True)
        recording = drive(robot, DefaultController(bench.arm), targets, plan)
    finally:
        robot.close()
    return measure_holds(bench.arm, recording, targets, protocol)


def _error(what: str, error: Array, paper: str = "") -> Number:
    found = spread(error.ravel(), cluster((len(error), 1, error.shape[1]))[1])
    one = Number.spread(what, found, paper, places=(2, 1))
    return one if found is None else replace(one, ours=one.ours + likely(found.mean, 1e3, 1))


def _figure_9(bench: Bench, arrivals: dict[str, Columns]) -> Drawing:
    looks = {"healthy": BLUE, "worn": RED}
    series = [
        Series(
            label=f"{name}, mean {1e3 * one['settled'][0].mean():.1f} mm (paper {PAPER_MM[name]:g} mm)",
            look=looks[name],
            value=1e3 * one["settled"][0],
        )
        for name, one in arrivals.items()
    ]
    return bench.draw(
        error_per_target(series),
        key="fig-9",
        alt="Bars of the error at ten targets: a few millimetres healthy, centimetres worn.",
        caption="Fig. 9. Error at each target of the first set; the means of the paper are in brackets.",
    )


FIG_9 = Experiment(
    name="fig-9",
    title="Fig. 9: healthy against worn",
    about="the same ten targets on a healthy and on a worn arm, open loop",
    run=run,
)
