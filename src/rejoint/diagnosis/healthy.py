"""What a healthy arm of the same kind measures, by the same procedure.

The reference of an arm of the catalogue is a file in this package. It is measured on the emulated arm
with the wear profile ``healthy``, which scales with the arm, or with one of its own in `NEW`, and written again by

    python -m rejoint.diagnosis mycobot280

What a new SO-101 measures goes with P and with the supply of its servos: it has a reference for each P in `MEASURED`,
and `as_set` makes that of an arm of them. For any other arm `healthy_reference` measures it when it is needed. A
diagnosis of a real arm that is known to be good is the better reference
(`rejoint.diagnosis.knowngood.reference_by`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.servogains import ServoGains
from rejoint.diagnosis.measurement import OFFSET_ALLOWED, JointMetrics, measure
from rejoint.diagnosis.open_loop import open_loop_errors
from rejoint.diagnosis.record import DiagnosisLogs, record
from rejoint.robots import SIMULATOR, open_robot
from rejoint.system.errors import InputError
from rejoint.system.extras import installed
from rejoint.system.files import read_json
from rejoint.system.statistics import Estimate

TOLERANCE = 0.3
"""Relative spread allowed between healthy arms of a kind, on top of what was seen (chosen: vendors publish none)."""

SIGMAS = 3.0
"""Standard deviations of repeated diagnoses that still count as healthy (chosen: an arm is judged by some
fifty numbers, so two would be too few)."""

OVERSHOOT_ALLOWED = 0.05
"""Fraction of a step that any healthy arm may shoot over (chosen)."""

NO_OFFSET = Estimate(0.0, -OFFSET_ALLOWED, OFFSET_ALLOWED)
"""What a joint without an offset shows: each servo has its own zero, so no other arm tells"""

ARMS, SEED = 12, 2024
"""Emulated healthy arms that are measured for the reference (chosen)."""

ARMS_ON_DEMAND = 6
"""The same where somebody waits for it (chosen: about 10 s)."""


NEW = {"so101": "so101-new"}
"""Arms whose new ones have a wear profile of their own: their servos are softer than any that `healthy` scales to"""

MEASURED = (16, 32, 64)
"""P of the servos under which such arms are measured: LeRobot's, as sold, and the largest that a search tries"""
AS_SOLD, SUPPLY = 32, 12.0
"""P where nothing is known of the gains, and [V] of the supply for which all of them are measured"""


@dataclass(frozen=True, kw_only=True)
class HealthyReference:
    """Healthy values; every ``Estimate`` holds the mean and the range within which an arm counts as healthy."""

    arm: str
    source: str
    """what was measured, in words"""
    motors_kg_m2: tuple[float | None, ...]
    """inertia of motor and gear seen from each joint; None where gravity does not load it enough to tell"""
    joints: tuple[JointMetrics, ...]
    error_mm: Estimate
    """of ten targets open loop, by encoder kinematics"""
    hidden_mm: Estimate | None
    """between the tool and where the encoders put it; None where nobody knew"""
    setting: str = ""
    """what of the arm at hand it was reckoned for, in words: the P of its servos and their supply"""


def reference_path(arm: Arm, p: int = AS_SOLD) -> Path:
    """Where the package keeps the reference of an arm; ``p`` is that of its servos, if there are several."""
    under = "" if p == AS_SOLD else f"_p{p}"
    return Path(str(files("rejoint.diagnosis"))) / f"healthy_{arm.name}{under}.json"


def load_healthy(arm: Arm, p: int = AS_SOLD) -> HealthyReference | None:
    """Return the package's reference for an arm, None if there is none."""
    path = reference_path(arm, p)
    return read_json(path, HealthyReference) if path.exists() else None


def healthy_reference(arm: Arm) -> HealthyReference | None:
    """Return the package's reference for an arm, or measure one in virtual time; None without the simulator."""
    packaged = load_healthy(arm)
    if packaged is not None or not installed(SIMULATOR):
        return packaged
    return measure_healthy(arm, count=ARMS_ON_DEMAND)


def as_set(
    arm: Arm, reference: HealthyReference | None, gains: ServoGains | None, voltage: Array | None
) -> HealthyReference | None:
    """Return what a healthy arm measures with these ``gains`` in its servos, and this ``voltage`` (n,) [V].

    Each joint is taken from the reference of the nearest P. A servo gives torque in proportion to P and to its supply,
    the variant for 7.4 V as well as that for 12 V; so does an arm sag. ``reference`` itself where nothing is told.
    """
    if _new(arm) is None or reference is None or gains is None or "p" not in gains:
        return reference
    p = np.array(gains["p"], dtype=float)
    share = np.ones(arm.joints) if voltage is None else np.asarray(voltage, float) / SUPPLY
    if not ((p > 0.0) & (share > 0.0)).all():
        return reference
    found = [_nearest(arm, one) for one in p]
    rows = [_stiffer(entry.joints[joint], p[joint] / of * share[joint]) for joint, (of, entry) in enumerate(found)]
    typical = float(np.exp(np.log(p).mean()))
    of, whole = _nearest(arm, typical)
    setting = f" with P = {_by_joint(gains['p'], arm.joint_names)}"
    if voltage is not None:
        setting += f" and a supply of {np.median(voltage):.1f} V"
    return replace(
        whole, joints=tuple(rows), error_mm=_times(whole.error_mm, of / typical / float(share.mean())),
        source=f"{whole.source},{setting}", setting=setting,
    )  # fmt: skip


def _by_joint(values: Sequence[int], names: Sequence[str]) -> str:
    """Tell a gain of each joint: what most of them have, then the others by name."""
    most = max(dict.fromkeys(values), key=list(values).count)
    others = [f"{name} {value}" for name, value in zip(names, values, strict=True) if value != most]
    return f"{most} ({', '.join(others)})" if others else str(most)


