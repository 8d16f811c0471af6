"""A batch of simulated worn arms.

The MuJoCo model has two hinges per axis: servo output, and play and flex behind it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask, gravity_torque, tcp_pose
from rejoint.arms.compiled import inner
from rejoint.arms.inertia import heavier, inertia_values
from rejoint.arms.kinematics import GRAVITY
from rejoint.system.errors import InputError
from rejoint.system.shell import free_cores
from rejoint_lab.plant import servo, sts3215, xseries
from rejoint_lab.plant.servo import STEP, stream_keys
from rejoint_lab.plant.wear import PARAMETERS, Wear, scale_of

_DISABLED = "CONSTRAINT CONTACT ACTUATION SENSOR SPRING DAMPER WARMSTART AUTORESET"
# [kg m^2] placeholders that keep the inertia matrix regular while MuJoCo compiles the chain.
_ARMATURE = {"servo": 0.01, "gear": 0.001}
_CONTENT = ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_pos", "body_quat")


def build_model(arm: Arm, gravity: Array = GRAVITY) -> mujoco.MjModel:
    """Compile ``arm`` with 2n hinges under ``gravity`` (3,), without armatures."""
    spec = mujoco.MjSpec()
    spec.option.gravity = gravity
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for name in _DISABLED.split():
        spec.option.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
    body = spec.worldbody
    for i, name in enumerate(arm.joint_names):
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, arm.offset[i, :3, :3].flatten())
        body = body.add_body(
            name=name,
            pos=arm.offset[i, :3, 3],
            quat=quaternion,
            mass=arm.mass[i],
            ipos=arm.com[i],
            fullinertia=inertia_values(arm.inertia[i]),
            explicitinertial=True,
        )
        for part, armature in _ARMATURE.items():
            body.add_joint(name=f"{name}/{part}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=arm.axis[i], armature=armature)
    return spec.compile()


Ids = NDArray[np.int64]

# [N m] gravity torque below which a link rests in the middle of its play instead of at a flank.
_NO_LOAD = 1e-6

ARMS_PER_THREAD = 24
"""(measured by processor time)"""


class _State:
    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, plant: Plant, _: object = None) -> Array:
        return np.array(plant.servos[self._name])


class Plant:
    """B simulated arms in steps of a millisecond.

    Arm i moves bit for bit as alone, by the stream ``first + i`` of ``seed``.
    """

    def __init__(
        self,
        arm: Arm,
        wears: Sequence[Wear],
        *,
        seed: int,
        first: int = 0,
        payload: Array | float = 0.0,
        bodies: Sequence[Arm] | None = None,
        gravity: Array = GRAVITY,
    ) -> None:
        """Put the arms at rest.

        In truth with a ``payload`` (B,) [kg] at the TCP, ``bodies`` (B,), ``gravity`` (3,) [m/s^2] in the base frame.
        """
        self.arm, self.count = arm, len(wears)
        self._pull, loads = np.asarray(gravity, dtype=float), np.broadcast_to(payload, self.count)
        self._carried = dict(enumerate(bodies or ()))  # arms that differ
        for i in np.flatnonzero(loads > 0.0).tolist():
            true = self._carried.get(i, arm)
            self._carried[i] = replace(true, **heavier(true, float(loads[i]), true.tip[:3, 3]))
        self.joints = np.array([joint_records(arm, wear) for wear in wears])
        """(B, n) as `servo.JOINT`"""
        self.servos = np.zeros((self.count, arm.joints), servo.STATE)
        """(B, n) as `servo.STATE`"""
        self._tick = np.zeros(self.count, np.int64)
        self._key = stream_keys(seed, self.count, first=first)
        self._due = np.full((self.count, servo.QUEUE), servo.NEVER)
        self._queue = np.zeros((self.count, servo.QUEUE, arm.joints))
        self._sts: tuple[NDArray[Any], ...] | None = None
        self._x: tuple[NDArray[Any], ...] | None = None
        self._history = np.zeros((self.count, servo.HISTORY, arm.joints))
        threads = max(1, min(free_cores(), self.count // ARMS_PER_THREAD))  # no effect on results
        self.batch = Batch(build_model(arm, self._pull), self.count, threads)
        armature = self.batch.expand("dof_armature")
        armature[:, 0::2] = self.joints["reflected_inertia"]
        armature[:, 1::2] = self.joints["link_stiffness"] * (servo.GEAR_STEPS * STEP) ** 2
        if self._carried:
            fields = {name: self.batch.expand(name) for name in _CONTENT}
            for i, true in self._carried.items():
                body = build_model(true, self._pull)
                for name, values in fields.items():
                    values[i] = getattr(body, name)
            self.batch.set_const(np.array(list(self._carried), dtype=np.int32))  # the masses of whole branches
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        """(B, 2 n) [rad] and [rad/s]: servo output and gear in turn"""
        self._applied = self.batch.bind("qfrc_applied")
        self._bodies = self.qpos, self.qvel, self._applied
        self.servos["speed_limit"] = servo.RAMP_SHARE * arm.max_speed
        self.servos["temperature"] = self.joints["ambient"]
        self._equip()
        self.reset(np.tile(arm.rest, (self.count, 1)))

    def _equip(self) -> None:
        """Add servos with a firmware of their own."""

    @property
    def time(self) -> Array:
        """(B,) [s]."""
        return np.asarray(self._tick * servo.STEP)

    @property
    def speed(self) -> Array:
        """(B, n) [rad/s] of the servo outputs."""
        return self.qvel[:, 0::2].copy()

    torque = _State("torque")
    """(B, n) [N m] of the motors"""
    load = _State("load")
    """(B, n) reported torque share, smoothed over 10 ms"""
    temperature = _State("temperature")
    """(B, n) [deg C]"""
    goal = _State("goal")
    """(B, n) [rad] command in the firmware"""

    def link_position(self) -> Array:
        """(B, n) [rad] true links, behind play and flex."""
        return self.qpos[:, 0::2] + self.qpos[:, 1::2]

    def true_tcp(self) -> Array:
        """(B, 3) [m] true tools."""
        return self.true_pose()[:, :3, 3]

    def true_pose(self) -> Array:
        """(B, 4, 4) true tools."""
        links = self.link_position()
        pose = tcp_pose(self.arm, links)
        for i, arm in self._carried.items():
            pose[i] = tcp_pose(arm, links[i])
        return pose

    def encoder(self, age: Array | float = 0.0) -> Array:
        """(B, n) [rad] encoder reading ``age`` (B,) [s] ago."""
        tick = self._tick - np.rint(age / servo.STEP).astype(np.int64)
        return self._history[np.arange(self.count), tick % servo.HISTORY]

    def reset(self, position: Array) -> None:
        """Put the arms at rest at encoder ``position`` (B, n) [rad]."""
        position = self._checked(position)
        self.qpos[:, 0::2], self.qpos[:, 1::2], load = self._balance(position)
        self.qvel[:] = self._applied[:] = 0.0
        limit, step = self.joints["torque_limit"], self.arm.encoder_step
        torque = np.clip(load, -limit, limit)
        fresh = {
            "measured": np.rint(position / step) * step,
            "measured_speed": 0.0,
            "bristle": 0.0,
            "torque": torque,
            "load": torque / limit,
            "powered": True,
            "frozen": False,
            "blind": False,
        }
        for name, value in fresh.items():
            self.servos[name] = value
        self._history[:] = self.servos["measured"][:, None]
        self._hold(position + self._lead(torque))

    def command(self, position: Array, delay: Array | float = 0.0, where: Mask | None = None) -> None:
        """Send ``position`` (B, n) [rad]; it arrives after ``delay`` (B,) [s]."""
        position = self._checked(position)
        due = self._tick + np.ceil(delay / servo.STEP - 1e-9).astype(np.int64)
        for i in range(self.count) if where is None else np.flatnonzero(where):
            slot = self._due[i].argmax()
            if self._due[i, slot] != servo.NEVER:
                raise InputError(f"arm {i}: more than {servo.QUEUE} commands on their way")
            self._due[i, slot], self._queue[i, slot] = due[i], position[i]

    def advance(self, duration: Array | float, where: Mask | None = None) -> None:
        """Advance by ``duration`` (B,) [s], in whole milliseconds."""
        steps = np.rint(np.broadcast_to(duration, self.count) / servo.STEP).astype(np.int64)
        if where is not None:
            steps[~where] = 0
        done = 0
        for until in sorted({*steps[steps > 0].tolist()}):  # arms with longer durations go on without the others
            self._run(np.flatnonzero(steps >= until), until - done)
            done = until

    def set_power(self, on: bool) -> None:
        """Switch the servos. Off: only friction. On: hold."""
        if on and not self.servos["powered"].all():
            self._hold(self.encoder())
        self.servos["powered"] = on

    def halt(self) -> None:
        """Stop the reference and drop pending commands."""
        self._hold(self.servos["reference"])

    def freeze(self, joints: Mask) -> None:
        """Freeze the reported encoders of ``joints`` (B, n)."""
        self.servos["frozen"] |= joints

    def blind(self, joints: Mask) -> None:
        """Freeze also what the servos of ``joints`` (B, n) see: they run away."""
        self.servos["blind"] |= joints

    def set_speed_limit(self, speed: Array | float) -> None:
        """Limit the reference's speed [rad/s], above 0: (B, n) or a number."""
        self.servos["speed_limit"] = speed

    def _hold(self, position: Array) -> None:
        self._due[:] = servo.NEVER
        self.servos["goal"] = self.servos["reference"] = position

    def _lead(self, torque: Array) -> Array:
        """Command minus position (B, n) [rad] that gives ``torque`` (B, n) [N m]."""
        return torque / self.joints["position_gain"] - self.joints["offset"]

    def _run(self, ids: Ids, steps: int) -> None:
        stepped = None if len(ids) == self.count else ids
        clock, arms, commands = (self._tick, self._history), (self.joints, self.servos), (self._due, self._queue)
        for k in range(steps):
            _drive(ids, (k > 0, *clock), self._key, arms, commands, self._bodies, self._sts, self._x)
            self.batch.step(stepped)
        servo.record(ids, *clock, *arms, self.qpos)

    def _balance(self, position: Array) -> tuple[Array, Array, Array]:
        """Servo angles, gear angles and motor torques (B, n) at rest."""
        joints, seen = self.joints, np.zeros_like(position)
        load = self._gravity(position)
        for _ in range(5):  # the gear turns the links by a degree or two, which hardly changes the load
            flank = np.where(np.abs(load) > _NO_LOAD, -0.5 * joints["play"] * np.sign(load), 0.0)
            gear = flank - load / joints["link_stiffness"]
            seen = np.where(joints["play_in_loop"], flank, 0.0)
            load = self._gravity(position - seen + gear)
        return position - seen, gear, load

    def _gravity(self, position: Array) -> Array:
        load = gravity_torque(self.arm, position, self._pull)
        for i, arm in self._carried.items():
            load[i] = gravity_torque(arm, position[i], self._pull)
        return load

    def _checked(self, position: Array) -> Array:
        position = np.asarray(position, dtype=float)
        if position.shape != (self.count, self.arm.joints) or not np.isfinite(position).all():
            raise InputError(f"expected finite joint positions of shape {(self.count, self.arm.joints)} [rad]")
        return position


