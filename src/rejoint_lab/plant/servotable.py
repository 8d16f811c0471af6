"""Tables of servos: registers, settings, and what a new one is."""

from __future__ import annotations

import csv
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray


class ServoTable:
    """A CSV file of servos: rows of registers, and without an address of other properties [SI].

    ``setting`` names the field of a simulated servo that holds the value times ``factor``.
    """

    def __init__(self, file: str) -> None:
        with (files(__package__) / file).open(encoding="utf-8") as stream:
            self.rows = tuple(csv.DictReader(stream))
        columns = tuple(self.rows[0])
        self.models = columns[columns.index("sign") + 1 :]
        self.new = {model: {row["name"]: float(row[model]) for row in self.rows if row[model]} for model in self.models}
        """values as sold by model and name"""
        self.settings = {
            row["setting"]: (row["name"], float(row["factor"] or 1)) for row in self.rows if row["setting"]
        }
        """name and factor by field"""

    def as_sold(self, model: str, kind: np.dtype[np.void]) -> NDArray[np.void]:
        """Return settings () of a ``kind`` as sold, powered, torque on."""
        setting = np.zeros((), kind)
        for field, (name, factor) in self.settings.items():
            setting[field] = self.new[model][name] * factor
        setting["torque_on"] = 1
        return setting
