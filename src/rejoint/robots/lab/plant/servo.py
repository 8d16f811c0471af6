"""One servo, its gear and what lies behind it, once per millisecond: firmware, motor, friction, play.

Everything about the plant that is not rigid-body mechanics is here, as scalar functions of one joint
that read like firmware. Positions are in rad, speeds in rad/s, torques in N m.

Sources
-------
Structure and gains of position servos of this class (proportional and derivative term, dead zone of
one count, speed-limited goal): register table of Feetech STS servos, whose registers the vendor's
manual of the myCobot 280 shows. Motor: the linear torque-speed line of a DC motor.
Friction: LuGre (Canudas de Wit et al. 1995) with the Stribeck curve, in the elasto-plastic form of
Dupont et al. 2002, whose bristles are purely elastic until they slide; the original creeps under
any vibration and so has no stiction. The load-dependent part follows Linderoth et al. 2013.
Play: dead-band spring (Nordin and Gutman 2002).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201
from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.robots.lab.plant.streams import uniform

STEP = 0.001
"""[s] period of the servo firmware and step of the simulation (chosen: STS servos run about 1 kHz)"""
HISTORY = 256
"""Encoder readings kept per joint, one per step (chosen)."""
QUEUE = 8
"""Commands of one arm that may be on their way at a time (chosen)."""
NEVER = np.iinfo(np.int64).max
"""Due step of an empty slot of that queue."""
RAMP_SPEED = np.radians(120.0)
"""[rad/s] default speed limit of the reference of a myCobot 280 (chosen: 80 % of the vendor's 150 deg/s)"""

_NO_LOAD_SPEED = 5.0  # [rad/s] STS3215 at 12 V: 45 rpm and some more without its own friction
_NO_LOAD_MARGIN = 1.05  # least no-load speed by the joint's largest speed (chosen, as above)
_RAMP_SHARE_OF = np.radians(150.0)  # [rad/s] the joint speed that RAMP_SPEED belongs to
_SPEED_FILTER = 0.1  # weight of the newest encoder difference: a time constant of 10 ms (chosen)
_LOAD_FILTER = 0.1  # weight of the newest torque in the load that is told: a time constant of 10 ms (chosen)
_STRIBECK_SPEED = 0.06  # [rad/s] chosen
_BRISTLE_RATE = 150.0  # [rad/s] natural frequency of bristle and reflected inertia (chosen): a stuck
#   worn joint yields by less than half an encoder count before it breaks loose, and 1 kHz resolves it
_BRISTLE_DAMPING = 1.0  # damping ratio of the same (chosen: a stuck joint does not ring)
_RIPPLE_PERIODS = 30.0  # periods of the gear ripple per output turn (chosen: teeth of the last wheel)
_GREASE = 0.02  # [N m s/rad] viscous torque inside the play (chosen)
_GREASE_TIME = 0.002  # [s] its largest ratio to the stiffness of the gear: more is unstable in steps of 1 ms
_GEAR_DAMPING_TIME = 0.0012  # [s] damping of a loaded gear over its stiffness (chosen)
_GEAR_STEPS = 2.0  # steps per radian of the fastest gear oscillation
_STOP_MARGIN = np.radians(3.0)  # [rad] mechanical stops lie beyond the joint limits (chosen)
_STOP_STIFFNESS = 60.0  # [N m/rad] of a myCobot 280, as the viscous torques (chosen)
_STOP_DAMPING = 0.5  # [N m s/rad] chosen
AMBIENT = 25.0
"""[deg C] temperature of a servo that never worked (chosen)"""
_HEAT_RISE = 60.0  # [deg C] final rise of a servo held at its torque limit (chosen: trips near 80 deg C)
_HEAT_TIME = 400.0  # [s] thermal time constant (chosen)

JOINT = np.dtype(
    [
        ("position_gain", "f8"), ("damping_gain", "f8"), ("torque_limit", "f8"), ("coulomb", "f8"),
        ("stiction", "f8"), ("load_friction", "f8"), ("play", "f8"), ("link_stiffness", "f8"),
        ("reflected_inertia", "f8"), ("ripple", "f8"), ("torque_noise", "f8"), ("play_in_loop", "?"),
        ("encoder_step", "f8"), ("lower", "f8"), ("upper", "f8"), ("offset", "f8"), ("no_load_speed", "f8"),
        ("grease", "f8"), ("stop_stiffness", "f8"), ("stop_damping", "f8"),
        ("ambient", "f8"),
    ]
)  # fmt: skip
"""What a joint is made of; the first fields and the offset are those of `rejoint.robots.lab.plant.wear.Wear`."""

STATE = np.dtype(
    [
        ("goal", "f8"), ("reference", "f8"), ("speed_limit", "f8"), ("measured", "f8"),
        ("measured_speed", "f8"), ("bristle", "f8"), ("torque", "f8"), ("load", "f8"), ("temperature", "f8"),
        ("powered", "?"), ("frozen", "?"), ("blind", "?"),
    ]
)  # fmt: skip
"""What a servo remembers between two steps, and which readings of its encoder no longer change: those it tells
(``frozen``), or those it controls by as well (``blind``)."""


def gear_armature(stiffness: Array) -> Array:
    """Inertia [kg m^2] that the gear hinge needs beside the link's own.

    A wrist link has 1e-5 kg m^2; on its gear stiffness it would ring at kilohertz, which explicit
    steps of 1 ms cannot follow. This much inertia on the relative motion alone (it does not weigh on
    the motion of motor and link together) keeps every gear oscillation at `_GEAR_STEPS` steps per
    radian, a quarter of the stability limit, whatever the stiffness.
    """
    return stiffness * (_GEAR_STEPS * STEP) ** 2


def ramp_speed(max_speed: Array) -> Array:
    """Default speed limit (n,) [rad/s] of the references of joints that can move at ``max_speed`` (n,) [rad/s]."""
    return np.asarray(RAMP_SPEED * (max_speed / _RAMP_SHARE_OF))


def no_load_speed(max_speed: Array) -> Array:
    """Speed (n,) [rad/s] at which motors have no torque left: of the servo, or more where a joint is faster."""
    return np.maximum(_NO_LOAD_SPEED, _NO_LOAD_MARGIN * max_speed)


def fill_constants(records: NDArray[np.void], torque: Array, time: float) -> None:
    """Write into JOINT records (n,) what profiles do not give, for an arm of scales ``torque`` (n,) and ``time``."""
    records["grease"] = np.minimum(_GREASE * (torque * time), _GREASE_TIME * records["link_stiffness"])
    records["stop_stiffness"] = _STOP_STIFFNESS * torque
    records["stop_damping"] = _STOP_DAMPING * (torque * time)


@njit(cache=True)
def read_encoder(joint, servo_angle, gear_angle):
    """Angle in whole counts; an encoder behind the gear sees the play but not the flex."""
    angle = servo_angle
    if joint.play_in_loop:
        angle += min(max(gear_angle, -0.5 * joint.play), 0.5 * joint.play)
    return np.rint(angle / joint.encoder_step) * joint.encoder_step


@njit(cache=True)
def motor_torque(joint, servo, angle, speed):
    """Run the position loop on the encoder angle and return the torque of the motor."""
    servo.measured_speed += _SPEED_FILTER * ((angle - servo.measured) / STEP - servo.measured_speed)
    servo.measured = angle
    if not servo.powered:
        return 0.0  # the windings are open: not even back-EMF
    stride = servo.speed_limit * STEP
    servo.reference += min(max(servo.goal - servo.reference, -stride), stride)
    error = servo.reference + joint.offset - angle
    if abs(error) <= joint.encoder_step:
        error = 0.0
    wanted = joint.position_gain * error - joint.damping_gain * servo.measured_speed
    duty = min(max(wanted / joint.torque_limit, -1.0), 1.0)
    return joint.torque_limit * (duty - speed / joint.no_load_speed)


@njit(cache=True)
def friction_torque(joint, servo, speed, load):
    """Friction of motor and gear at ``speed`` under the transmitted torque ``load``; opposes the motion."""
    stribeck = np.exp(-((speed / _STRIBECK_SPEED) ** 2))
    most = joint.coulomb + (joint.stiction - joint.coulomb) * stribeck + joint.load_friction * abs(load)
    stiffness = joint.reflected_inertia * _BRISTLE_RATE**2
    damping = 2.0 * _BRISTLE_DAMPING * joint.reflected_inertia * _BRISTLE_RATE
    bristle = servo.bristle + speed * STEP
    servo.bristle = min(max(bristle, -most / stiffness), most / stiffness)
    return -min(max(stiffness * servo.bristle + damping * speed, -most), most)


@njit(cache=True)
def gear_torque(joint, angle, speed):
    """Torque of gear and link upon the link when it is turned by ``angle`` against the servo output."""
    half = 0.5 * joint.play
    bent = angle - min(max(angle, -half), half)
    if bent == 0.0:
        return -joint.grease * speed
    torque = -joint.link_stiffness * (bent + _GEAR_DAMPING_TIME * speed)
    if torque * bent > 0.0:  # teeth push, they do not pull
        torque = 0.0
    return torque - joint.grease * speed


@njit(cache=True)
def disturbance(joint, angle, speed, unit):
    """Gear ripple and mechanical stops; ``unit`` in [0, 1) draws the torque noise of a running motor."""
    torque = joint.ripple * np.sin(_RIPPLE_PERIODS * angle)
    torque += joint.torque_noise * np.sqrt(12.0) * (unit - 0.5)
    beyond = angle - min(max(angle, joint.lower - _STOP_MARGIN), joint.upper + _STOP_MARGIN)
    if beyond != 0.0:
        torque -= joint.stop_stiffness * beyond + joint.stop_damping * speed
    return torque


@njit(cache=True)
def warm_up(joint, servo):
    """One step of a first-order thermal model heated by the copper losses."""
    load = servo.torque / joint.torque_limit
    rise = _HEAT_RISE * load * load
    servo.temperature += STEP / _HEAT_TIME * (joint.ambient + rise - servo.temperature)


@njit(cache=True)
def drive(ids, tick, key, joints, servos, due, queue, qpos, qvel, applied):
    """Write the torques of the coming step for the arms ``ids``.

    ``tick`` (B,) counts steps, ``key`` (B,) names the noise streams, ``joints`` (B, n) JOINT and
    ``servos`` (B, n) STATE, ``due`` (B, QUEUE) and ``queue`` (B, QUEUE, n) hold commands on their way,
    ``qpos``, ``qvel`` and ``applied`` (B, 2n) are MuJoCo's.
    """
    n = joints.shape[1]
    for i in ids:
        receive(tick[i], due[i], queue[i], servos[i])
        for j in range(n):
            joint, servo = joints[i, j], servos[i, j]
            angle, speed = qpos[i, 2 * j], qvel[i, 2 * j]
            gear_angle, gear_speed = qpos[i, 2 * j + 1], qvel[i, 2 * j + 1]
            seen = servo.measured if servo.blind else read_encoder(joint, angle, gear_angle)
            servo.torque = motor_torque(joint, servo, seen, speed)
            servo.load += _LOAD_FILTER * (servo.torque / joint.torque_limit - servo.load)
            load = gear_torque(joint, gear_angle, gear_speed)
            unit = uniform(key[i], tick[i] * n + j) if servo.powered else 0.5
            applied[i, 2 * j] = (
                servo.torque + friction_torque(joint, servo, speed, load) + disturbance(joint, angle, speed, unit)
            )
            applied[i, 2 * j + 1] = load
            warm_up(joint, servo)


@njit(cache=True)
def receive(tick, due, queue, servos):
    """Take over the commands of one arm that have arrived, the latest arrival last."""
    while True:
        slot = np.argmin(due)
        if due[slot] > tick:
            return
        due[slot] = NEVER
        for j in range(len(servos)):
            servos[j].goal = queue[slot, j]


@njit(cache=True)
def record(ids, tick, joints, servos, qpos, history):
    """Count one step and keep the encoder readings (B, HISTORY, n) after it."""
    for i in ids:
        tick[i] += 1
        for j in range(joints.shape[1]):
            if servos[i, j].frozen or servos[i, j].blind:
                history[i, tick[i] % HISTORY, j] = history[i, (tick[i] - 1) % HISTORY, j]
            else:
                history[i, tick[i] % HISTORY, j] = read_encoder(joints[i, j], qpos[i, 2 * j], qpos[i, 2 * j + 1])
