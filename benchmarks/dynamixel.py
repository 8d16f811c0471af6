"""What a control cycle of an arm of Dynamixel X servos costs: time on the bus, and time of the processor.

As `python -m benchmarks feetech`: the emulator runs in a process of its own, as slow as the wire and a USB adapter are;
the same bytes are exchanged in turn with the driver and without it.

With logs of a real XL330 on a pendulum (Rhoban/bam), `python -m benchmarks dynamixel LOGS [OTHERS]`, how well the
emulator's servo predicts them: with BAM's motor and friction, and fitted to LOGS. OTHERS are logs that the fit has not
seen; without them, each motion in LOGS is left out in turn.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.optimize import least_squares

from benchmarks.feetech import bus_cost
from rejoint.arms import Arm, Box
from rejoint.robots.dynamixel import KIND
from rejoint.robots.dynamixel.bus import MEASURED, DynamixelBus
from rejoint_lab.emulator.dynamixel import encode
from rejoint_lab.emulator.servobus import ADAPTER, BROADCAST, BYTE, SYNC_READ, SYNC_WRITE, TURN, Packet
from rejoint_lab.plant.plant import XPlant
from rejoint_lab.plant.wear import Wear
from rejoint_lab.plant.xseries import NEW

MOST = 1.1, 0.4
"""Times what the wire and the adapter take, and [ms] of the processor, at the median"""


def asked_of(bus, goal):
    """Return the packets of a cycle, the size of the answer, and their time [s] on the wire and in the adapter."""
    pairs = zip(bus.ids, bus.zeros.counts(goal[bus.joint]), strict=True)
    goals = b"".join(bytes([one]) + count.to_bytes(4, "little") for one, count in pairs)
    write = KIND.registers["goal"].address.to_bytes(2, "little") + (4).to_bytes(2, "little") + goals
    first, length = bus.span(MEASURED)
    read = first.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes(bus.ids)
    write, read = (encode(Packet(BROADCAST, *one)) for one in ((SYNC_WRITE, write), (SYNC_READ, read)))
    size = len(bus.ids) * (length + 11)
    return write, read, size, (len(write) + len(read) + size) * BYTE + len(bus.ids) * TURN + ADAPTER


SERVO = "XL330-M288"
FITTED = ("stall", "no_load", "inertia", "coulomb", "viscous", "load_friction", "divisor")
"""Properties of `rejoint_lab.plant.xseries.NEW` that a fit finds"""
AROUND, ROUNDS = 0.02, 12
"""Relative step of its derivatives, and its most iterations (chosen)"""


def pendulum(mass, length):
    """Return an arm of one servo with a point mass, which hangs at zero."""
    end = np.eye(4)
    end[2, 3] = -length
    ends, one = np.array([-10.0]), np.ones(3)
    return Arm(
        name="pendulum", joint_names=("a",), offset=np.eye(4)[None], axis=np.array([[0.0, 1.0, 0.0]]), tip=end,
        lower=ends, upper=-ends, max_speed=-ends, mass=np.array([mass]), com=end[None, :3, 3],
        inertia=1e-6 * np.eye(3)[None], rest=np.zeros(1), targets=Box(lower=-one, upper=one), floor=-1.0,
        encoder_step=2 * np.pi / 4096, servos=(SERVO,),
    )  # fmt: skip


def wear(servo):
    """Return the wear of a servo with these properties."""
    known = dict.fromkeys(("damping_gain", "play", "ripple", "torque_noise"), 0.0)
    known |= {"position_gain": 0.6, "torque_limit": servo["stall"], "link_stiffness": 100.0}
    known |= {"coulomb": servo["coulomb"], "stiction": servo["coulomb"], "load_friction": servo["load_friction"]}
    known |= {"reflected_inertia": servo["inertia"]}
    return Wear(name="bam", **{name: np.array([value]) for name, value in known.items()})


def predicted(log, servos):
    """Angles (T, B) [rad] of B servos that are sent what a log was."""
    rows = log["entries"]
    plant = XPlant(pendulum(log["mass"], log["length"]), [wear(one) for one in servos], seed=0)
    plant.settings["p"], plant.settings["voltage"], plant.settings["shutdown"] = log["kp"], log["vin"], 0
    for name in ("no_load", "divisor", "viscous"):
        plant.settings[name][:, 0, 0] = [one[name] for one in servos]
    plant.reset(np.full((len(servos), 1), rows[0]["position"]))
    seen, start, passed = [plant.encoder()[:, 0]], rows[0]["timestamp"], 0
    for now, then in pairwise(rows):
        plant.status["goal"] = round(now["goal_position"] / plant.arm.encoder_step)
        plant.settings["torque_on"] = now["torque_enable"]
        steps = round(1e3 * (then["timestamp"] - start)) - passed
        plant.advance(1e-3 * steps)
        passed += steps
        seen.append(plant.encoder()[:, 0])
    return np.array(seen)


def errors(logs, servos):
    """Errors (T, B) [deg] over all logs, one after the other."""
    real = [[row["position"] for row in log["entries"]] for log in logs]
    return np.vstack(
        [np.degrees(predicted(log, servos) - np.array(one)[:, None]) for log, one in zip(logs, real, strict=True)]
    )


def fit(logs):
    """Return the servo that follows the logs best."""
    new = NEW[SERVO]

    def servo(factors):
        return new | {name: new[name] * float(np.exp(factor)) for name, factor in zip(FITTED, factors, strict=True)}

    def derivative(factors):
        rows = errors(logs, [servo(factors + sign * one) for one in AROUND * np.eye(len(FITTED)) for sign in (1, -1)])
        return (rows[:, ::2] - rows[:, 1::2]) / (2 * AROUND)

    start = np.zeros(len(FITTED))
    found = least_squares(lambda x: errors(logs, [servo(x)])[:, 0], start, derivative, max_nfev=ROUNDS, x_scale=0.2)
    return servo(found.x)


def predict(folder, others):
    """Print the errors of the servo with BAM's properties, and of a fitted one."""
    logs = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("*.json"))]
    unseen = [json.loads(path.read_text()) for path in sorted(Path(others).glob("*.json"))] if others else []

    def say(what, logs, servo):
        root = [np.sqrt((errors([log], [servo]) ** 2).mean()) for log in logs]
        whole = np.sqrt((errors(logs, [servo]) ** 2).mean())
        print(f"{what}: {whole:.2f} deg rms; motions " + ", ".join(f"{one:.1f}" for one in root), flush=True)

    say("BAM's motor and friction", [*logs, *unseen], NEW[SERVO])
    found = fit(logs)
    say("fitted to these", logs, found)
    print(", ".join(f"{name} {found[name]:.4g}" for name in FITTED))
    if unseen:
        say("the same on others", unseen, found)
        return
    left = [errors([logs[k]], [fit(logs[:k] + logs[k + 1 :])]) for k in range(len(logs))]
    print(f"each motion left out: {np.sqrt((np.vstack(left) ** 2).mean()):.2f} deg rms")


def main(words: Annotated[list[str] | None, typer.Argument()] = None):
    """Measure control cycles of a Koch and a WidowX, or predict logs."""
    if words:
        predict(words[0], (*words, "")[1])
        return
    for name in ("koch", "wx250s"):
        bus_cost(name, DynamixelBus, asked_of, lambda least: (MOST[0] * least, MOST[1]))
