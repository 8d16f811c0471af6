"""Errors with names and the exit code of the command line.

2 unusable input, 3 the guard stopped, 4 the robot failed.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar


class RejointError(Exception):
    """Base of every error that the project raises on purpose."""

    exit_code: ClassVar[int] = 2

    def __reduce__(self) -> tuple[object, ...]:
        """Travel between processes as it is: what a constructor is given differs from what it says (`args`)."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class InputError(RejointError, ValueError):
    """A value given by the user cannot be used."""


class AddressError(InputError):
    """A robot address is malformed, unknown, or nothing answers there."""


class ProfileError(InputError):
    """A wear profile does not exist or holds values that make no sense."""


class FileError(RejointError):
    """A file is missing, truncated, or not what its name says."""

    def __init__(self, path: Path | str, problem: str, remedy: str) -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}; {remedy}")


class MissingExtraError(RejointError):
    """Something needs packages that the base installation does not bring."""


class UnsavedError(FileError):
    """A result could not be written; it is here all the same, so that it can be shown."""

    def __init__(self, error: FileError, result: object) -> None:
        self.result = result
        super().__init__(error.path, error.problem, error.remedy)
        for note in getattr(error, "__notes__", ()):
            self.add_note(note)


class ContractError(RejointError):
    """A policy file does not fit the arm or the robot it is to drive."""


class RobotError(RejointError):
    """The robot failed while it was being driven."""

    exit_code: ClassVar[int] = 4


class NoReplyError(RobotError, TimeoutError):
    """The robot did not answer in time."""


class StaleReplyError(RobotError):
    """The robot answered with an old or repeated state."""


class ImpossibleReplyError(RobotError, ValueError):
    """The robot answered with numbers that no such arm can have."""


class ConnectionLostError(RobotError, ConnectionError):
    """The connection to the robot broke and could not be made again safely."""


class PowerLostError(ConnectionLostError):
    """The arm lost its power: only its owner may switch it on again."""


class NotReadyError(RobotError):
    """The robot is in no state to be driven: nothing was moved, or it was only on its way to rest."""


class NotReachedError(RejointError, TimeoutError):
    """The arm did not come to its target in time; it holds where it is."""

    exit_code: ClassVar[int] = 5


class GuardTripError(RejointError):
    """The guard stopped the motion; `reason` names why."""

    exit_code: ClassVar[int] = 3

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        super().__init__(f"guard trip ({reason}): {detail}")


def first_line(error: BaseException) -> str:
    """Return what an error of another library says, cut to one line; its name where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]
