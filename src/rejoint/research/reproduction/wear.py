"""Fig. 9: a healthy and a worn arm, open loop."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.arms import Array
from rejoint.control.classical import DefaultController
from rejoint.control.comparison.protocols import measure_holds, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.loop import run as drive
from rejoint.control.targets import draw_targets
from rejoint.pages.html import BLUE, RED
from rejoint.pages.report.figures import Series, error_per_target
from rejoint.research.reproduction.experiment import Bench, Drawing, Experiment, Findings, Number
from rejoint.robots import open_robot
from rejoint.system.statistics import cluster, spread

DWELL = 5.0
"""[s] per target; chosen"""
PAPER_MM = {"healthy": 3.09, "worn": 22.7}
"""Park et al. 2024, section IV-B"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrival:
    """Errors of an arm at rest."""

    encoder_mm: Array
    """(S, K) by encoders"""
    true_mm: Array
    """(S, K) of the tool"""


def run(bench: Bench) -> Findings:
    """Move both arms to the same targets."""
    targets = draw_targets(bench.arm, sets=bench.scale.sets, count=bench.scale.targets, seed=bench.seed)
    arrivals = {}
    for step, profile in enumerate(PAPER_MM):
        bench.on_progress(step / len(PAPER_MM), f"{profile} arm, {targets.shape[0]} sets of targets")
        arrivals[profile] = _arrive(bench, profile, targets)
    healthy, worn = arrivals["healthy"].encoder_mm, arrivals["worn"].encoder_mm
    ratio = float(worn.mean() / healthy.mean())
    numbers = (
        *(_error(f"{profile} arm, mean error", PAPER_MM[profile], one.encoder_mm) for profile, one in arrivals.items()),
        Number(what="worn over healthy", ours=f"{ratio:.1f}", paper="7.34", value=ratio),
        *(
            _error(f"{profile} arm, mean error of the tool itself", None, one.true_mm)
            for profile, one in arrivals.items()
        ),
    )
    per_set = worn.mean(axis=1)
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


def _arrive(bench: Bench, profile: str, targets: Array) -> Arrival:
    protocol = Protocol(hold=DWELL)
    robot = open_robot(f"emulated:{profile}", arm=bench.arm, seed=bench.seed, count=len(targets), threads=bench.threads)
    try:
        plan = schedule("hold", protocol, keep_going=True)
        recording = drive(robot, DefaultController(bench.arm), targets, plan)
    finally:
        robot.close()
    holds = measure_holds(bench.arm, recording, targets, protocol)
    return Arrival(encoder_mm=1e3 * holds["settled"], true_mm=1e3 * holds["settled_true"])


def _error(what: str, paper: float | None, error_mm: Array) -> Number:
    found = spread(error_mm.ravel(), cluster((*error_mm.shape[:1], 1, error_mm.shape[1]))[1])
    assert found is not None  # noqa: S101 - for the type checker; an open-loop run ends no target early
    mean = found.mean
    likely = "" if mean.low is None or mean.high is None else f" ({mean.low:.1f} to {mean.high:.1f})"
    ours = f"{mean.value:.2f}{'' if found.std is None else f' ± {found.std:.1f}'} mm{likely}"
    return Number(what=what, ours=ours, paper="" if paper is None else f"{paper:g} mm", value=mean.value)


def _figure_9(bench: Bench, arrivals: dict[str, Arrival]) -> Drawing:
    looks = {"healthy": BLUE, "worn": RED}
    series = [
        Series(
            label=f"{name}, mean {one.encoder_mm[0].mean():.1f} mm (paper {PAPER_MM[name]:g} mm)",
            look=looks[name],
            value=one.encoder_mm[0],
        )
        for name, one in arrivals.items()
    ]
    return bench.draw(
        error_per_target(series),
        Drawing(
            key="fig-9",
            alt="Bars of the error at ten targets: a few millimetres healthy, centimetres worn.",
            caption="Fig. 9. Error at each target of the first set; the means of the paper are in brackets.",
        ),
    )


FIG_9 = Experiment(
    name="fig-9",
    title="Fig. 9: healthy against worn",
    about="the same ten targets on a healthy and on a worn arm, open loop",
    run=run,
)
