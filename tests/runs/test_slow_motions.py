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
