"""The tool in a single picture, for whoever closes a loop on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.camera.board import BoardView
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.sighting import place
from rejoint.arms.camera.views import Detector, Unusable
from rejoint.control.seeing import Sighting
from rejoint.diagnosis.calibration.camera.bundle import point_sigma

CROOKED = 1.0
"""[px] of corners beside those of a flat board from which a picture is not trusted (chosen: six times a sharp one's)"""


class ToolTracker:
    """Tells from one picture at a time where the tool is; pictures may come at any rate and fail to show the board."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.why = ""
        """why the last picture was of no use; empty where it was"""
        self._detector = Detector(rig.board)

    def see(self, picture: NDArray[np.uint8], time: float = 0.0) -> Sighting | None:
        """Where the tool is in a grey or BGR ``picture`` taken at ``time`` [s]; None where the board is not seen well.

        It needs no more than the picture: a wrong encoder cannot mislead it.
        """
        found = self._detector.find("picture", picture)
        self.why = found.why if isinstance(found, Unusable) else ""
        return None if isinstance(found, Unusable) else self.sighting(found, time)

    def sighting(self, view: BoardView, time: float = 0.0) -> Sighting | None:
        """Return the same for a ``view`` whose corners are known."""
        placed = place(self.rig.lens, self.rig.board.corners[view.number], view.pixel)
        if placed.rms > CROOKED:
            self.why = f"its corners lie {placed.rms:.1f} px beside those of a flat board"
            return None
        sights, spread = placed.pose[None], placed.covariance[None]
        sigma = float(point_sigma(self.rig, sights, spread)[0])
        return Sighting(place=self.rig.tool(sights)[0, :3, 3], sigma=sigma, time=time)
