"""An arm of Dynamixel X servos: one synchronous read and write per cycle.

Registers that outlast the power are never written. What the driver changes in the others is put back when it closes,
but for the bus watchdog, which would trip as soon as the bus is quiet.
"""

import contextlib
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
from dynamixel_sdk import COMM_RX_CORRUPT, PortHandler, Protocol2PacketHandler

from rejoint.arms import Arm, Array
from rejoint.logs.joints import COUNTS_PER_TURN
from rejoint.robots.bus import Bus, Reading, Vitals
from rejoint.robots.dynamixel import CURRENT_BASED, KIND, DynamixelAddress
from rejoint.robots.family import Wire
from rejoint.robots.knobs import Values
from rejoint.robots.servobus import RETRY, STEP, VOLT, ServoBus, Zeros, listed, trouble
from rejoint.robots.servowire import OK, ServoWire, judge
from rejoint.system.errors import LOGGER, InputError, RejointError, RobotError
from rejoint.system.stopping import shielded

TABLE = KIND.registers
ALERT = 0x80
"""Bit of the error byte: the servo has switched itself off"""
LATENCY = 50.0
"""[ms] after which an answer is missing (chosen: three times an adapter's latency as sold)"""
ECHO = 0.002
"""[s] after the answer of one servo in which another's with the same ID would come (chosen)"""
REFUSED = {4: "a value out of range", 6: "a value beyond a limit", 7: "a register that is locked under torque"}
"""Numbers in an error byte that say why"""
_LENGTH = 5  # its place in a status packet


class DynamixelWire(ServoWire, PortHandler):  # type: ignore[misc]  # the maker's package has no types
    """An open bus of Dynamixel servos, whose answers are waited for whole."""

    places, overhead = (4, 8), 11
    _last = (False,)  # one status packet each

    def __init__(self, address: Wire) -> None:
        super().__init__(address)
        self._client, self._first = Protocol2PacketHandler(), (self,)
        self.alerts: set[int] = set()
        """servos whose last answer had the alert bit"""

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802 - the maker's name
        """Begin to wait for ``length`` bytes."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * length + LATENCY)

    def model(self, servo: int) -> int:
        """Model number of a servo; ValueError where two answer."""
        number, result, error = self._client.ping(self, servo)
        if result == COMM_RX_CORRUPT or (result == OK and self.quieten(ECHO)):
            raise ValueError(f"have two servos the ID {servo}? A new one has 1")
        self._take(result, servo, error)
        return int(number)

    def write(self, servo: int, address: int, data: Sequence[int]) -> int:
        """Write registers; ValueError where the servo refuses."""
        error = super().write(servo, address, data) & ~ALERT
        if error:
            raise ValueError(
                f"servo {servo} refused {list(data)} for register {address}: {REFUSED.get(error, f'error {error}')}"
            )
        return error

    def reboot(self, servo: int) -> None:
        """Restart a servo: its torque is off, and its registers above 63 are as sold."""
        judge(self._client.reboot(self, servo)[0], servo)

    def _data(self, packet: Sequence[int]) -> bytes:
        return bytes(
            packet[self.places[1] + 1 : _LENGTH + packet[_LENGTH] + 256 * packet[_LENGTH + 1]]
        )  # behind them: a CRC

    def _take(self, result: int, servo: int, error: int) -> None:
        judge(result, servo)
        (self.alerts.add if error & ALERT else self.alerts.discard)(servo)


POSITION, MODES = 3, (3, 4, CURRENT_BASED)
"""Operating modes with goal positions: position, extended, current-based"""
NEAR = 1024
"""[counts] largest homing offset that is obeyed in the mode `POSITION`"""
FARTHEST = 1_048_575
"""[counts] of goals in the other modes"""
MIDDLE = 2048
"""[counts] at zero of a joint without a calibration"""
APART = 45
"""[counts] allowed difference of two servos of one joint (chosen: four degrees; backlash is 3 counts)"""
FIGHT = "its two servos pull against each other"
AWAKE = 3.0
"""[s] for a restart (chosen: ten times what users report)"""
LEAVE = 3.0
"""[s] for putting registers back (chosen: six times what it takes)"""
DELAY_UNIT, PROMPT = 2, 20
"""[us] per count of a servo's return delay, and the longest that is not named (chosen)"""
TIMER = "/sys/bus/usb-serial/devices/{}/latency_timer"
MEASURED = ("load", "position")
"""Registers of a cycle"""


