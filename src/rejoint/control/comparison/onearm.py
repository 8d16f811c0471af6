"""Trials on one arm, each from the rest posture: all of them in turns, or as many as a race takes.

A race goes through the target sets one after the other. In each, every controller first drives the crossing protocol,
which takes good ones seconds and shows bad ones; the holds, which take most of the time, come in blocks of a few
targets, and after each block who is beaten is out (`rejoint.control.comparison.racing`). At most all sets are driven.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison import racing
from rejoint.control.comparison.driven import Driven
from rejoint.control.comparison.elimination import Elimination
from rejoint.control.comparison.protocols import KINDS, Kind
from rejoint.control.comparison.racing import Race, Results
from rejoint.control.contract import check_controller_period
from rejoint.control.loop import move
from rejoint.control.robot import Robot
from rejoint.control.servogains import require_gains
from rejoint.control.start import begin
from rejoint.system.errors import ContractError

if TYPE_CHECKING:
    from rejoint.control.comparison.compare import TrialRunner

LONG_GAP = 2.0
"""[s] without an answer from which a trial on one arm is driven again (chosen: a quarter of a hold)"""
REPEATS = 2
"""Times that a trial is driven again at most; the last one counts, and the guard's column says that there were gaps"""

Place = tuple[int, int]


class OneArm:
    """Drives the trials of a comparison on one arm."""

    def __init__(self, session: TrialRunner, robot: Robot) -> None:
        self._session, self._robot = session, robot
        self._left = Elimination(session.settings.protocol)
        self._sent: Array | None = None
        self._rng = np.random.default_rng(session.settings.seed)

    def drive_all(self) -> None:
        """Drive every controller to all targets."""
        for place in self._places():
            for name in map(str, self._rng.permutation(list(self._session.tallies))):
                for kind in KINDS:
                    self._drive(name, kind, place)

    def race(self, race: Race) -> None:
        """Drive until the race is decided."""
        count, rivals, targets = self._session.shape[2], 0, 0
        for driven in self._session.measured:
            self._note(driven)
        for place in self._places():
            self._drive_left("crossing", place)
            rivals = rivals or max(len(self.left) - 1, 1)
            stops = [0, *looks(count, racing.fewest(rivals, race) if not targets else 0), count]
            for first, stop in pairwise(stops):
                self._drive_left("hold", place, first, stop - first)
                targets += stop - first
                self._drop_beaten(rivals, race)
                if self._decided(targets, race):
                    break
            if self._decided(targets, race):
                break
        self._session.progress.skip_rest()

    def _decided(self, targets: int, race: Race) -> bool:
        """Tell whether one is left, or none, and has had enough ``targets``."""
        return not self.left or (len(self.left) == 1 and targets >= race.least)

    @property
    def left(self) -> list[str]:
        """Controllers that are still driven."""
        return [name for name in self._session.controllers if not self._left.out(name)]

    def _places(self) -> list[Place]:
        sets, repetitions, _ = self._session.shape
        return [(s, r) for r in range(repetitions) for s in range(sets)]

    def _drive_left(self, kind: Kind, place: Place, first: int = 0, count: int | None = None) -> None:
        for name in map(str, self._rng.permutation(self.left)):
            self._drive(name, kind, place, first, count)

    def _drop_beaten(self, rivals: int, race: Race) -> None:
        """Put the most clearly beaten one out, and again, as long as others are left that beat one."""
        while len(self.left) > 1:
            narrow = int(np.argmin(self._session.settings.protocol.within))
            results = {}
            for name in self.left:
                tally = self._session.tallies[name]
                results[name] = Results(
                    crossed=tally.crossed.ravel(), settled=tally.settled.ravel(), stay=tally.stay[narrow].ravel()
                )
            found = racing.beaten(results, rivals, race)
            if not found:
                return
            self._left.drop(found[0].controller, found[0].why)
            self._session.tallies[found[0].controller].out = found[0].why

    def _drive(self, name: str, kind: Kind, place: Place, first: int = 0, count: int | None = None) -> None:
        """Drive a trial, or ``count`` targets of it, unless that is done or its controller out of the comparison."""
        session = self._session
        size = session.shape[2] if count is None else count
        if name not in session.controllers or self._left.out(name):
            session.progress.skip(size)
            return
        if session.tallies[name].has(kind, place, first, size):
            session.progress.skip(size)
            return
        driven = session.known(name, kind, (place,), first)
        if driven is None:
            start = self._start()
            if name not in session.controllers:  # its period does not suit, as the first motion has shown
                session.progress.skip(size)
                return
            driven = self._insist(name, kind, place, start, first, size)
            session.take(driven)
        self._watch(driven)

    def _note(self, driven: Driven) -> None:
        """Take over what was measured before the comparison."""
        tally = self._session.tallies[driven.controller]
        tally.add(driven)
        tally.source = self._session.source
        self._watch(driven)

    def _watch(self, driven: Driven) -> None:
        name, place = driven.controller, driven.places[0]
        tally = self._session.tallies[name]
        self._left.note(name, driven.kind, place, tally.crossed[place], driven.failed)
        tally.out = self._left.out(name)

    def _insist(self, name: str, kind: Kind, place: Place, start: Array, first: int, count: int) -> Driven:
        """Drive a trial, and again where the answers stayed away for long."""
        session, robot = self._session, self._robot
        for repeat in range(REPEATS + 1):
            controller = self._left.watch(name, session.controllers[name](robot.arm), robot.arm, kind)
            driven, recording = session.drive(
                robot, controller, name, kind, (place,), start, slice(first, first + count)
            )
            self._sent = recording.command[-1]
            if recording.gaps().max(initial=0.0) < LONG_GAP or repeat == REPEATS:
                break
            start = self._start()
        return driven

    def _start(self) -> Array:
        """Bring the arm to its rest posture; returns the command there (1, n) [rad]."""
        if self._sent is None:
            motion = begin(self._robot, self._session.limits, self._session.stance)
            self._check_period(motion.usual_period())
        else:
            motion = move(self._robot, self._robot.arm.rest, sent=self._sent, limits=self._session.limits)
        self._sent = motion.command[-1]
        return self._sent

    def _check_period(self, period: float) -> None:
        session = self._session
        for name, factory in list(session.controllers.items()):
            try:
                controller = factory(self._robot.arm)
                check_controller_period(controller, period)
                require_gains(self._robot, controller)
            except ContractError as error:
                if not session.settings.leave_out or len(session.controllers) == 1:
                    raise
                session.left_out.append(f"{name} did not take part: {error}.")
                del session.controllers[name]


def looks(count: int, fewest: int) -> list[int]:
    """Targets of a set of ``count`` after which the race is looked at: once before its end.

    That is when somebody can be beaten for the first time, ``fewest``; 0, where that was already, takes the middle.
    """
    look = fewest or count // 2
    return [look] if 0 < look < count else []
