"""What the checks catch: clocks, rates, limits, mixed-up and frozen joints."""

from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, sample

from rejoint.arms import Array
from rejoint.logs.columns import RecordedMotion
from rejoint.logs.importing import to_log
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError


def motion(found: Sample, unit: str = "rad") -> RecordedMotion:
    return RecordedMotion(
        name="motion",
        path=Path("log.csv"),
        place="line",
        number=np.arange(len(found.time)) + 2,
        time=found.time,
        position=found.position,
        command=found.command,
        columns=tuple(f"state.{name}" for name in ARM.joint_names),
        robot="csv:motion",
        angle_unit=unit,
    )


def check(found: Sample) -> tuple[RunLog, str]:
    log, notes = to_log(motion(found), ARM)
    return log, " | ".join(notes)


def changed(**arrays: Array) -> Sample:
    found = sample(rows=200)
    return Sample(**{name: arrays.get(name, getattr(found, name)) for name in ("time", "position", "command")})


def test_a_clean_log_has_no_notes():
    log, notes = check(changed())
    assert notes == ""
    assert log.position.tolist() == sample(rows=200).position.tolist()


def test_doubled_stamps_are_left_out_and_told():
    time = sample(rows=200).time.copy()
    time[[7, 8, 100]] = time[[6, 6, 99]]
    log, _ = check(changed(time=time))
    assert log.position.tolist() == np.delete(sample(rows=200).position, [7, 8, 100], axis=0).tolist()


def test_a_clock_that_goes_back_is_refused():
    time = sample(rows=200).time.copy()
    time[50:] -= 0.5
    with pytest.raises(FileError, match=r"state, line 52: the clock goes back by 0.48 s"):
        check(changed(time=time))


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e-3])
def test_a_wrong_time_unit_shows_in_the_rate(factor: float):
    with pytest.raises(FileError, match=r"one sample in .* s, expected 1 to 10000 Hz; set the time unit"):
        check(changed(time=sample(rows=200).time * factor))


def test_swapped_columns_of_states_are_refused():
    swapped = sample(rows=200).position[:, [0, 2, 1, 3, 4]]
    with pytest.raises(FileError, match=r"state of state.shoulder_lift follows the command of state.elbow_flex"):
        check(changed(position=swapped))


def test_a_reversed_axis_is_refused():
    position = sample(rows=200).position * np.array([1, 1, -1, 1, 1])
    with pytest.raises(FileError, match=r"state.elbow_flex moves against its command.*--map"):
        check(changed(position=position))


def test_joints_outside_their_limits():
    position = sample(rows=200).position.copy()
    position[:, 1] += 1.4 * np.exp(-(((np.arange(200) - 30) / 12) ** 2))
    assert (
        f"beyond the limits of joint shoulder_lift in {(position[:, 1] > ARM.upper[1]).sum()} samples"
        in check(changed(position=position))[1]
    )
    with pytest.raises(FileError, match=r"beyond the limits of joint shoulder_lift .* in 100 % .*gear"):
        check(changed(position=sample(rows=200).position + np.array([0, np.pi, 0, 0, 0])))
