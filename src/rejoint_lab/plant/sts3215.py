"""The position loop of an STS3215 in counts and per mille of PWM, per millisecond.

Sources: 0o8o0-blip/sts3215-firmware (MIT), kscalelabs/sysid, a measured sag (lerobot, PR 4310), Feetech's memory table.
"""

import numpy as np

from rejoint.arms.compiled import inner
from rejoint_lab.plant.servo import STEP, ServoTable, record_of, trapezoid, within

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201


COUNTS = 4096
"""per turn"""
WINDOW = 20
"""[ticks] of speed and derivative (register 81: 20 ms)"""
PWM_FULL = 1000
"""[0.1 %]"""
PWM_MOST = 970
"""saturation"""
NOMINAL_VOLTAGE = 12.0
"""[V] of stall torque and no-load speed"""
STALL_CURRENT = 12.0 / 9.03
"""[A] by the winding of kscalelabs/sysid, 9.03 ohm; the data sheet says 2.7 A"""
VOLTAGE, HEAT, CURRENT, OVERLOAD = 1, 4, 8, 32
"""Bits of the status register"""
GAIN_PER_P = COUNTS / (2 * np.pi) / 4 / PWM_FULL
"""[1/rad] share of the stall torque per radian at P = 1: 0.163"""

_SPEED_STEP = 50  # [counts/s] in which speeds are told
_ENCODER_SHARE = 0.8  # of the newest reading in the filtered one
_TRAVEL = 50  # [counts] of motion that show that a joint is not blocked
_HOT_TICKS = 50  # ticks over the limit that count
_COOL = 5.0  # [deg C] below the limit at which heat is forgotten
_INTEGRAL_DIVISOR = 500

SETTING = record_of(
    whole="p d i startup limit dead_cw dead_ccw torque_limit least most threshold unloading protective "
    "protection_ticks overload current_ticks torque_on",
    real="acceleration speed current_limit heat_limit low_voltage high_voltage voltage warmth stall bias viscous",
)
"""Settings: outputs in 0.1 % PWM, ``least`` and ``most`` in counts (equal: none), counts/s^2, counts/s, A,
``torque_on`` 0, 1 or 2 (damping). Environment: ``voltage`` [V], ``warmth`` [K], ``stall`` [N m], ``bias`` [N m],
``viscous`` [N m s/rad]."""

STATUS = record_of(
    whole="goal position speed error output alarms blocked blocked_at sign over_current hot",
    real="reference rate filtered sum current",
    flag="moving",
)
"""State: counts, counts/s, 0.1 % PWM, A; ``alarms`` are bits, then counters in ticks"""

TABLE = ServoTable("sts3215.csv")
"""The model ``STS3215`` (C018)"""


@inner
def ramp(setting, status):
    """Move the reference by one tick, on a trapezoid of speed."""
    goal = float(status.goal)
    if setting.least != setting.most:
        goal = min(max(goal, float(setting.least)), float(setting.most))
    status.reference, status.rate = trapezoid(status.reference, status.rate, goal, setting.speed, setting.acceleration)


@inner
def sense(status, count, positions, tick):
    """Take an encoder reading, and the speed over `WINDOW`; ``positions`` (WINDOW,)."""
    status.filtered += _ENCODER_SHARE * (count - status.filtered)
    status.position = int(np.rint(status.filtered))
    slot = tick % WINDOW
    speed = (status.position - positions[slot]) / (WINDOW * STEP)
    status.speed = int(speed / _SPEED_STEP) * _SPEED_STEP
    positions[slot] = status.position


@inner
def output_of(setting, status, errors, tick):
    """Output [0.1 % PWM]; ``errors`` (WINDOW,)."""
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
    if setting.limit:
        part = within(part, 4 * setting.limit)
    output += part
    if output > 0:
        output += setting.startup
    elif output < 0:
        output -= setting.startup
    held = within(output, setting.torque_limit)
    if setting.i != 0 and abs(status.speed) < _SPEED_STEP and not status.alarms & setting.unloading:
        status.sum += error + (held - output)  # what the clamp cut off is not counted
    return held


@inner
def protect(setting, status, output, temperature):
    """Update the alarms of a tick; returns the allowed ``output``."""
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
        return within(output, setting.protective)
    return output


@inner
def torque_of(setting, status, speed, no_load_speed):
    """Motor torque [N m] at ``speed`` [rad/s] and the present voltage."""
    braked = setting.stall * speed / no_load_speed
    if setting.torque_on == 0:
        status.output, status.current = 0, 0.0
        return 0.0  # the windings are open
    if setting.torque_on == 2:
        status.output = 0
        return -braked
    duty = within(status.output, PWM_MOST) / PWM_FULL
    torque = setting.stall * duty * setting.voltage / NOMINAL_VOLTAGE - braked
    status.current = STALL_CURRENT * torque / setting.stall
    return torque


@inner
def tick_servo(setting, status, rings, joint, state, tick, count, speed):
    """One millisecond of a servo at ``count``; ``rings`` (2, WINDOW); returns the torque [N m] on the output."""
    errors, positions = rings[0], rings[1]
    temperature = state.temperature + setting.warmth
    sense(status, count, positions, tick)
    if setting.torque_on != 1:
        status.reference, status.rate, status.sum = float(status.position), 0.0, 0.0
        status.goal = status.position
        status.alarms &= ~(OVERLOAD | CURRENT)
        errors[:] = 0
        status.moving = status.speed != 0
        status.output = protect(setting, status, 0, temperature)
    else:
        ramp(setting, status)
        status.output = protect(setting, status, output_of(setting, status, errors, tick), temperature)
        status.moving = status.rate != 0.0 or status.speed != 0
    state.torque = torque_of(setting, status, speed, joint.no_load_speed)
    state.load = status.output / PWM_FULL
    return state.torque + setting.bias - setting.viscous * speed
