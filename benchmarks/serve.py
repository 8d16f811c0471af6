"""The vendor's unmodified client against a bare worn arm and through `rejoint serve` on it: one script, errors beside.

    python -m benchmarks serve
    python -m benchmarks serve --run runs/mine --abuse 600
    python -m benchmarks serve --run runs/mine --controller predictive

The arm is an emulated one behind TCP, in wall-clock time. Without ``--run`` it is diagnosed and its twin identified
first, which takes minutes. Then a client of the second kind: reconnects, garbage, half frames, and clients killed in
the middle of a motion; at the end the arm must hold, and the log must be whole. A test runs a short version.

    python -m benchmarks serve --run runs/mine --anywhere 20

sends as many poses and postures, drawn in the whole workspace, to a healthy arm and through `rejoint serve` to the worn
one, and compares where their tools truly are.
"""

import json
import multiprocessing
import os
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import rejoint
from benchmarks.joints import clear, prepare
from benchmarks.virtual import endpoint, reset_at_end
from rejoint.arms import Array, mycobot280, tcp_pose
from rejoint.arms.rotations import difference, to_coords, to_pose
from rejoint.robots import open_robot
from rejoint.robots.mycobot.bus import MyCobot280Socket
from rejoint.robots.mycobot.wire import Frame, answer, encode, flag, pack_angles, pack_coords
from rejoint.session.motions import Serving
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import WireSession, on_port

ARM = mycobot280()
SPEED = 50
"""[%] of every order"""
LONGEST = 40.0
"""[s] that a move may take"""
ABUSE = 60.0
"""[s] of it; ten minutes by `--abuse 600`"""
READS = 400
REACH = 281.0
"""[mm] largest x and y that the client sends (pymycobot 4.0.7)"""

POSTURES = np.degrees(ARM.rest) + np.array(
    [
        [10.0, 8.0, -12.0, 5.0, 6.0, 10.0],
        [-25.0, -6.0, 8.0, -8.0, -10.0, -20.0],
        [20.0, 12.0, 6.0, -12.0, 12.0, 15.0],
        [-10.0, 4.0, -15.0, 14.0, -6.0, 40.0],
    ]
)
"""(4, 6) [deg]"""
OFFSETS = np.array([[20.0, 25.0, 10.0], [0.0, -30.0, 25.0], [-20.0, 10.0, -20.0], [15.0, -15.0, 0.0]])
"""(4, 3) [mm] of the points from the tool at rest"""


class Step(NamedTuple):
    """One order of the script, and where a perfect arm has its tool after it."""

    kind: str
    order: Callable[[Any], object]
    goal: Array
    """(6,) [mm, deg]"""


class Outcome(NamedTuple):
    """What a step left."""

    kind: str
    error: float
    """[mm]"""
    turn: float
    """[deg]"""
    seconds: float


def script() -> Iterator[Step]:
    """Angles, points, whole poses, single coordinates, jogs by increments."""
    rest = coords_at(np.degrees(ARM.rest))
    for posture in (*POSTURES, np.degrees(ARM.rest)):
        yield _step("angles", "send_angles", (_plain(posture),), coords_at(posture))
    for offset in OFFSETS:
        goal = rest + np.r_[offset, 0.0, 0.0, 0.0]
        yield _step("points", "send_coords", (_plain(goal),), goal)
    for posture in (*POSTURES[::-1], np.degrees(ARM.rest)):
        goal = coords_at(posture)
        yield _step("poses", "send_coords", (_plain(goal),), goal)
    for axis, way in ((1, 20.0), (2, -25.0), (3, 15.0)):
        goal = goal + way * np.eye(6)[axis - 1]
        yield _step("one coordinate", "send_coord", (axis, float(goal[axis - 1])), goal)
    for axis, way in ((1, -15.0), (2, 30.0), (3, 10.0)):
        goal = goal + way * np.eye(6)[axis - 1]
        yield _step("jog", "jog_increment_coord", (axis, way), goal)


