"""The plant with STS3215 servos: bodies, gears, friction of `rejoint.robots.lab.plant.plant`, the law of the firmware.

What a wear profile calls ``position_gain`` was measured on an arm with some P; the stall torque that makes the law
give that gain at that P is this joint's. Its ``damping_gain`` and the back-EMF of its motor are the viscous friction
that was measured; what this motor's own back-EMF leaves of it is friction of the joint. Its ``offset`` is no part of
the law, which knows counts alone: it is taken for a constant torque, of cables or masses, that turns the joint by as
much at that gain.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN202
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit

from rejoint.arms import Arm, Array
from rejoint.robots.lab.plant import servo, sts3215
from rejoint.robots.lab.plant.plant import Ids, Mask, Plant
from rejoint.robots.lab.plant.streams import uniform
from rejoint.robots.lab.plant.wear import Wear

RECORDED_P = 32
"""P of the servos of the SO-101 whose logs the profile ``so101`` was measured on: its gains fit this value at the stall
torque that bench measurements give (4.4 to 6 N m, kscalelabs/sysid), and its viscous friction, within a tenth in four
of five joints, the sum of that motor's back-EMF and the D of a servo as sold"""


class StsPlant(Plant):
    """B arms with STS3215 servos, whose ``settings`` (B, n) of `sts3215.SETTING` may be changed at any time."""

    def __init__(self, arm: Arm, wears: Sequence[Wear], *, seed: int, **options: Any) -> None:  # noqa: ANN401
        shape = (len(wears), arm.joints)
        self.settings = np.zeros(shape, sts3215.SETTING)
        for name, value in sts3215.DEFAULTS.items():
            self.settings[name] = value
        gain = np.array([wear.position_gain for wear in wears])
        self.settings["stall"] = gain / (sts3215.GAIN_PER_P * RECORDED_P)
        self.settings["bias"] = gain * np.array([wear.offset for wear in wears])
        if np.isfinite(arm.servo_acceleration):
            self.settings["acceleration"] = arm.servo_acceleration / arm.encoder_step
        no_load = servo.no_load_speed(arm.max_speed)
        measured = np.array([wear.damping_gain + wear.torque_limit / no_load for wear in wears])
        self.settings["viscous"] = np.maximum(measured - self.settings["stall"] / no_load, 0.0)
        self.status = np.zeros(shape, sts3215.STATUS)
        """(B, n) how the servos stand, as `sts3215.STATUS`"""
        self._errors = np.zeros((*shape, sts3215.WINDOW), np.int64)
        self._positions = np.zeros((*shape, sts3215.WINDOW), np.int64)
        super().__init__(arm, wears, seed=seed, **options)

    @property
    def load(self) -> Array:
        """(B, n) what the servos tell of their torque: their output, as a share of PWM."""
        return np.asarray(self.status["output"] / sts3215.PWM_FULL)

    @property
    def torque_limit(self) -> Array:
        """(B, n) [N m] of the motors at standstill."""
        return self.settings["stall"].copy()

    def counts(self, position: Array) -> Ids:
        """Whole counts (B, n) of joint positions [rad]."""
        return np.rint(position / self.arm.encoder_step).astype(np.int64)

    def set_speed_limit(self, speed: Array | float) -> None:
        """Limit the speed of the reference: (B,), (B, n) or a number, [rad/s], above 0."""
        super().set_speed_limit(speed)
        self.settings["speed"] = self.servos["speed_limit"] / self.arm.encoder_step

    def halt(self, where: Mask | None = None) -> None:
        """Freeze the reference where its ramp is now and drop commands on their way."""
        self._hold(self._selected(where), self.status["reference"] * self.arm.encoder_step)

    def _held(self, position: Array, torque: Array) -> Array:
        """Command (B, n) [rad] at which the servos give ``torque`` (B, n) [N m] where they read ``position``."""
        output = sts3215.PWM_FULL * (torque - self.settings["bias"]) / self.settings["stall"]
        size = np.maximum(np.abs(output) - self.settings["startup"], 0.0) * 4 / np.maximum(self.settings["p"], 1)
        lead = np.where(np.abs(output) > 0.5, size + self.settings["dead_cw"], 0.0) * np.sign(output)
        return np.asarray(position + np.rint(lead) * self.arm.encoder_step)

    def _hold(self, ids: Ids, position: Array) -> None:
        """Take ``position`` (B, n) [rad] for goal and reference of the arms ``ids``; the joints are where they are."""
        super()._hold(ids, position)
        goal, here = self.counts(position), self.counts(self.servos["measured"])
        status = self.status
        for name, value in (("goal", goal), ("reference", goal), ("filtered", here), ("position", here)):
            status[name][ids] = value[ids]
        for name in ("rate", "speed", "sum", "alarms", "blocked", "over_current", "hot"):
            status[name][ids] = 0
        raw = goal - here
        error = np.sign(raw) * np.maximum(np.abs(raw) - self.settings["dead_cw"], 0)
        self._errors[ids], self._positions[ids] = error[ids][..., None], here[ids][..., None]

    def _run(self, ids: Ids, steps: int) -> None:
        stepped = None if len(ids) == self.count else ids
        for _ in range(steps):
            _drive(
                ids, self._tick, self._key, self.joints, self.servos, self.settings, self.status, self._errors,
                self._positions, self._due, self._queue, self.qpos, self.qvel, self._applied,
            )  # fmt: skip
            self.batch.step(stepped)
            servo.record(ids, self._tick, self.joints, self.servos, self.qpos, self._history)


@njit(cache=True)
def _drive(
    ids, tick, key, joints, servos, settings, status, errors, positions, due, queue, qpos, qvel, applied
):  # fmt: skip
    """Write the torques of the coming step, as `servo.drive` does."""
    n = joints.shape[1]
    for i in ids:
        if due[i].min() <= tick[i]:
            servo.receive(tick[i], due[i], queue[i], servos[i])
            for j in range(n):
                status[i, j].goal = int(np.rint(servos[i, j].goal / joints[i, j].encoder_step))
        for j in range(n):
            joint, state = joints[i, j], servos[i, j]
            angle, speed = qpos[i, 2 * j], qvel[i, 2 * j]
            gear_angle, gear_speed = qpos[i, 2 * j + 1], qvel[i, 2 * j + 1]
            if not state.blind:
                state.measured = servo.read_encoder(joint, angle, gear_angle)
            state.torque = sts3215.tick_servo(
                settings[i, j], status[i, j], errors[i, j], positions[i, j], tick[i],
                int(np.rint(state.measured / joint.encoder_step)), state.powered, speed, joint.no_load_speed,
                state.temperature,
            )  # fmt: skip
            state.load = status[i, j].output / sts3215.PWM_FULL
            load = servo.gear_torque(joint, gear_angle, gear_speed)
            unit = uniform(key[i], tick[i] * n + j) if state.powered else 0.5
            applied[i, 2 * j] = (
                state.torque + settings[i, j].bias - settings[i, j].viscous * speed
                + servo.friction_torque(joint, state, speed, load) + servo.disturbance(joint, angle, speed, unit)
            )  # fmt: skip
            applied[i, 2 * j + 1] = load
            servo.warm_up(joint, state)
