"""A plant without faults, for laws that no wear may blur, and the worn one."""

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint_lab.emulator.firmware import Firmware

ARM = mycobot280()


class IdealPlant:
    """One arm whose joints follow their speed-limited reference exactly; encoders of infinite resolution."""

    def __init__(self, *_, **__):
        self.goal = np.array(ARM.rest, dtype=float)[None]
        self.position = self.goal.copy()
        self.limit = np.inf
        self.told = np.full((1, 6), np.nan)  # of encoders that froze
        self.seen = np.full((1, 6), np.nan)  # by servos that went blind: they see no progress and run on
        self.on = True
        self.writes = []
        self.time = np.zeros(1)
        self.temperature = np.full((1, 6), 30.0)
        self.torque = np.zeros((1, 6))
        self.speed = np.zeros((1, 6))

    def command(self, position):
        self.goal = np.array(position)
        self.writes.append(self.goal[0].copy())

    def advance(self, duration):
        before, self.time = self.position, self.time + duration
        if self.on:
            reach = self.limit * duration
            missing = self.goal - np.where(np.isnan(self.seen), before, self.seen)
            self.position = before + np.clip(missing, -reach, reach)
        self.speed = (self.position - before) / duration

    def encoder(self):
        return np.where(np.isnan(self.told), self.position, self.told)

    def freeze(self, joints):
        self.told = np.where(joints & np.isnan(self.told), self.encoder(), self.told)

    def blind(self, joints):
        self.seen = np.where(joints & np.isnan(self.seen), self.encoder(), self.seen)
        self.freeze(joints)

    def link_position(self):
        return self.position

    def true_tcp(self):
        return tcp_position(ARM, self.position)

    def halt(self):
        self.goal = self.position.copy()

    def set_power(self, on):
        self.on = on

    def set_speed_limit(self, speed):
        self.limit = speed


class IdealFirmware(Firmware):
    kind = IdealPlant


@pytest.fixture(scope="session")
def ideal():
    return IdealFirmware


@pytest.fixture
def firmware(ideal):
    return ideal(ARM, None)


@pytest.fixture
def plant(firmware):
    return firmware.plant


@pytest.fixture
def worn():
    return Firmware.build(ARM, "worn")
