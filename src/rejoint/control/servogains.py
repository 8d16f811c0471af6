"""Gains of the servos' own position loops: what a controller asks for, what a policy was trained for, what is there.

Gains are whole numbers in the servos' own units, one per joint, by the name of what they set: ``p``, ``i``, ``d``,
``dead`` and whatever else a family knows. A controller that says `servo_gains` is driven under those, and the ones
before are put back afterwards, also after an error or a signal. A policy says which it was trained for; under others it
is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple, Protocol, cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.contract import PolicyContract
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.system.errors import ContractError, InputError, RejointError, first_line
from rejoint.system.stopping import shielded

ServoGains = Mapping[str, tuple[int, ...]]
"""(n,) of each name"""
HOTTEST, HEAVIEST = 55.0, 0.7
"""[deg C] and share of the largest torque at which a servo's gains are taken back (chosen: below its protections)"""


class Rung(NamedTuple):
    """What a search for better gains tries, one value after the other."""

    names: tuple[str, ...]
    """of the gains that it sets alike"""
    values: tuple[int, ...]
    """in the order in which they are tried; a joint leaves out those that it is beyond"""
    rising: bool = True
    beside: tuple[tuple[str, int], ...] = ()
    """what has to be set with it, whatever its value"""


class Tunable(Robot, Protocol):
    """A robot whose servos' own gains can be read and set."""

    def servo_gains(self) -> ServoGains | None:
        """Return the gains in force; None where the servos keep them to themselves."""

    def rungs(self) -> tuple[Rung, ...]:
        """Return what a search for better gains tries, the safest first, and last what a controller does not need."""

    def tune(self, gains: ServoGains) -> None:
        """Bring the gains in small steps to these, until the power goes; RobotError where a servo does not bear it."""

    def keep(self, gains: ServoGains) -> None:
        """Bring the gains to these, and have the servos keep them without power."""


def gains_in_force(robot: Robot) -> ServoGains | None:
    """Return the gains of the servos of ``robot``; None where nobody knows."""
    ask = getattr(robot, "servo_gains", None)
    return None if ask is None else cast(Tunable, robot).servo_gains()


@contextmanager
def under_gains(robot: Robot, controller: object) -> Iterator[None]:
    """Let ``controller`` drive under the gains that it asks for; those before are put back at the end.

    ContractError for a policy that was trained for others than are there, InputError where they cannot be set.
    """
    require_gains(robot, controller)
    wanted: ServoGains | None = getattr(controller, "servo_gains", None)
    if wanted is None:
        yield
        return
    before = gains_in_force(robot)
    if before is None:
        raise InputError(f"{robot.address} has no servo gains that could be set, which this controller needs")
    if not differing(wanted, before):
        yield
        return
    with put_back(cast(Tunable, robot), before):
        cast(Tunable, robot).tune(wanted)
        yield


@contextmanager
def put_back(robot: Tunable, before: ServoGains) -> Iterator[None]:
    """Set the gains ``before`` at the end, however that comes."""
    try:
        yield
    except BaseException as error:
        with shielded():
            try:
                robot.tune(before)
            except (RejointError, OSError) as other:  # the first error is the one to report
                error.add_note(
                    f"The servos' gains were not put back ({first_line(other)}). Before they were {in_words(before)}, "
                    "as they are again once the arm's power was off."
                )
        raise
    with shielded():
        robot.tune(before)


def limits_under(limits: GuardLimits | None, robot: Robot, controller: object) -> GuardLimits | None:
    """Return what the guard allows while ``controller`` drives: what a diagnosis tells holds for the gains of then.

    Under stiffer ones a joint stands at smaller leads: its band is shifted, and as wide as it was at most. An I part
    pushes without a lead, so that nothing is known under one.
    """
    gains: ServoGains | None = getattr(controller, "servo_gains", None) or gains_in_force(robot)
    if limits is None or limits.gains is None or gains is None or not differing(gains, limits.gains):
        return limits
    now = {**limits.gains, **gains}
    stiffer = stiffness_under(np.ones(limits.arm.joints), limits.gains, now)
    if limits.bands is None or "p" not in now or any(now.get("i", ())) or (stiffer < 1.0).any():
        return replace(limits, servos=None, bands=None)
    return replace(limits, servos=None, bands=replace(limits.bands, slope=limits.bands.slope / stiffer))


def require_gains(robot: Robot, controller: object) -> None:
    """Refuse (ContractError) a policy that was trained for other gains than it is driven under.

    Those are the ones that the servos of ``robot`` have, or those that the controller itself asks for.
    """
    contract = getattr(controller, "contract", None)
    if not isinstance(contract, PolicyContract) or contract.servo_gains is None:
        return
    found: ServoGains | None = getattr(controller, "servo_gains", None) or gains_in_force(robot)
    if found is None:
        return
    other = differing(contract.servo_gains, found)
    if other:
        name, joint = other[0]
        ours, theirs = contract.servo_gains[name][joint], found[name][joint]
        raise ContractError(
            f"the policy was trained for servos with {name}={ours} at {robot.arm.joint_names[joint]}, and {name} is "
            f"{theirs} there; set it back ({in_words(contract.servo_gains)}), or repair the arm again"
        )


def differing(wanted: ServoGains, found: ServoGains) -> list[tuple[str, int]]:
    """Names and joints, from 0, in which ``wanted`` is not what was ``found``; a name that is not there differs."""
    return [
        (name, joint)
        for name, values in wanted.items()
        for joint, value in enumerate(values)
        if name not in found or joint >= len(found[name]) or found[name][joint] != value
    ]


def stiffness_under(stiffness: Array, before: ServoGains | None, now: ServoGains | None) -> Array:
    """Return the stiffness (n,) [N m/rad] that was found under the gains ``before``, under those of ``now``.

    A servo's stiffness goes with its P; where nobody knows either, it is as it was.
    """
    if before is None or now is None or "p" not in before or "p" not in now:
        return stiffness
    return np.asarray(stiffness * np.array(now["p"]) / np.maximum(before["p"], 1))


def in_words(gains: ServoGains) -> str:
    """Put gains into words: one number where all joints share it."""
    return ", ".join(
        f"{name} {values[0]}" if len(set(values)) == 1 else f"{name} {'/'.join(map(str, values))}"
        for name, values in gains.items()
    )
