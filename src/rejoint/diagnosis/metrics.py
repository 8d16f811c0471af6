"""A joint's law, overshoot, hunting, noise and torque, from its motion and rest.

The following error e = command - measured position of a servo with stiffness k, damping d, inertia J, gravity torque
tau and Coulomb friction F is

    e = (d/k) q' + (F/k) sign(q') + (J/k) q'' + tau/k + offset.

`fit_law` fits all terms to moving moments of any log. Only the start of a step separates delay from lag: each delay
gets its own fit, and the one that predicts these starts best wins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import CATALOGUE, Arm, Array, gravity_torque
from rejoint.arms.workspace import length_size, torque_size
from rejoint.diagnosis.modulation import window_averages
from rejoint.diagnosis.regression import LinearFit, fit_trimmed, mean_of
from rejoint.diagnosis.segments import FREE, HOLD, STEP, STILL, SWEEP, ExcitationLog, log_of
from rejoint.system.statistics import Estimate

SETTLED_LAST = 0.4
"""[s] at the end of a hold or step; chosen"""

_WINDOW = 0.3
"""[s] of a window; chosen"""

COARSEST = 0.1
"""[s] most between readings; chosen"""

_SETTLING = 0.2
"""[s] left out at the start of free stretches; chosen"""

_MOVING = 0.7
"""Averaged direction of a moving window; chosen: 0.04 rad/s"""

_SLOW, _GENTLE = 0.6, 5.0
"""[rad/s] and [rad/s^2] of slow motion; chosen"""

_BOTH_WAYS = 0.1
"""Least share of the windows in either direction; chosen"""

_FEWEST = 8
"""Independent observations per direction for a law; chosen"""

_LIGHT = 0.2
"""Share of least loaded windows to start from; chosen: keeps saturation out"""

_MANY_LOGS = 8
"""Logs from which each is one observation; chosen"""

_VISIBLE = 1e-3
"""Least relative effect of masses that shows; chosen"""

_MIN_TORQUE_RANGE = 2e-3
"""[N m] least range of gravity's torque on a myCobot 280; chosen"""

MIN_SWEEP = 0.1
"""[rad] least range of commands for a sweep gain; chosen"""

_MIN_STEP = 0.02
"""[rad] least motion for a relative overshoot; chosen"""

CHANCE = 3.0
"""Standard errors from which a correlation is not chance; chosen"""

LAG, WIDTH, INERTIA, SOFTNESS, OFFSET = range(5)
"""Coefficients: d/k [s], F/k [rad], J/k [s^2], 1/k [rad/(N m)], offset [rad]"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """Of one joint, N windows."""

    fit: LinearFit
    torque_range: float
    """[N m] of gravity"""
    follows: float = 1.0
    """share of the sag by any masses that the arm's own explain; 1 for hobby servos"""


@dataclass(frozen=True, kw_only=True, eq=False)
class _LogMotion:
    design: Array
    """(N, 5) in the order of the coefficients"""
    error: Array
    """(D, N) [rad] for each delay"""
    effort: Array
    cluster: NDArray[np.intp]
    """(N,) independent observation"""
    position: Array
    """(N, n) [rad]"""

    @property
    def enough(self) -> bool:
        forward = self.design[:, WIDTH] > 0.0
        ways = [len(np.unique(self.cluster[way])) for way in (forward, ~forward)]
        return min(ways) >= _FEWEST and bool(_BOTH_WAYS < forward.mean() < 1.0 - _BOTH_WAYS)

    @property
    def torque_range(self) -> float:
        return float(np.ptp(self.design[:, SOFTNESS])) if len(self.design) else 0.0


def _motion(data: ExcitationLog, joint: int, delays: Array, *, fast: bool) -> _LogMotion:
    segments = data.of_kind(FREE)
    averages = window_averages(data, segments, joint, length=_WINDOW, delays=delays, cut=_SETTLING)
    chosen = np.abs(averages.direction) > _MOVING
    if not fast:
        chosen &= (np.abs(averages.speed) < _SLOW) & (np.abs(averages.acceleration) < _GENTLE)
    logs = np.array([log_of(segment) for segment in segments], dtype=np.intp)
    segment, piece = np.divmod(averages.cluster, 1000)  # pieces of 2 s, see `rejoint.diagnosis.modulation`
    cluster = 1000 * segment + piece // (1 if fast else 4)
    if len(np.unique(logs)) >= _MANY_LOGS:
        cluster = logs[segment]
    gravity = averages.gravity
    loaded = len(gravity) > 0 and np.ptp(gravity) > _MIN_TORQUE_RANGE * torque_size(data.arm)
    columns = (averages.speed, np.sign(averages.direction), averages.acceleration, gravity * loaded)
    design = np.stack([*columns, np.ones(len(gravity))], axis=1)
    time, log = averages.time[chosen], data.log
    return _LogMotion(
        design=design[chosen],
        error=averages.error[:, chosen],
        effort=averages.effort[chosen],
        cluster=cluster[chosen],
        position=np.stack([np.interp(time, log.time, column) for column in log.position.T], axis=1),
    )


