"""LeRobot's own bus on an emulated arm, in an environment of its own: run with the device of its serial line.

`make judge` installs what it needs into .judge; LeRobot's heavier dependencies, which its bus does not use, are stood
in for. Writes what it saw to standard output, as JSON.
"""

import json
import sys
import time
from types import ModuleType


def stand_in(name, **content):
    module = ModuleType(name)
    module.__dict__.update(content)
    sys.modules[name] = module
    return module


def stand_in_for_what_the_bus_does_not_use():
    anything = type("Anything", (), {})
    torch = stand_in("torch", Tensor=anything, device=anything, dtype=anything)
    torch.nn, torch.cuda = stand_in("torch.nn", Module=anything), stand_in("torch.cuda")
    stand_in("accelerate", Accelerator=anything)
    stand_in("datasets")
    stand_in("datasets.utils")
    stand_in("datasets.utils.logging", disable_progress_bar=lambda: None, enable_progress_bar=lambda: None)


NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def judge(device, family):
    from lerobot.motors import Motor, MotorCalibration, MotorNormMode

    if family == "feetech":
        from lerobot.motors.feetech import FeetechMotorsBus as Bus
        from lerobot.motors.feetech import OperatingMode

        models, mode, gain = ("sts3215",) * 6, OperatingMode.POSITION, "P_Coefficient"
    else:
        from lerobot.motors.dynamixel import DynamixelMotorsBus as Bus
        from lerobot.motors.dynamixel import OperatingMode

        models = ("xl430-w250",) * 2 + ("xl330-m288",) * 4
        mode, gain = OperatingMode.EXTENDED_POSITION, "Position_P_Gain"
    motors = {name: Motor(i + 1, models[i], MotorNormMode.DEGREES) for i, name in enumerate(NAMES)}
    bus = Bus(port=device, motors=motors)
    bus.connect()
    seen = {"models": sorted(set(bus.broadcast_ping().values()))}
    held = bus.read_calibration()
    seen["held"] = {name: [c.homing_offset, c.range_min, c.range_max] for name, c in held.items()}
    bus.disable_torque()
    bus.configure_motors()
    for name in NAMES:
        bus.write("Operating_Mode", name, mode.value)
        bus.write(gain, name, 16 if family == "feetech" else 1600)
    seen["offsets"] = bus.set_half_turn_homings()
    seen["middle"] = bus.sync_read("Present_Position", normalize=False)
    ranges = {"drive_mode": 0, "range_min": 1000, "range_max": 3000}
    new = {name: MotorCalibration(id=c.id, homing_offset=seen["offsets"][name], **ranges) for name, c in held.items()}
    bus.write_calibration(new)
    seen["calibrated"] = bus.is_calibrated
    bus.sync_write("Goal_Position", seen["middle"], normalize=False)
    bus.enable_torque()
    start = bus.sync_read("Present_Position")
    bus.sync_write("Goal_Position", {name: angle + 10.0 for name, angle in start.items()})
    time.sleep(1.5)
    seen["moved"] = {name: angle - start[name] for name, angle in bus.sync_read("Present_Position").items()}
    bus.disconnect()
    return seen


if __name__ == "__main__":
    stand_in_for_what_the_bus_does_not_use()
    sys.stdout.write(json.dumps(judge(*sys.argv[1:])) + "\n")