def joint_records(arm: Arm, wear: Wear) -> NDArray[np.void]:
    """`servo.JOINT` (n,) of an arm of some wear."""
    records = np.zeros(arm.joints, servo.JOINT)
    for name in (*PARAMETERS, "offset", "play_in_loop", "ambient"):
        records[name] = getattr(wear, name)
    records["encoder_step"], records["lower"], records["upper"] = arm.encoder_step, arm.lower, arm.upper
    scale = scale_of(arm)
    servo.fill_constants(records, arm.max_speed, scale.torque, scale.time)
    return records


RECORDED_P = 32
"""P of the profile ``so101`` (kscalelabs/sysid: 4.4 to 6 N m stall)"""


class ServoPlant(Plant, ABC):
    """Arms whose servos have a firmware, with ``settings`` and ``status`` (B, n, ...)."""

    settings: NDArray[np.void]
    status: NDArray[np.void]

    def halt(self) -> None:
        """Stop the reference and drop pending commands."""
        reference = self.status["reference"].reshape(self.count, self.arm.joints, -1)[..., 0]
        self._hold(reference * self.arm.encoder_step)

    def _hold(self, position: Array) -> None:
        """Set goal and reference to ``position`` (B, n) [rad]."""
        super()._hold(position)
        goal, here = (
            np.rint(angle / self.arm.encoder_step).astype(np.int64) for angle in (position, self.servos["measured"])
        )
        self.status[:] = 0
        known = {"goal": goal, "reference": goal, "position": here}
        for name, value in (known | self._begin(goal, here)).items():
            self.status[name].T[:] = value.T

    @abstractmethod
    def _begin(self, goal: Ids, here: Ids) -> dict[str, Ids]:
        """Return more of the status of servos that hold ``goal`` from ``here`` (B, n) [counts]."""