@cache
def say(text: str) -> None:
    """Tell the owner, once."""
    LOGGER.warning(text)


class DynamixelBus(ServoBus):
    """The servos of an arm by ID, without the gripper."""

    name = "Dynamixel arm"
    advice = f"{Bus.advice} `rejoint emulate --arm koch` starts an arm to try"
    confirms, last, turned, wire_type = 2, 20, True, DynamixelWire
    wire: DynamixelWire
    address: DynamixelAddress

    def __init__(self, address: DynamixelAddress, arm: Arm) -> None:
        super().__init__(address, arm)
        if strange := set(address.reverse) - set(arm.joint_names):
            raise InputError(f"reverse= of the address: {arm.name} has no {listed(sorted(strange))}")
        self._sign = np.array([-1.0 if name in address.reverse else 1.0 for name in arm.joint_names])
        self._volts: Array
        self._words = [""] * len(self.ids)
        self._currents: dict[int, tuple[int, int]] = {}  # limits of servos that obey them: found, and largest
        self._before: Values = {}
        self._sound = False  # whether the last question was answered, and without an alert

    def check(self, servo: int) -> None:
        """Require the model of the arm's description, a mode with positions and no alert; switch a watchdog off."""
        model = self.found[servo].name
        wanted = (self.arm.servos or (model,) * self.arm.joints)[self.joint[self.ids.index(servo)]]
        if model not in wanted:
            raise RobotError(
                f"{self.call(servo)} is of model {model}, and {self.arm.name} has {wanted} there; say which arm this "
                "is with --arm, or which servos turn each joint with ids= in the address"
            )
        if servo in self.wire.alerts and self.address.reboot and not self._was_ready:
            self.sure(partial(self.wire.reboot, servo))
            end = self.clock.now() + AWAKE
            self.clock.wait(RETRY)
            while not self.answers(servo) and self.clock.now() < end:
                self.clock.wait(RETRY)
        if servo in self.wire.alerts and not self._was_ready:
            raise RobotError(
                f"{self.call(servo)} has switched itself off ({trouble(KIND.faults, self.get(servo, 'error'))}); find "
                "out why, let it cool down, support the arm, then say reboot=yes in the address, or switch the power "
                "off and on"
            )
        mode, homing = self.get(servo, "mode"), self.get(servo, "homing")
        if mode not in MODES:
            raise RobotError(f"{self.call(servo)} has no position mode; set its register {TABLE['mode'].address} to 3")
        if mode == POSITION and abs(homing) > NEAR:
            raise RobotError(
                f"{self.call(servo)} ignores its homing offset of {homing} counts in position mode; set its register "
                f"{TABLE['mode'].address} to 4, or calibrate it again"
            )
        if self.get(servo, "watchdog"):
            say(f"{self.call(servo)} had a bus watchdog: it is off now, and stays so until something sets it again")
            self.set(servo, "watchdog", 0)

    def find_zeros(self) -> Zeros:
        """Read where the joints are; a servo may count from another turn than its calibration."""
        homing, drive, mode, low, high, place = map(
            self.get_all, ("homing", "drive", "mode", "low", "high", "position")
        )
        arm, file, lead = self.arm, self.file, self.leads
        middle = np.full(len(self.ids), float(MIDDLE))
        if file is None:
            say(f"No calibration= in the address: {MIDDLE} counts of each servo are taken for zero of {arm.name}")
        else:
            file.require(arm, homing[lead])
            turned = file.turned != drive[lead] % 2
            if turned.any():
                raise RobotError(f"{listed(np.array(arm.joint_names)[turned])}: other drive mode than in the file")
            middle = ((file.low + file.high) / 2)[self.joint]
        middle += COUNTS_PER_TURN * np.round((place - middle) / COUNTS_PER_TURN)
        apart = place - middle - (place - middle)[lead][self.joint]
        if (np.abs(apart) > APART).any():
            at = np.argmax(np.abs(apart))
            raise RobotError(
                f"{self.call(self.ids[at])} stands {apart[at]:.0f} counts from the other servo of its joint, and would "
                f"pull against it: set its homing offset (register {TABLE['homing'].address}) and its drive mode"
            )
        for servo, based in zip(self.ids, mode == CURRENT_BASED, strict=True):
            if based and servo not in self._currents:
                self._currents[servo] = self.get(servo, "current"), self.get(servo, "largest")
                self.memory = (*KIND.memory, "current")
        free = mode != POSITION
        return Zeros(
            middle=middle,
            zero=self.address.middle(arm)[self.joint],
            low=np.where(free, -FARTHEST, low),
            high=np.where(free, FARTHEST, high),
            step=STEP * self._sign[self.joint],
        )

    def set_up(self) -> None:
        """Find what is quick, and what was set."""
        self._before = self._before or self.read_gains()
        self._care()
        slow = DELAY_UNIT * self.get_all("delay").max()
        if slow > PROMPT:
            say(f"A servo waits {slow} us before it answers; register {TABLE['delay'].address} set to 0 would end that")
        held = _latency(self.place.device)
        if held > 1:
            say(f"The USB adapter keeps answers for {held} ms; 1 is better: write it to {TIMER.format('ttyUSB*')}")

    def read(self) -> Reading:
        """Ask all servos; those with an alert, why."""
        self._sound = False
        loads, counts = self.ask_all(*MEASURED)
        if self.wire.alerts:
            (errors,) = self.ask_all("error")
            self._words = [trouble(KIND.faults, error) or word for error, word in zip(errors, self._words, strict=True)]
        self._sound = not self.wire.alerts
        places = self.zeros.radians(counts)
        position = places[self.leads]
        fights = np.abs(places - position[self.joint]) > APART * STEP
        words = [word or FIGHT * fight for word, fight in zip(self._words, fights.tolist(), strict=True)]
        told = tuple(  # of each joint's servos together
            ", ".join(dict.fromkeys(word for word, of in zip(words, self.joint, strict=True) if word and of == j))
            for j in range(self.arm.joints)
        )
        shares = [self.found[first].share(load) for first, load in zip(self.firsts, loads[self.leads], strict=True)]
        return Reading(
            position=position,
            load=self._sign * shares,
            voltage=self._volts[self.leads],
            fault=np.array(told, bool),
            trouble=told,
        )

    def read_gains(self) -> Values:
        """Ask for the gains; a limit of the current in percent of the largest."""
        found = super().read_gains()
        if "current" in found:
            found["current"] = tuple(map(self._percent, self.firsts, found["current"]))
        return found

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all joints; a limit of the current where a servo obeys it."""
        if name != "current":
            super().write_gain(name, values)
            return
        for servo, (before, largest) in self._currents.items():
            percent = values[self.joint[self.ids.index(servo)]]
            unchanged = percent == self._percent(servo, before)
            self.set(servo, name, before if unchanged else largest * percent // 100)

    def _percent(self, servo: int, current: int) -> int:
        return round(100 * current / self._currents[servo][1]) if servo in self._currents else 100

    def vitals(self) -> tuple[Callable[[], Vitals], ...]:
        """Further questions."""
        return (self._care,)

    def close(self) -> None:
        """Put registers back and release the port; the servos hold."""
        if self._wire is not None and self._sound and self._before:
            with contextlib.suppress(RejointError, OSError), shielded(), self.by(self.clock.now() + LEAVE):
                self.walk(self._before)
        self._sound = False
        super().close()

    def _care(self) -> Vitals:
        """Ask for supply and temperature."""
        volts, heats = self.ask_all("voltage", "heat")
        self._volts = VOLT * volts
        self.supply = self.supply or tuple(self._volts)
        self._words = [trouble({}, 0, *seen) for seen in zip(self._volts, self.supply, strict=True)]
        return Vitals(temperature=np.maximum.reduceat(heats, self.leads))


def _latency(device: str) -> int:
    """Return how long [ms] a USB adapter keeps short answers; 0: not said."""
    try:
        return int(Path(TIMER.format(Path(device).resolve().name)).read_text())
    except (OSError, ValueError):
        return 0
