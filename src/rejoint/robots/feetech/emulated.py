"""The gains of emulated servos in virtual time, read and set as those on the bus are, by the same steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Array
from rejoint.control.servogains import ServoGains
from rejoint.robots.feetech.gains import FIRST, LIMIT, REGISTERS, SIZE, Gains, for_all
from rejoint.robots.feetech.law import FULL
from rejoint.robots.feetech.tuning import LOAD, Tuning
from rejoint.robots.lab.plant.stsplant import StsPlant

_FIELDS = {address: "integral_limit" if name == LIMIT else name for name, address in REGISTERS.items()}
"""Fields of `rejoint.robots.lab.plant.sts3215.SETTING` that the registers of gains are"""


class EmulatedServos:
    """The registers that `Tuning` needs, of a batch of arms that all have the same gains."""

    def __init__(self, plant: StsPlant, gains: Gains) -> None:
        """``gains`` are in force from the start, in place of those of servos as sold."""
        self._plant = plant
        joints = plant.arm.joints
        for name, values in for_all(gains, joints).items():
            plant.settings[_FIELDS[REGISTERS[name]]] = values
        self._tuning = Tuning(
            range(1, joints + 1), {}, read=self._read, write=self._write,
            call=lambda servo: plant.arm.joint_names[servo - 1], wait=plant.advance,
        )  # fmt: skip
        self._tuning.prepare(None)

    @property
    def gains(self) -> ServoGains:
        """Gains in force."""
        return dict(self._tuning.values)

    @property
    def load(self) -> Array:
        """(B, n) share of the largest torque, as the driver of the bus tells it (`rejoint.robots.feetech.law`)."""
        status = self._plant.status
        duty, error = status["output"].tolist(), (status["goal"] - status["position"]).tolist()
        return np.array(
            [[law.share(*seen) for law, *seen in zip(self._tuning.laws, *arm, strict=True)]
             for arm in zip(duty, error, strict=True)]
        )  # fmt: skip

    def tune(self, gains: ServoGains) -> None:
        """Bring the gains of all arms to these, see `Tuning.tune`; their clocks go on meanwhile."""
        self._tuning.tune(gains)

    def _read(self, servo: int, address: int, size: int, _until: float | None) -> bytes:
        """Return registers of a servo: of load and heat those of the arm that suffers most."""
        joint, plant = servo - 1, self._plant
        if (address, size) == (FIRST, SIZE):
            row = plant.settings[0, joint]
            return bytes(int(row[_FIELDS[cell]]) for cell in range(FIRST, FIRST + SIZE))
        if address != LOAD:
            raise ValueError(f"register {address} of an emulated servo is not known here")
        duty = int(np.abs(plant.status["output"][:, joint]).max())
        return bytes((*min(duty, int(FULL)).to_bytes(2, "little"), 0, int(plant.temperature[:, joint].max())))

    def _write(self, servo: int, address: int, data: Sequence[int], _until: float | None) -> None:
        self._plant.settings[_FIELDS[address]][:, servo - 1] = data[0]
