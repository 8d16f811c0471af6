"""Fig. 10: three pairs of P and D in the twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rejoint.arms import Array, solve_position, tcp_position
from rejoint.control.targets import draw_targets
from rejoint.pages.html import BLUE, ORANGE, RED
from rejoint.pages.report.figures import Ways, ways
from rejoint.research.reproduction.experiment import Bench, Drawing, Experiment, Findings, Grid, Number
from rejoint.training.ranges import PaperRanges
from rejoint.twin.batch import TwinBatch

PAIRS = ((1e4, 1e3), (1e3, 50.0), (200.0, 10.0))
"""Park et al. 2024, section IV-C"""
WORDS = ("minimal error and oscillation", "large oscillations, low error", "large errors and oscillations")
"""The paper's words"""

STEP = 1.0 / 240.0
"""[s] time step"""
DWELL = 2.0
"""[s] per target; chosen"""
WINDOW = 0.25
"""[s] at the end of a target; chosen"""
BOUNDLESS = 1e6
"""[N m] no torque limit, as in equation 12"""
VISITS = 6
"""targets on the figure; chosen"""


def run(bench: Bench) -> Findings:
    """Move twins to the same targets, in both units."""
    count = min(VISITS, bench.scale.targets)
    targets = draw_targets(bench.arm, sets=1, count=count, seed=bench.seed)[0]
    ours, literal = PaperRanges(arm=bench.arm), PaperRanges(arm=bench.arm, stiffness_unit=1.0, damping_unit=1.0)
    paths = {"rescaled": trace(bench, ours, targets), "N m/rad": trace(bench, literal, targets)}
    measured = {unit: [judge(path, targets) for path in found] for unit, found in paths.items()}
    text = (
        f"The twin with the paper's three pairs is sent to {count} targets, one every {DWELL:g} s. The error is what "
        f"is left in the last {WINDOW:g} s; the overshoot is how far the tool shoots past the place where it comes to "
        "rest, in percent of its way there.",
        f"Read as N m/rad, P = 200 holds a 0.85 kg arm within {measured['N m/rad'][2][0]:.1f} mm and lets nothing "
        "oscillate, which is the opposite of what Fig. 10 shows; so the units must be others. With "
        f"{ours.stiffness_unit:g} N m/rad to a unit of P and {ours.damping_unit:g} N m s/rad to a unit of D the three "
        "descriptions hold, and these are the units of every training below.",
    )
    numbers = tuple(
        Number.of(f"P = {p:g}, D = {d:g}: error, overshoot", error, f"{{:.2g}} mm, {over:.0f} %", word)
        for (p, d), (error, over), word in zip(PAIRS, measured["rescaled"], WORDS, strict=True)
    )
    readings = (
        "P and D are given without units; see above. Friction and delay are left out, as in the paper's model.",
        "The range for training is given twice: 50 < P < 200 with P/50 < D < P/10 (section IV-C), and P of 50 to 100 "
        "with D of P/10 to 50 (section IV-D). The first was taken: it alone holds the pair that Fig. 10 shows "
        "as the worn one.",
    )
    drawing = _figure(bench, paths["rescaled"], targets, measured["rescaled"])
    return Findings(text=text, numbers=numbers, readings=readings, grids=(_grid(measured),), drawings=(drawing,))


def trace(bench: Bench, ranges: PaperRanges, targets: Array) -> Array:
    """Move twins to ``targets`` (K, 3) [m]; returns paths (3, T, 3) [m]."""
    arm = bench.arm
    p, d = np.array(PAIRS).T[..., None]
    twins = TwinBatch(arm, len(PAIRS), timestep=STEP)
    free = ranges.twins(p, d)
    twins.write(replace(free, torque_limit=np.full_like(free.stiffness, BOUNDLESS)))
    twins.restart(np.tile(arm.rest, (len(PAIRS), 1)))
    steps, goal, paths = round(DWELL / STEP), arm.rest, []
    for target in targets:
        goal = solve_position(arm, target, goal).q
        commands = np.broadcast_to(goal, (len(PAIRS), steps, arm.joints))
        paths.append(tcp_position(arm, twins.rollout(commands)))
    return np.concatenate(paths, axis=1)


def judge(path: Array, targets: Array) -> tuple[float, float]:
    """Mean error [mm] and overshoot [%] of a path (T, 3) [m]."""
    last, errors, overshoots = round(WINDOW / STEP), [], []
    start = path[0]
    for part, target in zip(np.split(path, len(targets)), targets, strict=True):
        end = part[-last:].mean(axis=0)
        errors.append(1e3 * np.linalg.norm(part[-last:] - target, axis=-1).mean())
        way = end - start
        along = (part - start) @ way / (way @ way)
        overshoots.append(100.0 * max(float(along.max()) - 1.0, 0.0))
        start = end
    return float(np.mean(errors)), float(np.mean(overshoots))


def _grid(measured: dict[str, list[tuple[float, float]]]) -> Grid:
    rows = []
    for i, (p, d) in enumerate(PAIRS):
        cells = [f"{found[i][0]:.2g} mm, {found[i][1]:.0f} %" for found in measured.values()]
        rows.append((f"{p:g}", f"{d:g}", *cells))
    headers = ("P", "D", "rescaled: error, overshoot", "P in N m/rad: error, overshoot")
    return Grid(title="Both readings of the units", headers=headers, rows=tuple(rows))


def _figure(bench: Bench, paths: Array, targets: Array, measured: list[tuple[float, float]]) -> Drawing:
    panels = [
        Ways(title=f"P = {p:g}, D = {d:g}", look=look, paths=[path], targets=targets)
        for (p, d), look, path in zip(PAIRS, (BLUE, ORANGE, RED), paths, strict=True)
    ]
    points = paths.reshape(-1, 3)
    limits = np.stack([points.min(axis=0) - 0.015, points.max(axis=0) + 0.015], axis=1)
    return bench.draw(
        ways(panels, limits, views=("top",)),
        key="fig-10",
        alt=f"Straight paths for the stiff pair, ringing ones for the others; errors "
        f"{', '.join(f'{error:.1f}' for error, _ in measured)} mm.",
        caption="Fig. 10. Paths of the TCP from above; circles of 10 mm around the targets, a square at the start.",
    )


FIG_10 = Experiment(
    name="fig-10",
    title="Fig. 10: stiffness and damping of the twin",
    about="three pairs of P and D in the twin, from above",
    run=run,
)
