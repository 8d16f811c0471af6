"""Under which conditions a log was recorded, where those are declared: gains of the servos, and torque switched off.

They stand in the log itself (`RunLog.extra`), as text. ``gain`` is the servos' position gain over that which the twin
is to have, one number or one for each joint: ``0.5`` or ``1 0.5 1``. ``torque_off`` are times in which the servos give
no torque, in seconds since the start of the log: ``3-7.5 12-14``. A twin says nothing of them, so the log is cut there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rejoint.arms import Array
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError

GAIN, TORQUE_OFF = "gain", "torque_off"
"""Keys in `RunLog.extra`"""


def declare(logs: Sequence[RunLog], key: str, values: Mapping[str, str]) -> list[RunLog]:
    """Give the logs whose labels ``values`` names their value of ``key``; InputError if there is no such log."""
    unknown = sorted(set(values) - {log.label for log in logs})
    if unknown:
        raise InputError(
            f"{key}: there is no motion {', '.join(unknown)}; there are {', '.join(x.label for x in logs)}"
        )
    found = [replace(x, extra={**x.extra, key: values[x.label]}) if x.label in values else x for x in logs]
    for log in found:
        gains(log)
        spans_off(log)
    return found


def gains(log: RunLog) -> Array:
    """Position gain (n,) of each servo over that of the twin."""
    n = len(log.joint_names)
    found = _numbers(log, GAIN, log.extra.get(GAIN, "1").replace(",", " ").split())
    if len(found) not in (1, n) or (found <= 0).any():
        raise InputError(f"{log.label}: {GAIN} {log.extra[GAIN]!r}, expected one number above zero, or {n}")
    return np.broadcast_to(found, (n,))


def spans_off(log: RunLog) -> list[tuple[float, float]]:
    """Read the times [s] since the start of the log, from and to, in which the servos give no torque."""
    spans = []
    for word in log.extra.get(TORQUE_OFF, "").replace(",", " ").split():
        ends = _numbers(log, TORQUE_OFF, word.split("-"))
        if len(ends) != 2 or not 0.0 <= ends[0] < ends[1]:
            raise InputError(f"{log.label}: {TORQUE_OFF} {word!r}, expected seconds from and to, such as 3-7.5")
        spans.append((float(ends[0]), float(ends[1])))
    return spans


def powered(logs: Sequence[RunLog]) -> list[RunLog]:
    """Cut logs where the servos give no torque; the pieces of one log are numbered."""
    found = []
    for log in logs:
        since, spans = log.time - log.time[0], spans_off(log)
        on = ~np.any([(since >= first) & (since <= last) for first, last in spans], axis=0) if spans else since >= 0.0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
        pieces = [log.rows(slice(a, b)) for a, b in edges.reshape(-1, 2).tolist() if b - a > 2]
        extra = {key: value for key, value in log.extra.items() if key != TORQUE_OFF}
        found += [
            replace(piece, label=f"{log.label} ({i + 1})", extra=extra) for i, piece in enumerate(pieces)
        ] if spans else [log]  # fmt: skip
    return found


def _numbers(log: RunLog, key: str, words: Sequence[str]) -> Array:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{log.label}: {key} {' '.join(words)!r} is not a number") from error
