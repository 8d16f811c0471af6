"""Robots of a few lines, which every test lets move as it needs."""

import numpy as np

from rejoint.arms import gravity_torque, mycobot280, tcp_position
from rejoint.control.robot import ControlInput, JointState


def state_of(position, time=0.0, **told):
    """The state of arms at ``position`` (B, n), or of one at (n,)."""
    position = np.atleast_2d(position)
    zeros = np.zeros(len(position))
    return JointState(**{"time": zeros + time, "position": position, "age": zeros} | told)


def inputs_of(state, target, goal, sent, since=0.0):
    return ControlInput(state=state, target=target, goal=goal, sent=sent, since_target=np.zeros(len(sent)) + since)


def now_at(position, time=0.0, since=None, **told):
    """What a reference is asked with: arms at ``position``, ``since`` [s] in its leg; by default its time."""
    state = state_of(position, time, **told)
    nowhere = np.full((len(state.time), 3), np.nan)
    return inputs_of(state, nowhere, state.position, state.position, state.time if since is None else since)


class StandIn:
    """Arms (B) that begin at rest; each active one is where ``moved`` says, a period after its command."""

    arm, address = mycobot280(), "test:stand-in"

    def __init__(self, count=1, *, period=0.025, start=None):
        self.count = count
        self.periods = np.broadcast_to(np.asarray(period, dtype=float), count)
        self.position = np.tile(self.arm.rest if start is None else start, (count, 1)).astype(float)
        self.time = np.zeros(count)
        self.stops = self.closed = 0

    def moved(self, command):
        return command

    def read(self, **told):
        return state_of(self.position, self.time, **told)

    def step(self, command, active=None):
        active = np.ones(self.count, dtype=bool) if active is None else active
        self.position = np.where(active[:, None], self.moved(command), self.position)
        self.time = self.time + np.where(active, self.periods, 0.0)
        return self.read()

    def true_tcp(self):
        return np.full((self.count, 3), np.nan)

    def tcp(self):
        return tcp_position(self.arm, self.position)

    def stop(self):
        self.stops += 1

    def close(self):
        self.closed += 1


class SaggingArms(StandIn):
    """Servos with a lag that sag by gravity's torque over their ``stiffness`` [N m/rad]; the encoders see it."""

    stiffness, share = 6.0, 0.3

    def moved(self, command):
        goal = command - gravity_torque(self.arm, self.position) / self.stiffness
        return self.position + self.share * (goal - self.position)
