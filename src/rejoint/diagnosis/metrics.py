"""A joint's law, overshoot, hunting, noise and torque, from its motion and rest.

Speeds and accelerations are averages under smooth windows w: int q'' w = int q w'' (modulating functions, Shinbrot
1957).

The following error e = command - measured position of a servo with stiffness k, damping d, inertia J, gravity torque
tau and Coulomb friction F is

    e = (d/k) q' + (F/k) sign(q') + (J/k) q'' + tau/k + offset + (f/k) (|tau| - mean |tau|) sign(q')

with friction F at the mean load, which grows by f (Linderoth et al. 2013). Only the start of a step separates delay
from lag.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from rejoint.arms import CATALOGUE, Arm, Array, Index, Mask, gravity_torque
from rejoint.arms.kinematics import GRAVITY, frames, position_kinematics
from rejoint.arms.workspace import length_size, torque_size
from rejoint.control.correction import rms
from rejoint.diagnosis.regression import PER_SET, LinearFit, fit_trimmed, mean_of
from rejoint.diagnosis.segments import (
    AT_REST,
    FREE,
    HOLD,
    QUIET,
    SETTLED_LAST,
    STEP,
    STILL,
    SWEEP,
    ExcitationLog,
    Segment,
)
from rejoint.logs.exclusions import free_runs, joint_speed, velocity
from rejoint.system.numbers import interpolated
from rejoint.system.records import entity
from rejoint.system.shell import Late
from rejoint.system.statistics import Estimate

signal = Late("scipy.signal")

_GRID = 0.0025
"""[s] step of the interpolated readings; chosen"""

_STILL_SPEED = 0.05
"""[rad/s] below which motion counts less; chosen"""

_SPARSE = 0.5
"""Largest share of a window between two readings; chosen"""

_LONG = 4.0
"""[s] longest cluster; chosen"""


class Averages(NamedTuple):
    """Averages of a joint's signals, N windows, D delays."""

    error: Array
    """(D, N) [rad] delayed command minus measured position, times ``gain``"""
    command_speed: Array
    """(N,) [rad/s], without delay"""
    speed: Array
    """(N,) [rad/s]"""
    acceleration: Array
    """(N,) [rad/s^2]"""
    direction: Array
    """(N,) -1 to 1"""
    gain: Array
    """(N,) P gain over the joint's largest"""
    gravity: Array
    """(N,) [N m] that holds the arm"""
    effort: Array
    """(N,) torque or current, in the log's unit; NaN: not read"""
    load: Array
    """(N,) [N m] that gravity and the links' inertia take; without effort only gravity"""
    cluster: Index
    """(N,) number of the motion; of independent observations"""
    time: Array
    """(N,) [s] middle of the window"""

    def at(self, rows: Mask) -> Averages:
        """Only the windows ``rows`` (N,)."""
        return Averages._make(part[..., rows] for part in self)

    @property
    def design(self) -> Array:
        """(N, 5) in the order of the coefficients."""
        columns = (self.speed, np.sign(self.direction), self.acceleration, self.gravity, self.gain)
        return np.stack(columns, axis=1)

    @property
    def enough(self) -> bool:
        """Whether a law can be fitted."""
        forward = self.direction > 0.0
        ways = [len(np.unique(self.cluster[way])) for way in (forward, ~forward)]
        return min(ways) >= _FEWEST and _BOTH_WAYS < forward.mean() < 1.0 - _BOTH_WAYS


def window_averages(
    data: ExcitationLog, segments: list[Segment], joint: int, *, length: float, delays: Array, cut: float = 0.0
) -> Averages:
    """Average a joint's signals under windows of ``length`` [s], overlapping by three quarters.

    Tries ``delays`` (D,) [s]; leaves out ``cut`` [s] of each segment and gaps in the readings.
    """
    nothing = Averages(*np.zeros((len(Averages._fields), 0)))
    parts = [nothing._replace(error=np.zeros((len(delays), 0)), cluster=np.zeros(0, dtype=np.intp))]
    for index, segment in enumerate(segments):
        time = np.arange(segment.start + cut, segment.stop, _GRID)
        if len(time) * _GRID > length:
            parts.append(_averages(data, time, joint, length, delays, 1000 * index))
    return Averages._make(np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))


