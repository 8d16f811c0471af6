"""The motion of a check, always the same for one arm: two to three minutes that show each joint and the tool.

First every other joint goes slowly back and forth, then the rest. Then the tool goes to the five poses of ISO 9283:1998
in the arm's region of targets, P1 in its middle and P2 to P5 on a diagonal plane, ten per cent from its corners, each
five times from below and five times from above in all joints.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.inverse import solve_position
from rejoint.arms.room import HOLD_OFFSET, is_safe, line_is_safe, unsafe
from rejoint.control.comparison.iso import RISING_LEFT, iso_poses
from rejoint.diagnosis.excitation import Excitation
from rejoint.diagnosis.path import CommandPath
from rejoint.system.errors import InputError

POSES = 5
"""ISO 9283:1998: P1 to P5"""
CYCLES = 5
"""Times that each pose is approached from each side (chosen: the check then takes two and a half minutes)"""
SIDES = ("below", "above")

_SWEEP_SPEED = 0.12  # [rad/s] twice the usual Stribeck velocity, as the slow sweeps of a diagnosis
_SWEEP_SHARE = 0.2  # of the slowest joint's speed that sweeps may take (as in a diagnosis)
_SWEEP_CYCLES = 2  # back and forth
_AMPLITUDE = 0.18  # [rad] several times a worn joint's hysteresis, as the sweeps of a diagnosis
_TRAVEL_SPEED, _TRAVEL_SHARE = 0.8, 0.4  # [rad/s], and share of the slowest joint's speed (as in a diagnosis)
_APPROACH_SPEED = 0.3  # [rad/s] so slow that nothing overshoots (as the holds of a diagnosis)
_PAUSE = 0.3  # [s] before a turn (chosen)
_DWELL = 0.8  # [s] in a pose (chosen: a worn joint has come to rest after half of it)
_SMALLER = 0.8 ** np.arange(10)  # shares of amplitude and region that are tried where there is little room


def plan_check(arm: Arm) -> Excitation:
    """Plan the check of an arm that stands in its rest posture.

    Where there is no room, poses move towards the rest posture and joints go less far. InputError where that does not
    suffice.
    """
    postures, offset = _poses(arm)
    amplitude = _amplitude(arm)
    slowest = float(arm.max_speed.min())
    travel = min(_TRAVEL_SPEED, _TRAVEL_SHARE * slowest)
    path = CommandPath(arm.rest)
    path.wait(0.5)
    _sweep(path, arm, amplitude, min(_SWEEP_SPEED, _SWEEP_SHARE * slowest), travel)
    for cycle in range(CYCLES):
        for pose, posture in enumerate(postures):
            for sign, side in zip((-1.0, 1.0), SIDES, strict=True):
                path.travel(posture + sign * offset, travel)
                path.wait(_PAUSE)
                path.travel(posture, min(_APPROACH_SPEED, _SWEEP_SHARE * slowest))
                with path.segment(f"pose/{pose}/{side}/{cycle}", "pose", tuple(range(arm.joints))):
                    path.wait(_DWELL)
    path.travel(arm.rest, travel)
    time, position = path.knots()
    return Excitation(arm=arm, segments=path.segments, time=time, position=position)


def _sweep(path: CommandPath, arm: Arm, amplitude: float, speed: float, travel: float) -> None:
    """Go back and forth with every other joint at once: neighbours disturb each other, the rest hardly."""
    for group in (range(0, arm.joints, 2), range(1, arm.joints, 2)):
        joints = tuple(group)
        way = _directions(arm, joints) * amplitude
        path.travel(arm.rest - way, travel)
        path.wait(_PAUSE)
        for half in range(2 * _SWEEP_CYCLES):
            with path.segment(f"sweep/{'-'.join(map(str, joints))}/0/{half}", "sweep", joints):
                path.travel(arm.rest + (way if half % 2 == 0 else -way), speed)
        path.travel(arm.rest, travel)
        path.wait(_PAUSE)


def _directions(arm: Arm, joints: tuple[int, ...]) -> Array:
    """Signs (n,) by which the joints of a group move: neighbours of the group against each other, others not."""
    sign = np.zeros(arm.joints)
    sign[list(joints)] = np.where(np.arange(len(joints)) % 2, -1.0, 1.0)
    return sign


def _poses(arm: Arm) -> tuple[Array, float]:
    """Postures (5, n) [rad] of the poses, and the distance [rad] from which each can be approached by all joints."""
    for size in _SMALLER:
        q = solve_position(arm, iso_poses(arm, RISING_LEFT, float(size)), arm.rest).q
        for offset in HOLD_OFFSET * _SMALLER[:4]:
            ends = [q + sign * offset for sign in (-1.0, 1.0)]
            stops = np.concatenate([np.stack([ends[0][i], q[i], ends[1][i], q[i]]) for i in range(POSES)])
            chain = np.concatenate([arm.rest[None], stops, arm.rest[None]])
            back = line_is_safe(arm, q[-1], ends[0][0])  # the next cycle begins at the first pose
            if bool(line_is_safe(arm, chain[:-1], chain[1:]).all() and back):
                return q, float(offset)
    why = unsafe(arm, solve_position(arm, iso_poses(arm, RISING_LEFT), arm.rest).q[0])
    raise InputError(
        f"arm {arm.name}: the five poses of a check cannot be reached safely from its rest posture"
        f"{f': {why}' if why else ''}; give another rest_deg or other targets in the arm's TOML file"
    )


def _amplitude(arm: Arm) -> float:
    """[rad] by which joints can go back and forth about the rest posture."""
    for share in _SMALLER:
        ends = np.array(
            [sign * share * _AMPLITUDE * _directions(arm, tuple(range(first, arm.joints, 2)))
             for first in (0, 1) for sign in (-1.0, 1.0)]
        )  # fmt: skip
        if is_safe(arm, arm.rest + ends).all():
            return float(share * _AMPLITUDE)
    raise InputError(f"arm {arm.name}: its rest posture leaves no room to move its joints: {unsafe(arm, arm.rest)}")
