"""STS3215 servos by themselves, each turning a flywheel: a gripper's, or one on a bench."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN202
from __future__ import annotations

import numpy as np
from numba import njit

from rejoint.arms import Array
from rejoint.robots.lab.plant import servo, sts3215

STEP_ANGLE = 2 * np.pi / sts3215.COUNTS
_NO_LOAD_SPEED = 4.71  # [rad/s] 45 rpm
_FRICTION = 0.05  # [N m] of a bare servo (fits of Rhoban/bam: 0.051 and 0.053)
_INERTIA = 0.0261  # [kg m^2] motor and gear, seen from the output (Rhoban/bam)


class BareServos:
    """n servos at rest where they read 0, with a torque each from outside."""

    def __init__(self, count: int, *, lower: float = -np.inf, upper: float = np.inf) -> None:
        """``lower`` and ``upper`` [rad] are mechanical stops."""
        self.settings = np.zeros(count, sts3215.SETTING)
        for name, value in sts3215.DEFAULTS.items():
            self.settings[name] = value
        self.status = np.zeros(count, sts3215.STATUS)
        self.joints, self.servos = np.zeros(count, servo.JOINT), np.zeros(count, servo.STATE)
        known = {
            "coulomb": _FRICTION, "stiction": 1.1 * _FRICTION, "reflected_inertia": _INERTIA, "lower": lower,
            "upper": upper, "no_load_speed": _NO_LOAD_SPEED, "stop_stiffness": 60.0, "stop_damping": 0.5,
        }  # fmt: skip
        for name, value in known.items():
            self.joints[name] = value
        self.joints["ambient"] = servo.AMBIENT
        self.joints["torque_limit"] = self.settings["stall"]
        self.servos["temperature"], self.servos["powered"] = servo.AMBIENT, True
        self.angle, self.speed, self.push = np.zeros(count), np.zeros(count), np.zeros(count)
        """(n,) [rad] and [rad/s] of the shafts, and [N m] that pushes them from outside"""
        self._errors = np.zeros((count, sts3215.WINDOW), np.int64)
        self._positions = np.zeros((count, sts3215.WINDOW), np.int64)
        self._tick = 0

    def put(self, angle: Array) -> None:
        """Turn the shafts to ``angle`` (n,) [rad], at rest, and hold them there."""
        count = np.rint(np.asarray(angle) / STEP_ANGLE).astype(np.int64)
        self.angle[:], self.speed[:] = angle, 0.0
        for name in ("goal", "reference", "filtered", "position"):
            self.status[name] = count
        self._errors[:], self._positions[:] = 0, count[:, None]

    def advance(self, duration: float, *, blocked: bool = False) -> None:
        """Let ``duration`` [s] pass, in whole milliseconds; ``blocked`` shafts stand."""
        steps = round(duration / servo.STEP)
        _turn(
            steps, self._tick, self.settings, self.status, self.joints, self.servos, self._errors, self._positions,
            self.angle, self.speed, self.push, blocked,
        )  # fmt: skip
        self._tick += steps


@njit(cache=True)
def _turn(steps, tick, settings, status, joints, servos, errors, positions, angle, speed, push, blocked):
    for step in range(steps):
        for j in range(len(settings)):
            joint, state = joints[j], servos[j]
            state.torque = sts3215.tick_servo(
                settings[j], status[j], errors[j], positions[j], tick + step, int(np.rint(angle[j] / STEP_ANGLE)),
                state.powered, speed[j], joint.no_load_speed, state.temperature,
            )  # fmt: skip
            servo.warm_up(joint, state)
            if blocked:
                continue
            torque = state.torque + push[j] + servo.disturbance(joint, angle[j], speed[j], 0.5)
            torque += servo.friction_torque(joint, state, speed[j], 0.0)
            speed[j] += servo.STEP * torque / joint.reflected_inertia
            angle[j] += servo.STEP * speed[j]
