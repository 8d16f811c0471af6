"""What the checks catch: clocks, rates, limits, mixed-up and frozen joints."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, sample

from rejoint.arms import Array
from rejoint.logs.columns import RecordedMotion
from rejoint.logs.importing import to_log
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError


def motion(found: Sample) -> RecordedMotion:
    return RecordedMotion(
        name="motion",
        path=Path("log.csv"),
        place="line",
        number=np.arange(len(found.time)) + 2,
        time=found.time,
        position=found.position,
        command=found.command,
        columns=tuple(f"state.{name}" for name in ARM.joint_names),
        extra={"format": "csv", "source": "motion.csv"},
        angle_unit="rad",
        half=None,
        more={},
        units={},
    )


GOOD = sample(rows=200)


def check(**changed: Array) -> tuple[RunLog, str]:
    log, notes = to_log(motion(replace(GOOD, **changed)), ARM)
    return log, " | ".join(notes)


def test_a_clean_log_has_no_notes():
    log, notes = check()
    assert notes == ""
    assert (log.position == GOOD.position).all()


def test_doubled_stamps_are_left_out_and_told():
    time = GOOD.time.copy()
    time[[7, 8, 100]] = time[[6, 6, 99]]
    log, _ = check(time=time)
    assert log.position.tolist() == np.delete(GOOD.position, [7, 8, 100], axis=0).tolist()


RATE = r"one sample in .* s, expected 1 to 10000 Hz; set the time unit"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"time": GOOD.time - 0.5 * (np.arange(200) >= 50)}, r"state, line 52: the clock goes back by 0.48 s"),
        *(({"time": GOOD.time * factor}, RATE) for factor in (1e3, 1e6, 1e-3)),
        ({"position": GOOD.position[:, [0, 2, 1, 3, 4]]}, r"shoulder_lift follows the command of state.elbow_flex"),
        ({"position": GOOD.position * [1, 1, -1, 1, 1]}, r"state.elbow_flex moves against its command.*--map"),
        ({"position": GOOD.position + np.pi * np.eye(5)[1]}, r"limits of joint shoulder_lift .* in 100 % .*gear"),
    ],
)
def test_what_no_arm_did_is_refused(wrong: dict[str, Array], said: str):
    with pytest.raises(FileError, match=said):
        check(**wrong)


def test_angles_a_turn_off_are_brought_into_limits():
    log, _ = check(position=GOOD.position % (2 * np.pi), command=GOOD.command % (2 * np.pi))
    np.testing.assert_allclose(log.position, GOOD.position, atol=1e-9)


def test_a_joint_that_turns_all_around_has_no_end() -> None:
    endless = replace(ARM, lower=np.full(5, -np.pi), upper=np.full(5, np.pi))
    turned = [one + np.linspace(0.0, 5.0, 200)[:, None] for one in (GOOD.position, GOOD.command)]
    position, command = ((one + np.pi) % (2 * np.pi) - np.pi for one in turned)
    log, _ = to_log(motion(replace(GOOD, position=position, command=command)), endless)
    np.testing.assert_allclose([log.position, log.command], turned, atol=1e-9)


def test_joints_outside_their_limits():
    position = GOOD.position.copy()
    position[:, 1] += 1.4 * np.exp(-(((np.arange(200) - 30) / 12) ** 2))
    outside = 100 * (position[:, 1] > ARM.upper[1]).mean()
    assert f"rad) in {outside:.3g} % of the samples" in check(position=position)[1]
