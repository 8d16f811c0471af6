"""Measuring by hand: what a person has typed is never asked for again, whatever interrupts it."""

import logging
from dataclasses import replace

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.diagnosis.calibration import fit
from rejoint.diagnosis.calibration.measurements import read_interrupted
from rejoint.diagnosis.calibration.procedure import TouchGauge
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError, UnsavedError
from rejoint.system.stopping import Interrupted

ARM = mycobot280()
ROBOT = "emulated:worn?seed=5"
COUNT, TOTAL = 3, 6


class Hand:
    """Somebody with a ruler, who leaves the second posture out, and is gone after ``last`` answers."""

    def __init__(self, last=99):
        self.last, self.asked = last, []

    def gauge(self, **options):
        return TouchGauge(ask=self.answer, **options)

    def answer(self, stop):
        if len(self.asked) == self.last:
            raise InputError("the answers ended")
        self.asked.append(stop.number)
        x, y, z = 1e3 * stop.believed
        return "" if stop.number == 2 else f"{x + 3:.2f} {y - 2:.2f} {z - 5:.2f}"


def calibrate(run, hand, calibration=None, **options):
    settings = rejoint.Settings(calibration=calibration)
    return rejoint.calibrate(ROBOT, run=run, gauge=hand.gauge(), settings=settings, **({"count": COUNT} | options))


@pytest.fixture
def run(tmp_path):
    return Run.create(tmp_path, ROBOT, ARM)


def leave(run, last, **options):
    """Answer for the first ``last`` postures of a new session, and end."""
    with pytest.raises(InputError, match="the answers ended") as stopped:
        calibrate(run, hand := Hand(last), **options)
    assert hand.asked == list(range(1, last + 1))
    return stopped


def test_what_was_typed_is_not_asked_for_again(run, caplog):
    caplog.set_level(logging.WARNING, logger="rejoint")
    stopped = leave(run, 3)
    assert any("the same command goes on there" in note for note in stopped.value.__notes__)
    kept, session = read_interrupted(run.folder.measurements, ARM)
    assert (len(kept), session.answered, session.fresh) == (2, 3, False)

    found = calibrate(run, hand := Hand())
    assert hand.asked == [4, 5, 6]  # what was left out stays out
    assert "3 of 6 measurements are done" in caplog.text
    np.testing.assert_array_equal(found.measurements.point[:2], kept.point)
    assert found.calibration.points == len(found.measurements) == TOTAL - 1
    assert np.unique(found.measurements.posture, return_counts=True)[1].tolist().count(2) == COUNT - 1
    assert read_interrupted(run.folder.measurements, ARM) is None

    for answers in (0, 1):  # that one was at its end: another begins anew, once it has an answer
        leave(run, answers)
        assert len(list(run.path.glob("measurements-*.json"))) == answers


def full(path, _):
    raise FileError(path, "cannot be written (No space left on device)", "free some space")


def stopped(*given, found=fit.leave_out):
    rejoint.interrupt("the button")
    return found(*given)


def test_a_calibration_that_was_not_written_is_made_again_from_what_was_typed(run, monkeypatch):
    asked = []
    for place, what, error in (
        ("runs.stages.calibrate.write_calibration", full, UnsavedError),
        ("diagnosis.calibration.fit.leave_out", stopped, Interrupted),
    ):
        with monkeypatch.context() as broken:
            broken.setattr(f"rejoint.{place}", what)
            with pytest.raises(error):
                calibrate(run, hand := Hand())
        asked += hand.asked
        assert not run.folder.calibration.exists()
    found = calibrate(run, hand := Hand())
    assert found.calibration.points == TOTAL - 1
    assert [*asked, *hand.asked] == list(range(1, TOTAL + 1))
    assert run.folder.calibration.exists()


def test_another_session_is_refused_and_begun_anew_where_that_is_asked_for(run):
    leave(run, 2)
    before = run.folder.measurements.read_bytes()
    for other in ({"count": 4}, {"visits": 1}, {"gauge": Hand().gauge(frame="room")}):
        with pytest.raises(InputError, match="calibrate ROBOT RUN --fresh"):
            rejoint.calibrate(ROBOT, run=run, **({"gauge": Hand(0).gauge(), "count": COUNT} | other))
        assert run.folder.measurements.read_bytes() == before
    leave(run, 1, calibration="none")
    assert next(run.path.glob("measurements-*.json")).read_bytes() == before


def test_what_was_interrupted_can_be_fitted_as_it_is_and_is_at_its_end_then(run):
    leave(run, 5)
    before = run.folder.measurements.read_bytes()
    found = rejoint.calibrate(run=run, gauge=run.folder.measurements)
    assert found.calibration.points == 4
    assert read_interrupted(run.folder.measurements, ARM) is None
    assert next(run.path.glob("measurements-*.json")).read_bytes() == before

    whole = run.folder.calibration.read_bytes()
    wrong = replace(found.measurements, point=0.1 * found.measurements.point)  # cm as mm
    with pytest.raises(InputError, match="units"):
        rejoint.calibrate(run=run, gauge=wrong)
    assert run.folder.calibration.read_bytes() == whole


def test_a_damaged_session_is_one_line_and_no_guess(run):
    leave(run, 1)
    whole = run.folder.measurements.read_bytes()
    at = whole.index(b'"answered": 1')
    run.folder.measurements.write_bytes(whole[: at + 12] + b"5" + whole[at + 13 :])
    with pytest.raises(FileError, match="digest is another") as refused:
        calibrate(run, Hand())
    assert "calibrate ROBOT RUN --fresh" in refused.value.__notes__[-1]
    leave(run, 1, calibration="none")
