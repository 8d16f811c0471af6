"""One servo, its gear and its link, per millisecond; tables of servos; and the channel.

Sources: Feetech's STS register table; friction: LuGre (Canudas de Wit et al. 1995), elasto-plastic (Dupont et al.
2002), load-dependent (Linderoth et al. 2013); play as a dead-band spring (Nordin and Gutman 2002). Random streams:
SplitMix64 (Steele, Lea, Flood 2014).
"""

import csv
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numba import float64, int64, uint64, vectorize
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.compiled import inner

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201


Keys = NDArray[np.uint64]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_1, _SHIFT_2, _SHIFT_3, _TO_53_BITS = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


def stream_keys(seed: int, count: int, *, first: int = 0, purpose: int = 0) -> Keys:
    """Stream keys (count,) of arms ``first``, ``first + 1``, ... for one purpose."""
    sequences = (np.random.SeedSequence(seed, spawn_key=(first + i, purpose)) for i in range(count))
    return np.array([sequence.generate_state(1, np.uint64)[0] for sequence in sequences], dtype=np.uint64)


@vectorize([float64(uint64, int64)], cache=True)
def uniform(key, counter):
    """Return number ``counter`` of a stream, uniform in [0, 1)."""
    z = key + np.uint64(counter + 1) * _STEP
    z = (z ^ (z >> _SHIFT_1)) * _MIX_1
    z = (z ^ (z >> _SHIFT_2)) * _MIX_2
    z = z ^ (z >> _SHIFT_3)
    return np.float64(z >> _TO_53_BITS) * _UNIT


STEP = 0.001
"""[s] (chosen: STS servos run at about 1 kHz)"""
HISTORY = 256
"""Encoder readings per joint (chosen)"""
QUEUE = 8
"""Pending commands per arm (chosen)"""
NEVER = np.iinfo(np.int64).max
"""Due step of an empty slot"""
RAMP_SHARE = 0.8
"""Default speed of references over the joint's largest (chosen)"""

_NO_LOAD_SPEED = 5.0  # [rad/s] STS3215 at 12 V: 45 rpm and some more without its own friction
_NO_LOAD_MARGIN = 1.05  # least no-load speed by the joint's largest speed (chosen, as above)
_SPEED_FILTER = 0.1  # weight of the newest encoder difference: a time constant of 10 ms (chosen)
LOAD_FILTER = 0.1  # weight of the newest torque in the load that is told: a time constant of 10 ms (chosen)
_STRIBECK_SPEED = 0.06  # [rad/s] chosen
_BRISTLE_RATE = 150.0  # [rad/s] natural frequency of bristle and reflected inertia (chosen): a stuck
#   worn joint yields by less than half an encoder count before it breaks loose, and 1 kHz resolves it
_BRISTLE_DAMPING = 1.0  # damping ratio of the same (chosen: a stuck joint does not ring)
_RIPPLE_PERIODS = 30.0  # periods of the gear ripple per output turn (chosen: teeth of the last wheel)
_GREASE = 0.02  # [N m s/rad] viscous torque inside the play (chosen)
_GREASE_TIME = 0.002  # [s] its largest ratio to the stiffness of the gear: more is unstable in steps of 1 ms
_GEAR_DAMPING_TIME = 0.0012  # [s] damping of a loaded gear over its stiffness (chosen)
GEAR_STEPS = 2.0
"""Steps per radian of the fastest gear oscillation"""
_STOP_MARGIN = np.radians(3.0)  # [rad] mechanical stops lie beyond the joint limits (chosen)
_STOP_STIFFNESS = 60.0  # [N m/rad] of a myCobot 280, as the viscous torques (chosen)
_STOP_DAMPING = 0.5  # [N m s/rad] chosen
AMBIENT = 25.0
"""[deg C] (chosen)"""
_HEAT_RISE = 60.0  # [deg C] final rise of a servo held at its torque limit (chosen: trips near 80 deg C)
_HEAT_TIME = 400.0  # [s] thermal time constant (chosen)


