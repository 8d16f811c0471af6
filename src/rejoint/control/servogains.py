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
from typing import Protocol, cast

from rejoint.control.contract import PolicyContract
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.system.errors import ContractError, InputError, RejointError, first_line
from rejoint.system.stopping import shielded

ServoGains = Mapping[str, tuple[int, ...]]
"""(n,) of each name"""


class Tunable(Robot, Protocol):
    """A robot whose servos' own gains can be read and set."""

    def servo_gains(self) -> ServoGains | None:
        """Return the gains in force; None where the servos keep them to themselves."""

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
    tunable = cast(Tunable, robot)
    try:
        tunable.tune(wanted)
        yield
    except BaseException as error:
        with shielded():
            try:
                tunable.tune(before)
            except (RejointError, OSError) as other:  # the first error is the one to report
                error.add_note(
                    f"The servos keep the gains {told(wanted)} until their power goes ({first_line(other)}); before "
                    f"they had {told(before)}."
                )
        raise
    with shielded():
        tunable.tune(before)


def limits_under(limits: GuardLimits | None, robot: Robot, controller: object) -> GuardLimits | None:
    """Return what the guard allows while ``controller`` drives: what a diagnosis tells holds for the gains of then."""
    wanted: ServoGains | None = getattr(controller, "servo_gains", None)
    before = gains_in_force(robot)
    if limits is None or wanted is None or before is None or not differing(wanted, before):
        return limits
    return replace(limits, servos=None, bands=None)


def require_gains(robot: Robot, controller: object) -> None:
    """Refuse (ContractError) a policy that was trained for other gains than the servos of ``robot`` have."""
    contract = getattr(controller, "contract", None)
    if not isinstance(contract, PolicyContract) or contract.servo_gains is None:
        return
    found = gains_in_force(robot)
    if found is None:
        return
    other = differing(contract.servo_gains, found)
    if other:
        name, joint = other[0]
        ours, theirs = contract.servo_gains[name][joint], found[name][joint]
        raise ContractError(
            f"the policy was trained for servos with {name}={ours} at {robot.arm.joint_names[joint]}, and {name} is "
            f"{theirs} there; set it back ({told(contract.servo_gains)}), or repair the arm again"
        )


def differing(wanted: ServoGains, found: ServoGains) -> list[tuple[str, int]]:
    """Names and joints, from 0, in which ``wanted`` is not what was ``found``; a name that is not there differs."""
    return [
        (name, joint)
        for name, values in wanted.items()
        for joint, value in enumerate(values)
        if name not in found or joint >= len(found[name]) or found[name][joint] != value
    ]


def told(gains: ServoGains) -> str:
    """Put gains into words: one number where all joints share it."""
    return ", ".join(
        f"{name} {values[0]}" if len(set(values)) == 1 else f"{name} {'/'.join(map(str, values))}"
        for name, values in gains.items()
    )
