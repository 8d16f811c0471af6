"""Table 1: the paper's and the vendor's DH tables are equal. Fig. 10: three pairs of P and D in the twin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from rejoint.arms import Arm, Array, mycobot280, solve_position, tcp_pose, tcp_position
from rejoint.arms.arm import dh_chain
from rejoint.pages.html import BLUE, INK, ORANGE, RED, Look
from rejoint.pages.report.figures import WIDE, Stroke, canvas, plane
from rejoint.twin.chain.batch import ChainBatch
from rejoint_lab.research.reproduction.campaign import Bench, Found, Grid
from rejoint_lab.research.reproduction.paper import PaperRanges

POSTURES = 1000

DH_TABLE = np.array(
    [
        (0.13122, 0.0, np.pi / 2, 0.0),
        (0.0, -0.1104, 0.0, -np.pi / 2),
        (0.0, -0.096, 0.0, 0.0),
        (0.0634, 0.0, np.pi / 2, -np.pi / 2),
        (0.07505, 0.0, -np.pi / 2, np.pi / 2),
        (0.0456, 0.0, 0.0, 0.0),
    ]
)
"""d [m], a [m], alpha [rad], offset [rad] of `dh_chain`"""

PAPER_DH_TABLE = np.array(
    [
        (0.1312, 0.0, -np.pi / 2, 0.0),
        (0.0, 0.1104, 0.0, 0.0),
        (0.0, 0.096, 0.0, 0.0),
        (0.0634, 0.0, np.pi / 2, 0.0),
        (0.0741, 0.0, -np.pi / 2, 0.0),
        (0.0456, 0.0, 0.0, 0.0),
    ]
)
"""Table 1 of Park et al. 2024"""

PAPER_ANGLE_SHIFT = np.radians([180.0, -90.0, 0.0, 90.0, 90.0, 0.0])
"""Angles of the paper minus the vendor's"""


def measure_kinematics(bench: Bench) -> Found:
    """Compare both tables."""
    vendor, paper = mycobot280(), paper_arm(PAPER_DH_TABLE)
    rows = PAPER_DH_TABLE.copy()
    rows[[0, 4], 0] = DH_TABLE[[0, 4], 0]
    postures = np.random.default_rng(bench.seed).uniform(vendor.lower, vendor.upper, (POSTURES, vendor.joints))
    apart, equal = (
        1e3 * np.linalg.norm(_flanges(other, postures + PAPER_ANGLE_SHIFT) - _flanges(vendor, postures), axis=1).max()
        for other in (paper, paper_arm(rows))
    )
    names = ("offset °", "d mm", "a mm", "α °")
    headers = ("joint", *(f"{whose}: {name}" for whose in ("paper", "vendor") for name in names))
    tables = zip(PAPER_DH_TABLE, DH_TABLE, strict=True)
    cells = tuple((str(i), *_cells(paper), *_cells(vendor)) for i, (paper, vendor) in enumerate(tables, start=1))
    return {
        "apart": apart,
        "equal": equal,
        "postures": POSTURES,
        "shift": ", ".join(f"{angle:.0f}" for angle in np.degrees(PAPER_ANGLE_SHIFT)),
        "encoder": np.degrees(vendor.encoder_step),
        "grids": [Grid("Both tables", headers, cells)],
    }


def paper_arm(rows: Array) -> Arm:
    """Build the myCobot 280 from a table of the paper."""
    vendor, (offset, axis, tip) = mycobot280(), dh_chain(rows)
    shifted = {name: getattr(vendor, name) + PAPER_ANGLE_SHIFT for name in ("lower", "upper", "rest")}
    return replace(vendor, offset=offset, axis=axis, tip=tip, **shifted)


def _flanges(arm: Arm, postures: Array) -> Array:
    return tcp_pose(arm, postures)[:, :3, 3]


def _cells(row: Array) -> tuple[str, ...]:
    d, a, alpha, offset = row
    return f"{np.degrees(offset):g}", f"{1e3 * d:.5g}", f"{1e3 * a:.5g}", f"{np.degrees(alpha):g}"


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


def measure_gains(bench: Bench) -> Found:
    """Move twins to the same targets, in both units."""
    targets = bench.targets[0, :VISITS]
    ours, literal = PaperRanges(arm=bench.arm), PaperRanges(arm=bench.arm, stiffness_unit=1.0, damping_unit=1.0)
    paths, printed = (trace(bench, ranges, targets) for ranges in (ours, literal))
    panels = {
        f"P = {p:g}, D = {d:g}": strokes_of([path], targets, look)
        for (p, d), look, path in zip(PAIRS, (BLUE, ORANGE, RED), paths, strict=True)
    }
    bench.draw(ways(panels, views=("from above",)), "fig-10")
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


def ways(panels: Mapping[str, Sequence[Stroke]], views: Sequence[str] = ("from above", "from the side")) -> Figure:
    """Draw each panel in ``views``, one below the other, on common axes."""
    figure, grid = canvas((WIDE, 4.0 * len(views)), len(views), len(panels), sharex="row", sharey="row")
    for (row, column), axes in np.ndenumerate(grid):
        title, strokes = list(panels.items())[column]
        plane(axes, views[row], strokes, "" if row else title)
    return figure


def strokes_of(paths: Sequence[Array], targets: Array, look: Look) -> list[Stroke]:
    """TCP ``paths`` (T, 3) [m] with their starts, and ``targets`` (K, 3) [m]."""
    width, colour = 0.8 if len(paths) > 1 else 1.1, look.colour
    return [
        *((path, {"color": colour, "linewidth": width}) for path in paths),
        (np.stack([path[0] for path in paths]), {"color": colour, "marker": "s", "markersize": 4, "linestyle": ""}),
        (targets, {"color": INK, "marker": "+", "markersize": 6, "linestyle": ""}),
    ]
