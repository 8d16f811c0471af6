"""A camera whose pictures, with the board that is found in them, are shown on the page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from rejoint.camera.board import ON_TOOL, Detector, Picture, Unusable, read_board
from rejoint.camera.filming import CameraGauge, StillCamera
from rejoint.camera.tracker import LiveCamera
from rejoint.control.robot import Robot
from rejoint.control.seeing import simulated
from rejoint.robots import is_virtual
from rejoint.studio.machine import Studio

WIDTH = 480
"""[px] of a shown picture (chosen)"""


class _ShownCamera(NamedTuple):
    studio: Studio
    camera: StillCamera
    detector: Detector

    def still(self, number: int) -> Picture:
        """Take a picture, and show it."""
        picture = self.camera.still(number)
        seen = self.detector.find(f"picture {number}", picture)
        drawn = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
        if isinstance(seen, Unusable):
            self.studio.message(f"Picture {number}: {seen.why}")
        else:
            for x, y in np.rint(seen.pixel).astype(int).tolist():
                cv2.circle(drawn, (x, y), max(picture.shape[1] // 120, 3), (30, 160, 90), -1)
        height = round(WIDTH * picture.shape[0] / picture.shape[1])
        self.studio.change(picture=np.asarray(cv2.resize(drawn, (WIDTH, height), interpolation=cv2.INTER_AREA)))
        return picture


def shown_camera(studio: Studio, address: str, file: Path, number: int) -> CameraGauge:
    """Return the camera of this ``number``, which measures; ``file`` describes the board."""
    emulated = is_virtual(address)
    board = ON_TOOL if emulated and not file.exists() else read_board(file)

    @contextmanager
    def camera(robot: Robot) -> Iterator[StillCamera]:
        opened = nullcontext(simulated(robot).camera(board, "board", 0)) if emulated else LiveCamera(number)
        with opened as taken:
            yield _ShownCamera(studio, taken, Detector(board))

    return CameraGauge(camera=camera, board=board)
