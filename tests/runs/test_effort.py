"""What a repair cost is counted stage by stage, over all attempts, and said in words."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.playback import move
from rejoint.logs.runfolder.effort import Effort, StageCost, add, cost, read_effort
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.robots import open_robot
from rejoint.runs.metering import Meter, metered
from rejoint.runs.run import Run

ARM = mycobot280()


def test_time_and_travel_are_those_of_the_motion():
    meter = Meter()
    robot = meter.watch(open_robot("emulated:healthy", seed=1))
    posture = ARM.rest.copy()
    posture[0] += 0.5
    first = move(robot, ARM.rest)
    before = meter.moving, meter.travel
    motion = move(robot, posture, sent=first.command[-1])
    robot.close()
    assert meter.moving - before[0] == pytest.approx(motion.time[-1, 0] - first.time[-1, 0], rel=0.01)
    assert meter.travel - before[1] == pytest.approx(np.abs(np.diff(motion.position[:, 0], axis=0)).sum(), rel=0.02)
    assert meter.travel > 0.45


def test_a_counted_robot_moves_as_one_that_is_not():
    plain, counted = (open_robot("emulated:worn", seed=2) for _ in range(2))
    ours, theirs = move(Meter().watch(counted), ARM.rest), move(plain, ARM.rest)
    np.testing.assert_array_equal(ours.position, theirs.position)
    batch = open_robot("emulated:worn", seed=2, count=2)
    assert Meter().watch(batch) is batch, "arms side by side in virtual time cost nothing"


def test_attempts_add_up_and_a_stage_that_fails_has_cost_as_well(tmp_path):
    run = Run.create(tmp_path / "run", "tcp://10.0.0.2:9000", ARM)
    with metered(run.folder, "diagnose") as meter:
        meter.moving, meter.travel = 60.0, 2 * np.pi
    add(run.folder, StageCost(name="diagnose", wall=90.0))
    with pytest.raises(OSError, match="gone"), metered(run.folder, "compare") as meter:  # noqa: PT012 - it fails later
        meter.moving = 30.0
        raise OSError("gone")
    with metered(run.folder, "compare") as meter:
        meter.moving = 12.0
    found = read_effort(run.folder)
    assert found.stages == (
        StageCost(name="diagnose", wall=90.0, moving=60.0, travel=2 * np.pi), StageCost(name="compare", moving=42.0)
    )  # fmt: skip
    assert (found.wall, found.moving) == (90.0, 102.0)
    assert cost(found.stages[0]) == "1.5 min; 1.0 min of the arm's time with 1.0 turns of its joints"
    assert cost(StageCost(name="train", wall=30.0)) == "0.5 min"


def test_nothing_is_written_where_there_is_no_run(tmp_path):
    folder = RunFolder(tmp_path / "none")
    add(folder, StageCost(name="train", wall=1.0))
    assert not folder.path.exists()
    assert read_effort(folder) is None
    assert Effort().moving == 0
