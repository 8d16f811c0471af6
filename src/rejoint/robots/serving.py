"""An arm offered on the myCobot's own wire, with a controller behind: its computer, answers and log.

The computer plans moves as the vendor's. The control loop calls `ServedArm.advance`; the server's thread carries out
orders. Clients see a perfect arm whose tool is where this one's is. Orders that would let the arm fall or move its
zeros are refused. When a client goes, the arm holds.
"""

import contextlib
import json
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from datetime import datetime
from io import FileIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Motors, choose_postures, tcp_position
from rejoint.arms.postures import too_heavy
from rejoint.arms.rotations import WEIGHT, Orientation, tool_axis
from rejoint.control.controllers.posture import MOVING, OFF, PostureGains, Unloading
from rejoint.control.correction import Modelled, tool_error
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.reference import Reference
from rejoint.control.robot import ControlInput, JointState
from rejoint.robots.bus import LOST
from rejoint.robots.mycobot.bus import ORDERS as NAMES
from rejoint.robots.mycobot.motion import TimedPath
from rejoint.robots.mycobot.wire import (
    ARRIVED_LENGTH,
    COLLISION,
    COMMANDS,
    FORMAT,
    NO_LINE,
    NO_SOLUTION,
    Computer,
    Frame,
    Sensed,
    answer,
    at,
    encode,
    flag,
)
from rejoint.robots.wireserver import ByteStream, Conversation, Server, TcpServer, TerminalServer, await_data
from rejoint.system.errors import RobotError
from rejoint.system.files import writing

IN_PLACE = PostureGains.close
"""[m] of the tool at the end of a move: where the controller rests"""
CALM = 0.3
"""[s] there (chosen: longer than a worn joint rings)"""
STANDS = 0.15
"""[s] for which a stopped arm is slow before it is held (chosen)"""
PATIENCE = 8.0
"""[s] of bringing it nearer (chosen: worn joints stick for seconds)"""
LONGEST = 0.1
"""[s] of the reference per cycle at most (chosen)"""
TOUCH = 1e-6
"""[m] of rounding in comparisons of goals (chosen)"""
_SMOOTHING = 0.5  # share of the newest difference in the speed that is told (chosen)


class MoveEnd(NamedTuple):
    """The end of a move."""

    error: float
    """[m] of the tool from its goal, by the encoders"""
    angle: float
    """[rad] of the joint that is farthest away"""
    after: float
    """[s] from the end of the planned way"""
    held_back: str
    """what the guard kept it from, or empty"""
    short: str
    """which joint stands off its goal, in words, or empty"""


