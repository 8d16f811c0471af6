"""How hard the emulator is to kill: fuzzed requests, connections opened and dropped, an hour without a rest.

`make test` runs shorter versions of the same functions.
"""

import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from benchmarks.virtual import START, VirtualClient, endpoint, reset_at_end
from rejoint.arms import mycobot280
from rejoint.robots.mycobot.wire import FORMAT, MAX_PAYLOAD, ROWS, Frame, answer, encode, pack_angles
from rejoint.robots.wireserver import Finder, Server
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import WireSession, on_port

FRAMES, CONNECTIONS, SOAK = 1_000_000, 10_000, 3600.0
"""How many requests and connections, and how long [s] the soak is"""

GET_ANGLES = encode(Frame(0x20))
KNOWN = [*ROWS]
_SEARCHING = (0x24, 0x25, 0x31, 0x32, 0x34, 0x8D)
"""Requests that need inverse kinematics, tens of milliseconds each: drawn in one of `_SELDOM` cases only."""
_SELDOM = 1000
_QUICK = [request for request in KNOWN if request[0] not in _SEARCHING]
_SLOW = [request for request in KNOWN if request[0] in _SEARCHING]


def streams(rng: np.random.Generator, count: int) -> Iterator[bytes]:
    """Frames as they arrive: known and unknown ones, of all contents, some of them damaged on the way."""
    for _ in range(count):
        kind = rng.integers(_SELDOM)
        if kind < _SELDOM // 10:
            command, size = int(rng.integers(256)), int(rng.integers(MAX_PAYLOAD + 1))
        else:
            table = _SLOW if kind == _SELDOM - 1 else _QUICK
            command, size = table[rng.integers(len(table))]
        yield _damaged(rng, encode(Frame(command, _payload(rng, size))))


