"""A bus of a few lines, in simulated time."""

from typing import ClassVar

from rejoint.arms import mycobot280
from rejoint.robots.bus import Bus, Clock, Reading

ARM = mycobot280()


class SimulatedClock(Clock):
    time = 0.0

    def now(self):
        return self.time

    def wait(self, duration):
        self.time += max(duration, 0.0)


class PlainBus(Bus):
    """An arm that is at once where it is sent; ``faults`` are raised or answered, one per question."""

    costs: ClassVar = {}
    """[s] that questions take; others 4 ms"""

    name = "Plain"

    def __init__(self, faults=(), **extra):
        self.clock, self.faults, self.extra = SimulatedClock(), list(faults), extra
        self.position, self.done = ARM.rest.copy(), []

    def tell(self, what):
        self.done.append(what)
        self.clock.wait(self.costs.get(what, 0.004))
        fault = self.faults.pop(0) if self.faults else None
        if isinstance(fault, BaseException):
            raise fault
        return fault

    def open(self):
        self.tell("open")

    def prepare(self, until=None):  # noqa: ARG002 - as it is called
        self.tell("prepare")

    def read(self):
        return self.tell("read") or Reading(position=self.position.copy(), **self.extra)

    def send(self, goal):
        self.tell("send")
        self.position = goal.copy()

    def stop(self):
        self.tell("stop")

    def resynchronise(self, deadline):  # noqa: ARG002 - as it is called
        self.tell("resynchronise")

    def close(self):
        self.done.append("close")