def coords_at(angles: Array) -> Array:
    """Coordinates (6,) [mm, deg] of a perfect arm at ``angles`` (6,) [deg]."""
    found = to_coords(tcp_pose(ARM, np.radians(angles)))
    return np.concatenate([1e3 * found[:3], np.degrees(found[3:])])


def play(client: Any, pace: float = 1.0, steps: int | None = None) -> list[Outcome]:
    """Give the orders of the script, each when the last move has ended; AssertionError where one is refused."""
    outcomes = []
    for step in list(script())[:steps]:
        began = time.monotonic()
        if step.order(client) != 1:
            raise AssertionError(f"an order of {step.kind} was refused")
        await_rest(client, pace)
        seconds = pace * (time.monotonic() - began)
        outcomes.append(Outcome(step.kind, *_off(np.array(client.get_coords()), step.goal), seconds))
    return outcomes


def await_rest(client: Any, pace: float = 1.0) -> None:
    """Wait as a program does: until nothing moves any more, and a moment longer."""
    deadline = time.monotonic() + LONGEST
    time.sleep(0.2 / pace)
    while client.is_moving() == 1 and time.monotonic() < deadline:
        time.sleep(0.05 / pace)
    time.sleep(0.5 / pace)


def _step(kind: str, method: str, values: tuple[object, ...], goal: Array) -> Step:
    return Step(kind, lambda client: getattr(client, method)(*values, SPEED), goal)


def _plain(values: Array) -> list[float]:
    return [float(value) for value in values]


def _off(here: Array, goal: Array) -> tuple[float, float]:
    """Distance [mm] and turn [deg] between coordinates (6,) [mm, deg]."""
    seen, wanted = (to_pose(np.r_[coords[:3], np.radians(coords[3:])]) for coords in (here, goal))
    shift, turn = np.linalg.norm(difference(seen, wanted).reshape(2, 3), axis=1)
    return float(shift), float(np.degrees(turn))


class _Announced(rejoint.Observer):
    """Hands on where the arm is served, and keeps messages."""

    def __init__(self, announce: Callable[[str], object], said: list[str] | None) -> None:
        self._announce, self._said = announce, said

    def served(self, address: str) -> None:
        self._announce(address)

    def message(self, line: str) -> None:
        if self._said is not None:
            self._said.append(line)


@contextmanager
def served(robot: Any, run: Path, said: list[str] | None = None, **options: Any) -> Iterator[tuple[str, list[Serving]]]:
    """Serve ``robot`` in a thread: its address, and at the end what it was served for; ``said`` gets the messages."""
    stop, ready = threading.Event(), threading.Event()
    address: list[str] = []
    ends: list[Serving] = []
    errors: list[BaseException] = []

    def announce(at: str) -> None:
        address.append(at)
        ready.set()

    def work() -> None:
        try:
            ends.append(rejoint.serve(robot, run, stop=stop, **options, observer=_Announced(announce, said)))
        except BaseException as error:  # noqa: BLE001 - raised again below
            errors.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        ready.wait()
        if address:
            yield address[0], ends
    finally:
        stop.set()
        thread.join()
    if errors:
        raise errors[0]


def connected(address: str) -> Any:
    """Return the vendor's client."""
    return closing(MyCobot280Socket(*endpoint(address)))


def _jog(address: str) -> None:
    """Be a program that lets a joint run; for a process that is killed."""
    client = socket.create_connection(endpoint(address), 5.0)
    client.sendall(encode(Frame(0x30, bytes((1, 1, 30)))))
    time.sleep(60.0)


