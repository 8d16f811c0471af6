"""An emulated SO-101 in virtual time whose servos obey the law of an STS3215, and tell their gains."""

from rejoint.arms import load_arm
from rejoint.lab.plant.stsplant import StsPlant
from rejoint.lab.plant.wear import load_wear
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.feetech.gains import LIMIT, REGISTERS, RUNGS
from rejoint.system.errors import RobotError

ARM = load_arm("so101")
FIELDS = {LIMIT: "integral_limit"}


class ServoRobot(EmulatedRobot):
    def __init__(self, wear="so101"):
        wears = [load_wear(wear, ARM)]
        super().__init__(ARM, wears, seed=0, period=(0.020, 0.020))
        self.plant = StsPlant(ARM, wears, seed=0)
        self.restart(ARM.rest)
        self.history, self.frail = [], None

    def servo_gains(self):
        return {name: tuple(self.plant.settings[FIELDS.get(name, name)][0].tolist()) for name in REGISTERS}

    def rungs(self):
        return RUNGS

    def tune(self, gains):
        for name, values in gains.items():
            self.plant.settings[FIELDS.get(name, name)][0] = values
        self.history.append(self.servo_gains())
        if self.frail is not None and gains["p"][1] >= self.frail:
            raise RobotError("shoulder_lift does not bear it")
