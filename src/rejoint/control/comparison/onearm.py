"""Trials on one arm, each from the rest posture: all of them in turns, or as many as a race takes.

A race goes through the target sets one after the other, in blocks of a few targets that all who are left hold in turns.
After each block it is looked who is out (`rejoint.control.comparison.racing`); at most all sets are driven. A hold
tells as well when its target was first crossed, so that nobody drives the other protocol.
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
from rejoint.control.comparison.recommend import complexity
from rejoint.control.contract import check_controller_period
from rejoint.control.playback import move
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

PACE = 2
"""Targets between two looks (chosen: each costs a way to the rest posture, half the time of a target)"""

Place = tuple[int, int]


class OneArm:
    """Drives the trials of a comparison on one arm."""

    def __init__(self, session: TrialRunner, robot: Robot) -> None:
        self._session, self._robot = session, robot
        self._racing = session.settings.race is not None
        self._left = Elimination(session.settings.protocol, "hold" if self._racing else "crossing")
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
        targets = 0
        for driven in self._session.measured:
            self._note(driven)
        field = sorted(self.left, key=complexity)
        for place in self._places():
            for first, stop in pairwise(looks(self._session.shape[2], targets, race)):
                self._drive_left(place, first, stop - first)
                targets += stop - first
                self._drop(field, race)
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

    def _drive_left(self, place: Place, first: int, count: int) -> None:
        for name in map(str, self._rng.permutation(self.left)):
            self._drive(name, "hold", place, first, count)

    def _drop(self, field: list[str], race: Race) -> None:
        """Put the one out of whom it is clearest, and again, as long as there is one."""
        while len(self.left) > 1:
            narrow = int(np.argmin(self._session.settings.protocol.within))
            results = {}
            for name in self.left:
                tally = self._session.tallies[name]
                results[name] = Results(
                    crossed=tally.crossed.ravel(), settled=tally.settled.ravel(), stay=tally.stay[narrow].ravel()
                )
            out = racing.next_out(results, field, race)
            if out is None:
                return
            self._left.drop(out.controller, out.why)
            self._session.tallies[out.controller].out = out.why

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
                robot, controller, name, kind, (place,), start, slice(first, first + count), both=self._racing
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


def looks(count: int, driven: int, race: Race) -> list[int]:
    """Targets of a set of ``count`` from 0 to its end at which a race is looked at, ``driven`` before the set.

    First when anybody can be out, then after every two.
    """
    first = min(max(racing.fewest(race) - driven, PACE), count)
    return [0, *range(first, count, PACE), count]
