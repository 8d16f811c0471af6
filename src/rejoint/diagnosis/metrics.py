"""What slow motions and rest say about a joint: friction, sag, overshoot, hunting, noise.

The following error e = command - measured position is all that encoders offer. A position servo of
stiffness k and damping d that turns an inertia J against gravity torque tau and Coulomb friction F
leaves

    e = (d/k) q' + (F/k) sign(q') + (J/k) q'' + tau/k + offset,

linear in d/k (lag), F/k (half the hysteresis), J/k and 1/k. Each is taken from the motion that shows it
best: lag and hysteresis from slow sweeps, J/k from the multisine (`rejoint.diagnosis.dynamics`), and
1/k from postures held after an approach from both sides, whose mean is free of friction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.size import torque_size
from rejoint.diagnosis.modulation import Averages, window_averages
from rejoint.diagnosis.regression import LinearFit, fit_line, fit_trimmed, mean_of
from rejoint.diagnosis.segments import ExcitationLog
from rejoint.system.statistics import Estimate

SETTLED_LAST = 0.4
"""[s] of a hold or a step that counts as settled (chosen: the last sixteen readings at 25 ms)."""

_SWEEP_WINDOW = 0.2
"""[s] as long as half sweeps allow (chosen)."""

MOVING = 0.7
"""Size of the averaged direction above which a window counts as moving: about 0.04 rad/s (chosen)."""

_MIN_TORQUE_RANGE = 2e-3
"""[N m] variation of gravity torque below which it is not fitted: the column would only add noise (chosen; goes with
the load of the arm)."""

MIN_SWEEP = 0.1
"""[rad] range of a sweep below which nothing is said about how it was followed (chosen: a third of the plan's)."""

_MIN_STEP = 0.02
"""[rad] motion below which an overshoot is not expressed as a fraction of it (chosen)."""

CHANCE = 3.0
"""Standard errors from which a correlation is none of chance (chosen)."""


def sweep_fit(data: ExcitationLog, joint: int, delay: float) -> LinearFit | None:
    """Fit the sweeps of a joint: coefficients (d/k [s], F/k [rad], J/k [s^2], 1/k [rad/(N m)], offset [rad]).

    Windows in which the joint sticks are left out: friction is then whatever it needs to be. J/k and 1/k
    are nuisances here; other motions measure them far better. None if the joint hardly moves when it is told to.
    """
    segments = data.of_kind("sweep", joint)
    averages = window_averages(data, segments, joint, length=_SWEEP_WINDOW, delays=np.array([delay]), cut=0.1)
    moving = np.abs(averages.direction) > MOVING
    data.require(len(segments) >= 6, "sweeps", joint)
    if len(np.unique(averages.cluster[moving])) < 6:
        return None
    design = np.stack(
        [averages.speed, np.sign(averages.direction), averages.acceleration, *nuisance(data, averages)], axis=1
    )
    return fit_trimmed(design[moving], averages.error[0, moving], averages.cluster[moving])


def sweep_gain(data: ExcitationLog, joint: int) -> float | None:
    """Share of a sweep's range that the joint really covers; None if the sweep was not sent (the guard forbade it)."""
    rows = np.concatenate([data.rows(segment) for segment in data.of_kind("sweep", joint)])
    asked = float(np.ptp(data.log.command[rows, joint])) if len(rows) else 0.0
    return float(np.ptp(data.log.position[rows, joint])) / asked if asked > MIN_SWEEP else None


def nuisance(data: ExcitationLog, averages: Averages) -> tuple[Array, Array]:
    """Columns (N,) of gravity torque and offset that every fit needs beside its own."""
    loaded = len(averages.gravity) > 0 and np.ptp(averages.gravity) > _MIN_TORQUE_RANGE * torque_size(data.arm)
    return averages.gravity * loaded, np.ones(len(averages.gravity))


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldPostures:
    """Settled following errors of one joint in postures held after an approach from both sides; P postures."""

    torque: Array
    """(P, 2) [N m] gravity torque at the measured postures; approached from below, from above"""
    error: Array
    """(P, 2) [rad] command minus measured position"""

    def sag(self) -> tuple[LinearFit, NDArray[np.bool_]]:
        """Line of the mean of both sides over gravity torque, and the postures (P,) it was fitted on.

        Coefficients (offset [rad], 1/k [rad/(N m)]). Postures far off the line that the others make, or
        with a far larger gap between both sides (more than 6 median absolute deviations and 10 mrad,
        chosen), are left out: there the servo is at its torque limit or something is in the way, and
        no stiffness shows.
        """
        x, y = self.torque.mean(axis=1), self.error.mean(axis=1)
        i, j = np.triu_indices(len(x), 1)
        apart = np.abs(x[i] - x[j]) > 0.1 * np.ptp(x)
        slope = float(np.median((y[j] - y[i])[apart] / (x[j] - x[i])[apart])) if apart.any() else 0.0  # Theil-Sen
        kept = _usual(y - slope * x) & _usual(self.error[:, 0] - self.error[:, 1])
        return fit_line(x[kept], y[kept]), kept


def holds(data: ExcitationLog, joint: int) -> HeldPostures:
    """Collect the holds of a joint."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for segment in data.of_kind("hold", joint):
        rows = data.rows(segment, last=SETTLED_LAST)
        if len(rows):
            _, posture, side = segment.name.split("/")
            error = float((data.log.command[rows, joint] - data.log.position[rows, joint]).mean())
            found.setdefault(posture, {})[side] = (float(data.gravity[rows, joint].mean()), error)
    pairs = np.array([[both["below"], both["above"]] for both in found.values() if len(both) == 2])
    data.require(len(pairs) >= 3, "holds", joint)
    return HeldPostures(torque=pairs[:, :, 0], error=pairs[:, :, 1])


def overshoot(data: ExcitationLog, joint: int) -> Estimate:
    """How far a joint shoots beyond where it settles after a step, as a fraction of its motion."""
    shares = []
    for segment in data.of_kind("step", joint):
        rows, end = data.rows(segment), data.rows(segment, last=SETTLED_LAST)
        if not len(end):
            continue
        position, final = data.log.position[rows, joint], float(data.log.position[end, joint].mean())
        moved = final - position[0]
        if abs(moved) > _MIN_STEP:
            shares.append(max(float((np.sign(moved) * (position - final)).max() / abs(moved)), 0.0))
    return mean_of(np.array(shares)) if shares else Estimate(0.0, 0.0, None)


def hunting(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of the motion that is left at the end of holds, when all commands have long stood still.

    A joint hunts in some postures and is quiet in others, so this is the mean over the worst quarter
    of the holds, and its bounds are the least and the most of that quarter. A motion repeats itself and
    noise does not: only the share of the power that correlates with earlier readings counts. None with fewer than four
    holds of at least four readings.
    """
    spans = [data.rows(segment, last=SETTLED_LAST) for segment in data.of_kind("hold")]
    spans = [rows for rows in spans if len(rows) >= 4]
    if len(spans) < 4:
        return None
    rest = [_without_drift(data.log.time[rows], data.log.position[rows, joint]) for rows in spans]
    worst = np.sort([float(np.sqrt((r**2).mean())) for r in rest])[-(len(rest) // 4) :]
    motion = worst * _repeating_share(rest) ** 0.5
    return Estimate(float(motion.mean()), float(motion[0]), float(motion[-1]))


def _repeating_share(pieces: list[Array]) -> float:
    """Largest correlation, 0 to 1, of the pieces with themselves one to five readings earlier; 0 for noise.

    A line that was taken out of a piece leaves a correlation even in noise, the larger the shorter the piece is. What
    counts has to differ from that by more than chance.
    """
    power = sum(float((piece**2).sum()) for piece in pieces)
    if power <= 0.0:
        return 0.0
    shares = []
    for shift in range(1, 6):
        longer = [piece for piece in pieces if len(piece) > shift]
        both = sum(float((piece[shift:] * piece[:-shift]).sum()) for piece in longer)
        base = sum(float((piece[shift:] ** 2).sum() + (piece[:-shift] ** 2).sum()) / 2 for piece in longer)
        pairs = sum(len(piece) - shift for piece in longer)
        if base > 0.0:
            off = abs(both / base - _share_of_noise([len(piece) for piece in longer], shift))
            shares.append(abs(both) / base if off * pairs**0.5 > CHANCE else 0.0)
    return min(max(shares, default=0.0), 1.0)


def _share_of_noise(lengths: list[int], shift: int) -> float:
    """Correlation with itself ``shift`` readings earlier of white noise without its line, in pieces of ``lengths``."""
    both = base = 0.0
    for length in lengths:
        line = np.linalg.qr(np.stack([np.ones(length), np.arange(length)], axis=1))[0]
        left = np.eye(length) - line @ line.T
        both += float(np.trace(left, -shift))
        base += float(np.trace(left)) - float(np.diag(left)[:shift].sum() + np.diag(left)[-shift:].sum()) / 2
    return both / base


def noise(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of a single reading while nothing is asked for, from differences of neighbours; None with under 12."""
    rows = [data.rows(segment, skip=0.5) for segment in data.of_kind("still")]
    if sum(map(len, rows)) < 12:
        return None
    steps = np.concatenate([np.diff(data.log.position[part, joint]) for part in rows])
    blocks = np.array_split(steps, 6)
    power = mean_of(np.array([float((block**2).mean()) / 2 for block in blocks]))
    low, high = max(power.low or 0.0, 0.0), max(power.high or 0.0, 0.0)
    return Estimate(power.value**0.5, low**0.5, high**0.5)


def _usual(values: Array) -> NDArray[np.bool_]:
    off = np.abs(values - np.median(values))
    return off <= max(6 * float(np.median(off)), 0.010)


def _without_drift(time: Array, value: Array) -> Array:
    return value - np.polyval(np.polyfit(time - time[0], value, 1), time - time[0])
