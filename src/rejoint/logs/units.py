"""Wrong units, by the steps of encoders: in radians or degrees each has one step, whatever the joint.

LeRobot's normalised values step by 200 over the counts of a joint's calibrated range. All thresholds are chosen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.consistency import LogFindings
from rejoint.logs.joints import COUNTS_PER_TURN
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import TWO_TURNS
from rejoint.logs.track import RecordedMotion
from rejoint.system.errors import FileError

FEWEST_VALUES = 20
"""Different readings for a step"""
FEWEST_STEPS = 10
"""Steps spanned by readings"""
ON, OFF = 0.9, 0.6
"""on a grid, and off it (1: all readings)"""
BITS = range(10, 22)
"""of encoders"""
SPANS = np.arange(1000, 4097)
"""[counts] of calibrated ranges"""
GEAR_REMEDY = "give gear, sign and zero of each joint: --map JOINT=THEIRS/RATIO+OFFSET"
_MISREAD = {
    "degrees were read as radians": 180.0 / np.pi,
    "radians were read as degrees": np.pi / 180.0,
    "turns were read as radians": 0.5 / np.pi,
    "turns were read as degrees": np.pi / 180.0 * 0.5 / np.pi,
}
"""Factor of an encoder's step"""


def check_units(motion: RecordedMotion, arm: Arm, options: ImportOptions, found: LogFindings) -> None:
    """Check the declared unit of angles."""
    state, unit = motion.state, motion.angle_unit
    extent = float(np.rad2deg(np.abs(state.value).max()))
    gear = max(float((np.ptp(state.value, axis=0) / (arm.upper - arm.lower)).max()), 1.0)
    motors = f"angles of the motors, before a gear of {gear:.2g} or more"
    if unit == "deg" and (bits := _turn_bits(np.rad2deg(state.value))):
        found.doubt(
            state,
            f"state: the values come in steps of 2 pi / {2**bits}: they are radians, not degrees; up to {extent:.4g} "
            "rad are angles of the motors, before their gear",
            GEAR_REMEDY,
        )
    for track in motion.tracks:
        far = np.abs(track.value)
        if (far <= TWO_TURNS).all():
            continue
        row, joint = np.unravel_index(int(np.argmax(far)), far.shape)
        bits = _turn_bits(track.value) if unit == "rad" else None
        cause = f"degrees, or {motors}" if bits is None else f"{motors}, for they come in steps of 2 pi / {2**bits}"
        raise FileError(
            track.path,
            f"{track.what}, {track.where(int(row))}: {track.columns[joint]} is {track.value[row, joint]:.4g} rad, "
            f"beyond two turns; the values are {cause if unit == 'rad' else 'in another unit'}",
            f"set --angle-unit, correct the column's name, or {GEAR_REMEDY}" if bits is None else GEAR_REMEDY,
        )
    if unit == "deg" and extent <= 2 * np.pi:
        found.doubt(
            state,
            f"state: no angle is beyond {extent:.3g} deg; the values are surely radians",
            "set --angle-unit rad, or correct the column's name where that says a unit",
        )
    _check_steps(motion, arm, options, found)


def _check_steps(motion: RecordedMotion, arm: Arm, options: ImportOptions, found: LogFindings) -> None:
    state = motion.state
    # no other program normalises, and other encoders have other steps
    lerobot = motion.extra.get("format") == "lerobot"
    if options.angle_unit in ("deg", "normalised") and (lerobot or options.calibration is not None):
        raw = np.rad2deg(state.value) if motion.half is None else state.value / motion.half * 100.0
        kind, why = _by_grid(raw)
        if kind is None and lerobot and np.abs(raw).max() <= 101.0:
            told = "nothing in the file tells degrees from normalised values: compare with what the arm did"
            found.notes.append(told)
        if kind not in (None, options.angle_unit):
            said = {"deg": "degrees", "normalised": "normalised values (-100 to 100)"}[str(kind)]
            found.doubt(
                state,
                f"the states are {said}, but --angle-unit says {options.angle_unit}: {why}",
                f"set --angle-unit {kind}" + " with --calibration" * (kind == "normalised"),
            )
    if motion.half is not None:  # its steps are those of the calibration
        return
    for title, column in zip(state.columns, state.value.T, strict=True):
        values = np.unique(np.round(column, 9))
        if len(values) < FEWEST_VALUES or on_grid(values, arm.encoder_step) > OFF:
            continue
        # Readings whose zero was moved are on no grid of one zero, yet on any much finer one: it must be used as well.
        for misread, factor in _MISREAD.items():
            step = arm.encoder_step * factor
            if on_grid(values, step) > ON and np.percentile(np.diff(values), 10) < FEWEST_STEPS * step:
                found.doubt(
                    state,
                    f"the states of {title} come in steps of {step:.3g} rad, where the encoders of this arm have "
                    f"{arm.encoder_step:.3g}: as if {misread}",
                    "declare their unit",
                )


