"""Speeds and accelerations without differentiating noise: averages under smooth windows.

For a window w(t) that is zero with its first derivatives at both ends, int q'' w = int q w'' (modulating functions,
Shinbrot 1957).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.diagnosis.segments import ExcitationLog, Segment

_GRID = 0.0025
"""[s] step of the interpolated readings; chosen"""

_STILL_SPEED = 0.05
"""[rad/s] below which motion counts less; chosen"""

_SPARSE = 0.5
"""Largest share of a window between two readings; chosen"""

_LONG = 4.0
"""[s] longest cluster; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Averages:
    """Averages of a joint's signals, N windows, D delays."""

    error: Array
    """(D, N) [rad] delayed command minus measured position"""
    command_speed: Array
    """(N,) [rad/s], without delay"""
    speed: Array
    """(N,) [rad/s]"""
    acceleration: Array
    """(N,) [rad/s^2]"""
    direction: Array
    """(N,) -1 to 1"""
    gravity: Array
    """(N,) [N m] that holds the arm"""
    effort: Array
    """(N,) torque or current, in the log's unit; else zero"""
    cluster: NDArray[np.intp]
    """(N,) number of the motion"""
    time: Array
    """(N,) [s] middle of the window"""


def window_averages(
    data: ExcitationLog, segments: list[Segment], joint: int, *, length: float, delays: Array, cut: float = 0.0
) -> Averages:
    """Average a joint's signals under windows of ``length`` [s], overlapping by three quarters.

    Tries ``delays`` (D,) [s]; leaves out ``cut`` [s] of each segment and gaps in the readings.
    """
    parts = []
    for index, segment in enumerate(segments):
        time = np.arange(segment.start + cut, segment.stop, _GRID)
        if len(time) * _GRID > length:
            parts.append(_averages(data, time, joint, length, delays, 1000 * index))
    names = [part.name for part in fields(Averages)]
    if not parts:
        empty: dict[str, Any] = dict.fromkeys(names, np.zeros(0))
        return Averages(**empty | {"error": np.zeros((len(delays), 0)), "cluster": np.zeros(0, dtype=np.intp)})
    return Averages(**{name: np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names})


def _averages(
    data: ExcitationLog, time: Array, joint: int, length: float, delays: Array, first_cluster: int
) -> Averages:
    log = data.log
    position = np.interp(time, log.time, log.position[:, joint])
    count = round(length / _GRID)
    window, first, second = _window(count)
    hop = max(count // 4, 1)

    def average(signal: Array, weight: Array) -> Array:
        return sliding_window_view(signal, count, axis=-1)[..., ::hop, :] @ weight / window.sum()

    smooth = np.convolve(np.pad(np.gradient(position, _GRID), 20, mode="edge"), np.full(41, 1 / 41), mode="valid")
    speed = -average(position, first)
    begins = hop * _GRID * np.arange(len(speed))
    duration = _LONG / 2 if time[-1] - time[0] > _LONG else np.inf
    read = sliding_window_view(_read(log.time, time, length), count)[::hop].all(axis=-1)
    return Averages(
        error=average(data.commanded(joint, time - delays[:, None]) - position, window)[:, read],
        command_speed=-average(np.interp(time, log.time, log.command[:, joint]), first)[read],
        speed=speed[read],
        acceleration=average(position, second)[read],
        direction=average(np.tanh(smooth / _STILL_SPEED), window)[read],
        gravity=average(np.interp(time, log.time, data.gravity[:, joint]), window)[read],
        effort=average(np.interp(time, log.time, data.effort[:, joint]), window)[read],
        cluster=first_cluster + (begins / duration).astype(np.intp)[read],
        time=(time[0] + begins + 0.5 * length)[read],
    )


def _read(readings: Array, time: Array, length: float) -> NDArray[np.bool_]:
    """Whether ``readings`` (T,) [s] are near each ``time`` (K,) [s]."""
    apart = np.diff(readings)
    before = np.clip(np.searchsorted(readings, time, side="right") - 1, 0, len(apart) - 1)
    return np.asarray(apart[before] <= max(_SPARSE * length, 2.0 * float(np.median(apart))))


def _window(count: int) -> tuple[Array, Array, Array]:
    x = (np.arange(count) + 0.5) / count
    rate = np.pi / (count * _GRID)
    sine, cosine = np.sin(np.pi * x), np.cos(np.pi * x)
    return sine**4, 4 * rate * sine**3 * cosine, 4 * rate**2 * (3 * sine**2 * cosine**2 - sine**4)