def record_of(*, real: str, whole: str = "", flag: str = "") -> np.dtype[np.void]:
    """Record type with fields by kind."""
    kinds = ((real, "f8"), (whole, "i8"), (flag, "?"))
    return np.dtype([(name, kind) for names, kind in kinds for name in names.split()])


JOINT = record_of(
    real="position_gain damping_gain torque_limit coulomb stiction load_friction play link_stiffness "
    "reflected_inertia ripple torque_noise encoder_step lower upper offset no_load_speed grease "
    "stop_stiffness stop_damping ambient",
    flag="play_in_loop",
)
"""Properties of a joint, as `rejoint_lab.plant.wear.Wear`"""

STATE = record_of(
    real="goal reference speed_limit measured measured_speed bristle torque load temperature",
    flag="powered frozen blind",
)
"""State; ``frozen``: reports an old reading, ``blind``: also controls by it"""


def fill_constants(records: NDArray[np.void], max_speed: Array, torque: Array, time: float) -> None:
    """Fill JOINT records (n,) with what profiles lack; ``max_speed`` (n,) [rad/s]; scales ``torque`` (n,), ``time``."""
    records["no_load_speed"] = np.maximum(_NO_LOAD_SPEED, _NO_LOAD_MARGIN * max_speed)
    records["grease"] = np.minimum(_GREASE * (torque * time), _GREASE_TIME * records["link_stiffness"])
    records["stop_stiffness"] = _STOP_STIFFNESS * torque
    records["stop_damping"] = _STOP_DAMPING * (torque * time)


@inner
def within(value, most):
    """``value`` between ``-most`` and ``most``."""
    return min(max(value, -most), most)


@inner
def read_encoder(joint, servo_angle, gear_angle):
    """Angle in whole counts; behind the gear with play, without flex."""
    angle = servo_angle
    if joint.play_in_loop:
        angle += within(gear_angle, 0.5 * joint.play)
    return np.rint(angle / joint.encoder_step) * joint.encoder_step


@inner
def motor_torque(joint, servo, angle, speed):
    """Position loop on the encoder angle; returns the motor torque."""
    servo.measured_speed += _SPEED_FILTER * ((angle - servo.measured) / STEP - servo.measured_speed)
    servo.measured = angle
    if not servo.powered:
        return 0.0  # the windings are open: not even back-EMF
    stride = servo.speed_limit * STEP
    servo.reference += within(servo.goal - servo.reference, stride)
    error = servo.reference + joint.offset - angle
    if abs(error) <= joint.encoder_step:
        error = 0.0
    wanted = joint.position_gain * error - joint.damping_gain * servo.measured_speed
    duty = within(wanted / joint.torque_limit, 1.0)
    return joint.torque_limit * (duty - speed / joint.no_load_speed)


@inner
def friction_torque(joint, servo, speed, load):
    """Friction of motor and gear at ``speed`` under the transmitted torque ``load``."""
    stribeck = np.exp(-((speed / _STRIBECK_SPEED) ** 2))
    most = joint.coulomb + (joint.stiction - joint.coulomb) * stribeck + joint.load_friction * abs(load)
    stiffness = joint.reflected_inertia * _BRISTLE_RATE**2
    damping = 2.0 * _BRISTLE_DAMPING * joint.reflected_inertia * _BRISTLE_RATE
    servo.bristle = within(servo.bristle + speed * STEP, most / stiffness)
    return -within(stiffness * servo.bristle + damping * speed, most)


@inner
def gear_torque(joint, angle, speed):
    """Torque on the link, turned by ``angle`` against the servo output."""
    bent = angle - within(angle, 0.5 * joint.play)
    if bent == 0.0:
        return -joint.grease * speed
    torque = -joint.link_stiffness * (bent + _GEAR_DAMPING_TIME * speed)
    if torque * bent > 0.0:  # teeth push, they do not pull
        torque = 0.0
    return torque - joint.grease * speed