class ServedArm(Computer, Reference):
    """One arm of n joints at rest at ``position`` (n,) [rad]."""

    def __init__(
        self,
        arm: Arm,
        position: Array,
        *,
        apparent: Modelled,
        limits: GuardLimits | None = None,
        motors: Motors | None = None,
    ) -> None:
        """``apparent``: the arm that clients see. Refuses orders that ``limits`` or ``motors`` rule out."""
        self._limits, self._motors = limits, motors
        self.note = ""
        """what a motor is too weak for in the last order, or empty"""
        self._apparent = apparent
        self._unloading = Unloading(arm, motors)
        super().__init__(arm, self._apparent.shown(position))
        self.lock = threading.RLock()
        """keeps the control loop from half-changed plans"""
        self.on_arrival: Callable[[MoveEnd], object] = lambda _: None
        """is told how each move ended"""
        self.held_back = ""
        """what the guard keeps the arm from now, in words"""
        self._state = JointState(time=np.full(1, np.inf), position=position[None].copy(), age=np.zeros(1))
        self._seen, self._speed = time.monotonic(), np.zeros(arm.joints)
        self._aim = position.copy()
        self._goal, self._arrived = self._aim[None], np.ones(1, dtype=bool)
        # when [s] the reference ended its way; inf while it moves
        self._since = np.inf
        self._settled = True
        # when [s] the tool came within `IN_PLACE`, or a stopped arm became slow; inf where it is not
        self._calm_since = np.inf
        # whether the move was stopped: it ends where the arm comes to stand
        self._stopped = False

    # --- what the control loop does ---------------------------------------------------------

    def advance(self, now: ControlInput) -> ControlInput:
        """Take a reading; return where the arm is to be."""
        if self.lock.acquire(blocking=False):  # else a posture is being searched: the reference waits
            try:
                self._observe(now.state)
                under_way = self.motion.moving or (self.motion.paused and not self._settled)
                if under_way or np.isinf(self._since):
                    self._aim = self._apparent.measured(self.motion.reference)
                wanted = replace(now, goal=self._aim[None], arrived=np.array([not under_way]))
                if not (self._settled or self._stopped):
                    wanted = self._unloading.advance(wanted)
                self._goal, self._arrived = wanted.goal, wanted.arrived
                self._judge()
            finally:
                self.lock.release()
        return replace(now, goal=self._goal, arrived=self._arrived)

    def _observe(self, state: JointState) -> None:
        before, self._state, self._seen = self._state, state, time.monotonic()
        elapsed = state.time[0] - before.time[0]
        if elapsed > 0.0:
            self._speed += _SMOOTHING * ((state.position[0] - before.position[0]) / elapsed - self._speed)
            self.motion.advance(min(elapsed, LONGEST))

    def _judge(self) -> None:
        """End a move whose tool stays in place, that was stopped and stands, or that came no nearer for long."""
        if not self._arrived[0]:
            self._since, self._settled, self._calm_since = np.inf, False, np.inf
            return
        now, position = self._state.time[0], self._state.position[0]
        self._since = min(self._since, now)
        if self._settled:
            return
        posture, after = self._goal[0], now - self._since
        error = float(tool_error(self.arm, position, tcp_position(self.arm, posture)))
        away = np.abs(posture - position).max()
        if self._stopped:
            calm, lasts = bool((np.abs(self._speed) < MOVING).all()), STANDS
        else:
            calm, lasts = error < IN_PLACE and (away < OFF or self._unloading.given_up), CALM
        self._calm_since = min(self._calm_since, now) if calm else np.inf
        if now - self._calm_since < lasts and after <= PATIENCE:
            return
        held_back = self.held_back if error > ARRIVED_LENGTH else ""
        self._settled = True
        if self._stopped or held_back:  # what is ordered next begins where the arm is, not where it will never come
            self._stay()
            self._aim = position.copy()
            self._goal = self._aim[None]
        if not self._stopped:
            short = self._unloading.short(position)
            self.on_arrival(MoveEnd(error=error, angle=away, after=after, held_back=held_back, short=short))

    def _stay(self) -> None:
        self.motion.place(slice(None), np.clip(self.angles, self.lower, self.upper))

    # --- what clients ask -------------------------------------------------------------------

    @property
    def is_lost(self) -> bool:
        """Whether the robot has not answered for `LOST`."""
        return time.monotonic() - self._seen > LOST

    @property
    def angles(self) -> Array:
        """(n,) [rad] shown joint angles."""
        return self._apparent.shown(self._state.position[0])

    @property
    def sensed(self) -> Sensed:
        """What the robot tells, else zeros."""
        none, heat, fault = np.zeros(self.arm.joints), self._state.temperature, self._state.fault
        return Sensed(
            speed=self._speed,
            current=none,
            voltage=none,
            temperature=none if heat is None else heat[0],
            alarms=(none if fault is None else fault[0]).astype(np.uint8),
        )

    @property
    def moving(self) -> bool:
        """Whether a move or its last approach is under way."""
        return not self.motion.paused and (self.motion.moving or not self._settled)

    def is_at(self, goal: Array) -> bool:
        """Whether the arm is at angles (n,) [rad], or its tool at a pose (4, 4), after the move."""
        planned, pose = (self.planned_angles, self.pose_at(goal)) if goal.ndim == 1 else (self.planned_pose(), goal)
        if not at(planned, goal):
            return super().is_at(goal)
        return not self.moving and bool(np.linalg.norm(self.pose[:3, 3] - pose[:3, 3]) < ARRIVED_LENGTH)

    # --- what clients order -----------------------------------------------------------------

    def stop(self, joint: int | None = None) -> None:
        """Hold one joint where the reference is, or the arm where it is: it may be far behind."""
        under_way = self.motion.moving or not self._settled
        self.motion.hold(joint)
        if joint is None and under_way:
            self._stay()
            self._since, self._settled, self._stopped = np.inf, False, True

    def stand_by(self) -> None:
        """Hold: no client sees a swing; only a last approach goes on."""
        if self._unloading.give_up() or self.motion.moving:
            self.stop()
        self.motion.paused = False

    def pause(self, on: bool) -> None:
        """Hold or continue; a swing ends where it is."""
        if on and self._unloading.give_up():
            self.stop()
        super().pause(on)

    def _posture(self, pose: Array, start: Array, *, turned: bool) -> Array | None:
        turn = Orientation(
            rotation=pose[None, :3, :3],
            whole=np.ones(1, dtype=bool),
            weight=np.full(1, WEIGHT),
            axis=tool_axis(self.arm),
        )
        found = self._held(pose, start, turn)
        if found is not None:
            return found
        found = super()._posture(pose, start, turned=turned)
        if found is None or turned or self._too_heavy(found)[0] is None:
            return found
        alone = self._held(pose, start, None)
        if alone is not None:
            self.note = f"with this orientation {self._too_heavy(found)[1]}; the tool comes there turned otherwise"
        return found if alone is None else alone

    def _held(self, pose: Array, start: Array, turn: Orientation | None) -> Array | None:
        """Return a posture (n,) [rad] that the motors hold, or None."""
        found = choose_postures(self.arm, pose[None, :3, 3], start, turn=turn, motors=self._motors, thorough=False)
        return None if found.refusals[0] else found.q[0]

    def _too_heavy(self, angles: Array) -> tuple[int | None, str]:
        """Return the joint that cannot hold ``angles`` (n,) [rad], and why, or None."""
        if self._motors is None:
            return None, ""
        return too_heavy(self.arm, self._apparent.measured(angles), self._motors.most)

    def _is_clear(self, angles: Array) -> bool:
        """Whether motors and guard allow ``angles`` (n,) [rad]; in contact it may go nearer to what is clear."""
        joint, why = self._too_heavy(angles)
        if joint is not None:
            self.error, self.note = joint + 1, f"too heavy: {why} (error {joint + 1})"
            return False
        if self._limits is None:
            return True
        goal, here = (self._apparent.measured(one) for one in (angles, self.planned_angles))
        clear = clear_by(self._limits, np.stack([goal, here]))
        if (clear[0] >= np.minimum(clear[1], 0.0) - TOUCH).all():
            return True
        self.error = COLLISION
        return False

    def _reach(self, path: TimedPath) -> int:
        inside, error = super()._reach(path), self.error
        reach = next((k for k in range(1, inside) if not self._is_clear(path.points[k])), inside)
        self.error = error  # a jog ends there, and is no wrong order
        return reach

    def _ready(self) -> bool:
        self._settled, self._since, self._stopped = False, np.inf, False
        return True


