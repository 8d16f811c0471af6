"""A camera before an emulated arm: rendered pictures of where its tool really is."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.camera.board import Board
from rejoint.control.robot import Robot
from rejoint.robots.lab.camera.rendering import Picture
from rejoint.robots.lab.camera.scene import Scene, beside, on_tool
from rejoint.system.errors import FileError, InputError

_REMEDY = "give the file that `rejoint emulate --log FILE` writes"
_TAIL = 4096  # [bytes] of a truth log that are read (chosen: some rows)


class EmulatedCamera:
    """Takes rendered pictures; the same seed and number give the same noise."""

    def __init__(self, scene: Scene, tool: Callable[[], Array], seed: int = 0) -> None:
        """Watch the tool whose pose (4, 4) in the base ``tool`` tells."""
        self.scene, self._tool, self._seed = scene, tool, seed

    def still(self, number: int) -> Picture:
        """Render picture ``number``."""
        return self.scene.shows(self._tool(), (self._seed, number))


def watching(
    board: Board, carried: str, seed: int, truth: Path | None = None
) -> Callable[[Robot], AbstractContextManager[EmulatedCamera]]:
    """Return what opens a camera before an emulated arm, which stands beside it or is on its tool.

    An arm of another process, `rejoint emulate`, tells where it is by its ``truth`` log.
    """
    if truth is not None and not truth.exists():
        raise FileError(truth, "no such file", _REMEDY)

    def opened(robot: Robot) -> AbstractContextManager[EmulatedCamera]:
        arm = robot.arm
        scene = beside(arm, board=board) if carried == "board" else on_tool(arm, board=board)
        if truth is not None:
            return nullcontext(EmulatedCamera(scene, lambda: pose_of_log(truth, arm), seed))
        plant = getattr(robot, "plant", None)  # whatever else a robot is wrapped in
        if plant is None:
            raise InputError(
                f"camera emulated: {robot.address} is not emulated in this process; give the number of a camera, or "
                "emulated=FILE with what `rejoint emulate --log FILE` writes"
            )
        return nullcontext(EmulatedCamera(scene, lambda: plant.true_pose()[0], seed))

    return opened


def pose_of_log(path: Path, arm: Arm) -> Array:
    """Pose (4, 4) of the tool by the newest row of a truth log; FileError where it holds none."""
    try:
        with path.open("rb") as file:
            names = file.readline().decode().strip().split(",")
            file.seek(max(path.stat().st_size - _TAIL, file.tell()))
            rows = file.read().decode().split("\n")
        places = [names.index(f"link.joint{i + 1}") for i in range(arm.joints)]
        cells = rows[-2].split(",")  # the last may be cut
        return tcp_pose(arm, np.array([float(cells[place]) for place in places]))
    except FileNotFoundError as error:
        raise FileError(path, "no such file", _REMEDY) from error
    except (OSError, ValueError, IndexError) as error:
        raise FileError(path, "no truth log of this arm", _REMEDY) from error
