"""What clients ordered and what became of it: lines of JSON, written as they come.

A line has the local date, what happened, and what belongs to it. Questions are not written one by one: each order says
how many came since the line before it. A disk that is full ends the log and says so once; the arm goes on.
"""

from __future__ import annotations

import json
import os
import threading
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from rejoint.system.files import unwritable

NAMES = {
    0x05: "clear_queue", 0x08: "clear_error_information", 0x10: "power_on", 0x11: "power_off",
    0x13: "release_all_servos", 0x16: "set_fresh_mode", 0x1A: "set_free_mode", 0x21: "send_angle", 0x22: "send_angles",
    0x24: "send_coord", 0x25: "send_coords", 0x26: "pause", 0x28: "resume", 0x29: "stop", 0x30: "jog_angle",
    0x31: "jog_rpy", 0x32: "jog_coord", 0x33: "jog_increment_angle", 0x34: "jog_increment_coord", 0x3A: "set_encoder",
    0x3C: "set_encoders", 0x3E: "set_encoders_drag", 0x4C: "set_joint_min", 0x4D: "set_joint_max",
    0x52: "set_servo_data", 0x54: "set_servo_calibration", 0x55: "joint_brake", 0x56: "release_servo",
    0x57: "focus_servo", 0x60: "set_pin_mode", 0x61: "set_digital_output", 0x66: "set_gripper_state",
    0x67: "set_gripper_value", 0x68: "set_gripper_calibration", 0x6A: "set_color", 0x6D: "set_gripper_mode",
    0x6F: "set_gripper_torque", 0x81: "set_tool_reference", 0x83: "set_world_reference", 0x85: "set_reference_frame",
    0x87: "set_movement_type", 0x89: "set_end_type", 0xA0: "set_basic_output",
}  # fmt: skip
"""Orders by the names that the vendor's client gives them"""


class OrderLog:
    """Writes to ``path``; without one it only counts. FileError where the file cannot be begun."""

    def __init__(self, path: Path | None = None, *, say: Callable[[str], object] = lambda _: None) -> None:
        self.path = path
        self.orders = 0
        """so far"""
        self._say, self._lock = say, threading.Lock()
        self._questions: Counter[str] = Counter()
        self._handle: int | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            except OSError as error:
                raise unwritable(path, error) from error

    def asked(self, command: int) -> None:
        """Count a question."""
        self._questions[f"0x{command:02x}"] += 1

    def ordered(self, command: int, payload: bytes, *, done: bool, why: str = "") -> int:
        """Write an order: whether it is carried out, and why not; returns its number, from 1."""
        with self._lock:
            self.orders += 1
            number = self.orders
        words = {"why": why} if why else {}
        questions, self._questions = dict(self._questions), Counter()
        self.write(
            "order", number=number, name=NAMES.get(command, f"0x{command:02x}"), payload=payload.hex(),
            done=done, **words, questions_before=questions,
        )  # fmt: skip
        return number

    def write(self, what: str, **found: object) -> None:
        """Write one line; it is with the system when this returns, so that a killed process loses nothing."""
        line = json.dumps({"date": datetime.now().isoformat(timespec="milliseconds"), "what": what, **found}) + "\n"
        with self._lock:
            try:
                if self._handle is not None:
                    os.write(self._handle, line.encode())
            except OSError as error:
                self._end()
                self._say(f"{self.path}: cannot be written any more ({error.strerror}); the arm goes on without")

    def close(self) -> None:
        """End the log."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None
