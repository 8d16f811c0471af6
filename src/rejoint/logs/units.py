"""Whether angles are degrees or LeRobot's normalised values, by what an encoder leaves in them.

A file of LeRobot holds either and says neither. Both lie between -100 and 100 and differ by some tenths, which no
limit shows. But states come from an encoder in whole counts: in degrees all joints have the same step, in normalised
values each has 200 over the counts of its calibrated range.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.doubts import Doubts
from rejoint.logs.joints import COUNTS_PER_TURN, half_ranges
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import RecordedMotion

FEWEST_VALUES = 20
"""Different readings of a joint below which its step is not looked for (chosen)"""
FEWEST_STEPS = 10
"""Steps that readings have to span to tell anything about them (chosen)"""
ON, OFF = 0.9, 0.6
"""chosen: how well readings lie on a grid, 1 for all of them, from which they are on it, and up to which they are not;
readings that know nothing of it have about one over the root of their number."""
SPANS = (1000, 4096)
"""[counts] calibrated ranges for which a grid is looked for (chosen: a quarter turn to a whole one)"""
CLIPPED = 3
"""Readings at exactly 100, none beyond, from which they count as clipped (chosen)"""
UNDER_FLOOR = 0.05
"""[m] under the floor of the arm from which a posture counts as impossible (chosen)"""
IMPOSSIBLE, POSSIBLE = 0.05, 0.005
"""chosen: shares of impossible postures from which a unit is given up, and up to which another one is right"""


def check_normalised(motion: RecordedMotion, arm: Arm, options: ImportOptions, doubts: Doubts) -> list[str]:
    """Look for normalised values that are declared as degrees, and the reverse; returns a note where nothing tells."""
    if options.angle_unit not in ("deg", "normalised"):
        return []
    if options.calibration is None and motion.extra.get("format") != "lerobot":
        return []  # nobody else normalises, and other encoders have other steps
    value, path = motion.state.value, motion.state.path
    if options.calibration is None:
        half, known = (arm.upper - arm.lower) / 2, False
    else:
        half, known = half_ranges(options.calibration, arm, options), True
    degrees = options.angle_unit == "deg"
    raw = np.rad2deg(value) if degrees else value / half * 100.0
    found = _by_grid(raw, half if known else None)
    if degrees and known is False and found is None:
        found = _by_clipping(raw)
    if found is None:
        found = _by_posture(raw, half, arm, degrees=degrees)
    if found is None:
        return _spoken(value, arm, options) if _may_be_either(raw, motion) else []
    kind, why = found
    if kind != options.angle_unit:
        said = {"deg": "degrees", "normalised": "normalised values (-100 to 100)"}
        doubts.stop(
            path, f"the states are {said[kind]}, but --angle-unit says {options.angle_unit}: {why}",
            f"set --angle-unit {kind}" + (" with --calibration" if kind == "normalised" else ""),
        )  # fmt: skip
    return []


def check_steps(motion: RecordedMotion, arm: Arm, doubts: Doubts) -> None:
    """Look for joints whose readings come in the steps of the arm's encoders, but in another unit than declared."""
    if "normalised" in motion.angle_unit:  # its steps are those of the calibration
        return
    step = arm.encoder_step
    others = {
        "degrees were read as radians": np.rad2deg(step), "radians were read as degrees": np.deg2rad(step),
        "turns were read as radians": step / (2 * np.pi), "turns were read as degrees": np.deg2rad(step / (2 * np.pi)),
    }  # fmt: skip
    for joint, title in enumerate(motion.state.columns):
        values = np.unique(np.round(motion.state.value[:, joint], 9))
        if len(values) < FEWEST_VALUES or _on_grid(values, step) > OFF:
            continue
        # Readings whose zero was moved are on no grid of one zero, yet on any much finer one: it must be used as well.
        for unit, other in others.items():
            if _on_grid(values, other) > ON and np.percentile(np.diff(values), 10) < FEWEST_STEPS * other:
                doubts.stop(
                    motion.state.path, f"the states of {title} come in steps of {other:.3g} rad, where the encoders of "
                    f"this arm have {step:.3g}: as if {unit}", "declare their unit",
                )  # fmt: skip


