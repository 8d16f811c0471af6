"""The robot: LeRobot's observations and actions on one side, a `rejoint serve --stdio` on the other."""

import json
import math
import subprocess
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from .config import RejointConfig, RejointKochConfig, RejointSo101Config, RejointViperxConfig

GRIPPER = "gripper"
DEGREES = math.degrees(1.0) * 4096 / 4095
"""LeRobot's degrees in a radian: it divides a turn of 4096 counts by 4095"""
END = 15.0
"""[s] that the program may take to bring the arm to a hold and to keep its log"""


class RejointArm(Robot):
    """An arm behind the law and the guard of `rejoint`.

    Connecting moves nothing, and disconnecting leaves the arm holding where it is: its torque is never switched off.
    Calibration stays LeRobot's: make it with `lerobot-calibrate`, with the type of LeRobot's own and the same id.
    """

    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    scheme = "feetech"
    """of the arm's address"""

    def __init__(self, config: RejointConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, Any] = {}
        if config.cameras:
            from lerobot.cameras.utils import make_cameras_from_configs

            self.cameras = make_cameras_from_configs(config.cameras)
        self._program: subprocess.Popen | None = None
        self._middle = [0.0] * len(self.joints)
        self._gripper = 0.0
        self._sent: list[float] | None = None

    @property
    def _motors(self) -> dict[str, type]:
        return {f"{name}.pos": float for name in (*self.joints, GRIPPER)}

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Positions of the six motors, and the pictures of the cameras."""
        sizes = {name: (one.height, one.width, 3) for name, one in self.config.cameras.items()}
        return {**self._motors, **sizes}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Goals of the six motors."""
        return self._motors

    @property
    def is_connected(self) -> bool:
        """Whether the arm is driven, and the cameras are there."""
        alive = self._program is not None and self._program.poll() is None
        return alive and all(camera.is_connected for camera in self.cameras.values())

    @property
    def is_calibrated(self) -> bool:
        """True: the servos hold their ranges, and `rejoint` reads them there."""
        return True

    def calibrate(self) -> None:
        """Do nothing, see the class."""

    def configure(self) -> None:
        """Do nothing: the servos' settings stay as they are."""

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - LeRobot's signature
        """Start `rejoint` and wait until it holds the arm; DeviceNotConnectedError says why it does not."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected")
        command = [
            self.config.rejoint,
            "serve",
            self._address(),
            self.config.run,
            "--stdio",
            "--period",
            f"{self.config.period_ms:g}",
        ]
        try:
            self._program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # noqa: S603
        except OSError as error:
            raise DeviceNotConnectedError(f"{command[0]} cannot be started ({error}); set --robot.rejoint") from error
        self._sent = None
        try:
            told = self._hear()
            if tuple(told["joints"]) != self.joints:
                raise DeviceNotConnectedError(f"the run is of an arm with {told['joints']}, expected {self.joints}")
            self._middle = told["middle"]
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self._end()
            raise

    def get_observation(self) -> dict[str, Any]:
        """Return the positions of the last control cycle, and pictures."""
        found = self._observed(self._ask({}))
        for name, camera in self.cameras.items():
            found[name] = camera.async_read()
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send goals; returns those that were taken, within the joints' limits.

        The arm goes there by itself, while LeRobot goes on. What is not in ``action`` stays where it was sent.
        """
        order: dict[str, Any] = {}
        if any(f"{name}.pos" in action for name in self.joints):
            goal = self._goal(action)
            order["goal"] = [degrees / DEGREES + middle for degrees, middle in zip(goal, self._middle, strict=True)]
        if f"{GRIPPER}.pos" in action:
            order["gripper"] = min(max(float(action[f"{GRIPPER}.pos"]), 0.0), 100.0)
        answer = self._ask(order)
        taken: dict[str, Any] = {}
        if answer["goal"] is not None:
            taken = self._named(answer["goal"])
            self._sent = list(taken.values())
        if "gripper" in order:
            taken[f"{GRIPPER}.pos"] = order["gripper"]
        return taken

    def disconnect(self) -> None:
        """End the drive; the arm holds where it is."""
        if self._program is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        self._end()

    def _address(self) -> str:
        """Address of the arm, with the calibration of its id where LeRobot has one."""
        port = self.config.port
        if "://" in port:
            return port
        file = Path(self.calibration_fpath)
        return f"{self.scheme}://{port}" + (f"?calibration={file}" if file.is_file() else "")

    def _goal(self, action: dict[str, Any]) -> list[float]:
        """Goals of all joints [deg]; those that are not named stay."""
        before = self._sent or list(self._named(self._ask({})["position"]).values())
        return [float(action.get(f"{name}.pos", old)) for name, old in zip(self.joints, before, strict=True)]

    def _observed(self, answer: dict[str, Any]) -> dict[str, Any]:
        if answer["gripper"] is not None:
            self._gripper = answer["gripper"]
        return {**self._named(answer["position"]), f"{GRIPPER}.pos": self._gripper}

    def _named(self, radians: list[float]) -> dict[str, float]:
        return {
            f"{name}.pos": (angle - middle) * DEGREES
            for name, angle, middle in zip(self.joints, radians, self._middle, strict=True)
        }

    def _ask(self, order: dict[str, Any]) -> dict[str, Any]:
        """Send a line and return its answer; ValueError where it is refused."""
        if self._program is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        try:
            self._program.stdin.write(json.dumps(order).encode() + b"\n")
            self._program.stdin.flush()
        except OSError as error:
            raise DeviceNotConnectedError(f"{self}: rejoint has ended ({self._code()}); the arm holds") from error
        answer = self._hear()
        if "refused" in answer:
            raise ValueError(f"rejoint refused the goal: {answer['refused']}")
        return answer

    def _hear(self) -> dict[str, Any]:
        line = self._program.stdout.readline()
        if not line:
            code = self._code()
            raise DeviceNotConnectedError(f"{self}: rejoint has ended ({code}); it said why; the arm holds")
        return json.loads(line)

    def _code(self) -> str:
        """Exit code of the program, which has ended or is about to."""
        program, self._program = self._program, None
        try:
            return f"exit code {program.wait(END)}"
        except subprocess.TimeoutExpired:
            program.terminate()
            return "without a word"

    def _end(self) -> None:
        """Close the program's input, wait until the arm holds, and close the cameras."""
        program, self._program = self._program, None
        if program is not None:
            program.stdin.close()
            try:
                program.wait(END)
            except subprocess.TimeoutExpired:
                program.terminate()
                program.wait()
            program.stdout.close()
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()


class RejointSo101(RejointArm):
    """An SO-100 or SO-101."""

    config_class, name = RejointSo101Config, "rejoint_so101"


class RejointKoch(RejointArm):
    """A Koch v1.1 follower."""

    config_class, name, scheme = RejointKochConfig, "rejoint_koch", "dynamixel"


class RejointViperx(RejointArm):
    """A ViperX 300S or WidowX 250S."""

    config_class, name, scheme = RejointViperxConfig, "rejoint_viperx", "dynamixel"
    joints = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
