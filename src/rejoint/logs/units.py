"""Degrees or LeRobot's normalised values, by encoder steps.

In degrees all joints have the same step; in normalised values each has 200 over the counts of its calibrated range.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.consistency import FEWEST_STEPS, FEWEST_VALUES, OFF, ON, Doubts, on_grid
from rejoint.logs.joints import COUNTS_PER_TURN, half_ranges
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import RecordedMotion
from rejoint.system.errors import FileError

SPANS = (1000, 4096)
"""[counts] of calibrated ranges (chosen)"""


def check_normalised(motion: RecordedMotion, arm: Arm, options: ImportOptions, doubts: Doubts) -> list[str]:
    """Check the declared unit by encoder steps; returns a note where they show nothing."""
    if options.angle_unit not in ("deg", "normalised"):
        return []
    if options.calibration is None and motion.extra.get("format") != "lerobot":
        return []  # no other program normalises, and other encoders have other steps
    value, path = motion.state.value, motion.state.path
    if options.calibration is None:
        if options.angle_unit == "normalised":  # the ranges were found from the steps of such values
            return []
        half, known = (arm.upper - arm.lower) / 2, False
    else:
        half, known = half_ranges(options.calibration, arm, options), True
    degrees = options.angle_unit == "deg"
    raw = np.rad2deg(value) if degrees else value / half * 100.0
    found = _by_grid(raw, half if known else None)
    if found is None:
        either = motion.extra.get("format") == "lerobot" and float(np.abs(raw).max()) <= 101.0
        return ["nothing in the file tells degrees from normalised values: compare with what the arm did"] * either
    kind, why = found
    if kind != options.angle_unit:
        said = {"deg": "degrees", "normalised": "normalised values (-100 to 100)"}
        doubts.stop(
            path,
            f"the states are {said[kind]}, but --angle-unit says {options.angle_unit}: {why}",
            f"set --angle-unit {kind}" + (" with --calibration" if kind == "normalised" else ""),
        )
    return []


def calibrated_ranges(raw: Array, arm: Arm, path: Path) -> Array:
    """Calibrated range (n,) [counts] of joints from normalised readings (T, n); FileError without enough motion."""
    joints = [np.unique(np.round(joint, 4)) for joint in raw.T]
    if np.median([_turn_grid(values) for values in joints]) > ON:
        raise FileError(
            path,
            f"the states are degrees, but --angle-unit says normalised: they come in steps of "
            f"{360.0 / COUNTS_PER_TURN:.4f}, those of an encoder",
            "set --angle-unit deg",
        )
    counts = np.zeros(arm.joints)
    for joint, name in enumerate(arm.joint_names):
        values = joints[joint]
        step, fit = _best_grid(values) if len(values) >= FEWEST_VALUES else (0.0, 0.0)
        if fit < ON:
            raise FileError(
                path,
                f"the readings of {name} do not show the steps of its encoder: its range is not known",
                "give --calibration, or a recording in which it moves more",
            )
        counts[joint] = 200.0 / step
    return counts


def check_steps(motion: RecordedMotion, arm: Arm, doubts: Doubts) -> None:
    """Detect encoder steps in another unit than declared."""
    if "normalised" in motion.angle_unit:  # its steps are those of the calibration
        return
    step = arm.encoder_step
    others = {
        "degrees were read as radians": np.rad2deg(step),
        "radians were read as degrees": np.deg2rad(step),
        "turns were read as radians": step / (2 * np.pi),
        "turns were read as degrees": np.deg2rad(step / (2 * np.pi)),
    }
    for joint, title in enumerate(motion.state.columns):
        values = np.unique(np.round(motion.state.value[:, joint], 9))
        if len(values) < FEWEST_VALUES or on_grid(values, step) > OFF:
            continue
        # Readings whose zero was moved are on no grid of one zero, yet on any much finer one: it must be used as well.
        for unit, other in others.items():
            if on_grid(values, other) > ON and np.percentile(np.diff(values), 10) < FEWEST_STEPS * other:
                doubts.stop(
                    motion.state.path,
                    f"the states of {title} come in steps of {other:.3g} rad, where the encoders of "
                    f"this arm have {step:.3g}: as if {unit}",
                    "declare their unit",
                )


def _by_grid(raw: Array, half: Array | None) -> tuple[str, str] | None:
    """Return unit of readings (T, n) by their steps; ``half`` (n,) [rad]."""
    degrees, normalised, told = 0, 0, 0
    steps = []
    for joint in range(raw.shape[1]):
        values = np.unique(np.round(raw[:, joint], 4))
        if len(values) < FEWEST_VALUES:
            continue
        told += 1
        turn = _turn_grid(values)
        if half is not None:
            own = 200.0 / max(abs(half[joint]) * COUNTS_PER_TURN / np.pi, 1.0)
            other = on_grid(values, own)
        else:
            own, other = _best_grid(values)
        if turn > ON and (half is None or other < ON):
            degrees += 1
        elif other > ON and turn < OFF:
            normalised += 1
            steps.append(own)
    if told and degrees > told / 2:
        return "deg", f"they come in steps of {360.0 / COUNTS_PER_TURN:.4f} on {degrees} joints, those of an encoder"
    apart = half is not None or len({round(step, 4) for step in steps}) > 1  # joints differ in their ranges
    if told and normalised > told / 2 and apart:
        return "normalised", f"they come in steps of {', '.join(f'{step:.4f}' for step in steps)}, no degrees do"
    return None


def _turn_grid(values: Array) -> float:
    """Share of degrees on an encoder's grid: LeRobot counts 4095 steps per turn, others 4096."""
    return max(on_grid(values, 360.0 / COUNTS_PER_TURN), on_grid(values, 360.0 / (COUNTS_PER_TURN - 1)))


def _best_grid(values: Array) -> tuple[float, float]:
    spans = np.arange(SPANS[0], SPANS[1] + 1)
    steps = 200.0 / spans
    chosen = values if len(values) <= 300 else values[:: len(values) // 300]
    fit = np.abs(np.mean(np.exp(2j * np.pi * chosen[:, None] / steps), axis=0))
    best = int(np.argmax(fit))
    rounded = max(on_grid(values, step) for step in (0.05, 0.1, 0.2, 0.25, 0.5, 1.0))
    return float(steps[best]), 0.0 if rounded > ON else float(fit[best])
