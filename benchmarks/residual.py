"""Whether a smooth map of what the calibration leaves predicts points that it has not seen.

    python -m benchmarks.residual --arms 16

Emulated arms are measured at 40 postures. From the first 10 or 20 measurements an arm is calibrated, and a Gaussian
process over the place of the tool is fitted to what is left at them: amplitude and length by the marginal likelihood,
no amplitude among the choices. Distances of the other measured points, mean / 95th percentile [mm], by the calibration
alone, with the map on every arm, and with the map where leaving out points of the fit says that it helps (the gate).
"""

from __future__ import annotations

import argparse

import numpy as np

from rejoint.arms import Array, mycobot280, tcp_position
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.model import scatter
from rejoint.diagnosis.calibration.postures import suggest
from rejoint.research.evaluation.calibrating import SIGMA, find_condition, measure, open_condition
from rejoint.research.evaluation.family import ArmFamily

POINTS, ALL = (10, 20), 40
AMPLITUDES, LENGTHS = (0.0, 5e-4, 1e-3, 2e-3), (0.03, 0.06, 0.12)
"""[m]"""


def left(found: Calibration, position: Array, approach: Array, point: Array) -> Array:
    """Return what the calibration leaves (M, 3) [m]."""
    return point - found.tool(position, approach)


def smooth(place: Array, rest: Array, noise: Array, at: Array) -> Array:
    """Predict (N, 3) [m] ``at`` places (N, 3) from ``rest`` (M, 3) at ``place`` (M, 3) of variances ``noise`` (M,)."""
    best, chosen = -np.inf, np.zeros((len(at), 3))
    for amplitude in AMPLITUDES:
        for length in LENGTHS:
            covariance = kernel(place, place, amplitude, length) + np.diag(noise)
            weight = np.linalg.solve(covariance, rest)
            evidence = -0.5 * np.sum(rest * weight) - 1.5 * np.linalg.slogdet(covariance)[1]
            if evidence > best:
                best, chosen = evidence, kernel(at, place, amplitude, length) @ weight
    return chosen


def kernel(one: Array, other: Array, amplitude: float, length: float) -> Array:
    """Covariance (N, M) [m^2] of the map at two sets of places."""
    apart = np.linalg.norm(one[:, None] - other[None], axis=-1)
    return amplitude**2 * np.exp(-0.5 * (apart / length) ** 2)


def helps(place: Array, rest: Array, noise: Array) -> bool:
    """Tell whether the map predicts each point from the others clearly better than nothing does."""
    rows = np.arange(len(place))
    gain = np.array([
        np.linalg.norm(rest[k])
        - np.linalg.norm(rest[k] - smooth(place[rows != k], rest[rows != k], noise[rows != k], place[k : k + 1])[0])
        for k in rows
    ])  # fmt: skip
    return bool(gain.mean() > 1.3 * gain.std(ddof=1) / np.sqrt(len(gain)))


def main() -> None:
    """Print a row for each condition and number of points."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.residual", description="A map of what is left.")
    parser.add_argument("--arms", type=int, default=16)
    options, _ = parser.parse_known_args()
    arm, family = mycobot280(), ArmFamily(arms=options.arms, seed=0)
    for name in ("worn", "misdescribed"):
        plan = suggest(arm, ALL, visits=2, sigma=SIGMA)
        m = measure(open_condition(arm, find_condition(name), family, 1), plan, family.seed)
        for count in POINTS:
            errors, used = [], 0
            for i in range(options.arms):
                found = fit(arm, m.first(i, count))
                rest, place = left(found, m.position[i], m.approach[i], m.point[i]), tcp_position(arm, m.position[i])
                noise = SIGMA**2 + found.floor**2
                noise = noise + np.trace(scatter(arm, found.displacement, m.position[i]), axis1=1, axis2=2) / 3.0
                mapped = smooth(place[:count], rest[:count], noise[:count], place[count:])
                let = helps(place[:count], rest[:count], noise[:count])
                used += let
                errors.append([np.linalg.norm(rest[count:] - part, axis=1) for part in (0.0, mapped, let * mapped)])
            table = 1e3 * np.concatenate(errors, axis=1)
            cells = " | ".join(f"{row.mean():.2f} / {np.quantile(row, 0.95):.2f}" for row in table)
            print(f"{name}, {count} points: {cells} | gate: {used} of {options.arms}", flush=True)


if __name__ == "__main__":
    main()
