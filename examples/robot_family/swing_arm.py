"""Driver of the Swing, a made-up arm on a serial line that answers every line of text with one."""

import numpy as np
from swing_simulated import CLOCK, Line  # of a real arm: from serial import Serial

from rejoint.robots import Bus, Reading, bus_family


class SwingBus(Bus):
    name = "Swing arm"
    clock = CLOCK  # of a real arm: leave out

    def __init__(self, port, arm):
        self.port, self.line = port, None

    def open(self):
        self.line = Line(self.port, timeout=0.1)

    def read(self):
        numbers = [float(word) for word in self.ask("state?").split()]
        degrees, load, celsius, volt = np.reshape(numbers, (4, -1))  # ValueError: the answer was cut
        return Reading(position=np.radians(degrees), load=load, temperature=celsius, voltage=volt)

    def send(self, goal):
        self.ask("goal " + " ".join(f"{angle:.3f}" for angle in np.degrees(goal)))

    def stop(self):
        self.ask("hold")

    def resynchronise(self, deadline):
        self.line.reset_input_buffer()

    def close(self):
        if self.line is not None:
            self.line.close()

    def ask(self, words):
        self.line.write(f"{words}\n".encode())
        answer = self.line.readline()
        if not answer.endswith(b"\n"):
            raise TimeoutError(f"no answer to {words.split()[0]} within {self.line.timeout} s")
        return answer.decode()


def port(address):
    name = address.removeprefix("swing://")
    if not name or name == address:
        raise ValueError("not of the form swing://PORT")
    return name


FAMILY = bus_family(SwingBus, scheme="swing", form="swing://PORT", parse=port, default_arm="mycobot280")