def _may_be_either(raw: Array, motion: RecordedMotion) -> bool:
    return motion.extra.get("format") == "lerobot" and float(np.abs(raw).max()) <= 101.0


def _spoken(value: Array, arm: Arm, options: ImportOptions) -> list[str]:
    travel = ", ".join(
        f"{name} {np.rad2deg(value[:, joint].min()):.0f} to {np.rad2deg(value[:, joint].max()):.0f}"
        for joint, name in enumerate(arm.joint_names)
    )
    return [
        f"nothing in the file tells degrees from normalised values; read as {options.angle_unit}, the joints travel, "
        f"in degrees: {travel}: compare that with what the arm did"
    ]


def _by_grid(raw: Array, half: Array | None) -> tuple[str, str] | None:
    """Tell the unit of readings (T, n) by the steps they come in; ``half`` (n,) [rad] is the calibrated half range."""
    degrees, normalised, told = 0, 0, 0
    steps = []
    for joint in range(raw.shape[1]):
        values = np.unique(np.round(raw[:, joint], 4))
        if len(values) < FEWEST_VALUES:
            continue
        told += 1
        # LeRobot's degrees count 4095 steps in a turn, everybody else's 4096
        turn = max(_on_grid(values, 360.0 / COUNTS_PER_TURN), _on_grid(values, 360.0 / (COUNTS_PER_TURN - 1)))
        if half is not None:
            own = 200.0 / max(abs(half[joint]) * COUNTS_PER_TURN / np.pi, 1.0)
            other = _on_grid(values, own)
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


def _on_grid(values: Array, step: float) -> float:
    """Tell how well values lie on multiples of a step with any origin: 1 if they all do, 0 if they span only a few."""
    if np.ptp(values) < FEWEST_STEPS * step:
        return 0.0
    return float(np.abs(np.mean(np.exp(2j * np.pi * values / step))))


def _best_grid(values: Array) -> tuple[float, float]:
    """Find the step of normalised values for which they lie best on a grid; decimal rounding does not count."""
    spans = np.arange(SPANS[0], SPANS[1] + 1)
    steps = 200.0 / spans
    chosen = values if len(values) <= 300 else values[:: len(values) // 300]
    fit = np.abs(np.mean(np.exp(2j * np.pi * chosen[:, None] / steps), axis=0))
    best = int(np.argmax(fit))
    rounded = max(_on_grid(values, step) for step in (0.05, 0.1, 0.2, 0.25, 0.5, 1.0))
    return float(steps[best]), 0.0 if rounded > ON else float(fit[best])


def _by_clipping(raw: Array) -> tuple[str, str] | None:
    """Recognise values that stop at exactly 100, as LeRobot's normalised ones do and degrees do not."""
    at_end = np.abs(np.abs(raw) - 100.0) < 1e-4
    if float(np.abs(raw).max()) <= 100.0 + 1e-4 and at_end.sum() >= CLIPPED:
        return "normalised", f"{int(at_end.sum())} of them are exactly 100 or -100, and none is beyond"
    return None


def _by_posture(raw: Array, half: Array, arm: Arm, *, degrees: bool) -> tuple[str, str] | None:
    """Give up a unit that puts the arm where it cannot be, if the other one does not."""
    readings = {"deg": np.deg2rad(raw), "normalised": raw / 100.0 * half}
    shares = {kind: _impossible(value, arm) for kind, value in readings.items()}
    declared, other = ("deg", "normalised") if degrees else ("normalised", "deg")
    if shares[declared] > IMPOSSIBLE and shares[other] < POSSIBLE:
        return other, (
            f"read as declared, {100 * shares[declared]:.0f} % of the postures are beyond limits or under the floor"
        )
    return None


def _impossible(value: Array, arm: Arm) -> float:
    thin = value[:: max(len(value) // 2000, 1)]
    beyond = ((thin > arm.upper + np.radians(5)) | (thin < arm.lower - np.radians(5))).any(axis=1)
    under = tcp_position(arm, thin)[:, 2] < arm.floor - UNDER_FLOOR
    return float((beyond | under).mean())
