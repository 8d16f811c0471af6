"""The studio without a page: one job at a time, a stop that ends each of them, and errors from which one can go on."""

import re
import threading
import time
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280, tcp_position
from rejoint.control.recording import Observer, Observers
from rejoint.control.robot import WallClock
from rejoint.runs.fleet.file import name_arm
from rejoint.runs.repair import STAGES
from rejoint.runs.run import Run, mark
from rejoint.session.inputs import keep
from rejoint.studio import jobs
from rejoint.studio.machine import Studio
from rejoint.system.errors import AddressError
from waiting import until


class RealTime(Observer):
    """Slows an emulated arm down to the wall clock."""

    def watch(self, robot, **_):
        return WallClock(robot, lambda: 1.0)


GO = partial(jobs.go_to, target=np.array([0.17, 0.0, 0.2]))


def do(studio, job, *answers):
    """Do a job to its end, with answers to its questions; return the status."""
    assert studio.do("a job", job)
    given = list(answers)
    while studio.status.busy:
        if studio.status.question and given:
            studio.answer(studio.status.question, given.pop(0))
        time.sleep(0.01)
    return studio.status


def under_way(studio, start):
    seen = studio.seen
    return not studio.status.busy or (seen is not None and np.abs(seen.position[0] - start).sum() > 0.05)


def rest(studio):
    until(lambda: not studio.status.busy, 5.0)


def take(studio, address="emulated:worn", kind=None):
    return do(studio, partial(jobs.choose, address=address, name=kind))


def test_an_owner_is_led_from_the_arm_to_a_point_of_his_own(studio, few_targets):
    assert "emulated:worn" in do(studio, jobs.look).found["arms"].values()
    status = take(studio)
    assert (status.step, status.arm.name, status.error) == ("check", "mycobot280", "")
    assert not any(one.fix for one in status.found["checks"])
    assert do(studio, jobs.nudge, "no").step == "check"
    assert studio.status.error
    assert do(studio, jobs.nudge, "yes").step == "diagnose"
    status = do(studio, partial(jobs.diagnose, quick=True))
    assert status.found["diagnosis"].condition in ("worn", "bad")
    marks = jobs.marks(status.arm, status.found["diagnosis"])
    assert set(marks) <= set(range(status.arm.joints))
    assert any("mm" in text for text in marks.values())
    assert rejoint.Run.open(status.run).diagnosis is not None
    points = [np.array([0.17, 0.0, 0.2]), np.array([0.18, 0.04, 0.21])]
    before, after = do(studio, partial(jobs.prove, points=points)).found["proof"]
    errors = [np.mean([visit.error for visit in done.visits]) for done in (before, after)]
    assert errors[1] < 0.3 * errors[0]
    target = np.array([0.18, 0.02, 0.2])
    assert not do(studio, partial(jobs.go_to, target=target, within=5e-4)).error
    place = tcp_position(status.arm, studio.session().state.joints_rad)
    assert np.linalg.norm(place - target) < 1e-3


def test_a_calibration_by_typed_numbers_asks_for_every_posture(studio):
    take(studio, "emulated:healthy")
    assert studio.do("calibration", lambda machine: jobs.calibrate(machine, jobs.RULER, 2, "", 0))
    asked = set()
    while studio.status.busy:
        question = studio.status.question
        if question and question not in asked:
            asked.add(question)
            x, y, z = re.search(r"at (\S+) (\S+) (\S+) mm", question).groups()
            studio.answer(question, f"{x} {y} {z}")
        time.sleep(0.01)
    assert not studio.status.error, studio.status.error
    assert len(asked) == 4
    assert rejoint.Run.open(studio.status.run).folder.calibration.exists()


def test_only_one_job_is_done_at_a_time_and_a_question_is_answered_once(studio):
    heard = []
    assert studio.do("first", lambda machine: heard.append(machine.ask("which one?")))
    assert not studio.do("second", lambda _: heard.append("second"))
    until(lambda: studio.status.question)
    studio.answer("another one?", "early")
    studio.answer("which one?", "this")
    studio.answer("which one?", "twice")
    rest(studio)
    studio.answer("which one?", "late")
    assert heard == ["this"]


