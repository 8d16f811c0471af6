"""What a control cycle of an SO-101 costs: time on the bus, and time of the processor, at the emulated bus.

The emulator runs in a process of its own, on a pseudo-terminal, as slow as the wire and a USB adapter are. In turn with
the driver, the same bytes are exchanged without it: what they take beyond the time on the wire is the emulator's and
the system's, and what the driver takes beyond that is its own and that of the maker's client.

With the recordings of a real SO-101, `python -m benchmarks feetech LOGS`, how well the plant on the law of its
servos predicts them: open loop, from the first measured pose, with the acceleration that LeRobot
sets. With `gains` instead of LOGS, what gains of the servos leave of the error at ten targets, in virtual time. With
`joints ADDRESS RUN`, how near an arm comes to joint goals that a program sends: as they are, and through a session.
"""

import os
import select
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer

from benchmarks.frame import process
from rejoint.arms import load_arm, solve_position, tcp_position
from rejoint.control.comparison.protocols import metrics_of
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.logs.importing import import_logs
from rejoint.robots import open_robot, place_of
from rejoint.robots.feetech import KIND
from rejoint.robots.feetech.bus import MEASURED, FeetechBus
from rejoint.robots.wireserver import Finder
from rejoint.session.session import connect
from rejoint.system.errors import NoReplyError
from rejoint.twin.judge import judge
from rejoint.twin.twin import NO_TWIN
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.emulator.feetech import FORMAT, StsArm, encode
from rejoint_lab.emulator.servobus import ADAPTER, BROADCAST, BYTE, SYNC_READ, SYNC_WRITE, Packet
from rejoint_lab.plant.plant import Plant, StsPlant
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("so101")
CYCLES = 2000
PAUSE = 0.005
"""[s] between two of them (chosen: enough to sleep, as in a control period of 20 ms)"""
DELAY = 0.005
"""[s] from a command to the servos (chosen: half of what the twin's fit finds at most; the error is flat there)"""
DWELL = 5.0
"""[s] at each target"""
SETTLING = 1.5
"""[s] that an arm is given to come to rest at a joint goal"""
BUS, PROCESSOR = 3.0, 0.3
"""[ms] that a cycle should take at most, at the 99th percentile"""


def timed(work):
    """Return the times [s] that ``work`` takes, by the clock and of the processor."""
    began, worked = time.perf_counter(), time.thread_time()
    work()
    return time.perf_counter() - began, time.thread_time() - worked


def exchange(line, write, read, size):
    """Write both packets to a terminal, and wait for ``size`` bytes: what any driver has to do at least."""
    os.write(line, write)
    os.write(line, read)
    while size and select.select([line], [], [], 0.05)[0]:
        size -= len(os.read(line, size))


def bus_cost(name, kind, asked, bars):
    """Print what a cycle of an arm takes, by the clock and of the processor, with the driver and without.

    ``kind`` is the driver's class. ``asked(bus, goal)`` returns both packets, the size of the answer, and what these
    take on the wire and in the adapter [s]; ``bars`` from that what is asked for [ms].
    """
    with process("emulate", "--arm", name, "--pty") as address:
        place = place_of(address)
        with closing(kind(place.detail, load_arm(name))) as bus:
            bus.open()
            bus.prepare()
            rest, line = bus.read().position, os.open(place.detail.wire.device, os.O_RDWR | os.O_NOCTTY)
            taken = np.full((CYCLES, 2, 2), np.nan)
            for k, (driven, bare) in enumerate(taken):
                goal = rest + 0.05 * np.sin(k / 20)
                *request, least = asked(bus, goal)
                time.sleep(PAUSE)
                try:
                    driven[:] = timed(lambda goal=goal: (bus.send(goal), bus.read()))
                except (TimeoutError, NoReplyError):  # a busy machine: the emulator was late
                    bus.resynchronise(time.monotonic() + 1.0)
                time.sleep(PAUSE)
                bare[:] = timed(lambda request=request: exchange(line, *request))
            os.close(line)
            servos = len(bus.ids)
    print(f"{name}, {servos} servos: {1e3 * least:.2f} ms on the wire and in the adapter at least")
    for column, (what, most) in enumerate(zip(("bus", "processor"), bars(1e3 * least), strict=True)):
        for who, times in zip(("driver", "without"), 1e3 * taken[..., column].T, strict=True):
            shown = ", ".join(f"p{share} {np.nanpercentile(times, share):.2f}" for share in (10, 50, 90, 99))
            print(f"{what:10s} {who:8s} {shown} ms" + f" (at most {most:.2f} ms is asked for)" * (who == "driver"))


