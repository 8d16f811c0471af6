"""Errors by name, with exit codes: 2 unusable input, 3 the guard stopped, 4 the robot failed."""

import logging
from pathlib import Path
from typing import ClassVar

LOGGER = logging.getLogger("rejoint")
"""Logger of warnings that are no errors"""


class RejointError(Exception):
    """Base of all errors of the project."""

    exit_code: ClassVar[int] = 2

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as it is: `args` differ from the constructor's."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class InputError(RejointError, ValueError):
    """A value given by the user is unusable."""


class AddressError(InputError):
    """A robot address is malformed, unknown, or without answer."""


class ProfileError(InputError):
    """A wear profile is unknown or impossible."""


class FileError(RejointError):
    """A file is missing, damaged, or of another kind."""

    def __init__(self, path: Path | str, problem: str, remedy: str) -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}; {remedy}")


class MissingExtraError(RejointError):
    """A package beyond the base installation is missing."""


class UnsavedError(FileError):
    """A result could not be written; the error carries it."""

    def __init__(self, error: FileError, result: object) -> None:
        self.result = result
        super().__init__(error.path, error.problem, error.remedy)
        for note in getattr(error, "__notes__", ()):
            self.add_note(note)


class ContractError(RejointError):
    """A policy does not fit the arm or the robot."""


class RobotError(RejointError):
    """The robot failed while it was driven."""

    exit_code: ClassVar[int] = 4


class NoReplyError(RobotError, TimeoutError):
    """The robot did not answer in time."""


class StaleReplyError(RobotError):
    """The robot sent an old or repeated state."""


class ImpossibleReplyError(RobotError, ValueError):
    """The robot sent impossible numbers."""


class ConnectionLostError(RobotError, ConnectionError):
    """The connection to the robot broke, without safe recovery."""


class PowerLostError(ConnectionLostError):
    """The arm lost its power: only the user may switch it on."""


class NotReadyError(RobotError):
    """The robot is not ready: it did not move, or only towards rest."""


class NotReachedError(RejointError, TimeoutError):
    """The arm did not reach its target in time; it holds."""

    exit_code: ClassVar[int] = 5


class GuardTripError(RejointError):
    """The guard stopped the motion; `reason` names why, ``limp`` whether a joint may have no torque left."""

    exit_code: ClassVar[int] = 3

    def __init__(self, reason: str, detail: str, *, limp: bool = False) -> None:
        self.reason, self.limp = reason, limp
        super().__init__(f"guard trip ({reason}): {detail}")


def first_line(error: BaseException) -> str:
    """First line of another library's error, or its name."""
    return (str(error).splitlines() or [type(error).__name__])[0]