class StsPlant(ServoPlant):
    """B arms with STS3215 servos and adjustable `sts3215.SETTING`.

    A profile's ``position_gain`` gives the stall torque at `RECORDED_P`, its ``offset`` a constant torque.
    """

    def _equip(self) -> None:
        arm, no_load = self.arm, self.joints["no_load_speed"]
        shape = self.count, arm.joints
        self.settings = np.full(shape, sts3215.TABLE.as_sold("STS3215", sts3215.SETTING))
        stall = self.joints["position_gain"] / (sts3215.GAIN_PER_P * RECORDED_P)
        self.settings["stall"], self.settings["bias"] = stall, self.joints["position_gain"] * self.joints["offset"]
        if np.isfinite(arm.servo_acceleration):
            self.settings["acceleration"] = arm.servo_acceleration / arm.encoder_step
        measured = self.joints["damping_gain"] + self.joints["torque_limit"] / no_load
        self.settings["viscous"] = np.maximum(measured - stall / no_load, 0.0)
        self.status = np.zeros(shape, sts3215.STATUS)
        """(B, n) `sts3215.STATUS`"""
        self._rings = np.zeros((*shape, 2, sts3215.WINDOW), np.int64)
        self._sts = self.settings[..., None], self.status[..., None], self._rings

    def _lead(self, torque: Array) -> Array:
        """Command minus position (B, n) [rad] that gives ``torque`` (B, n) [N m]."""
        setting = self.settings
        output = sts3215.PWM_FULL * (torque - setting["bias"]) / setting["stall"]
        size = np.maximum(np.abs(output) - setting["startup"], 0.0) * 4 / np.maximum(setting["p"], 1)
        lead = np.where(np.abs(output) > 0.5, size + setting["dead_cw"], 0.0) * np.sign(output)
        return np.rint(lead) * self.arm.encoder_step

    def _begin(self, goal: Ids, here: Ids) -> dict[str, Ids]:
        raw = goal - here
        error = np.sign(raw) * np.maximum(np.abs(raw) - self.settings["dead_cw"], 0)
        self._rings[:] = np.stack([error, here], axis=-1)[..., None]
        return {"filtered": here}