def fit_law(data: ExcitationLog, joint: int, delay: float = 0.0, *, fast: bool = False) -> Law | None:
    """Fit the law to slow motion (friction, stiffness), or with ``fast`` motion (inertia).

    None with too little motion, one direction only, or readings further apart than `COARSEST`.
    """
    if not data.log.commanded or float(np.median(np.diff(data.log.time))) > COARSEST:
        return None
    motion = _motion(data, joint, np.array([delay]), fast=fast)
    if not motion.enough:
        return None
    load = np.abs(motion.design[:, SOFTNESS])
    light = load <= np.quantile(load, _LIGHT)  # at its torque limit a joint yields more than its law says
    fit = fit_trimmed(motion.design, motion.error[0], motion.cluster, light)
    follows = 1.0 if data.arm.name in CATALOGUE else _follows(data.arm, motion, joint)
    return Law(fit=fit, torque_range=motion.torque_range, follows=follows)


def _follows(arm: Arm, motion: _LogMotion, joint: int) -> float:
    """Share of the sag by any masses that the arm's own explain.

    It is low where a controller compensates gravity, or masses are wrong.
    """
    model, error = motion.design, motion.error[0]
    base = np.delete(model, SOFTNESS, axis=1)
    columns = gravity_terms(arm, motion.position)[:, joint]
    axes, sizes, _ = np.linalg.svd(columns - columns.mean(axis=0), full_matrices=False)
    free = np.hstack([base, axes[:, sizes > _VISIBLE * max(float(sizes[0]), 1e-12)]])

    def left(design: Array, rows: NDArray[np.bool_]) -> Array:
        fitted = np.linalg.lstsq(design[rows], error[rows], rcond=None)[0]
        return np.asarray(error - design @ fitted)

    rest = np.abs(left(free, np.ones(len(error), dtype=bool)))
    kept = rest <= 5 * 1.48 * float(np.median(rest))
    without, own, any_masses = (float((left(design, kept)[kept] ** 2).sum()) for design in (base, model, free))
    return (without - own) / max(without - any_masses, 1e-300)


def gravity_terms(arm: Arm, position: Array) -> Array:
    """Gravity torques (N, n, 4 n) [N m] at ``position`` (N, n) by 1 kg in each link, at its joint and 1 m off."""
    places = np.vstack([np.zeros(3), np.eye(3)])
    loads = [replace(arm, mass=mass, com=mass[:, None] * place) for mass in np.eye(arm.joints) for place in places]
    return np.stack([gravity_torque(load, position) for load in loads], axis=-1)


def fit_effort(data: ExcitationLog, joint: int) -> LinearFit | None:
    """Fit torque or current to the terms of the law; None with too little motion."""
    motion = _motion(data, joint, np.zeros(1), fast=True)
    if data.effort_unit is None or not motion.enough:
        return None
    return fit_trimmed(motion.design, motion.effort, motion.cluster)


def followed(data: ExcitationLog, joint: int) -> float | None:
    """Share of the commands' range that a joint covers, preferably in sweeps; None without."""
    rows = np.concatenate([data.rows(segment) for segment in data.of_kind(SWEEP, joint) or data.of_kind(FREE)])
    asked = float(np.ptp(data.log.command[rows, joint])) if len(rows) else 0.0
    return float(np.ptp(data.log.position[rows, joint])) / asked if asked > MIN_SWEEP else None


def farthest_off(data: ExcitationLog, joint: int, law: Law | None) -> float:
    """[rad] largest distance at rest that law and friction leave."""
    _, width, _, softness, offset = np.zeros(5) if law is None else law.fit.coefficients
    found = [0.0]
    for segment in data.of_kind(HOLD, joint):
        rows = data.rows(segment, last=SETTLED_LAST)
        if len(rows):
            error = data.log.command[rows, joint] - data.log.position[rows, joint]
            found.append(np.abs((error - offset - softness * data.gravity[rows, joint]).mean()) - width)
    return float(max(found))