class OrderLog:
    """Writes to ``path``; FileError."""

    def __init__(self, path: Path, *, say: Callable[[str], object]) -> None:
        self.path, self._say = path, say
        self.orders = 0
        """so far"""
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: FileIO | None = path.open("ab", buffering=0)

    def ordered(self, order: Frame, *, done: bool, why: str = "") -> int:
        """Write an order, whether it is carried out and why not; returns its number."""
        self.orders += 1
        name, because = NAMES.get(order.command, f"0x{order.command:02x}"), {"why": why} if why else {}
        self.write("order", number=self.orders, name=name, payload=order.payload.hex(), done=done, **because)
        return self.orders

    def write(self, what: str, **found: object) -> None:
        """Write one line at once, safe from a killed process; the loop and the server write."""
        line = json.dumps({"date": datetime.now().isoformat(timespec="milliseconds"), "what": what, **found}) + "\n"
        file = self._file
        if file is None:
            return
        try:
            file.write(line.encode())
        except OSError as error:
            self.close()
            self._say(f"{self.path}: cannot be written any more ({error.strerror}); the arm goes on without")

    def close(self) -> None:
        """End the log."""
        file, self._file = self._file, None
        if file is not None:
            file.close()


RELAY_PATIENCE = 0.25
"""[s] for which the server waits (chosen: clients over TCP give up after 0.3)"""

