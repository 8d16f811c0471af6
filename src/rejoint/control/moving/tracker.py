"""The tracker: postures on a path, commands by the twin's inverse ahead of time, and an observer of disturbances.

The posture nearest to the arm's home depends on the place alone. Deviation x of a joint:
``M x'' + D x' + k x = k (u + d)``; u was sent beyond the inverse, ``delay`` ago. A stationary Kalman filter estimates
x, x' and the disturbance d. The command subtracts d, and adds stiffness and damping.
"""

from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_are

from rejoint.arms import (
    Arm,
    Array,
    Mask,
    dls,
    gravity_torque,
    link_inertia,
    position_kinematics,
    tcp_position,
)
from rejoint.arms.kinematics import levers, task
from rejoint.arms.postures import body_of, find_postures
from rejoint.arms.rotations import Orientation
from rejoint.control.controllers.classical import NOMINAL_PERIOD, Pace, limit_position
from rejoint.control.reference import TURNING
from rejoint.control.robot import ControlInput, Servos

SPARED = 20.0
"""of the lightest joints over the heaviest (measured)"""
_LIGHT = 0.2  # share of the largest gravity torque below which a joint is light (chosen: the wrist)
_KEEP = 3  # joints that always count as heavy: those of a place in space
_ROUNDS, _FIRST = 4, 40  # steps of the search from a posture nearby, and from rest
_STEP = 0.3  # [rad] largest change of a joint in one of them
_SOFT = 1e-8  # [m^2] keeps singular postures finite


@lru_cache
def joint_weights(arm: Arm) -> Array:
    """Weights (n,) from 1 to `SPARED`."""
    postures = arm.drawn(2048)
    load = np.abs(gravity_torque(arm, postures)).max(axis=0)
    weights = np.where(load < _LIGHT * load.max(), SPARED, 1.0)
    lever = levers(arm, postures).max(axis=0)
    weights[np.argsort(-lever, kind="stable")[:_KEEP]] = 1.0
    return weights


