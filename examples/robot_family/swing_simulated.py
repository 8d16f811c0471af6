"""A serial line with a simulated Swing at its other end, in place of the arm that nobody has.

It loses one answer in fifty, and every second one of those arrives later, in front of the next. Time is simulated too:
it passes where somebody waits, so that an hour of driving takes minutes.
"""

import numpy as np

from rejoint.arms import load_arm
from rejoint.robots import Clock
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import load_wear

ANSWER = 0.004
"""[s] from a question to its answer"""
LOST_EVERY = 50
"""answers"""


class SimulatedClock(Clock):
    """Time that passes only where somebody waits."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait(self, duration):
        self.time += max(duration, 0.0)


CLOCK = SimulatedClock()


class Line:
    """What is used of `serial.Serial`. The port ``unplugged`` has nothing behind it."""

    answers = lost = 0

    def __init__(self, port, timeout):
        if port == "unplugged":
            raise FileNotFoundError(f"no such device: {port}")
        arm = load_arm("mycobot280")
        self.timeout, self._waiting = timeout, b""
        self._plant = Plant(arm, [load_wear("worn", arm)], seed=0)
        self._began = CLOCK.now() - self._plant.time[0]

    def write(self, data):
        CLOCK.wait(ANSWER)
        self._plant.advance(np.array([CLOCK.now() - self._began]) - self._plant.time)
        answer = self._answer(*data.decode().split()).encode() + b"\n"
        Line.answers += 1
        if Line.answers % LOST_EVERY == 0:
            Line.lost += 1
            self._late = answer if Line.lost % 2 == 0 else b""
        else:
            self._waiting += answer

    def readline(self):
        answer, newline, self._waiting = self._waiting.partition(b"\n")
        if not newline:
            CLOCK.wait(self.timeout)
            self._waiting = self._late
        return answer + newline

    def reset_input_buffer(self):
        self._waiting = b""

    def close(self):
        self._waiting = b""

    def _answer(self, word, *numbers):
        if word == "goal":
            self._plant.command(np.radians([[float(number) for number in numbers]]), np.array([0.010]))
        elif word == "hold":
            self._plant.halt()
        else:
            volts = np.full((1, 6), 7.4)
            state = np.degrees(self._plant.encoder()), self._plant.load, self._plant.temperature, volts
            return " ".join(f"{number:.3f}" for number in np.concatenate(state).ravel())
        return "ok"