SILENT = 2
"""Lost answers in a row after which a command is not passed on again (chosen: one may be lost on the wire)"""

Passes = Callable[[int, bytes], bytes | None]
"""Asks the robot by id and payload; None: no answer"""


_FALLS = "the arm would fall; support it and switch it off at its supply"
_STAYS = "it would change what the run knows of the arm; end `rejoint serve` first"
_OWN = "coordinates are those of the arm's own tool in its own base; the tip of a tool is told by --tool"
_OTHER_FRAME = {0x81: _OWN, 0x83: _OWN, 0x85: _OWN, 0x87: "straight lines are asked for with each order", 0x89: _OWN}
REFUSED = {0x11: _FALLS, 0x13: _FALLS, 0x1A: _FALLS, 0x56: _FALLS, 0x52: _STAYS, 0x54: _STAYS}
"""Refused orders, and why; 0x1A with 0 is allowed"""
PASSED_ON = frozenset((0x53, 0x60, 0x61, 0x62, *range(0x64, 0x70), 0xA0, 0xA1))
"""Registers of servos, gripper, lamp and pins (pymycobot 4.0.7, `ProtocolCode`)"""
# Those of them that change nothing
_ASKS = frozenset((0x53, 0x62, 0x65, 0x69, 0x6B, 0x6E, 0xA1))
CLEAR_ERROR = 0x08
AGAIN = 10.0
"""[s] after which the same refusal is said again (chosen)"""
MOVES = frozenset((0x21, 0x22, 0x24, 0x25, *range(0x30, 0x35), 0x3A, 0x3C))
_REASONS = {
    0: "the queue is full, or there is no such joint, axis or value",
    NO_SOLUTION: "no posture of the arm brings the tool there (error 32)",
    COLLISION: f"the guard keeps the arm from there: it would touch the ground, a box or itself (error {COLLISION})",
    NO_LINE: "the arm cannot follow a straight line there (error 33)",
    **{joint: f"joint {joint} would go beyond its limit (error {joint})" for joint in range(1, 7)},
}
_UNFINISHED = " Its last move was not at its end: a program waits for it with sync_send_angles or is_moving."