class PathPostures:
    """Postures of B arms."""

    def __init__(self, arm: Arm, place: Array, turn: Orientation | None = None, home: Array | None = None) -> None:
        """Begin at ``place`` (B, 3) [m], turned as in ``turn`` (B,), near ``home`` (n,) or (B, n) [rad]."""
        self._arm = arm
        self._home = arm.rest if home is None else home
        start = np.broadcast_to(self._home, (len(place), arm.joints))
        start = start if turn is None else find_postures(arm, place, start, turn)
        self.last = self._search(place, start, _FIRST, turn)
        """(B, n) [rad]"""

    def at(self, places: Array, turns: Orientation | None = None) -> Array:
        """Postures (k, B, n) [rad] of ``places`` (k, B, 3) [m] and ``turns`` (k, B); stores the middle one."""
        found = self._search(places, np.broadcast_to(self.last, (len(places), *self.last.shape)), _ROUNDS, turns)
        self.last = found[len(found) // 2]
        return found

    def along(self, places: Array, turns: Orientation | None = None) -> Array:
        """Postures (T, B, n) [rad] along ``places`` (T, B, 3) [m]."""
        return np.concatenate([self.at(place[None], turns and turns[k, None]) for k, place in enumerate(places)])

    def _search(self, place: Array, q: Array, rounds: int, turn: Orientation | None) -> Array:
        arm, weights = self._arm, joint_weights(self._arm)
        for _ in range(rounds):
            missed, jacobian = task(arm, q, place, turn)
            home = self._home - q
            way = missed - (jacobian @ home[..., None])[..., 0]
            spread = jacobian.mT / weights[:, None]  # mostly over heavy joints
            ridge = _SOFT * np.eye(way.shape[-1])
            step = home + (spread @ np.linalg.solve(jacobian @ spread + ridge, way[..., None]))[..., 0]
            largest = np.abs(step).max(axis=-1, keepdims=True)
            q = np.clip(q + step * np.minimum(1.0, _STEP / np.maximum(largest, _STEP)), *body_of(arm).inner)
        return q


STEP = 0.03
"""[s] between places for speed and acceleration (chosen)"""


def command_for(arm: Arm, servos: Servos, around: Array) -> Array:
    """Commands (B, n) [rad] by the twin's inverse, joint by joint; ``around`` (3, B, n) [rad], `STEP` apart."""
    posture, speed = around[1], (around[2] - around[0]) / (2.0 * STEP)
    acceleration = (around[2] - 2.0 * posture + around[0]) / STEP**2
    torque = gravity_torque(arm, posture) + servos.coulomb * np.tanh(speed / TURNING) + servos.damping * speed
    torque = torque + (servos.armature + link_inertia(arm, posture)) * acceleration
    return posture - servos.offset + torque / servos.stiffness


_PARTS = 5  # steps in which a control period, or a delay, is passed (chosen: 5 ms each)
_KEPT = 12  # commands that are remembered (chosen: more than arrive late at the shortest period)
_LEAST_INERTIA = 2e-3  # [kg m^2] believed of a joint (chosen: the least of the twins)


DRIFT, SHOCKS = 1e-3, 1.0
"""[rad^2/s] and [rad^2/s^3] noise of disturbance and speed (chosen)"""


class PushObserver:
    """Deviations of B arms from the wanted motion."""

    def __init__(self, arm: Arm, servos: Servos, period: float = NOMINAL_PERIOD) -> None:
        """``period`` [s] of control."""
        self._servos = servos
        self.mass = np.maximum(servos.armature + link_inertia(arm, arm.rest), _LEAST_INERTIA)
        """(B, n) [kg m^2]"""
        noise, step, mass = max(arm.encoder_step**2 / 12.0, 1e-8), period / _PARTS, self.mass
        brake, pull = 1.0 / (1.0 + step * servos.damping / mass), step * servos.stiffness / mass
        one = np.zeros((*mass.shape, 3, 3)) + np.eye(3)
        one[..., 1, 0], one[..., 1, 1], one[..., 1, 2] = -brake * pull, brake, brake * pull
        one[..., 0, :] = step * one[..., 1, :]
        one[..., 0, 0] += 1.0
        cycle = np.linalg.matrix_power(one, _PARTS)
        unknown, seen = np.diag([1e-9, SHOCKS * period, DRIFT * period]), np.eye(3, 1)
        self._gain = np.zeros((*mass.shape, 3))  # stationary
        for index in np.ndindex(mass.shape):
            covariance = solve_discrete_are(cycle[index].T, seen, unknown, [[noise]])
            self._gain[index] = covariance[:, 0] / (covariance[0, 0] + noise)
        self.away, self.speed, self.push = np.zeros((3, *servos.stiffness.shape))
        """(B, n): deviation [rad], its speed [rad/s], disturbance [rad]"""
        self._sent: list[tuple[Array, Array]] = []

    def sent(self, time: Array, beyond: Array) -> None:
        """Take what was sent at ``time`` (B,) [s] ``beyond`` (B, n) [rad] the inverse."""
        self._sent = [*self._sent[1 - _KEPT :], (time, beyond)]

    def see(self, time: Array, elapsed: Array, away: Array) -> None:
        """Take deviations ``away`` (B, n) [rad] at ``time`` (B,) [s], ``elapsed`` (B,) [s] after the last."""
        fresh = (elapsed > 0.0)[:, None]
        place, speed = self.after(time - elapsed, elapsed)
        missed = np.where(fresh, away - place, 0.0)
        self.away, self.speed = place + self._gain[..., 0] * missed, speed + self._gain[..., 1] * missed
        self.push = self.push + self._gain[..., 2] * missed

    def after(self, start: Array, span: Array) -> tuple[Array, Array]:
        """Deviation and speed (B, n), a ``span`` (B,) [s] after ``start`` (B,) [s]."""
        servos, step = self._servos, (span / _PARTS)[:, None]
        pull = step * servos.stiffness / self.mass
        brake = 1.0 / (1.0 + step * servos.damping / self.mass)
        away, speed = self.away, self.speed
        for k in range(_PARTS):
            beyond, time = np.zeros_like(self.push), start + (k + 0.5) * step[:, 0] - servos.delay
            for sent, one in self._sent:  # the last one before this time
                beyond = np.where((sent <= time)[:, None], one, beyond)
            speed = brake * (speed + pull * (beyond + self.push - away))
            away = away + step * speed
        return away, speed


_LEAST_DELAY = 0.02
"""[s] for the gains: fits mistake delay for damping"""
_RELIEF_DAMPING = 0.01  # [m] keeps what heavy joints take over finite (chosen: a fifth of the usual)
_SLOWER = 1.2  # times the usual period up to which a wire is as quick as ever (chosen: its jitter)
_SMOOTHING = 0.1  # share of the newest period in their mean (chosen)


# Chosen on the worn arms 30001 to 30004:
STIFFNESS = 1.25
"""added, over the servo's"""
ADDED_DAMPING = 0.065
"""[s] added, over the servo's stiffness"""
EARLY = 0.0075
"""[s] beyond delay and half a period: the servo's filter"""
PACE = 1.1
"""largest product of the delay and a joint's frequency [rad/s], or added damping over mass [1/s] (measured)"""
RELIEF = 0.15
"""[s] in which heavy joints take over from light ones"""
PUSH_LIMIT = np.radians(30.0)
"""[rad] largest correction of a disturbance"""
HELD_LIMIT = np.radians(2.0)
"""[rad] most that added stiffness and damping command: it ends large swings (measured on worn SO-101s)"""


class Tracker:
    """Follows moving targets with B arms."""

    name = "tracker"

    def __init__(self, arm: Arm, servos: Servos, period: float = NOMINAL_PERIOD) -> None:
        self._arm, self._servos, self._usual = arm, servos, period
        self._observer, self._pace = PushObserver(arm, servos, period), Pace()
        self._shift = np.zeros_like(servos.stiffness)  # (B, n) [rad] of heavy joints, for light ones
        self._last: Array | None = None  # (B,) [s] when the last command went out
        self._period = np.full(len(servos.delay), period)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Begin here; resets after the first command change nothing: a gap in the answers forgets nothing."""
        if self._last is None:
            self._pace.begin(inputs.state.time, where)
            self._wanted = self._expected = inputs.sent

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        observer, now = self._observer, inputs.state.time
        if self._last is not None:
            joint, useful = self._expected - self._servos.offset, self._servos.torque_limit / self._servos.stiffness
            effective = np.clip(inputs.sent, joint - useful, joint + useful)  # no windup
            observer.sent(self._last, effective - self._wanted)
        elapsed = self._pace.tick(now)
        self._period += _SMOOTHING * (elapsed > 0.0) * (elapsed - self._period)
        position, planned = inputs.state.position, inputs.goal
        shift = self._relieve(position, planned, elapsed)
        observer.see(now, elapsed, position - planned - shift)
        away, speed = observer.after(now, self._servos.delay)  # when this command takes effect
        ahead = self._servos.delay + 0.5 * self._period + EARLY
        around = inputs.goals(ahead + STEP * np.arange(-1.0, 2.0)[:, None]) + shift
        self._wanted, self._last = command_for(self._arm, self._servos, around), now
        self._expected = around[1] + away
        push = np.clip(observer.push, -PUSH_LIMIT, PUSH_LIMIT)
        stiff, most = self._stable(observer.mass)
        held = np.clip(stiff * (STIFFNESS * away + np.minimum(ADDED_DAMPING, most) * speed), -HELD_LIMIT, HELD_LIMIT)
        return limit_position(self._arm, self._wanted - push - held)

    def _stable(self, mass: Array) -> tuple[Array, Array]:
        """Stable share of the gains, and damping [s], of joints with ``mass`` (B, n) [kg m^2]; both (B, n)."""
        slower = np.maximum(self._period - _SLOWER * self._usual, 0.0)
        late = (np.maximum(self._servos.delay, _LEAST_DELAY) + 0.5 * self._usual + EARLY + slower)[:, None]
        square = mass / self._servos.stiffness  # [s^2]
        return np.clip(((PACE / late) ** 2 * square - 1.0) / STIFFNESS, 0.0, 1.0), PACE / late * square

    def _relieve(self, position: Array, planned: Array, elapsed: Array) -> Array:
        """Extra motion (B, n) [rad] of heavy joints that brings the tool to its place wherever the light ones are."""
        light = joint_weights(self._arm) > 1.0
        there, jacobian = position_kinematics(self._arm, np.where(light, position, planned + self._shift))
        step = dls(jacobian * ~light, tcp_position(self._arm, planned) - there, _RELIEF_DAMPING)
        self._shift = self._shift + (1.0 - np.exp(-elapsed / RELIEF))[:, None] * step
        return self._shift