@inner
def disturbance(joint, angle, speed, unit):
    """Gear ripple and stops; ``unit`` in [0, 1) draws the torque noise."""
    torque = joint.ripple * np.sin(_RIPPLE_PERIODS * angle)
    torque += joint.torque_noise * np.sqrt(12.0) * (unit - 0.5)
    beyond = angle - min(max(angle, joint.lower - _STOP_MARGIN), joint.upper + _STOP_MARGIN)
    if beyond != 0.0:
        torque -= joint.stop_stiffness * beyond + joint.stop_damping * speed
    return torque


@inner
def warm_up(joint, servo):
    """Step of a first-order thermal model, heated by copper losses."""
    load = servo.torque / joint.torque_limit
    rise = _HEAT_RISE * load * load
    servo.temperature += STEP / _HEAT_TIME * (joint.ambient + rise - servo.temperature)


@inner
def receive(tick, due, queue, servos):
    """Take arrived commands of one arm, the latest last."""
    while True:
        slot = np.argmin(due)
        if due[slot] > tick:
            return
        due[slot] = NEVER
        for j in range(len(servos)):
            servos[j].goal = queue[slot, j]


@inner
def record(ids, tick, history, joints, servos, qpos):
    """Count a step and store encoder readings (B, HISTORY, n)."""
    for i in ids:
        tick[i] += 1
        for j in range(joints.shape[1]):
            if servos[i, j].frozen or servos[i, j].blind:
                history[i, tick[i] % HISTORY, j] = history[i, (tick[i] - 1) % HISTORY, j]
            else:
                history[i, tick[i] % HISTORY, j] = read_encoder(joints[i, j], qpos[i, 2 * j], qpos[i, 2 * j + 1])


@inner
def trapezoid(reference, rate, goal, speed, acceleration):
    """Return reference and rate a tick later, on a trapezoid of speed to ``goal``; in one unit, per s and s^2."""
    left = goal - reference
    gain = acceleration * STEP
    braking = gain * (np.sqrt(0.25 + 2.0 * abs(left) / (gain * STEP)) - 0.5)  # from it the goal is reached in steps
    wanted = min(speed, braking)
    wanted = wanted if left >= 0.0 else -wanted
    rate += within(wanted - rate, gain)
    stride = rate * STEP
    if abs(left) <= max(abs(stride), 0.5) and abs(rate) <= 2.0 * gain:
        return goal, 0.0
    return reference + stride, rate


class ServoTable:
    """A CSV file of servos: rows of registers, and without an address of other properties [SI].

    ``setting`` names the field of a simulated servo that holds the value times ``factor``.
    """

    def __init__(self, file: str) -> None:
        with (files(__package__) / file).open(encoding="utf-8") as stream:
            self.rows = tuple(csv.DictReader(stream))
        columns = tuple(self.rows[0])
        models = columns[columns.index("sign") + 1 :]
        self.new = {model: {row["name"]: float(row[model]) for row in self.rows if row[model]} for model in models}
        """values as sold by model and name"""
        self.settings = {
            row["setting"]: (row["name"], float(row["factor"] or 1)) for row in self.rows if row["setting"]
        }
        """name and factor by field"""

    def as_sold(self, model: str, kind: np.dtype[np.void]) -> NDArray[np.void]:
        """Return settings () of a ``kind`` as sold, powered, torque on."""
        setting = np.zeros((), kind)
        for field, (name, factor) in self.settings.items():
            setting[field] = self.new[model][name] * factor
        setting["torque_on"] = 1
        return setting


Interval = tuple[float, float]


class Channel(NamedTuple):
    """Uniform delays; defaults: an idle wire."""

    latency: Interval = (0.008, 0.013)
    """[s] from a command to its arrival"""
    age: Interval = (0.006, 0.013)
    """[s] of a reading at its arrival"""
    period: Interval = (0.020, 0.030)
    """[s] of a cycle"""

    def draw(self, keys: Keys, cycle: NDArray[np.int64]) -> Array:
        """Return the three (3, B) [s] in ``cycle`` (B,), by stream keys (B,)."""
        draws = len(self)
        unit = uniform(keys[:, None], cycle[:, None] * draws + np.arange(draws))
        low, high = np.array(self).T
        return (low + unit * (high - low)).T