def _averages(
    data: ExcitationLog, time: Array, joint: int, length: float, delays: Array, first_cluster: int
) -> Averages:
    log, count = data.log, round(length / _GRID)

    def at(columns: Array) -> Array:
        return np.interp(time, log.time, columns[:, joint])

    position = at(log.position)
    window, first, second = _window(count)
    hop = max(count // 4, 1)

    def average(signal: Array, weight: Array) -> Array:
        return sliding_window_view(signal, count, axis=-1)[..., ::hop, :] @ weight / window.sum()

    smooth = ndimage.uniform_filter1d(np.gradient(position, _GRID), 41, mode="nearest")
    speed = -average(position, first)
    begins = hop * _GRID * np.arange(len(speed))
    duration = _LONG / 2 if time[-1] - time[0] > _LONG else np.inf
    apart = np.diff(log.time)
    before = np.clip(np.searchsorted(log.time, time, side="right") - 1, 0, len(apart) - 1)
    near = apart[before] <= max(_SPARSE * length, 2.0 * np.median(apart))
    gain = average(at(data.gain), window)
    return Averages(
        error=average(data.references[joint].sample(time, delays)[..., 0] - position, window) * gain,
        command_speed=-average(at(log.command), first),
        speed=speed,
        acceleration=average(position, second),
        direction=average(np.tanh(smooth / _STILL_SPEED), window),
        gain=gain,
        gravity=average(at(data.gravity), window),
        effort=average(at(data.effort), window),
        load=average(at(data.load), window),
        cluster=first_cluster + (begins / duration).astype(np.intp),
        time=time[0] + begins + 0.5 * length,
    ).at(np.asarray(sliding_window_view(near, count)[::hop].all(axis=-1)))


def _window(count: int) -> tuple[Array, Array, Array]:
    x = (np.arange(count) + 0.5) / count
    rate = np.pi / (count * _GRID)
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    return sine**4, 4 * rate * sine**3 * cosine, 4 * rate**2 * (3 * sine**2 * cosine**2 - sine**4)


_WINDOW = 0.3
"""[s] of a window; chosen"""

COARSEST = 0.11
"""[s] most between readings; chosen"""

_SETTLING = 0.2
"""[s] left out at the start of free stretches; chosen"""

_MOVING = 0.7
"""Averaged direction of a moving window; chosen: 0.04 rad/s"""

_TURNING = 0.9
"""The same of a window that tells friction by effort, without the standstill between; chosen: 0.07 rad/s"""

_SLOW, _GENTLE = 0.6, 5.0
"""[rad/s] and [rad/s^2] of slow motion; chosen"""

_BOTH_WAYS = 0.1
"""Least share of the windows in either direction; chosen"""

_FEWEST = 8
"""Independent observations per direction for a law; chosen"""

_LIGHT = 0.2
"""Share of least loaded windows to start from; chosen: keeps saturation out"""

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

LIMITED = 0.97
"""Share of the largest torque that may be a limit; chosen"""
UNEXPLAINED = 0.6
"""Share of the effort's variance of no law; chosen: of a joint that is pushed, 0.65"""
UNEVEN = 1.5
"""Ratio of speeds that tell friction by speed from dry friction; chosen"""

FADE = 2.0
"""[s] in which an integral term takes the load over; chosen: tells 0.5 to 10 s"""

LAG, WIDTH, INERTIA, SOFTNESS, OFFSET = range(5)
"""Coefficients: d/k [s], F/k [rad], J/k [s^2], 1/k [rad/(N m)], offset [rad]"""


@entity
class Law(LinearFit):
    """Of one joint, N windows."""

    torque_range: float
    """[N m] of gravity"""
    follows: float
    """share of the sag by any masses that the arm's own explain; 1 for hobby servos"""
    moments: Array | None
    """(4 n + 1, 4 n + 1) of `gravity_terms` and, last, error, in standard errors; None for hobby servos"""


_NONE = np.zeros(1)


def _motion(data: ExcitationLog, joint: int, delays: Array = _NONE, fast: bool = True) -> Averages:
    segments = data.of_kind(FREE)
    found = window_averages(data, segments, joint, length=_WINDOW, delays=delays, cut=_SETTLING)
    chosen = np.abs(found.direction) > _MOVING
    if not fast:
        chosen &= (np.abs(found.speed) < _SLOW) & (np.abs(found.acceleration) < _GENTLE)
    logs = PER_SET * np.array([segment.log for segment in segments], dtype=np.intp)
    segment, piece = np.divmod(found.cluster, 1000)  # pieces of half of `_LONG`
    pieces = 1 if fast else 2 if data.of_kind(SWEEP) else 4  # an excitation turns back every few seconds
    loaded = len(found.gravity) > 0 and np.ptp(found.gravity) > _MIN_TORQUE_RANGE * torque_size(data.arm)
    cluster = logs[segment] + 1000 * segment + piece // pieces
    found = found._replace(cluster=cluster, gravity=found.gravity * loaded).at(chosen)
    by_log = found._replace(cluster=logs[segment[chosen]])  # each log one observation, where enough of them tell
    return by_log if by_log.enough else found


def fit_law(data: ExcitationLog, joint: int, delay: float = 0.0, *, fast: bool = False) -> Law | None:
    """Fit the law to slow motion (friction, stiffness), or with ``fast`` motion (inertia).

    None with too little motion, one direction only, readings further apart than `COARSEST`, or no such law.
    """
    if not data.log.commanded or data.log.period > COARSEST:
        return None
    motion = _motion(data, joint, np.array([delay]), fast)
    if not motion.enough:
        return None
    load = np.abs(motion.gravity)
    light = load <= np.quantile(load, _LIGHT)  # at its torque limit a joint yields more than its law says
    known, error = data.arm.name in CATALOGUE, motion.error[0]  # of links that are not, it would imitate the masses
    rubbing = known * (load - load.mean()) * np.sign(motion.direction)
    design = np.column_stack([motion.design, rubbing])
    fit = fit_trimmed(design, error, motion.cluster, light)
    if np.median((error - design @ fit.coefficients) * np.sign(motion.gravity)) < 0.0:  # but never less
        fit = fit_trimmed(design, error, motion.cluster)
    every = motion if fast else _motion(data, joint, np.array([delay]))
    if rms(every.error[0] - every.design @ fit.coefficients[:-1]) > rms(every.error[0]):
        return None  # of other motion it tells less than nothing
    follows, moments = (1.0, None) if known or fast else _shared(data, motion, joint)
    return Law(
        **vars(fit),
        torque_range=np.ptp(motion.gravity),
        follows=follows,
        moments=moments,
    )


def _shared(data: ExcitationLog, motion: Averages, joint: int) -> tuple[float, Array]:
    """Share of the sag by any masses that the arm's own explain, and `Law.moments`."""
    model, error = motion.design, motion.error[0]
    base = np.delete(model, SOFTNESS, axis=1)
    columns, axes = _any_masses(data, motion, joint)
    free = np.hstack([base, axes])
    kept = _usual(error, free)
    without, own, any_masses = ((_left(error[kept], design[kept]) ** 2).sum() for design in (base, model, free))
    moments = np.linalg.qr(_left(np.column_stack([columns, error])[kept], base[kept]), mode="r")
    scale = len(np.unique(motion.cluster[kept])) ** 0.5 / max(any_masses**0.5, 1e-150)
    return (without - own) / max(without - any_masses, 1e-300), moments * scale


def _any_masses(data: ExcitationLog, motion: Averages, joint: int) -> tuple[Array, Array]:
    """`gravity_terms` (N, 4 n), and their visible axes (N, m)."""
    columns = gravity_terms(data.arm, interpolated(motion.time, data.log.time, data.log.position), joint)
    axes, sizes, _ = np.linalg.svd(columns - columns.mean(axis=0), full_matrices=False)
    return columns, axes[:, sizes > _VISIBLE * max(sizes[0], 1e-12)]


def mirrored_pulls(data: ExcitationLog, mirrors: Array) -> Array:
    """Sag (M, n, 6 + 2 n, 6 + 2 n) as `Law.moments`, as if angles (n,) were times ``mirrors`` (M, n, n).

    By gravity along each axis of the base, by 1 kg at the tip, and, for the first mirror, by gravity with each joint
    turned by 90 and by -90 degrees, and by gravity that fades. Mirrors exchange joints or turn their signs. Zeros
    without a law.
    """
    motions = [_motion(data, joint, fast=False) for joint in range(data.arm.joints)]
    quarters = 0.5 * np.pi * np.kron(np.eye(data.arm.joints), [[1.0], [-1.0]])
    size = 6 + len(quarters)
    found, log = np.zeros((*mirrors.shape[:2], size, size)), data.log
    for (k, joint), own in np.ndenumerate(np.abs(mirrors).argmax(axis=-1)):
        motion, mirror = motions[own], mirrors[k]
        if motion.enough:
            position = interpolated(motion.time, log.time, log.position) @ mirror
            pulls = [gravity_torque(data.arm, position, axis)[:, joint] for axis in np.eye(3)]
            tip = position_kinematics(data.arm, position)[1][:, :, joint] @ -GRAVITY
            others = np.zeros((size - 5, len(tip)))
            if k == 0:
                turned = [gravity_torque(data.arm, position + turn)[:, joint] for turn in quarters]
                others = np.stack([*turned, _faded(data, joint, motion.time)])
            design = np.column_stack([np.delete(motion.design, SOFTNESS, axis=1), *pulls, tip])
            error = mirror[joint, own] * motion.error[0]
            kept = _usual(error, design)
            rows = np.column_stack([design, *others, error])[kept]
            root = np.linalg.qr(np.pad(rows, ((0, size), (0, 0))), mode="r")[-size:, -size:]  # type: ignore[call-overload]
            found[k, joint] = (
                root * len(np.unique(motion.cluster[kept])) ** 0.5 / max(np.linalg.norm(root[4:, -1]), 1e-150)
            )
    return found


def _faded(data: ExcitationLog, joint: int, time: Array) -> Array:
    """Gravity's torque (N,) at ``time`` (N,) that an integral term has not taken over."""
    grid, keeps = np.arange(data.log.time[0], data.log.time[-1], 0.01 * FADE), np.exp(-0.01)
    pull = np.interp(grid, data.log.time, data.gravity[:, joint])
    taken = signal.lfilter([1.0 - keeps], [1.0, -keeps], pull, zi=keeps * pull[:1])[0]
    return np.interp(time, grid, pull - taken)


def _left(values: Array, design: Array) -> Array:
    return values - design @ np.linalg.lstsq(design, values, rcond=None)[0]


def _usual(error: Array, design: Array) -> Mask:
    rest = np.abs(_left(error, design))
    return rest <= 5 * 1.48 * np.median(rest)


def gravity_terms(arm: Arm, position: Array, joint: int) -> Array:
    """Torques (N, 4 n) of a joint at ``position`` (N, n) by gravity on each link.

    Per mass [m^2/s^2], and per mass times its place along each axis of the link [m/s^2].
    """
    found = frames(arm, position)
    pull = np.cross(found.axis[:, joint], GRAVITY)[:, None]
    lever = ((found.position - found.position[:, joint, None]) * pull).sum(axis=-1)
    turned = (pull[..., None] * found.rotation).sum(axis=-2)
    terms = np.concatenate([lever[..., None], turned], axis=-1)
    terms[:, :joint] = 0.0
    return terms.reshape(len(position), -1)


def fit_effort(data: ExcitationLog, joint: int, *, own: bool = False) -> LinearFit | None:
    """Fit torque or current to the law, with the links' inertia; None with too little motion, or most unexplained.

    Outside the catalogue by any masses, or by their ``own``. Friction grows with the speed where speeds differ.
    """
    motion = _motion(data, joint)
    motion = motion.at((np.abs(motion.direction) > _TURNING) & np.isfinite(motion.effort))
    if not motion.enough:
        return None
    design = motion.design
    design[:, WIDTH], design[:, SOFTNESS] = motion.direction, motion.load
    if not own and data.arm.name not in CATALOGUE:
        design = np.hstack([design, _any_masses(data, motion, joint)[1]])
    slow, fast = np.quantile(np.abs(design[:, LAG]), [0.05, 0.95])
    found = fit_trimmed(design, motion.effort, motion.cluster)
    if not own and not (fast > UNEVEN * slow and found.estimate(LAG).low > 0.0):  # type: ignore[operator]
        design[:, LAG] = 0.0
        found = fit_trimmed(design, motion.effort, motion.cluster)
    left = motion.effort - design @ found.coefficients
    return found if left.var() < UNEXPLAINED * motion.effort.var() else None


def fit_torque(data: ExcitationLog, joint: int) -> LinearFit | None:
    """Fit the following error to logged torque [N m], speeds, and gravity that may be fed forward; None without torque.

    A servo's torque over its following error is its stiffness, whatever the links weigh.
    """
    if data.effort_unit != "N m" or not data.log.commanded:
        return None
    motion, most = _motion(data, joint), np.fmax.reduce(np.abs(data.effort[:, joint]))
    motion = motion.at(np.abs(motion.effort) < LIMITED * most)  # at its limit the torque does not tell the error
    if not motion.enough:
        return None
    design = motion.design
    design[:, WIDTH], design[:, INERTIA], design[:, SOFTNESS] = motion.command_speed, motion.gravity, motion.effort
    return fit_trimmed(design, motion.error[0], motion.cluster)


def followed(data: ExcitationLog, joint: int) -> float | None:
    """Share of its commands that a joint follows, by regression, preferably in sweeps; None without."""
    rows = np.concatenate([data.rows(segment) for segment in data.of_kind(SWEEP, joint) or data.of_kind(FREE)])
    asked = data.log.command[rows, joint]
    if not data.log.commanded or not len(rows) or np.ptp(asked) <= MIN_SWEEP:
        return None
    asked = asked - asked.mean()
    return asked @ data.log.position[rows, joint] / (asked @ asked)


def farthest_off(data: ExcitationLog, joint: int, law: Law | None) -> float:
    """[rad] distance that law and friction leave while, for `SETTLED_LAST`, the joint comes no nearer."""
    lag, width, _, softness, offset, _ = np.zeros(6) if law is None else law.coefficients
    rows = np.concatenate([data.rows(one) for one in data.of_kind(FREE)])
    time, command, position = (
        data.log.time[rows],
        data.log.command[rows, joint, None],
        data.log.position[rows, joint, None],
    )
    error, gain = (command - position)[:, 0] - offset, data.gain[rows, joint]
    error -= softness / gain * data.gravity[rows, joint]
    beyond = np.maximum(np.abs(error) - width / gain, 0.0)
    nearing = np.sign(error) * velocity(time, position, 4)[:, 0]
    runs = free_runs(nearing < AT_REST, time, SETTLED_LAST)
    left = (joint_speed(time, command) >= AT_REST) | (np.diff(time, prepend=time[:1]) > QUIET)
    known = data.log.period <= COARSEST  # else, and before a command moves, the joint may be on its way
    runs = [(a, b) for a, b in runs if known and np.append(left, True)[b]]
    count = max(round((SETTLED_LAST + 2.0 * max(lag, 0.0)) / data.log.period), 1)  # a joint needs its lag to turn round
    stood = [sliding_window_view(beyond[a:b], min(count, b - a)).min(axis=-1).max() for a, b in runs]
    return max(stood, default=0.0)


def overshoot(data: ExcitationLog, joint: int) -> Estimate:
    """Overshoot of steps, as a fraction of the motion."""
    shares = []
    for segment in data.of_kind(STEP, joint):
        position, final = (data.log.position[data.rows(segment, last=last), joint] for last in (np.inf, SETTLED_LAST))
        moved = final.mean() - position[0] if len(final) else 0.0
        if abs(moved) > _MIN_STEP:
            shares.append(max((np.sign(moved) * (position - final.mean())).max() / abs(moved), 0.0))
    return mean_of(np.array(shares)) if shares else Estimate(0.0, 0.0, None)


def hunting(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of motion at the end of holds, without uncorrelated noise: mean, least and most of the worst quarter.

    None with fewer than four holds of four readings.
    """
    spans = [data.rows(segment, last=SETTLED_LAST) for segment in data.of_kind(HOLD)]
    rest = [signal.detrend(data.log.position[rows, joint]) for rows in spans if len(rows) >= 4]
    if len(rest) < 4:
        return None
    worst = np.sort([rms(r) for r in rest])[-(len(rest) // 4) :]
    motion = worst * _repeating_share(rest) ** 0.5
    return Estimate(motion.mean(), motion[0], motion[-1])


def _repeating_share(pieces: list[Array]) -> float:
    """Largest autocorrelation, 0 to 1, over one to five readings, or half a piece.

    0 if it may be that of noise without its line.
    """
    noise, share = [signal.detrend(np.eye(len(piece)), axis=0) for piece in pieces], 0.0
    for shift in range(1, min(5, min(map(len, pieces)) // 2) + 1):
        pairs = sum(len(piece) - shift for piece in pieces)
        both, chance = _correlation(pieces, shift), _correlation(noise, shift)
        if abs(both - chance) * pairs**0.5 > CHANCE:
            share = max(share, abs(both))
    return share


def _correlation(pieces: list[Array], shift: int) -> float:
    early, late = (np.concatenate([p[rows].ravel() for p in pieces]) for rows in (slice(-shift), slice(shift, None)))
    return early @ late / max(np.linalg.norm(early) * np.linalg.norm(late), 1e-300)


def noise(data: ExcitationLog, joint: int) -> Estimate | None:
    """Rms [rad] of a reading at rest, from neighbours' differences; None with under 12."""
    rows = [data.rows(segment, skip=0.5) for segment in data.of_kind(STILL)]
    if sum(map(len, rows)) < 12:
        return None
    steps = np.concatenate([np.diff(data.log.position[part, joint]) for part in rows])
    power = mean_of(np.array([(block**2).mean() / 2 for block in np.array_split(steps, 6)]))
    return Estimate(*((one or 0.0) ** 0.5 for one in (power.value, power.low, power.high)))


LONGEST, SLOWEST = 0.08, 0.3
"""[s] longest delay of a usual link, or two periods of a slow bus, and of any; chosen"""

_USUAL_DELAY = 0.02
"""[s] where no joint moves; chosen"""

_ONSET = 1.5
"""Beginning of a step that decides, over the longest delay; chosen"""

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
    longest, far = max(LONGEST, 2.0 * data.log.period), _delay(data, SLOWEST)
    return far if far > longest else _delay(data, longest)


def _delay(data: ExcitationLog, longest: float) -> float:
    found, delays = [], np.arange(0.005, longest + 1e-4, 0.005)
    for joint in range(data.arm.joints):
        motion = _motion(data, joint, delays)
        if len(motion.time) >= _MIN_WINDOWS:  # a joint that does not move has no time of its own
            fits = np.asarray(np.linalg.lstsq(motion.design, motion.error.T, rcond=None)[0].T)
            costs = _onset_costs(data, joint, delays, fits)
            found += [_lowest(delays, costs)] if np.isfinite(costs).any() else []
    return np.quantile(found, 0.25) if found else _USUAL_DELAY


def _lowest(delays: Array, cost: Array) -> float:
    """Delay [s] at the minimum of a parabola through the lowest cost (D,)."""
    i = np.argmin(cost)
    before, here, after = np.pad(cost, 1, constant_values=np.inf)[i : i + 3]
    bend = before - 2 * here + after  # infinite at either end
    aside = 0.5 * (before - after) / bend if np.isfinite(bend) and bend > 0.0 else 0.0
    return delays[i] + (delays[1] - delays[0]) * aside


def _onset_costs(data: ExcitationLog, joint: int, delays: Array, fits: Array) -> Array:
    """Squared errors (D,) of simulated step beginnings by laws (D, 5)."""
    log, steps = data.log, data.of_kind(STEP, joint)
    data.require(len(steps) >= 2, "steps", joint)
    offsets = np.arange(0.0, _ONSET * delays[-1], _STEP)
    time = np.array([s.start for s in steps])[:, None] + offsets  # (S, K)
    before = np.maximum(np.searchsorted(log.time, time[:, 0]) - 1, 0)
    start = log.position[before, joint]
    sent = data.references[joint].sample(time.ravel(), delays).reshape(-1, *time.shape)
    drive = sent - log.command[before, joint][:, None]  # (D, S, K)
    lag, half_width, ratio = np.maximum(fits.T[:3, :, None], np.array([0.0, 0.0, _MIN_RATIO])[:, None, None])
    way, speed = np.zeros(drive.shape[:2]), np.zeros(drive.shape[:2])
    cost = np.zeros(len(delays))
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


def torque_given(data: ExcitationLog, joint: int, law: Law, stiffness: float, delay: float) -> dict[str, Any]:
    """Compare the torque that a joint's law asks for with that of its load, in steady motion; see `JointMetrics`.

    A joint is behind where it hardly turns and the demand exceeds twice the torque, friction, `_EXCESS`, two
    encoder steps and 10 ms. It is at its limit if behind for `_MIN_SHARE` of the time, near its largest torque.
    """
    segments = [s for s in data.segments if s.kind in (SWEEP, STEP, "multisine", HOLD)]
    found = window_averages(data, segments, joint, length=_TORQUE_WINDOW, delays=np.array([delay]))
    found = found.at(np.abs(found.acceleration) < _STEADY / length_size(data.arm))
    data.require(len(found.time) >= _MIN_WINDOWS, "steady moments", joint)
    lag, half_width, _, _, offset, _ = law.coefficients
    friction = stiffness * max(half_width, 0.0)
    demand = stiffness * (found.error[0] - offset - lag * found.speed)
    given = found.gravity + friction * found.direction
    margin = 2 * friction + stiffness * (2 * data.arm.encoder_step + 0.010 * np.abs(found.command_speed))
    excess = np.abs(demand) - np.abs(given)
    behind = (excess > np.abs(given)) & (demand * given > 0) & (np.abs(found.speed) < _STANDING)
    behind &= excess > margin + _EXCESS * torque_size(data.arm)
    seen, share = np.quantile(np.abs(given), 0.995), behind.mean()
    of, size = found.cluster[behind], np.abs(given[behind])
    limit = mean_of(ndimage.median(size, of, np.unique(of))) if share >= _MIN_SHARE else None
    if limit is None or limit.value < 0.5 * seen:  # it could give more, and something else held it back
        return {}
    return {"torque_limit_nm": limit, "saturated_share": share}