def _payload(rng: np.random.Generator, size: int) -> bytes:
    kind = rng.integers(3)
    if kind == 0:  # values that a move accepts
        words = rng.integers(-9000, 9000, size // 2 + 1).astype(">i2").tobytes()
        return words[: size - size % 2] + rng.integers(0, 8, size % 2).astype(np.uint8).tobytes()
    if kind == 1:  # the ends of all ranges, small ids, pieces of frames
        return rng.choice(np.array([0, 1, 2, 6, 7, 0x7F, 0x80, 0xFA, 0xFE, 0xFF], np.uint8), size).tobytes()
    return rng.bytes(size)


def _damaged(rng: np.random.Generator, frame: bytes) -> bytes:
    kind, place = rng.integers(20), int(rng.integers(len(frame)))
    if kind == 0:
        return frame[:place]
    if kind == 1:
        return frame[:place] + rng.bytes(1) + frame[place + 1 :]
    if kind == 2:
        return frame[:place] + rng.bytes(int(rng.integers(40))) + frame[place:]
    return frame


def fuzz(firmware: Firmware, count: int, seed: int = 0) -> Counter[str]:
    """Let the firmware answer ``count`` fuzzed frames; raises what it raises. Returns how many came to what end."""
    rng, decoder, ends = np.random.default_rng(seed), Finder(FORMAT), Counter[str]()
    for number, stream in enumerate(streams(rng, count)):
        for request in decoder.feed(stream):
            reply = answer(firmware, request)
            ends["answered" if reply else "ignored"] += 1
            if reply is not None and reply.command != request.command:
                raise AssertionError(f"{request} was answered by {reply}")
        if number % 16 == 0:
            decoder.expire()
            firmware.advance(rng.uniform(0.0, 0.03))
            if not np.isfinite([*firmware.angles, *firmware.planned_angles, *firmware.destination]).all():
                raise AssertionError(f"not a posture after {number} frames: {firmware.angles}")
    return ends


def drop_connections(server: Server, count: int, seed: int = 0) -> None:
    """Open ``count`` connections and drop them in every way; AssertionError if an answer is not the expected one.

    Every second one waits for an answer before it does its worst: of those that do not wait, the third in a row would
    find the backlog full and had to try again after a second.
    """
    rng = np.random.default_rng(seed)
    for number in range(count):
        with closing(socket.create_connection(endpoint(server.address), 10.0)) as client:
            if number % 2:
                client.sendall(GET_ANGLES)
                if client.recv(100)[:4] != b"\xfe\xfe\x0e\x20":
                    raise AssertionError("the angles were asked for, and something else came")
            client.sendall((b"", GET_ANGLES, GET_ANGLES[:4], GET_ANGLES * 20, rng.bytes(500))[rng.integers(5)])
            if rng.random() < 0.5:
                reset_at_end(client)


def swing(period: float = 0.05) -> Iterator[bytes]:
    """Ask for the joint angles and send new ones, every ``period`` [s], for ever."""
    rest, wave = mycobot280().rest, np.radians([25.0, 10.0, 10.0, 15.0, 20.0, 30.0])
    cycle = 0
    while True:
        yield GET_ANGLES
        goal = rest + wave * np.sin(2 * np.pi * 0.1 * cycle * period)
        yield encode(Frame(0x22, pack_angles(goal) + bytes((100,))))
        cycle += 1


class Soak:
    """A robot that is driven without a rest, in virtual time."""

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        firmware.fresh = True
        self._client = VirtualClient(firmware)
        self._client.sent = self._count
        self._before = firmware.plant.time[0]
        self._requests = swing()
        self.answers = 0

    def run(self, duration: float) -> None:
        """Go on for ``duration`` [s]."""
        end = self._client.now + duration

        def until_the_end() -> Iterator[bytes]:
            while self._client.now < end:
                yield next(self._requests)

        self._client.ask(until_the_end(), pause=0.015)

    @property
    def drift(self) -> float:
        """[s] by which the robot's clock is ahead of the world's."""
        self._client.wait(0.0)
        return (self._firmware.plant.time[0] - self._before) - (self._client.now - START)

    def _count(self, _now: float, _data: bytes) -> None:
        self.answers += 1


def resident() -> float:
    """[MB] of memory that this process holds now."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def descriptors() -> int:
    """Return how many files and sockets this process holds open."""
    return len(list(Path("/proc/self/fd").iterdir()))


def _bench_fuzz(firmware: Firmware) -> None:
    fuzz(firmware, 20_000, seed=1)
    before, began = resident(), time.perf_counter()
    ends = fuzz(firmware, FRAMES)
    print(
        f"{FRAMES} fuzzed frames: {ends['answered']} answered, {ends['ignored']} ignored, none raised; "
        f"memory grew by {resident() - before:.1f} MB; {time.perf_counter() - began:.0f} s"
    )


def _bench_connections(firmware: Firmware) -> None:
    session = WireSession(firmware)
    session.state = session.acknowledgement = 0.0
    with on_port(session) as server:
        drop_connections(server, 500, seed=1)
        time.sleep(0.2)  # for the last ones to be noticed
        before, began = (resident(), descriptors(), threading.active_count()), time.perf_counter()
        drop_connections(server, CONNECTIONS)
        time.sleep(0.2)
        print(
            f"{CONNECTIONS} connections opened and dropped: memory grew by {resident() - before[0]:.1f} MB, "
            f"descriptors by {descriptors() - before[1]}, threads by {threading.active_count() - before[2]}; "
            f"{time.perf_counter() - began:.0f} s"
        )


def _bench_soak(firmware: Firmware) -> None:
    soak, began = Soak(firmware), time.perf_counter()
    soak.run(SOAK / 12)
    before = resident()
    soak.run(SOAK * 11 / 12)
    print(
        f"{SOAK:.0f} s of driving in virtual time: {soak.answers} answers, the clock is off by "
        f"{soak.drift * 1e3:+.2f} ms, memory grew by {resident() - before:.1f} MB after the first twelfth; "
        f"{time.perf_counter() - began:.0f} s"
    )


def main() -> None:
    for bench in (_bench_fuzz, _bench_connections, _bench_soak):
        bench(Firmware.build(mycobot280(), "worn"))
