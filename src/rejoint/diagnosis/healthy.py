"""What a healthy arm of the same kind measures, by the same procedure.

A catalogue arm has a file, measured on emulated arms of the wear profile ``healthy`` or that of `NEW` by

    python -m benchmarks healthy --arm mycobot280

An SO-101 has one for each P in `MEASURED`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.inertia import bare
from rejoint.control.servogains import ServoGains
from rejoint.diagnosis.excitation import DiagnosisLogs, record
from rejoint.diagnosis.measurement import OFFSET_ALLOWED, JointMetrics, measure
from rejoint.diagnosis.regression import scaled
from rejoint.diagnosis.segments import open_loop_errors
from rejoint.robots import open_robot, usable
from rejoint.system.errors import InputError
from rejoint.system.files import read_json
from rejoint.system.records import value_type
from rejoint.system.statistics import Estimate

if TYPE_CHECKING:
    from rejoint.diagnosis.diagnosis import Diagnosis

TOLERANCE = 0.3
"""Relative spread between healthy arms beyond what was seen; chosen"""

SIGMAS = 3.0
"""Standard deviations that count as healthy; chosen"""

OVERSHOOT_ALLOWED = 0.05
"""Of any healthy arm, as a fraction of a step; chosen"""

NO_OFFSET = Estimate(0.0, -OFFSET_ALLOWED, OFFSET_ALLOWED)
"""[rad] without an offset: each servo has its own zero"""

ARMS, SEED = 12, 2024
"""Emulated healthy arms of a reference, and their seed; chosen"""

ARMS_ON_DEMAND = 6
"""The same on demand (about 10 s); chosen"""


RUBS = 0.06
"""Friction over load of healthy gears, as of the profile ``so101-new``"""

HOBBY = ("emulated:", "feetech:", "dynamixel:")
"""Addresses of hobby servos begin so"""

NEW = {"so101": "so101-new"}
"""Wear profiles of new arms"""

MEASURED = (16, 32, 64)
"""P: LeRobot's, as sold, and the largest in a search"""
AS_SOLD, SUPPLY = 32, 12.0
"""P if unknown, and [V] supply of references"""


@value_type
class HealthyReference:
    """Healthy values; an ``Estimate`` holds mean and healthy range."""

    arm: str
    source: str
    motors_kg_m2: tuple[float | None, ...]
    """of motor and gear at each joint"""
    joints: tuple[JointMetrics, ...]
    error_mm: Estimate | None
    """of ten targets open loop, or at rest, by encoders"""
    effort_unit: str | None = None
    """as in `Measurement`"""
    setting: str = ""
    """load, P and supply it was computed for"""


def reference_path(arm: Arm, p: int = AS_SOLD) -> Path:
    """Path of the package's reference with servo gain ``p``."""
    under = "" if p == AS_SOLD else f"_p{p}"
    return Path(str(files("rejoint.diagnosis"))) / f"healthy_{arm.name}{under}.json"


def healthy_reference(
    arm: Arm, robot: str = "", gains: ServoGains | None = None, voltage: Array | None = None
) -> HealthyReference | None:
    """Return what healthy arms with this load, these ``gains`` and this ``voltage`` (n,) [V] measure, if known.

    From the package; for others with hobby servos, told by the address of a ``robot``, emulated arms are measured.
    """
    own = bare(arm)
    if not reference_path(own).exists() and not (robot.startswith(HOBBY) and usable("emulated:healthy")):
        return None
    p = np.array((gains or {}).get("p", [0]), dtype=float)
    share = np.ones(arm.joints) if voltage is None else voltage / SUPPLY
    if _new(arm) is None or not ((p > 0.0) & (share > 0.0)).all():
        return _laden(_measured(own, AS_SOLD), arm)
    typical = np.exp(np.log(p).mean())
    nearest = min(MEASURED, key=lambda one: abs(np.log(typical / one)))
    whole, rows = _laden(_measured(own, nearest), arm), []
    for row, stiffer in zip(whole.joints, (p / nearest * share).tolist(), strict=True):
        k, modelled, width = row.stiffness_nm_per_rad, row.modelled_nm_per_rad, row.hysteresis_rad
        k, modelled = k and scaled(k, stiffer), modelled and scaled(modelled, stiffer)
        width = width and scaled(width, 1.0 / stiffer)
        rows.append(replace(row, stiffness_nm_per_rad=k, modelled_nm_per_rad=modelled, hysteresis_rad=width))
    supply = "" if voltage is None else f"a supply of {np.median(voltage):.1f} V"
    named = f"P = {', '.join(f'{one:g}' for one in dict.fromkeys(p))}"
    setting = " and ".join(filter(None, (whole.setting, named, supply)))
    return replace(
        whole,
        joints=tuple(rows),
        error_mm=whole.error_mm and scaled(whole.error_mm, nearest / typical / share.mean()),
        source=f"{whole.source}, with {setting}",
        setting=setting,
    )


def _new(arm: Arm) -> str | None:
    return NEW.get(arm.name) if arm.servos else None


def _measured(arm: Arm, p: int) -> HealthyReference:
    path = reference_path(arm, p)
    return read_json(path, HealthyReference) if path.exists() else measure_healthy(arm, count=ARMS_ON_DEMAND, p=p)