def overshoot(data: ExcitationLog, joint: int) -> Estimate:
    """Overshoot of steps, as a fraction of the motion."""
    shares = []
    for segment in data.of_kind(STEP, joint):
        rows, end = data.rows(segment), data.rows(segment, last=SETTLED_LAST)
        if not len(end):
            continue
        position, final = data.log.position[rows, joint], float(data.log.position[end, joint].mean())
        moved = final - position[0]
        if abs(moved) > _MIN_STEP:
            shares.append(max(float((np.sign(moved) * (position - final)).max() / abs(moved)), 0.0))
    return mean_of(np.array(shares)) if shares else Estimate(0.0, 0.0, None)


def hunting(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of motion at the end of holds, without uncorrelated noise: mean, least and most of the worst quarter.

    None with fewer than four holds of four readings.
    """
    spans = [data.rows(segment, last=SETTLED_LAST) for segment in data.of_kind(HOLD)]
    spans = [rows for rows in spans if len(rows) >= 4]
    if len(spans) < 4:
        return None
    rest = [_without_drift(data.log.time[rows], data.log.position[rows, joint]) for rows in spans]
    worst = np.sort([float(np.sqrt((r**2).mean())) for r in rest])[-(len(rest) // 4) :]
    motion = worst * _repeating_share(rest) ** 0.5
    return Estimate(float(motion.mean()), float(motion[0]), float(motion[-1]))


def _repeating_share(pieces: list[Array]) -> float:
    """Largest autocorrelation, 0 to 1, over one to five readings; 0 for noise."""
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
    """Return the same for white noise less its line."""
    both = base = 0.0
    for length in lengths:
        line = np.linalg.qr(np.stack([np.ones(length), np.arange(length)], axis=1))[0]
        left = np.eye(length) - line @ line.T
        both += float(np.trace(left, -shift))
        base += float(np.trace(left)) - float(np.diag(left)[:shift].sum() + np.diag(left)[-shift:].sum()) / 2
    return both / base


def noise(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of a reading at rest, from neighbours' differences; None with under 12."""
    rows = [data.rows(segment, skip=0.5) for segment in data.of_kind(STILL)]
    if sum(map(len, rows)) < 12:
        return None
    steps = np.concatenate([np.diff(data.log.position[part, joint]) for part in rows])
    blocks = np.array_split(steps, 6)
    power = mean_of(np.array([float((block**2).mean()) / 2 for block in blocks]))
    low, high = max(power.low or 0.0, 0.0), max(power.high or 0.0, 0.0)
    return Estimate(power.value**0.5, low**0.5, high**0.5)


def _without_drift(time: Array, value: Array) -> Array:
    return value - np.polyval(np.polyfit(time - time[0], value, 1), time - time[0])


DELAYS = np.arange(0.005, 0.0801, 0.005)
"""[s] tried: idle bus to two periods of a slow one"""

_USUAL_DELAY = 0.02
"""[s] where no joint moves; chosen"""

_ONSET = 0.12
"""[s] of a step that decide the delay; chosen"""

_STEP = 0.0025
"""[s] step of that simulation; chosen"""

_TORQUE_WINDOW = 0.2
"""[s]; chosen"""

_MIN_WINDOWS = 40
"""Windows that a delay and a torque limit need; chosen: about 2 s"""

_EXCESS = 0.15
"""[N m] between demand and torque by chance, on a myCobot 280; chosen"""

_MIN_SHARE = 0.006
"""Share of the steady time at the limit; chosen on emulated arms"""

_STEADY = 1.5
"""[rad/s^2] of a myCobot 280 in steady motion; chosen"""

_STANDING = 0.2
"""[rad/s] of a lagging joint at top speed; chosen"""

_MIN_RATIO = 5e-5
"""[s^2] least trusted J/k: 22 Hz; chosen"""


def arm_delay(data: ExcitationLog) -> float:
    """Delay [s] of commands and answers: lower quartile of the joints."""
    found = []
    for joint in range(data.arm.joints):
        motion = _motion(data, joint, DELAYS, fast=True)
        if len(motion.design) < _MIN_WINDOWS:  # a joint that does not move has no time of its own
            continue
        fits: Array = np.asarray(np.linalg.lstsq(motion.design, motion.error.T, rcond=None)[0].T, dtype=np.float64)
        found.append(_lowest(_onset_costs(data, joint, fits)))
    return float(np.quantile(found, 0.25)) if found else _USUAL_DELAY


def _lowest(cost: Array) -> float:
    """Delay [s] at the minimum of a parabola through the lowest cost (D,)."""
    i = int(np.argmin(cost))
    around = np.pad(cost, 1, constant_values=np.inf)[i : i + 3]
    if not np.isfinite(around).all():
        return float(DELAYS[i])
    before, here, after = around
    bend = before - 2 * here + after
    aside = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(DELAYS[i] + (DELAYS[1] - DELAYS[0]) * aside)


def _onset_costs(data: ExcitationLog, joint: int, fits: Array) -> Array:
    """Squared errors (D,) of simulated step beginnings by laws (D, 5)."""
    log, steps = data.log, data.of_kind(STEP, joint)
    data.require(len(steps) >= 2, "steps", joint)
    offsets = np.arange(0.0, _ONSET, _STEP)
    time = np.array([s.start for s in steps])[:, None] + offsets  # (S, K)
    before = np.maximum(np.searchsorted(log.time, time[:, 0]) - 1, 0)
    start = log.position[before, joint]
    drive = data.commanded(joint, time - DELAYS[:, None, None]) - log.command[before, joint][:, None]  # (D, S, K)
    lag, half_width, ratio = np.maximum(fits.T[:3, :, None], np.array([0.0, 0.0, _MIN_RATIO])[:, None, None])
    way, speed = np.zeros(drive.shape[:2]), np.zeros(drive.shape[:2])
    cost = np.zeros(len(DELAYS))
    answers = [np.interp(t, log.time, log.position[:, joint]) for t in time]
    moved = np.array(answers) - start[:, None]
    for k in range(len(offsets)):
        push = drive[..., k] - way
        sticks = (np.abs(speed) < 1e-3) & (np.abs(push) < half_width)
        against = np.where(np.abs(speed) < 1e-3, np.sign(push), np.sign(speed))
        # implicit in the lag term: a stiff joint's lag is shorter than the step
        speed = (speed + _STEP * (push - half_width * against) / ratio) / (1 + _STEP * lag / ratio)
        speed = np.where(sticks, 0.0, speed)
        way = way + _STEP * speed
        cost += ((way - moved[:, k]) ** 2).sum(axis=1)
    return np.where(fits[:, INERTIA] > _MIN_RATIO, cost, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Torque:
    """Torque demanded and given."""

    limit: Estimate | None
    """[N m] at the load: motor limit less friction; None: not reached"""
    seen: float
    """[N m] largest given"""
    saturated_share: float
    """of the time, at the limit"""


def torque_given(data: ExcitationLog, joint: int, law: Law, stiffness: float, delay: float) -> Torque:
    """Compare the torque that a joint's law asks for with that of its load, in steady motion.

    A joint is behind where it hardly turns and the demand is over twice the torque, beyond friction, `_EXCESS` and
    10 ms. It is at its limit if behind for `_MIN_SHARE` of the time, near its largest torque.
    """
    segments = [s for s in data.segments if s.kind in (SWEEP, STEP, "multisine", HOLD)]
    averages = window_averages(data, segments, joint, length=_TORQUE_WINDOW, delays=np.array([delay]))
    steady = np.abs(averages.acceleration) < _STEADY / length_size(data.arm)
    data.require(int(steady.sum()) >= _MIN_WINDOWS, "steady moments", joint)
    lag, half_width, _, _, offset = law.fit.coefficients
    half_width = max(half_width, 0.0)
    demand = (stiffness * (averages.error[0] - offset - lag * averages.speed))[steady]
    given = (averages.gravity + stiffness * half_width * averages.direction)[steady]
    margin = 2 * half_width + 0.010 * np.abs(averages.command_speed[steady])
    excess = np.abs(demand) - np.abs(given)
    behind = (
        (excess > np.abs(given))
        & (demand * given > 0)
        & (excess > stiffness * margin + _EXCESS * torque_size(data.arm))
        & (np.abs(averages.speed[steady]) < _STANDING)
    )
    cluster = averages.cluster[steady]
    seen = float(np.quantile(np.abs(given), 0.995))
    share = float(behind.mean())
    if share < _MIN_SHARE:
        return Torque(limit=None, seen=seen, saturated_share=0.0)
    clusters = np.unique(cluster[behind])
    limits = [float(np.median(np.abs(given[behind & (cluster == c)]))) for c in clusters]
    limit = mean_of(np.array(limits))
    if limit.value < 0.5 * seen:  # it could give more than this, and something else held it back
        return Torque(limit=None, seen=seen, saturated_share=0.0)
    return Torque(limit=limit, seen=seen, saturated_share=share)