def attack(address: str, duration: float, seed: int = 0) -> int:
    """Connect, send garbage, half frames and orders, break off, be killed, for ``duration`` [s]; returns how often."""
    rng, until, count = np.random.default_rng(seed), time.monotonic() + duration, 0
    spawn = multiprocessing.get_context("spawn")
    while time.monotonic() < until:
        count += 1
        if count % 20 == 10:
            killed = spawn.Process(target=_jog, args=(address,))
            killed.start()
            time.sleep(rng.uniform(0.5, 3.0))
            os.kill(killed.pid or 0, signal.SIGKILL)
            killed.join()
            continue
        try:
            with closing(socket.create_connection(endpoint(address), 5.0)) as client:
                client.settimeout(1.0)
                goal = ARM.rest + rng.uniform(-0.15, 0.15, ARM.joints)
                order = encode(Frame(0x22, pack_angles(goal) + bytes((30,))))
                noise = rng.bytes(int(rng.integers(1, 400)))
                parts = (order, noise, order[:7], encode(Frame(0x20)), noise + order, b"\xfe\xfe\x1e", order * 30)
                for _ in range(int(rng.integers(1, 6))):
                    client.sendall(parts[rng.integers(len(parts))])
                    time.sleep(rng.uniform(0.0, 0.05))
                if rng.random() < 0.5:
                    reset_at_end(client)
        except OSError:
            time.sleep(0.05)  # the one before is not gone yet: refused
    return count


def holds(client: Any, pace: float = 1.0) -> bool:
    """Whether the arm comes to rest and stays there for a second."""
    await_rest(client, pace)
    before = np.array(client.get_angles())
    time.sleep(1.0 / pace)
    return bool(np.abs(np.array(client.get_angles()) - before).max() < 1.0)