def asked_of(bus, goal):
    """Return the packets of a cycle, the size of the answer, and their time [s] on the wire and in the adapter."""
    pairs = zip(bus.ids, bus.zeros.counts(goal), strict=True)
    goals = b"".join(bytes([servo, *count.to_bytes(2, "little")]) for servo, count in pairs)
    write = encode(Packet(BROADCAST, SYNC_WRITE, bytes([KIND.registers["goal"].address, 2]) + goals))
    read = encode(Packet(BROADCAST, SYNC_READ, bytes([*bus.span(MEASURED), *bus.ids])))
    size = (bus.span(MEASURED)[1] + 6) * len(bus.ids)  # header, ID, length, errors, checksum
    answers = StsArm.build(ARM, "so101").execute(Finder(FORMAT).feed(read)[0])
    return write, read, size, (len(write) + len(read)) * BYTE + answers[-1].after + ADAPTER


def measure_so101():
    """Print what a cycle of an SO-101 takes."""
    bus_cost("so101", FeetechBus, asked_of, lambda _: (BUS, PROCESSOR))


def predict(folder):
    """Print the errors of two plants on the motions in ``folder``: that of the law, and that of a linear servo."""
    wear = load_wear("so101", ARM)
    with TemporaryDirectory() as kept:
        folder = Path(folder)
        names = sorted(path.name for path in folder.iterdir() if (path / "control.csv").exists())
        logs = [import_logs(folder / name, ARM, out=Path(kept) / name).logs[0] for name in names]
    paths = {NO_TWIN: [log.command[np.maximum(np.arange(len(log)) - 1, 0)] for log in logs]}
    for name, kind in (("linear servo", Plant), ("law of the firmware", StsPlant)):
        paths[name] = [replay(kind(ARM, [wear], seed=0), log) for log in logs]
    found = judge(ARM, paths, logs)
    print(f"{len(logs)} motions; free space, means over motions")
    for name, errors in found.mean.items():
        print(f"{name:20s} tool {1e3 * errors.free.tcp:.2f} mm, joints {np.degrees(errors.free.joint):.2f} deg")


def gains():
    """Print what gains of the servos leave of the error at ten targets, alone and under the integrator."""
    targets = ARM.targets.sample(np.random.default_rng(0), (10,))
    for p, i in ((16, 0), (32, 0), (48, 0), (48, 4), (64, 8)):
        found = [_settled(controller(ARM), targets, p, i) for controller in (DefaultController, IntegratorController)]
        print(f"| {p}, {i} | {found[0]:.1f} | {found[1]:.1f} |")


def _settled(controller, targets, p, i):
    """Mean distance [mm] of the tool by the encoders from its target in the last second of `DWELL`."""
    gains = {"p": p, "i": i}
    robot = EmulatedRobot(ARM, [load_wear("so101", ARM)], seed=0, channel=Channel(period=(0.020, 0.020)), gains=gains)
    recording = run(robot, controller, targets[None], Schedule(dwell=DWELL))
    return 1e3 * metrics_of(ARM, recording, targets[None], Protocol(hold=DWELL))["settled"].mean()


def joints(address, run):
    """Print how near the tool comes, by the encoders, to where joint goals have it: sent as they are, and by us."""
    targets = ARM.targets.sample(np.random.default_rng(1), (10,))
    goals = solve_position(ARM, targets, np.tile(ARM.rest, (len(targets), 1))).q

    def streamed(send, read):
        """Send every goal in 30 steps a second at 1 rad/s, wait, and return the error [mm] and the largest [deg]."""
        found, sent = [], read()
        for goal in [ARM.rest, *goals]:
            count = max(int(np.abs(goal - sent).max() * 30), 1)
            for share in np.linspace(1 / count, 1.0, count):
                send(sent + share * (goal - sent))
            sent = goal
            for _ in range(int(30 * SETTLING)):
                send(goal)
            off = read() - goal
            found.append((1e3 * np.linalg.norm(tcp_position(ARM, read()) - tcp_position(ARM, goal)), np.abs(off).max()))
        error, angle = np.array(found[1:]).T
        return f"tool {error.mean():.2f} mm (largest {error.max():.2f}), joints {np.degrees(angle.max()):.2f} deg"

    with closing(open_robot(address, arm=ARM, period=(1 / 30, 1 / 30))) as robot:
        print("as they are:", streamed(lambda goal: robot.step(goal[None]), lambda: robot.read().position[0]))

    def send(goal):
        posed.send_joints(goal)
        time.sleep(1 / 30)

    with connect(address, run=run) as posed:
        print("through rejoint:", streamed(send, lambda: posed.state.joints_rad))


def replay(plant, log):
    """Return positions (T, n) [rad] of a plant that gets the commands of a log `DELAY` after they were sent."""
    plant.reset(log.position[:1])
    ticks = np.rint((log.time - log.time[0]) * 1e3)
    found = [plant.encoder()[0]]
    for k in range(1, len(log)):
        plant.command(log.command[k - 1][None], DELAY)
        plant.advance((ticks[k] - ticks[k - 1]) / 1e3)
        found.append(plant.encoder()[0])
    return np.array(found)


def main(words: Annotated[list[str] | None, typer.Argument()] = None):
    """Measure a control cycle; or do what the head of this file says of gains, joints ADDRESS RUN, or a folder."""
    what, *rest = words or ["bus"]
    {"bus": measure_so101, "gains": gains, "joints": joints}.get(what, partial(predict, what))(*rest)