def _new(arm: Arm) -> str | None:
    """Return the wear profile of a new arm of this kind, None where `healthy` does; so with servos of another make."""
    return NEW.get(arm.name) if arm.servos else None


def _nearest(arm: Arm, p: float) -> tuple[int, HealthyReference]:
    """Return the P of `MEASURED` that is nearest, and the reference for it."""
    of = min(MEASURED, key=lambda one: abs(float(np.log(p / one))))
    return of, read_json(reference_path(arm, of), HealthyReference)


def _stiffer(row: JointMetrics, factor: float) -> JointMetrics:
    """Return what a joint measures whose servo is stiffer by ``factor``."""
    stiffness, width = row.stiffness_nm_per_rad, row.hysteresis_rad
    return replace(
        row, stiffness_nm_per_rad=None if stiffness is None else _times(stiffness, factor),
        hysteresis_rad=None if width is None else _times(width, 1.0 / factor),
    )  # fmt: skip


def _times(found: Estimate, factor: float) -> Estimate:
    low, high = (None if end is None else end * factor for end in (found.low, found.high))
    return Estimate(found.value * factor, low, high)


def measure_healthy(arm: Arm, *, count: int = ARMS, p: int = AS_SOLD) -> HealthyReference:
    """Diagnose ``count`` emulated healthy arms, each with noise and excitation of its own.

    ``p`` is that of the servos of an arm in `NEW`; others are told none.
    """
    logs: list[DiagnosisLogs] = []
    new = _new(arm)
    profile = new or "healthy"
    address = f"emulated:{profile}?p={p}" if new else f"emulated:{profile}"
    for offset in range(2):  # two excitations, each on half of the arms
        robot = open_robot(address, arm=arm, seed=SEED + offset, count=count // 2)
        logs += record(robot, seed=SEED + offset)
    source = f"{len(logs)} emulated arms with wear profile '{profile}'"
    return reference_from(arm, logs, source=source, motors=new is None)


def reference_from(arm: Arm, logs: Sequence[DiagnosisLogs], *, source: str, motors: bool = True) -> HealthyReference:
    """Make a reference from the logs of healthy arms; at least three, for a spread.

    ``motors`` says whether their inertia can be told: the ramp and the D of an STS3215 hide half of it.
    """
    if len(logs) < 3:
        raise InputError(f"a healthy reference needs the logs of at least three diagnoses, got {len(logs)}")
    first = [measure(arm, entry.excitation) for entry in logs]
    inertia = tuple(
        _typical([m.joints[joint].motor_inertia_kg_m2 for m in first]) if motors else None
        for joint in range(arm.joints)
    )
    found = [(measure(arm, entry.excitation, inertia), open_loop_errors(arm, entry.targets)) for entry in logs]
    hidden = [loop.hidden_mm for _, loop in found if loop.hidden_mm is not None]
    return HealthyReference(
        arm=arm.name,
        source=source,
        motors_kg_m2=inertia,
        joints=tuple(_combine(arm, [m.joints[joint] for m, _ in found]) for joint in range(arm.joints)),
        error_mm=_range([loop.error_mm.value for _, loop in found]),
        hidden_mm=_range(hidden) if hidden else None,
    )


def _combine(arm: Arm, rows: list[JointMetrics]) -> JointMetrics:
    def known(name: str) -> list[float]:
        return [estimate.value for estimate in (getattr(row, name) for row in rows) if estimate is not None]

    def positive(name: str) -> Estimate | None:
        return _range(known(name)) if known(name) else None

    sources = [row.stiffness_source for row in rows]
    return JointMetrics(
        joint=rows[0].joint,
        stiffness_source=max(sorted(set(sources)), key=sources.count),  # a set has no order of its own
        stiffness_nm_per_rad=positive("stiffness_nm_per_rad"),
        coulomb_nm=positive("coulomb_nm"),
        damping_ratio=positive("damping_ratio"),
        hysteresis_rad=positive("hysteresis_rad"),
        lag_s=positive("lag_s"),
        overshoot=_range_about_zero(known("overshoot"), OVERSHOOT_ALLOWED),
        hunting_rad=_range_about_zero(known("hunting_rad"), arm.encoder_step),
        noise_rad=_range_about_zero(known("noise_rad"), arm.encoder_step),
        torque_limit_nm=None,
        torque_seen_nm=max(row.torque_seen_nm for row in rows),
        saturated_share=max(row.saturated_share for row in rows),
        motor_inertia_kg_m2=_typical([row.motor_inertia_kg_m2 for row in rows]),
        sweep_gain=min((row.sweep_gain for row in rows if row.sweep_gain is not None), default=None),
        stuck_rad=max(row.stuck_rad for row in rows),
        offset_rad=NO_OFFSET,
    )


def _typical(values: Sequence[float | None]) -> float | None:
    """Median of what is known, if that is at least a third of the values."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if 3 * len(known) >= len(values) else None


def _range(values: list[float]) -> Estimate:
    """Geometric mean and healthy range of a positive quantity: standard deviations and tolerance as factors."""
    logs = np.log(np.maximum(values, 1e-12))
    mean, spread = float(logs.mean()), float(logs.std(ddof=1)) if len(logs) > 1 else 0.0
    half = SIGMAS * spread + np.log1p(TOLERANCE)
    return Estimate(float(np.exp(mean)), float(np.exp(mean - half)), float(np.exp(mean + half)))


def _range_about_zero(values: list[float], allowed: float) -> Estimate:
    """Mean and healthy range of what is about zero when healthy; ``allowed`` widens it on both sides."""
    mean, spread = float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    half = SIGMAS * spread + TOLERANCE * abs(mean) + allowed
    return Estimate(mean, mean - half, mean + half)