class XPlant(ServoPlant):
    """B arms with servos of ROBOTIS' X series, one or two a joint, and adjustable `xseries.SETTING` (B, n, 2).

    A profile's ``torque_limit`` is the stall torque of a joint's servos; their gains are the registers'.
    """

    def _equip(self) -> None:
        arm = self.arm
        shape = self.count, arm.joints, 2
        self.settings, self.status = np.zeros(shape, xseries.SETTING), np.zeros(shape, xseries.STATUS)
        """(B, n, 2)"""
        for j, name in enumerate(arm.servos):
            model, count, gains = xseries.drive_of(name)
            self.settings[:, j, :count] = xseries.as_sold(model)
            for gain, value in gains.items():
                self.settings[gain][:, j, :count] = value
            self.settings["stall"][:, j, :count] = self.joints["torque_limit"][:, j, None] / count
            self.settings["viscous"][:, j] = xseries.NEW[model]["viscous"] * count
        bias = self.joints["position_gain"] * self.joints["offset"]
        self.settings["bias"] = bias[..., None]
        self._x = self.settings, self.status

    def reset(self, position: Array) -> None:
        """Put the arms at rest at encoder ``position`` (B, n) [rad], restarted."""
        self.settings["torque_on"] = 1
        super().reset(position)

    def _lead(self, torque: Array) -> Array:
        """Command minus position (B, n) [rad] that gives ``torque`` (B, n) [N m]."""
        first = self.settings[..., 0]
        share = (torque - first["bias"]) / self.settings["stall"].sum(axis=-1)
        lead = share * xseries.FULL * first["divisor"] / np.maximum(first["p"], 1)
        return np.rint(lead) * self.arm.encoder_step

    def _begin(self, goal: Ids, here: Ids) -> dict[str, Ids]:
        return {"aimed": goal, "error": goal - here}