def on_grid(values: Array, step: float) -> float:
    """Share of values on multiples of a step; 0: few steps."""
    if np.ptp(values) < FEWEST_STEPS * step:
        return 0.0
    return float(np.abs(np.mean(np.exp(2j * np.pi * values / step))))


def _readings(values: Array, decimals: int) -> list[Array]:
    """Different readings of the joints (T, n) that have enough."""
    return [one for joint in values.T if len(one := np.unique(np.round(joint, decimals))) >= FEWEST_VALUES]


def _turn_bits(values: Array) -> int | None:
    """Return encoder bits of readings (T, n) [rad], or None."""
    told = _readings(values, 12)
    return next((b for b in BITS if told and np.median([on_grid(one, 2 * np.pi / 2**b) for one in told]) > ON), None)


def _by_grid(raw: Array) -> tuple[str | None, str]:
    """Return unit of LeRobot's readings (T, n) by their steps, and why."""
    joints = [(_turn_grid(values), *_best_grid(values)) for values in _readings(raw, 4)]
    degrees = sum(turn > ON for turn, *_ in joints)
    steps = [step for turn, step, fit in joints if fit > ON and turn < OFF]
    if degrees > len(joints) / 2:
        return "deg", f"they come in steps of {360.0 / COUNTS_PER_TURN:.4f} on {degrees} joints, those of an encoder"
    if len(steps) > len(joints) / 2 and len({round(step, 4) for step in steps}) > 1:  # joints differ in their ranges
        return "normalised", f"they come in steps of {', '.join(f'{step:.4f}' for step in steps)}, no degrees do"
    return None, ""


def _turn_grid(values: Array) -> float:
    """Share of degrees on an encoder's grid: LeRobot counts 4095 steps per turn, others 4096."""
    return max(on_grid(values, 360.0 / (COUNTS_PER_TURN - less)) for less in (0, 1))


def _best_grid(values: Array) -> tuple[float, float]:
    """Step of normalised values and their share on it; 0 for round numbers."""
    chosen = values[:: max(len(values) // 300, 1)]
    fit = np.abs(np.mean(np.exp(2j * np.pi * chosen[:, None] * SPANS / 200.0), axis=0))
    best = int(np.argmax(fit))
    rounded = max(on_grid(values, step) for step in (0.05, 0.1, 0.2, 0.25, 0.5, 1.0))
    return 200.0 / float(SPANS[best]), 0.0 if rounded > ON else float(fit[best])


def calibrated_ranges(raw: Array, arm: Arm, path: Path) -> Array:
    """Calibrated range (n,) [counts] of joints from normalised readings (T, n); FileError without enough motion."""
    kind, why = _by_grid(raw)
    if kind == "deg":
        raise FileError(
            path, f"the states are degrees, but --angle-unit says normalised: {why}", "set --angle-unit deg"
        )
    counts = []
    for joint, name in zip(raw.T, arm.joint_names, strict=True):
        told = _readings(joint[:, None], 4)
        step, fit = _best_grid(told[0]) if told else (0.0, 0.0)
        if fit < ON:
            raise FileError(
                path,
                f"the readings of {name} do not show the steps of its encoder: its range is not known",
                "give --calibration, or a recording in which it moves more",
            )
        counts.append(200.0 / step)
    return np.array(counts)
