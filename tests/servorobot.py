"""An emulated SO-101 in virtual time that keeps a record of its gains, and may not bear some."""

from rejoint.arms import load_arm
from rejoint.system.errors import RobotError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("so101")


class ServoRobot(EmulatedRobot):
    def __init__(self, wear="so101"):
        super().__init__(ARM, [load_wear(wear, ARM)], channel=Channel(period=(0.020, 0.020)))
        self.history, self.frail = [], None

    def tune(self, gains):
        super().tune(gains)
        self.history.append(self.servo_gains())
        if self.frail is not None and gains["p"][1] >= self.frail:
            raise RobotError("shoulder_lift does not bear it")
