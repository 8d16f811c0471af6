"""What an arm did is kept wherever a motion ends early."""

import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from runs.test_connect import a_twin

ARM = mycobot280()


def failing(robot, steps):
    """Return the robot as one that fails after some steps."""
    step, left = robot.step, iter(range(steps))

    def fail_later(*given):
        if next(left, None) is None:
            raise rejoint.RobotError("made for this test")
        return step(*given)  # type: ignore[arg-type]

    robot.step = fail_later  # type: ignore[method-assign, assignment]
    return robot


@pytest.mark.parametrize(
    ("steps", "label", "stage"),
    [
        (20, "follow/begin/stopped", lambda robot, run: rejoint.follow(robot, "circle-8s", run=run)),
        (20, "serve/begin/stopped", lambda robot, run: rejoint.serve(robot, run, listen="127.0.0.1:0")),
        (20, "calibrate/cut-short", lambda robot, run: rejoint.calibrate(robot, run=run, count=2)),
        (
            150,
            "compare/cut-short",
            lambda robot, run: rejoint.compare(robot, ["default"], run=run, plan=rejoint.TrialPlan(sets=1)),
        ),
    ],
)
def test_what_an_arm_did_is_kept_where_a_stage_ends_early(tmp_path, steps, label, stage):
    run = Run.create(tmp_path, "emulated:worn", ARM)
    a_twin().save(run.folder.twin)
    with pytest.raises(rejoint.RobotError, match="made for this test") as failed:
        stage(failing(open_robot("emulated:worn", arm=ARM), steps), run)
    (log,) = run.logs.values()
    assert log.label == label
    assert 1 < len(log) <= steps + 1
    assert any("What was recorded until then" in note for note in failed.value.__notes__)
