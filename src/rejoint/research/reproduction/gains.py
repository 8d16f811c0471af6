"""Fig. 10: three pairs of P and D in the twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rejoint.arms import Array, solve_position, tcp_position
from rejoint.pages.html import BLUE, ORANGE, RED
from rejoint.pages.report.figures import Ways, bounds, ways
from rejoint.research.reproduction.bench import Bench, Found, Grid
from rejoint.training.ranges import PaperRanges
from rejoint.twin.chain.batch import ChainBatch

PAIRS = ((1e4, 1e3), (1e3, 50.0), (200.0, 10.0))
"""Park et al. 2024, section IV-C"""
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


def measure(bench: Bench) -> Found:
    """Move twins to the same targets, in both units."""
    targets = bench.targets[0, :VISITS]
    ours, literal = PaperRanges(arm=bench.arm), PaperRanges(arm=bench.arm, stiffness_unit=1.0, damping_unit=1.0)
    paths, printed = (trace(bench, ranges, targets) for ranges in (ours, literal))
    panels = [
        Ways(title=f"P = {p:g}, D = {d:g}", look=look, paths=[path], targets=targets)
        for (p, d), look, path in zip(PAIRS, (BLUE, ORANGE, RED), paths, strict=True)
    ]
    bench.draw(ways(panels, bounds(list(paths), 0.015), views=("from above",)), "fig-10")
    shown = [
        [f"{e:.2g} mm, {o:.0f} %" for e, o in (judge(path, targets) for path in some)] for some in (paths, printed)
    ]
    rows = tuple((f"{p:g}", f"{d:g}", *cells) for (p, d), *cells in zip(PAIRS, *shown, strict=True))
    headers = ("P", "D", "rescaled: error, overshoot", "P in N m/rad: error, overshoot")
    return {
        **dict(zip(("stiff", "soft", "softest"), shown[0], strict=True)),
        "count": len(targets),
        "dwell": DWELL,
        "window": WINDOW,
        "literal": judge(printed[2], targets)[0],
        "p": ours.stiffness_unit,
        "d": ours.damping_unit,
        "grids": [Grid("Both readings of the units", headers, rows)],
    }


def trace(bench: Bench, ranges: PaperRanges, targets: Array) -> Array:
    """Move twins to ``targets`` (K, 3) [m]; returns paths (3, T, 3) [m]."""
    arm = bench.arm
    twins, free = ChainBatch(arm, len(PAIRS), timestep=STEP), ranges.twins(*np.array(PAIRS).T[..., None])
    twins.write(replace(free, torque_limit=np.full_like(free.stiffness, BOUNDLESS)))
    twins.restart(np.tile(arm.rest, (len(PAIRS), 1)))
    steps, goal, paths = round(DWELL / STEP), arm.rest, []
    for target in targets:
        goal = solve_position(arm, target, goal).q
        paths.append(tcp_position(arm, twins.rollout(np.broadcast_to(goal, (len(PAIRS), steps, arm.joints)))))
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
