"""An arm of a run that is sent to points from Python."""

from pathlib import Path

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280, tcp_position
from rejoint.runs.run import Run

ARM = mycobot280()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Run.create(tmp_path / "run", "emulated:worn", ARM, 0).path


def test_an_arm_goes_to_points_and_leaves_one_log(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm:
        assert arm.controller == "feedforward", "nothing better is there yet"
        before = arm.state
        assert before.target_m is None
        assert not before.moving
        end = arm.move_to([0.18, 0.03, 0.21], within_m=0.003)
        assert end is not None
        assert end.error_m is not None
        assert end.error_m < 0.004
        np.testing.assert_allclose(end.tool_m, tcp_position(ARM, end.joints_rad))
        assert arm.move_to([0.17, 0.0, 0.2], within_m=0.003, wait=False) is None
        with pytest.raises(rejoint.NotReadyError, match="still on its way"):
            arm.move_to([0.18, 0.03, 0.21])
        assert arm.wait().error_m < 0.004
        arm.move_to([0.18, 0.03, 0.21], wait=False)
        arm.stop()
        assert not arm.state.moving
    (name, log), = Run.open(run).logs.items()  # fmt: skip
    assert name.startswith("move-")
    assert {tuple(np.round(place, 3)) for place in log.target} == {(0.18, 0.03, 0.21), (0.17, 0.0, 0.2)}
    assert (np.diff(log.time) > 0.0).all()


def test_what_cannot_be_reached_is_an_error_with_a_name_and_the_arm_goes_on(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run, controller="default") as arm:
        with pytest.raises(rejoint.NotReachedError, match=r"did not come within 0\.1 mm .* still .* mm off; it holds"):
            arm.move_to([0.18, 0.03, 0.21], within_m=1e-4, timeout_s=1.0)
        with pytest.raises(rejoint.InputError, match="out of reach"):
            arm.move_to([0.5, 0.0, 0.2])
        with pytest.raises(rejoint.InputError, match="expected a point"):
            arm.move_to([0.2, 0.0])
        with pytest.raises(rejoint.InputError, match="positive"):
            arm.move_to([0.18, 0.03, 0.21], timeout_s=0.0)
        assert arm.move_to([0.18, 0.03, 0.21], within_m=0.05) is not None
    assert issubclass(rejoint.NotReachedError, TimeoutError)


def test_arguments_that_do_not_go_together_are_refused(run: Path) -> None:
    with pytest.raises(rejoint.InputError, match="need a run"):
        rejoint.connect("emulated:worn", controller="default")
    with pytest.raises(rejoint.InputError, match="leave arm and count out"):
        rejoint.connect("emulated:worn", run=run, count=2)
    with rejoint.connect("emulated:worn", run=run), pytest.raises(rejoint.FileError, match="another rejoint"):
        rejoint.connect("emulated:worn", run=run)