def test_a_load_is_of_the_arm_that_carries_it_and_holds_instead_of_that_of_the_run(studio, tmp_path):
    keep(Run.create(tmp_path / "runs" / "mine", "emulated:worn", mycobot280()), rejoint.Settings(payload=0.1))
    take(studio)
    for grams in (50.0, 0.0):
        do(studio, partial(jobs.carry, grams=grams))
        assert studio.session().settings.payload == 1e-3 * grams
    assert take(studio, "tcp://127.0.0.1:9").error
    assert studio.settings.payload == 0.0
    take(studio, "emulated:so101")
    assert studio.settings.payload is None


def test_stop_ends_a_question_and_a_job_that_moves_nothing(studio):
    assert studio.do("asking", lambda machine: machine.ask("which one?"))
    until(lambda: studio.status.question)
    studio.stop()
    rest(studio)
    assert "stop" in studio.status.error

    def busy(machine):
        while True:
            machine.observer.progress(0.5, "thinking")
            time.sleep(0.005)

    assert studio.do("thinking", busy)
    studio.stop()
    rest(studio)
    assert studio.do("next", lambda _: None)


@pytest.mark.realtime
def test_stop_holds_a_moving_arm_at_once_and_the_studio_goes_on(studio):
    studio.observer = Observers(studio, RealTime())
    take(studio)
    do(studio, GO)
    for number in range(5):
        side = 0.09 * (-1) ** number
        start = studio.session().state.joints_rad
        assert studio.do("going", partial(jobs.go_to, target=np.array([0.16, side, 0.2]), within=1e-4))
        until(partial(under_way, studio, start))
        assert studio.status.busy, studio.status.error
        pressed = time.monotonic()
        threading.Thread(target=studio.stop).start()
        rest(studio)
        assert time.monotonic() - pressed < 0.3
        assert "stopped" in studio.status.error
    assert not do(studio, GO).error


def test_an_arm_that_is_gone_is_one_line_and_the_next_try_connects_again(studio, monkeypatch):
    status = take(studio, "tcp://127.0.0.1:9")
    assert status.error
    assert "\n" not in status.error
    assert (status.step, status.address) == ("find", "")
    take(studio)
    session = studio.session()
    monkeypatch.setattr(type(session), "move_to", Mock(side_effect=AddressError("the arm is off")))
    status = do(studio, GO)
    assert status.error == "the arm is off"
    monkeypatch.undo()
    assert "tcp:" in take(studio, "tcp://127.0.0.1:9").error
    assert do(studio, partial(jobs.carry, grams=5000.0)).error
    assert not do(studio, GO).error
    assert studio.session() is not session


def test_an_arm_with_a_name_is_offered_and_is_the_described_one(studio, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    name_arm("bench-3", address="emulated:worn?seed=5", description="mycobot280")
    label = next(iter(do(studio, jobs.look).found["arms"]))
    assert "bench-3" in label
    status = take(studio, studio.status.found["arms"][label])
    assert (status.address, status.step) == ("emulated:worn?seed=5", "check"), status.error


def test_a_known_arm_is_used_at_once(studio, tmp_path, few_targets):
    take(studio)
    do(studio, partial(jobs.diagnose, quick=True))
    again = Studio(tmp_path / "runs")
    status = take(again)
    assert status.run == studio.status.run
    assert status.found["diagnosis"] is not None
    assert take(again, kind="so101").run is None
    again.leave()


def test_an_arm_that_answers_at_a_port_is_offered_with_its_address(studio, monkeypatch):
    monkeypatch.setattr(jobs, "ports", lambda: dict.fromkeys("ab"))
    monkeypatch.setattr(jobs, "arm_at", {"a": "feetech:///a"}.get)
    assert {"feetech:///a", ""} <= {*jobs.candidates(studio.home).values()}


def test_a_quick_try_in_a_folder_of_any_name_is_left_for_another(studio, tmp_path):
    run = Run.create(tmp_path / "mine", "emulated:worn", mycobot280(), seed=3)
    mark(run.folder.quick)
    studio.change(run=run.path, address=run.robot, arm=run.arm)
    assert studio.begin_run(quick=True).path == run.path != studio.begin_run(quick=False).path


def test_every_stage_of_a_repair_has_a_time():
    assert set(jobs.EXPECTED) == set(STAGES)
