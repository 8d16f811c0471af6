"""The slow motions before the first target: what an arm did there is kept as well where they end early."""

from pathlib import Path

import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from runs.test_connect import a_twin

ARM = mycobot280()


def test_what_an_arm_did_before_its_path_is_kept(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", "emulated:worn", ARM, 0)
    a_twin().save(run.folder.twin)
    robot, left = open_robot("emulated:worn", arm=ARM), iter(range(20))
    step = robot.step

    def fail_later(*given: object) -> object:
        if next(left, None) is None:
            raise rejoint.RobotError("made for this test")
        return step(*given)  # type: ignore[arg-type]

    robot.step = fail_later  # type: ignore[method-assign, assignment]
    with pytest.raises(rejoint.RobotError, match="made for this test") as failed:
        rejoint.follow(robot, "circle-8s", run=run)
    (log,) = run.logs.values()
    assert (len(log), log.label) == (21, "follow/begin/stopped")
    assert any("What was recorded until then" in note for note in failed.value.__notes__)


class Fails:
    """A gauge that measures once."""

    sigma, frame, source, left = 5e-4, "base", "touch", 1

    def measure(self, robot, stop):  # noqa: ARG002 - as every gauge
        if not self.left:
            raise rejoint.RobotError("made for this test")
        self.left -= 1
        return stop.believed


def test_the_line_that_fits_what_was_measured_is_given_whole(tmp_path: Path) -> None:
    folder = tmp_path / "my run"
    Run.create(folder, "emulated:worn", ARM, 0)
    with pytest.raises(rejoint.RobotError, match="made for this test") as failed:
        rejoint.calibrate("emulated:worn", run=folder, gauge=Fails(), count=1)
    points = folder / "measurements.parquet"
    assert points.exists()
    line = f"rejoint calibrate emulated:worn '{folder}' --points '{points}'"
    assert any(note.endswith(line) for note in failed.value.__notes__)