class Clients(Conversation[Frame]):
    """Answers the clients of ``served``, one at a time; ``say`` tells the terminal."""

    wire_format = FORMAT

    def __init__(
        self,
        served: ServedArm,
        log: OrderLog,
        passes: Passes | None,
        say: Callable[[str], object],
        listener: socket.socket | None = None,
    ) -> None:
        self._served, self._log, self._passes, self._say, self._listener = served, log, passes, say, listener
        self._number: int | None = None
        self._waiting: tuple[Frame, Future[bytes | None]] | None = None  # what the loop is to pass on
        self._lost = Counter[int]()  # answers of the robot to a command, the last ones in a row
        self._said: dict[str, float] = {}  # what was said -> when [s] last

    def server(self) -> Server:
        """Serve on the listening socket, or without one on a pseudo-terminal."""
        return TerminalServer(self) if self._listener is None else TcpServer(self, self._listener)

    def came(self, client: str) -> None:
        """Say that a client is there."""
        self._served.error = 0  # of an order by another
        self._say(f"A client is there: {client}.")

    def left(self, client: str) -> None:
        """Let the arm hold."""
        with self._served.lock:
            unfinished = self._served.moving
            self._served.stand_by()
        self._log.write("hold", why=client, on_its_way=unfinished)
        self._say(f"{client[0].upper()}{client[1:]}; the arm holds.{_UNFINISHED * unfinished}")

    def arrived(self, arrival: MoveEnd) -> None:
        """Write how a move ended; for the control loop."""
        self._log.write(
            "arrival",
            number=self._number,
            error_mm=round(1e3 * arrival.error, 3),
            farthest_joint_rad=round(arrival.angle, 5),
            after_s=round(arrival.after, 3),
            **{name: told for name in ("held_back", "short") if (told := getattr(arrival, name))},
        )
        if arrival.error > ARRIVED_LENGTH or arrival.short:
            cause = f"the guard kept it back ({arrival.held_back})" if arrival.held_back else arrival.short
            away = f" {1e3 * arrival.error:.0f} mm from where it was sent" * (arrival.error > ARRIVED_LENGTH)
            cause = cause or "it came no nearer"
            self._say_again(f"A move ended{away}: {cause}.", about=cause)

    def answer(self, request: Frame) -> Frame | None:
        """Carry out ``request``; None: silence."""
        command, payload = request.command, request.payload
        if command in PASSED_ON:
            return self._pass_on(request)
        why = "" if command == 0x1A and payload[:1] == b"\x00" else REFUSED.get(command, "")
        if why:
            return self._refuse(request, why)
        if command not in COMMANDS:
            return None if self._served.is_lost else answer(self._served, request)
        with self._served.lock:
            error, self._served.error, self._served.note = self._served.error, 0, ""
            reply, found, note = answer(self._served, request), self._served.error, self._served.note
            if command != CLEAR_ERROR:
                self._served.error = found or error
        if reply is None:
            return None  # not well formed
        if reply.payload != flag(True):
            return self._refuse(request, _OTHER_FRAME.get(command) or note or _REASONS[found])
        if note:
            self._say_again(f"{NAMES[command]}: {note}.")
        number = self._log.ordered(request, done=True, why=note)
        if command in MOVES:
            self._number = number
        return reply

    def _refuse(self, request: Frame, why: str) -> Frame:
        self._log.ordered(request, done=False, why=why)
        self._say_again(f"Refused {NAMES.get(request.command, hex(request.command))}: {why}")
        return Frame(request.command, flag(False))

    def _pass_on(self, request: Frame) -> Frame | None:
        found, future = None, Future[bytes | None]()
        if self._passes is not None and self._lost[request.command] < SILENT:
            self._waiting = request, future
            with contextlib.suppress(TimeoutError):
                found = future.result(RELAY_PATIENCE)
            future.cancel()  # what the log calls not done is not done later
        if request.command not in _ASKS:
            why = "" if found is not None else "the robot does not answer it, or its driver cannot pass it on"
            self._log.ordered(request, done=found is not None, why=why)
        return None if found is None else Frame(request.command, found)

    def relay(self) -> None:
        """Pass on what waits for the robot; for the control loop."""
        waiting, self._waiting = self._waiting, None
        if waiting is None or self._passes is None or not waiting[1].set_running_or_notify_cancel():
            return
        (request, future), answer = waiting, None
        with contextlib.suppress(RobotError):
            answer = self._passes(request.command, request.payload)
        self._lost[request.command] = 0 if answer is not None else self._lost[request.command] + 1
        future.set_result(answer)

    def _say_again(self, line: str, about: str = "") -> None:
        now, about = time.monotonic(), about or line
        if now - self._said.get(about, -AGAIN) >= AGAIN:
            self._said[about] = now
            self._say(line)

    def _answer(self, channel: ByteStream, request: Frame) -> None:
        found = self.answer(request)
        if found is not None:
            channel.send(encode(found))

    def _look(self, readable: int | None) -> None:
        if self._listener is None or readable is None or readable == self._listener.fileno():
            return
        ready = [handle for handle in (self._listener.fileno(), readable) if await_data(handle, 0.0)]
        if self._listener.fileno() not in ready or (readable in ready and _is_gone(readable)):
            return
        with contextlib.suppress(OSError):
            connection, there = self._listener.accept()
            connection.close()
            self._say_again(f"Refused a second client, {there[0]}: one at a time drives the arm.")


def _is_gone(handle: int) -> bool:
    try:
        with socket.socket(fileno=os.dup(handle)) as present:
            return not present.recv(1, socket.MSG_PEEK)
    except OSError:
        return True