def check_log(path: Path) -> int:
    """Return how many orders a log has; AssertionError unless every line is whole and no order is missing."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    numbers = [line["number"] for line in lines if line["what"] == "order"]
    if lines[0]["what"] != "begin" or numbers != list(range(1, len(numbers) + 1)):
        raise AssertionError(f"{path}: orders are missing")
    return len(numbers)


def read_times(client: Any, count: int = READS) -> Array:
    """How long reads take (count,) [ms]."""
    times = []
    for _ in range(count):
        began = time.perf_counter()
        client.get_angles()
        times.append(1e3 * (time.perf_counter() - began))
        time.sleep(0.003)
    return np.array(times)


def table(bare: list[Outcome], through: list[Outcome]) -> str:
    """Errors side by side, by kind of order."""
    lines = [
        f"{'':16}{'bare mm':>12}{'served mm':>12}{'largest':>10}{'bare deg':>10}{'served deg':>12}{'s':>6}{'s':>6}"
    ]
    for kind in (*dict.fromkeys(outcome.kind for outcome in bare), "all"):
        a, b = ([o for o in found if kind in (o.kind, "all")] for found in (bare, through))
        means = [np.mean([getattr(o, name) for o in x]) for name in ("error", "turn", "seconds") for x in (a, b)]
        most = max(o.error for o in b)
        lines.append(
            f"{kind:16}{means[0]:12.1f}{means[1]:12.2f}{most:10.2f}{means[2]:10.1f}{means[3]:12.1f}"
            f"{means[4]:6.1f}{means[5]:6.1f}"
        )
    return "\n".join(lines)


def drawn(count: int, seed: int) -> Array:
    """Postures (count, 6) [deg] anywhere in the workspace, 5 mm clear of what the arm could touch."""
    postures = (np.round(np.degrees(q), 2) for q in clear(ARM, seed))
    takes = (q for q in postures if np.abs(coords_at(q)[:2]).max() <= REACH)  # the client refuses the rest
    return np.array([*islice(takes, count)])


def roam(client: Any, count: int, tool: Callable[[], Array], pace: float = 1.0) -> Array:
    """Send ``count`` poses and as many postures; true tool errors (2, count) [mm], NaN where refused."""
    errors = np.full((2, count), np.nan)
    for row, (order, seed) in enumerate((("send_coords", 11), ("send_angles", 12))):
        for k, posture in enumerate(drawn(count, seed)):
            goal = coords_at(posture)
            if getattr(client, order)(_plain(np.round(goal, 1) if row == 0 else posture), SPEED) == 1:
                await_rest(client, pace)
                errors[row, k] = np.linalg.norm(1e3 * tool() - goal[:3])
    return errors


def healthy(count: int) -> Array:
    """Return true tool errors (2, count) [mm] of a healthy arm under the orders of `roam`, in simulated time."""
    firmware, errors = Firmware.build(ARM, "healthy"), np.full((2, count), np.nan)
    for row, (order, seed) in enumerate(((0x25, 11), (0x22, 12))):
        for k, posture in enumerate(np.radians(drawn(count, seed))):
            goal = tcp_pose(ARM, posture)
            payload = pack_coords(goal) + bytes((SPEED, 0)) if row == 0 else pack_angles(posture) + bytes((SPEED,))
            reply = answer(firmware, Frame(order, payload))
            if reply is None or reply.payload != flag(True):
                firmware.error = 0
                continue
            firmware.advance(1.0)
            while firmware.moving and firmware.plant.time[0] < LONGEST * (row * count + k + 1):
                firmware.advance(0.1)
            firmware.advance(0.5)
            errors[row, k] = 1e3 * np.linalg.norm(firmware.plant.true_tcp()[0] - goal[:3, 3])
    return errors


def anywhere(run: Path, count: int) -> None:
    """Print how far the tools of a healthy arm and of the served worn one are from what a program orders anywhere."""
    said = list[str]()
    robot: Any = open_robot("emulated:worn", seed=0)  # in virtual time
    with served(robot, run, said, listen="127.0.0.1:0") as (address, ends), connected(address) as client:
        worn = roam(client, count, lambda: robot.true_tcp()[0], 20.0)
    lines = [json.loads(line) for line in Path(ends[0].log).read_text().splitlines()]
    encoders = np.array([line["error_mm"] for line in lines if line["what"] == "arrival"])
    for kind, bare, through in zip(("send_coords", "send_angles"), healthy(count), worn, strict=True):
        both = ~np.isnan(bare) & ~np.isnan(through)
        for name, errors in (("healthy", bare), ("served", through)):
            refused = np.isnan(errors).sum()
            print(f"{kind} {name}: {np.nanmedian(errors):.1f} mm, largest {np.nanmax(errors):.1f}, {refused} refused")
        print(f"{kind}: at most 1 mm worse than healthy {(through <= bare + 1.0)[both].sum()} of {both.sum()}")
    print(f"from where it was sent, by the encoders: {np.median(encoders):.2f} mm, largest {encoders.max():.2f}")
    print(*said, sep="\n")


def main(
    run: Path | None = None,
    abuse: float = ABUSE,
    anywhere_count: Annotated[int, typer.Option("--anywhere")] = 0,
    controller: str | None = None,
) -> None:
    """Play the script, then abuse the arm for so many seconds; or only send ``--anywhere`` so many orders."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        if run is None:
            prepare("emulated:worn", ARM, folder)
        else:
            folder.mkdir()
            for file in ("run.json", "twin.toml", *(("calibration.toml",) if anywhere_count else ())):
                shutil.copy(run / file, folder / file)
        if anywhere_count:
            anywhere(folder, anywhere_count)
            return
        with on_port(WireSession(Firmware.build(ARM, "worn"))) as emulator, connected(emulator.address) as client:
            client.send_angles(_plain(np.degrees(ARM.rest)), SPEED)
            await_rest(client)
            bare, bare_reads = play(client), read_times(client)
        with (
            on_port(WireSession(Firmware.build(ARM, "worn"))) as emulator,
            served(
                emulator.address, folder, listen="127.0.0.1:0", settings=rejoint.Settings(controller=controller)
            ) as (address, ends),
        ):
            with connected(address) as client:
                through, reads = play(client), read_times(client)
            print(table(bare, through))
            print(
                f"reads: bare {np.median(bare_reads):.1f} ms, 99 % within {np.quantile(bare_reads, 0.99):.1f}; "
                f"served {np.median(reads):.1f} ms, 99 % within {np.quantile(reads, 0.99):.1f}"
            )
            count = attack(address, abuse)
            time.sleep(0.5)
            with connected(address) as client:
                print(f"{count} clients in {abuse:.0f} s, every twentieth killed; the arm holds: {holds(client)}")
        print(f"log: {check_log(Path(ends[0].log))} orders, whole")