def _laden(found: HealthyReference, arm: Arm) -> HealthyReference:
    """Let the error grow as the weight bends the arm at rest, and friction by load."""
    own, ends = bare(arm), [one.stiffness_nm_per_rad for one in found.joints]
    softness = np.array([1.0 / k.value if k else 0.0 for k in ends])
    weight = [gravity_torque(one, one.rest) for one in (own, arm)]
    jacobians = [position_kinematics(one, one.rest)[1] for one in (own, arm)]
    bent = [float(np.linalg.norm(turn @ (softness * pull))) for turn, pull in zip(jacobians, weight, strict=True)]
    rubs, load = RUBS * np.abs(weight[1] - weight[0]), round(arm.mass.sum() - own.mass.sum(), 6)
    rows = [
        replace(row, coulomb_nm=_wider(row.coulomb_nm, by), hysteresis_rad=_wider(row.hysteresis_rad, 2.0 * by * soft))
        for row, by, soft in zip(found.joints, rubs.tolist(), softness.tolist(), strict=True)
    ]
    error = found.error_mm and scaled(found.error_mm, bent[1] / bent[0] if bent[0] > 0.0 else 1.0)
    return replace(found, joints=tuple(rows), error_mm=error, setting=f"{load:g} kg" * bool(load))


def _wider(range_: Estimate | None, by: float) -> Estimate | None:
    return range_ and replace(range_, high=(range_.high or 0.0) + by)


def measure_healthy(arm: Arm, *, count: int = ARMS, p: int) -> HealthyReference:
    """Diagnose emulated healthy arms; ``p``: gain of an arm in `NEW`."""
    new = _new(arm)
    profile = new or ("new" if arm.servos else "healthy")
    robot = open_robot(f"emulated:{profile}{f'?p={p}' * bool(new)}", arm=arm, seed=SEED, count=count)
    source = f"{count} emulated arms with wear profile '{profile}'"
    return reference_from(arm, record(robot, seed=SEED), source=source, motors=new is None)


def reference_from(arm: Arm, logs: Sequence[DiagnosisLogs], *, source: str, motors: bool = True) -> HealthyReference:
    """Make a reference from the logs of healthy arms; ``motors``: with their inertia."""
    first = [measure(arm, entry.excitation) for entry in logs]
    inertia = tuple(
        _typical([m.joints[joint].motor_inertia_kg_m2 for m in first]) if motors else None
        for joint in range(arm.joints)
    )
    found = [(measure(arm, entry.excitation, inertia), open_loop_errors(arm, entry.targets)) for entry in logs]
    return HealthyReference(
        arm=arm.name,
        source=source,
        motors_kg_m2=inertia,
        joints=tuple(_ranges(arm, [m.joints[joint] for m, _ in found]) for joint in range(arm.joints)),
        error_mm=_range([loop.error_mm for _, loop in found]),
    )


def _ranges(arm: Arm, rows: Sequence[JointMetrics]) -> JointMetrics:
    allowed = {"overshoot": OVERSHOOT_ALLOWED, "hunting_rad": arm.encoder_step, "noise_rad": arm.encoder_step}
    ranges, k = dict[str, Any](), rows[0].stiffness_nm_per_rad
    least = {"hysteresis_rad": 2.0 * arm.encoder_step, "coulomb_nm": arm.encoder_step * (k.value if k else 0.0)}
    for name in (*POSITIVE, *allowed):
        known = [found for row in rows if (found := getattr(row, name)) is not None]
        if known:
            ranges[name] = _range(known, allowed.get(name), least.get(name, 0.0))
    return JointMetrics(joint=rows[0].joint, offset_rad=NO_OFFSET, **ranges)


def _typical(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if 3 * len(known) >= len(values) else None


def _range(found: Sequence[Estimate], allowed: float | None = None, least: float = 0.0) -> Estimate:
    """Healthy range: `SIGMAS` of several values and `TOLERANCE`; of one its interval, and twice that.

    Of logarithms of ``least`` or more, for positive quantities; about zero with ``allowed`` beside.
    """
    known = np.array([(one.value, one.low, one.high) for one in found], float)
    ends = np.where(np.isnan(known), known[:, :1], known)  # an open end is the value
    if allowed is None:
        ends = np.log(np.maximum(ends, least or 1e-12))
    value = ends[:, 0].mean()
    margin = np.log1p(TOLERANCE) if allowed is None else TOLERANCE * abs(value) + allowed
    half = SIGMAS * ends[:, 0].std(ddof=1) + margin if len(ends) > 1 else np.hypot(ends[0, 1:] - value, 2.0 * margin)
    range_ = value, *(value + np.multiply(half, (-1.0, 1.0)))
    return Estimate(*(np.exp(range_) if allowed is None else range_))


POSITIVE = (
    "stiffness_nm_per_rad",
    "modelled_nm_per_rad",
    "coulomb_nm",
    "damping_ratio",
    "hysteresis_rad",
    "lag_s",
    "coulomb_effort",
)


def reference_by(arm: Arm, good: Diagnosis) -> HealthyReference:
    """Make a reference from a diagnosis, for other arms; InputError for another kind."""
    if good.arm != arm.name:
        raise InputError(f"the arm known to be good is a {good.arm}, expected {arm.name}")
    loop, seen = good.open_loop, good.evidence
    error = loop.error_mm if loop else seen.rest_error_mm if seen else None
    return HealthyReference(
        arm=arm.name,
        source=f"an arm known to be good ({good.robot})",
        motors_kg_m2=tuple(row.motor_inertia_kg_m2 for row in good.measurement.joints),
        joints=tuple(_ranges(arm, [row]) for row in good.measurement.joints),
        error_mm=error and _range([error]),
        effort_unit=good.measurement.effort_unit,
    )