def plant_of(arm: Arm) -> type[Plant]:
    """Kind of plant that the servos of an ``arm`` need."""
    if set(arm.servos) == {"STS3215"}:
        return StsPlant
    return XPlant if xseries.drives(arm.servos) else Plant


# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN202


@inner
def _aim(joints, servos, status):
    """Give the goals of one arm to its servos (n, S), in counts."""
    for j in range(len(joints)):
        for k in range(status.shape[1]):
            status[j, k].goal = int(np.rint(servos[j].goal / joints[j].encoder_step))


@inner
def _drive(ids, clock, key, arms, commands, bodies, sts, x):
    """Write the next torques of the arms ``ids``.

    ``clock``: whether to record, steps (B,), readings (B, HISTORY, n); ``arms``: JOINT and
    STATE (B, n); ``commands``: due steps (B, QUEUE), goals (B, QUEUE, n); ``bodies``: positions,
    velocities, torques (B, 2n); ``sts``, ``x``: None, or SETTING and STATUS (B, n, S) of joints with S such servos, and
    rings (B, n, ...) of an STS3215.
    """
    (late, tick, history), (joints, servos), (due, queue), (qpos, qvel, applied) = clock, arms, commands, bodies
    if late:
        servo.record(ids, tick, history, joints, servos, qpos)
    n = joints.shape[1]
    for i in ids:
        if due[i].min() <= tick[i]:
            servo.receive(tick[i], due[i], queue[i], servos[i])
            if sts is not None:
                _aim(joints[i], servos[i], sts[1][i])
            if x is not None:
                _aim(joints[i], servos[i], x[1][i])
        for j in range(n):
            joint, state = joints[i, j], servos[i, j]
            angle, speed = qpos[i, 2 * j], qvel[i, 2 * j]
            gear_angle, gear_speed = qpos[i, 2 * j + 1], qvel[i, 2 * j + 1]
            seen = state.measured if state.blind else servo.read_encoder(joint, angle, gear_angle)
            count = int(np.rint(seen / joint.encoder_step))
            if sts is not None:
                state.measured = seen
                setting, status = sts[0][i, j, 0], sts[1][i, j, 0]
                push = sts3215.tick_servo(setting, status, sts[2][i, j], joint, state, tick[i], count, speed)
            elif x is not None:
                state.measured = seen
                push = xseries.tick_servos(x[0][i, j], x[1][i, j], state, count, speed)
            else:
                push = state.torque = servo.motor_torque(joint, state, seen, speed)
                state.load += servo.LOAD_FILTER * (push / joint.torque_limit - state.load)
            load = servo.gear_torque(joint, gear_angle, gear_speed)
            unit = servo.uniform(key[i], tick[i] * n + j) if state.powered else 0.5
            friction = servo.friction_torque(joint, state, speed, load)
            applied[i, 2 * j] = push + friction + servo.disturbance(joint, angle, speed, unit)
            applied[i, 2 * j + 1] = load
            servo.warm_up(joint, state)
