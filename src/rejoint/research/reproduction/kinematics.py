"""Table 1: the paper's and the vendor's DH tables are equal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, mycobot280, solve_position, tcp_pose
from rejoint.arms.arm import DhRow, dh_chain
from rejoint.arms.catalogue import DH_TABLE, PAPER_ANGLE_SHIFT, PAPER_DH_TABLE
from rejoint.arms.inverse import DAMPING
from rejoint.control.law import dls_step
from rejoint.research.reproduction.experiment import Bench, Experiment, Findings, Grid, Number

POSTURES = 1000
EDGE = 9
"""points per edge of the target box"""
CLOSE = 1e-3
"""[m] convergence of damped least squares"""


def run(bench: Bench) -> Findings:
    """Compare both tables."""
    vendor, paper = mycobot280(), paper_arm(PAPER_DH_TABLE)
    lengths = {0: DH_TABLE[0].d, 4: DH_TABLE[4].d}
    same = paper_arm(tuple(replace(row, d=lengths.get(i, row.d)) for i, row in enumerate(PAPER_DH_TABLE)))
    postures = np.random.default_rng(bench.seed).uniform(vendor.lower, vendor.upper, (POSTURES, vendor.joints))
    apart, equal = (1e3 * _largest_difference(vendor, other, postures) for other in (paper, same))
    reached, steps = 100 * _reachable(paper).mean(), _steps_to(vendor, bench.seed)
    shift = ", ".join(f"{angle:.0f}" for angle in np.degrees(PAPER_ANGLE_SHIFT))
    text = (
        f"The table's angles are those of the vendor's table plus ({shift}) degrees: the paper drops the vendor's "
        "joint offsets, turns the signs of α1, a2 and a3, and gives d5 0.95 mm shorter. With the vendor's d1 and d5 "
        f"put in, the flange poses of both agree to {equal:.1g} mm on {POSTURES} random postures. So controllers may "
        "run on the vendor's angles, as ours do, and nothing that is compared below depends on the choice.",
    )
    numbers = (
        Number.of("largest flange distance, Table 1 against the vendor's", apart, "{:.2f} mm"),
        Number.of("the same with the vendor's d1 and d5", equal, "{:.1g} mm"),
        Number.of("target box that inverse kinematics reaches", reached, "{:.0f} %"),
        Number.of("damped least-squares steps to 1 mm, at most 5° each (median)", steps, "{:.0f}"),
        Number.of("encoder step", np.degrees(vendor.encoder_step), "{:.3f}°", "0.18°"),
    )
    readings = (
        "Equation 5 prints θ where a rotation about x by α is meant; α was taken.",
        f"Equation 11, damping λ = {DAMPING:g}: the paper gives no unit. It is read in metres, and only the "
        "position is asked for: many targets cannot be reached with the start's orientation as well.",
        "12 bit are 4096 steps of 0.088°, as the vendor's manual has it; the paper prints 0.18°.",
    )
    return Findings(text=text, numbers=numbers, readings=readings, grids=(_table(),))


def paper_arm(rows: tuple[DhRow, ...]) -> Arm:
    """Build the myCobot 280 from a table of the paper."""
    vendor, (offset, axis, tip) = mycobot280(), dh_chain(rows)
    return replace(
        vendor,
        offset=offset,
        axis=axis,
        tip=tip,
        lower=vendor.lower + PAPER_ANGLE_SHIFT,
        upper=vendor.upper + PAPER_ANGLE_SHIFT,
        rest=vendor.rest + PAPER_ANGLE_SHIFT,
    )


def _largest_difference(vendor: Arm, paper: Arm, postures: Array) -> float:
    difference = tcp_pose(paper, postures + PAPER_ANGLE_SHIFT) - tcp_pose(vendor, postures)
    return float(np.linalg.norm(difference[:, :3, 3], axis=-1).max())


def _reachable(arm: Arm) -> NDArray[np.bool_]:
    """Points (EDGE^3,) of the target box within 0.1 mm."""
    axes = np.linspace(arm.targets.lower, arm.targets.upper, EDGE).T
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return solve_position(arm, points, arm.rest, tolerance=1e-4).converged


def _steps_to(arm: Arm, seed: int) -> float:
    targets = arm.targets.sample(np.random.default_rng(seed), (200,))
    q, needed = np.tile(arm.rest, (200, 1)), np.zeros(200)
    for _ in range(200):
        step = dls_step(arm, q, targets)
        far = np.linalg.norm(step.error, axis=-1) > CLOSE
        needed += far
        q = np.where(far[:, None], q + step.step, q)
    return float(np.median(needed))


def _table() -> Grid:
    rows = []
    for i, (paper, vendor) in enumerate(zip(PAPER_DH_TABLE, DH_TABLE, strict=True), start=1):
        rows.append((str(i), *_row(paper), *_row(vendor)))
    names = ("offset °", "d mm", "a mm", "α °")
    headers = ("joint", *(f"paper: {name}" for name in names), *(f"vendor: {name}" for name in names))
    return Grid(title="Both tables", headers=headers, rows=tuple(rows))


def _row(row: DhRow) -> tuple[str, ...]:
    return (
        f"{np.degrees(row.offset):g}",
        f"{1e3 * row.d:.5g}",
        f"{1e3 * row.a:.5g}",
        f"{np.degrees(row.alpha):g}",
    )


TABLE_1 = Experiment(
    name="table-1",
    title="Table 1: kinematics",
    about="the paper's DH table against the vendor's; reach of the target box",
    run=run,
)
