"""What a repair cost is counted stage by stage, over all attempts, and said in words."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.start import move
from rejoint.logs.runfolder import read_effort
from rejoint.robots import open_robot
from rejoint.runs.run import Run, staged

ARM = mycobot280()


def test_time_and_travel_are_those_of_the_motion(tmp_path):
    run, robot = Run.create(tmp_path, "emulated:healthy", ARM), open_robot("emulated:healthy", seed=1)
    first = move(robot, ARM.rest)
    with staged(run, "turn") as watch:
        motion = move(watch(robot), ARM.rest + 0.5 * np.eye(6)[0], sent=first.command[-1])
    robot.close()
    (spent,) = read_effort(run.folder).stages
    assert spent.moving == pytest.approx(motion.time[-1, 0] - first.time[-1, 0], rel=0.02)
    assert spent.travel == pytest.approx(np.abs(np.diff(motion.position[:, 0], axis=0)).sum(), rel=0.02)
    assert spent.travel > 0.45


def test_a_counted_robot_moves_as_one_that_is_not():
    plain, counted = (open_robot("emulated:worn", seed=2) for _ in range(2))
    batch = open_robot("emulated:worn", seed=2, count=2)
    with staged(None, "") as watch:
        ours, theirs = move(watch(counted), ARM.rest), move(plain, ARM.rest)
        assert watch(batch) is batch, "arms side by side in virtual time cost nothing"
    np.testing.assert_array_equal(ours.position, theirs.position)
