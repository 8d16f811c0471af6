"""The lines of load over error of an arm's servos, read from logs of its own motion.

A position servo gives a torque in proportion to the error that it sees. While its joint stands, what it tells of its
torque is a line over command minus reading, with a slope (`Knowledge.gain`) and an offset. Wherever joints of a log
stand under commands that rest, and the load is neither at its end nor in the servo's dead zone, the line can be seen;
friction, sag and play do not enter it. A joint whose leads hardly differ, or whose loads do not lie on a line, is left
unknown: on healthy arms those that no weight loads, since they never stand away from their command.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.control.following import Following, Knowledge, states_of
from rejoint.logs.runlog import RunLog
from rejoint.system.late import Late

watching = Late("rejoint.control.watching")

FEWEST = 50
"""rows from which a line is drawn (chosen: two seconds of standing at 25 ms)"""
STILL = 4
"""rows for which a reading must have stood (chosen, as `watching.LEARN_STILL`)"""
AT_REST = np.radians(0.1)
"""[rad] by which commands may differ meanwhile (chosen: an encoder count)"""
SURE = 4.0
"""Times the residual over the spread of the leads that a slope may be wrong (chosen). The number of rows does not make
it smaller: a reading that flickers unseen bends all of them the same way."""
LEAST_ERROR = 0.01
"""relative error of a slope that is never fallen below (chosen: a register counts loads in thousandths, and they are
seldom more than a tenth)"""
LEAST_NOISE = 0.001
"""share of the largest torque, likewise (chosen: registers count in thousandths)"""
HUBER = 2.0
"""Residuals, in robust standard deviations, from which a row counts for less (chosen)"""
_ROUNDS = 20  # of reweighting (chosen: it settles in ten)
PER_MEDIAN = 1.4826
"""Standard deviation of normal residuals over the median of their sizes"""


def servo_lines(arm: Arm, logs: Sequence[RunLog]) -> Knowledge | None:
    """Read what ``logs`` of an arm tell of its servos; None where they tell of none.

    A joint that would be taken for one that turns in these logs themselves is unknown too.
    """
    told = [log for log in logs if log.servo_load is not None]
    rows = [_standing(arm, log, log.servo_load) for log in logs if log.servo_load is not None]
    if not rows:
        return None
    lines = [_line(*(np.concatenate([part[k][:, j] for part in rows]) for k in range(3))) for j in range(arm.joints)]
    gain, offset, within, noise = np.array(lines).T
    within = np.where(within < watching.KNOWN, within, np.inf)
    for log in told:
        known = _knowledge(gain, offset, within, noise)
        if known is not None:
            within = np.where(_turns(arm, log, known), np.inf, within)
    return _knowledge(gain, offset, within, noise)


def _knowledge(gain: Array, offset: Array, within: Array, noise: Array) -> Knowledge | None:
    known = np.isfinite(within)
    if not known.any():
        return None
    return Knowledge(
        gain=np.where(known, gain, 1.0), offset=np.where(known, offset / gain, 0.0), within=within,
        noise=np.where(known, noise, 1.0),
    )  # fmt: skip


def _standing(arm: Arm, log: RunLog, load: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Leads (T, n) [rad] and the loads (T, n) of a log, and where (T, n) they say something of the line."""
    low, high = commands_in_force(log)
    lead = 0.5 * (low + high) - log.position
    moved = np.vstack([np.ones((1, arm.joints), dtype=bool), np.diff(log.position, axis=0) != 0.0])
    last = np.maximum.accumulate(np.where(moved, np.arange(len(log))[:, None], 0), axis=0)
    stands = np.arange(len(log))[:, None] - last >= STILL
    dead = watching.COUNTS * arm.encoder_step
    told = np.abs(load) < watching.FULL  # not where it is NaN
    return lead, load, stands & told & (high - low < AT_REST) & (np.abs(lead) > dead)


def commands_in_force(log: RunLog) -> tuple[Array, Array]:
    """Lowest and highest command (T, n) [rad] of those that may be in force at each row."""
    rows = np.arange(len(log))
    oldest = np.searchsorted(log.time, log.time - watching.SETTLE, side="right") - 1
    low = high = log.command[np.maximum(rows - 1, 0)]
    for back in range(2, watching.HISTORY + 1):
        command = log.command[np.maximum(np.maximum(rows - back, oldest), 0)]
        low, high = np.minimum(low, command), np.maximum(high, command)
    return low, high


def _line(lead: Array, load: Array, use: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    """Slope [1/rad], offset, relative error of the slope (infinite: unknown) and noise of one joint, robustly."""
    lead, load = lead[use], load[use]
    unknown = (1.0, 0.0, np.inf, 1.0)
    if len(lead) < FEWEST or np.ptp(lead) == 0.0:
        return unknown
    columns, weight = np.stack([lead, np.ones_like(lead)], axis=-1), np.ones_like(lead)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        slope, offset = np.linalg.lstsq(columns * root[:, None], load * root)[0]
        off = np.abs(load - columns @ (slope, offset))
        noise = max(PER_MEDIAN * float(np.median(off)), LEAST_NOISE)
        weight = np.minimum(1.0, HUBER * noise / np.maximum(off, 1e-12))
    if slope <= 0.0:
        return unknown
    return float(slope), float(offset), LEAST_ERROR + SURE * noise / (slope * float(lead.std())), noise


def _turns(arm: Arm, log: RunLog, known: Knowledge) -> NDArray[np.bool_]:
    """Joints (n,) that the monitor takes for turning ones somewhere in a log of an arm that was whole."""
    states = states_of(log)
    following, found = Following(arm, next(states), log.command[:1], known), np.zeros(arm.joints, dtype=bool)
    for row, state in enumerate(states):
        bad = following.check(state, log.command[row : row + 1], np.zeros(1, dtype=bool))
        if bad is not None:
            found |= bad[0]
    return found
