"""The control loops of ROBOTIS' X series in counts and 1/885 of PWM, per millisecond; two servos may turn one joint.

Sources: ROBOTIS' e-manual (PID, profiles, protection); Rhoban/bam (the XL330's divisor of 256, its motor and friction;
those of MX-64 and MX-106, scaled, for XM430 and XM540).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.compiled import inner
from rejoint_lab.plant.servo import STEP, ServoTable, record_of, trapezoid, within

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201

COUNTS = 4096
"""per turn"""
FULL = 885
"""PWM at full duty"""
VELOCITY_UNIT = 0.229 / 60 * COUNTS
"""[counts/s] of the velocity registers"""
ACCELERATION_UNIT = 214.577 / 3600 * COUNTS
"""[counts/s^2] of the acceleration registers"""
VOLTAGE, HEAT, SHOCK, OVERLOAD = 1, 4, 16, 32
"""Bits of the hardware error status"""
CURRENT, VELOCITY, POSITION, EXTENDED, CURRENT_POSITION, PWM = 0, 1, 3, 4, 5, 16
"""Operating modes"""
AT_ONCE = 1e9
"""[counts/s^2] acceleration without a profile"""

_FILTER = 0.1  # weight of the newest difference in speed and derivative: 10 ms (chosen)
_TRAVEL = 20  # [counts] of motion that show that a joint is not blocked (chosen)
_OVERLOAD_TICKS = 2000  # at the limit without motion (chosen: "a few seconds" in interbotix_ros_arms, issue 26)
_ALARM_TICKS = 50  # outside the limits of voltage or heat (chosen)

TABLE = ServoTable("xseries.csv")
NEW = TABLE.new
"""Registers as sold, and properties of a new servo: [V], [N m], [A], [rad/s], [N m s/rad], [kg m^2]"""


def drive_of(servo: str) -> tuple[str, int, dict[str, int]]:
    """Model, number and gains of the servos of a joint: ``2 XM430-W350 p=850`` (`Arm.servos`)."""
    words = servo.split()
    count = int(words.pop(0)) if words and words[0].isdecimal() else 1
    model, *gains = words or [""]
    return model, count, {name: int(value) for name, equals, value in (gain.partition("=") for gain in gains) if equals}


def drives(servos: Sequence[str]) -> bool:
    """Whether all ``servos`` of an arm are of the table."""
    return bool(servos) and all(drive_of(servo)[0] in NEW for servo in servos)


SETTING = record_of(
    whole="mode torque_on p i d feed_1 feed_2 velocity_p velocity_i timed shutdown",
    real="limit pwm_goal current_goal velocity_goal acceleration speed slope heat_limit low_voltage high_voltage "
    "voltage warmth nominal stall stall_current no_load divisor bias viscous",
    flag="input_current",
)
"""Settings: outputs in 1/885 PWM, [A], counts/s, counts/s^2 (``timed``: ms), [V/ms]. A servo without ``stall`` is none.
Environment: ``voltage`` [V], ``warmth`` [K], ``bias`` [N m], ``viscous`` [N m s/rad] of the joint."""

STATUS = record_of(
    whole="goal aimed position alarms blocked blocked_at hot strained",
    real="reference rate top gain error change sum speed output current",
    flag="moving",
)
"""State: counts, counts/s, 1/885 PWM, A; ``alarms`` are bits that stay, then counters in ticks"""


def as_sold(model: str) -> NDArray[np.void]:
    """Return `SETTING` () of a model, powered, torque on."""
    setting, new = TABLE.as_sold(model, SETTING), NEW[model]
    setting["input_current"] = model.startswith("XL330")
    setting["current_goal"] = new.get("Current_Limit", 0) * new.get("current_unit", 0.0)
    setting["slope"] = new.get("PWM_Slope", np.inf) * 1.977e-3
    return setting


@inner
def follow(setting, status):
    """Move the reference by one tick towards the goal."""
    if status.goal != status.aimed:
        status.aimed = status.goal
        way = abs(status.goal - status.reference)
        status.top, status.gain = setting.speed, setting.acceleration
        if setting.timed and setting.speed > 0.0:  # total and accelerating [ms]
            rise = min(setting.acceleration, 0.5 * setting.speed)
            status.top = 1e3 * way / (setting.speed - rise)
            status.gain = 1e3 * status.top / rise if rise > 0.0 else AT_ONCE
        if status.gain == 0.0:
            status.gain = AT_ONCE
    if status.top == 0.0:
        status.reference, status.rate = float(status.goal), 0.0
    else:
        status.reference, status.rate = trapezoid(
            status.reference, status.rate, float(status.goal), status.top, status.gain
        )


@inner
def output_of(setting, status, speed):
    """Output before its limits; ``speed`` [rad/s]."""
    if setting.mode == PWM:
        return setting.pwm_goal
    if setting.mode == CURRENT:
        return FULL * (setting.current_goal / setting.stall_current + speed / setting.no_load)
    if setting.mode == VELOCITY:
        error = (setting.velocity_goal - status.speed) / VELOCITY_UNIT
        status.sum += error if abs(status.output) < setting.limit else 0.0
        return setting.velocity_p / 128 * error + setting.velocity_i / 65536 * status.sum
    before = status.rate
    follow(setting, status)
    error = status.reference - status.position
    status.change += _FILTER * (error - status.error - status.change)
    status.error = error
    output = setting.p / setting.divisor * error + setting.d / 16 * status.change + status.sum
    output += STEP * (setting.feed_1 / 4 * status.rate + setting.feed_2 / 4 * (status.rate - before))
    if setting.i == 0:  # another gain is no jump (chosen)
        status.sum = 0.0
    elif abs(output) < setting.limit or output * error < 0.0:  # what the limit cuts off is not summed up
        status.sum += setting.i / 65536 * error
    if setting.mode == CURRENT_POSITION:  # the loop asks for a current, which an inner loop gives
        most = setting.current_goal
        if setting.input_current:  # the XL330 limits the current of its supply, at stall the duty times the motor's
            most = np.sqrt(most * setting.stall_current)
        current = within(output / FULL * setting.stall_current, most)
        output = FULL * (current / setting.stall_current + speed / setting.no_load)
    return output


@inner
def protect(setting, status, wanted, temperature):
    """Update the alarms, which stay; one of ``shutdown`` takes the torque off."""
    if abs(wanted) >= setting.limit and abs(status.position - status.blocked_at) <= _TRAVEL:
        status.blocked += 1
    else:
        status.blocked, status.blocked_at = 0, status.position
    status.hot = status.hot + 1 if temperature > setting.heat_limit else 0
    sound = setting.low_voltage <= setting.voltage <= setting.high_voltage
    status.strained = 0 if sound else status.strained + 1
    if status.blocked > _OVERLOAD_TICKS:
        status.alarms |= OVERLOAD
    if status.hot > _ALARM_TICKS:
        status.alarms |= HEAT
    if status.strained > _ALARM_TICKS:
        status.alarms |= VOLTAGE
    if status.alarms & setting.shutdown:
        setting.torque_on = 0


@inner
def tick_servo(setting, status, state, count, speed):
    """One millisecond of one servo at ``count``; returns its motor torque [N m]."""
    status.speed += _FILTER * ((count - status.position) / STEP - status.speed)
    status.position = count
    if setting.torque_on == 0:
        protect(setting, status, 0.0, state.temperature + setting.warmth)
        status.reference, status.aimed, status.rate, status.sum = float(count), count, 0.0, 0.0
        status.error, status.change = 0.0, 0.0
        status.output, status.current, status.moving = 0.0, 0.0, False
        return 0.0  # the windings are open
    wanted = output_of(setting, status, speed)
    protect(setting, status, wanted, state.temperature + setting.warmth)
    slope = FULL * setting.slope / max(setting.voltage, 0.1)
    status.output += within(within(wanted, setting.limit) - status.output, slope)
    status.moving = status.rate != 0.0
    duty = status.output / FULL
    torque = setting.stall * (duty * setting.voltage / setting.nominal - speed / setting.no_load)
    status.current = setting.stall_current * torque / setting.stall
    if setting.input_current:
        status.current *= abs(duty)
    return torque


@inner
def tick_servos(settings, status, state, count, speed):
    """One millisecond of a joint's servos at ``count``; returns the torque [N m] on the output."""
    torque = 0.0
    for k in range(len(settings)):
        if settings[k].stall > 0.0:
            torque += tick_servo(settings[k], status[k], state, count, speed)
    state.torque = torque
    state.load = status[0].output / FULL
    return torque + settings[0].bias - settings[0].viscous * speed
