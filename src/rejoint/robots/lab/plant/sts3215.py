"""The position loop of an STS3215 as its firmware computes it: whole counts and per mille of PWM, once per millisecond.

A second servo beside that of `rejoint.robots.lab.plant.servo`, whose friction, gear and mechanical stops it shares.
Counts are those of the encoder, from the zero of the joint; what a register holds is read by whoever fills `SETTING`.

Sources
-------
Structure, units and order of operations: read in 0o8o0-blip/sts3215-firmware (MIT; a rewrite that is compared with the
maker's binary), and checked against kscalelabs/sysid's duty over error on a bench (within 3 %), Feetech's own
identification (error gain 0.163 per rad and unit of P) and an owner's sag at P = 16 and 32 (lerobot, PR 4310). Units
of the registers: Feetech's memory table.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201
from __future__ import annotations

import numpy as np
from numba import njit

from rejoint.arms import Arm
from rejoint.robots.lab.plant.servo import STEP

SERVO = "STS3215"
"""As `rejoint.arms.Arm.servos` calls it"""
COUNTS = 4096
"""of the encoder a turn"""
WINDOW = 20
"""[ticks] over which speed and the derivative are taken (register 81: 20 ms)"""
PWM_FULL = 1000
"""of the unit of outputs: 0.1 % of PWM"""
PWM_MOST = 970
"""at which the bridge saturates"""
NOMINAL_VOLTAGE = 12.0
"""[V] at which stall torque and no-load speed are named"""
STALL_CURRENT = 12.0 / 9.03
"""[A] by the winding that kscalelabs/sysid fitted at 12 V, 9.03 ohm; the data sheet names 2.7 A, at which the current
protection would come before the overload protection, and on the same bench it did not"""
VOLTAGE, HEAT, CURRENT, OVERLOAD = 1, 4, 8, 32
"""Bits of the status register."""
GAIN_PER_P = COUNTS / (2 * np.pi) / 4 / PWM_FULL
"""[1/rad] share of the stall torque that one radian of error calls for with P = 1: 0.163"""

_SPEED_STEP = 50  # [counts/s] in which speeds are told
_ENCODER_SHARE = 0.8  # of the newest reading in the filtered one
_TRAVEL = 50  # [counts] of motion that show that a joint is not blocked
_HOT_TICKS = 50  # ticks over the limit that count
_COOL = 5.0  # [deg C] below the limit at which heat is forgotten
_INTEGRAL_DIVISOR = 500

SETTING = np.dtype(
    [
        ("p", "i8"), ("d", "i8"), ("i", "i8"), ("startup", "i8"), ("integral_limit", "i8"), ("dead_cw", "i8"),
        ("dead_ccw", "i8"), ("torque_limit", "i8"), ("least", "i8"), ("most", "i8"), ("acceleration", "f8"),
        ("speed", "f8"), ("threshold", "i8"), ("unloading", "i8"), ("protective", "i8"), ("protection_ticks", "i8"),
        ("overload", "i8"), ("current_limit", "f8"), ("current_ticks", "i8"), ("heat_limit", "f8"),
        ("low_voltage", "f8"), ("high_voltage", "f8"), ("torque_on", "i8"), ("voltage", "f8"), ("warmth", "f8"),
        ("stall", "f8"), ("bias", "f8"), ("viscous", "f8"),
    ]
)  # fmt: skip
"""What a servo is told, in the units of the law: outputs in 0.1 % PWM, ``least`` and ``most`` in counts (equal: none),
``acceleration`` and ``speed`` of the reference in counts/s^2 and counts/s, currents in A, ``torque_on`` 0, 1 or 2
(damping); then what it finds: ``voltage`` [V] of its supply, ``warmth`` [K] beside that of its own work, ``stall``
[N m] at `NOMINAL_VOLTAGE`, ``bias`` [N m], a constant torque on the joint that no model of its masses explains, and
``viscous`` [N m s/rad], what its friction grows with speed."""

STATUS = np.dtype(
    [
        ("goal", "i8"), ("reference", "f8"), ("rate", "f8"), ("filtered", "f8"), ("position", "i8"), ("speed", "i8"),
        ("error", "i8"), ("sum", "f8"), ("output", "i8"), ("moving", "?"), ("current", "f8"), ("alarms", "i8"),
        ("blocked", "i8"), ("blocked_at", "i8"), ("sign", "i8"), ("over_current", "i8"), ("hot", "i8"),
    ]
)  # fmt: skip
"""What a servo remembers: counts, counts/s, 0.1 % PWM, A; ``alarms`` are bits, then counters in ticks."""

DEFAULTS = {
    "p": 32, "d": 32, "i": 0, "startup": 16, "integral_limit": 0, "dead_cw": 1, "dead_ccw": 1, "torque_limit": 1000,
    "least": 0, "most": 0, "acceleration": 10_000.0, "speed": 7500.0, "threshold": 2, "unloading": 44,
    "protective": 200, "protection_ticks": 2000, "overload": 800, "current_limit": 310 * 0.0065, "current_ticks": 2000,
    "heat_limit": 70.0, "low_voltage": 4.0, "high_voltage": 14.0, "torque_on": 1, "voltage": NOMINAL_VOLTAGE,
    "warmth": 0.0, "stall": 2.94, "bias": 0.0, "viscous": 0.0,
}  # fmt: skip
"""A servo as sold (C018), powered, with its torque on."""


def has_these_servos(arm: Arm) -> bool:
    """Tell whether every joint of ``arm`` is moved by such a servo."""
    return set(arm.servos) == {SERVO}


@njit(cache=True)
def ramp(setting, status):
    """Move the reference by one tick towards the goal, on a trapezoid of speed."""
    goal = float(status.goal)
    if setting.least != setting.most:
        goal = min(max(goal, float(setting.least)), float(setting.most))
    left = goal - status.reference
    gain = setting.acceleration * STEP
    braking = gain * (np.sqrt(0.25 + 2.0 * abs(left) / (gain * STEP)) - 0.5)  # from it the goal is reached in steps
    wanted = min(setting.speed, braking)
    wanted = wanted if left >= 0.0 else -wanted
    status.rate += min(max(wanted - status.rate, -gain), gain)
    stride = status.rate * STEP
    if abs(left) <= max(abs(stride), 0.5) and abs(status.rate) <= 2.0 * gain:
        status.reference, status.rate = goal, 0.0
    else:
        status.reference += stride


@njit(cache=True)
def sense(status, count, positions, tick):
    """Take over an encoder reading [counts], and the speed over `WINDOW`; ``positions`` (WINDOW,) is a ring."""
    status.filtered += _ENCODER_SHARE * (count - status.filtered)
    status.position = int(np.rint(status.filtered))
    slot = tick % WINDOW
    speed = (status.position - positions[slot]) / (WINDOW * STEP)
    status.speed = int(speed / _SPEED_STEP) * _SPEED_STEP
    positions[slot] = status.position


@njit(cache=True)
def output_of(setting, status, errors, tick):
    """One tick of the position loop: the wanted output [0.1 % PWM]; ``errors`` (WINDOW,) is a ring."""
    raw = int(status.reference) - status.position
    error = max(raw - setting.dead_cw, 0) if raw > 0 else min(raw + setting.dead_ccw, 0)
    slot = tick % WINDOW
    change = error - errors[slot]
    errors[slot] = error
    status.error = error
    if abs(change) < setting.threshold:
        change = 0
    output = int(error * setting.p / 4) + int(change * setting.d / 8)
    if setting.i == 0:
        status.sum = 0.0
    part = int(status.sum * setting.i / _INTEGRAL_DIVISOR)
    if setting.integral_limit:
        part = min(max(part, -4 * setting.integral_limit), 4 * setting.integral_limit)
    output += part
    if output > 0:
        output += setting.startup
    elif output < 0:
        output -= setting.startup
    held = min(max(output, -setting.torque_limit), setting.torque_limit)
    if setting.i != 0 and abs(status.speed) < _SPEED_STEP and not status.alarms & setting.unloading:
        status.sum += error + (held - output)  # what the clamp cut off is not counted
    return held


@njit(cache=True)
def protect(setting, status, output, temperature):
    """Set and clear the alarms of one tick, and return what of ``output`` they leave."""
    turned = output * status.sign < 0
    if abs(output) > setting.overload:
        if status.blocked == 0 or abs(status.position - status.blocked_at) > _TRAVEL:
            status.blocked, status.blocked_at = 0, status.position
        status.blocked += 1
        if status.blocked > setting.protection_ticks and not status.alarms & OVERLOAD:
            status.alarms |= OVERLOAD
            status.sign = 1 if output > 0 else -1
    else:
        status.blocked = 0
    if status.alarms & OVERLOAD and (turned or abs(output) <= setting.protective):
        status.alarms &= ~OVERLOAD
        status.blocked = 0
    if abs(status.current) > setting.current_limit:
        status.over_current += 1
        if status.over_current > setting.current_ticks:
            status.alarms |= CURRENT
            if setting.unloading & CURRENT:
                setting.torque_on = 0
    else:
        status.over_current = 0
    status.hot = status.hot + 1 if temperature > setting.heat_limit else 0
    if status.hot > _HOT_TICKS:
        status.alarms |= HEAT
    elif temperature < setting.heat_limit - _COOL:
        status.alarms &= ~HEAT
    if setting.low_voltage <= setting.voltage <= setting.high_voltage:
        status.alarms &= ~VOLTAGE
    else:
        status.alarms |= VOLTAGE
    masked = status.alarms & setting.unloading
    if masked & HEAT:
        return 0
    if masked & OVERLOAD:
        return min(max(output, -setting.protective), setting.protective)
    return output


@njit(cache=True)
def torque_of(setting, status, powered, speed, no_load_speed):
    """Torque [N m] of the motor at ``speed`` [rad/s], by the linear torque-speed line at the voltage there is."""
    braked = setting.stall * speed / no_load_speed
    if not powered or setting.torque_on == 0:
        status.output, status.current = 0, 0.0
        return 0.0  # the windings are open
    if setting.torque_on == 2:
        status.output = 0
        return -braked
    duty = min(max(status.output, -PWM_MOST), PWM_MOST) / PWM_FULL
    torque = setting.stall * duty * setting.voltage / NOMINAL_VOLTAGE - braked
    status.current = STALL_CURRENT * torque / setting.stall
    return torque


@njit(cache=True)
def tick_servo(setting, status, errors, positions, tick, count, powered, speed, no_load_speed, temperature):
    """One millisecond of a servo whose encoder reads ``count``; returns the torque [N m] of its motor.

    While the torque is off, the reference stays with the joint, so that nothing jumps when it comes on.
    """
    sense(status, count, positions, tick)
    if not powered or setting.torque_on != 1:
        status.reference, status.rate, status.sum = float(status.position), 0.0, 0.0
        status.goal = status.position
        status.alarms &= ~(OVERLOAD | CURRENT)
        errors[:] = 0
        status.moving = status.speed != 0
        status.output = protect(setting, status, 0, temperature + setting.warmth)
    else:
        ramp(setting, status)
        status.output = protect(setting, status, output_of(setting, status, errors, tick), temperature + setting.warmth)
        status.moving = status.rate != 0.0 or status.speed != 0
    return torque_of(setting, status, powered, speed, no_load_speed)
