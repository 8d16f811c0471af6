"""A drive of weeks: what it keeps comes in pieces, idle arms fill no disk, and a full disk ends nothing."""

import itertools

import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.start import move
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from rejoint.session import driver
from rejoint.session.driver import RunRecorder
from rejoint.system.errors import FileError

ARM = mycobot280()


@pytest.fixture
def run(tmp_path):
    return Run.create(tmp_path, "emulated:worn", ARM)


def test_motions_of_one_connection_come_in_pieces(run, monkeypatch):
    monkeypatch.setattr("rejoint.session.driver.PIECE", 4.0)
    with rejoint.connect("emulated:worn", run=run.path, settings=rejoint.Settings(controller="default")) as arm:
        for y in (0.03, -0.03, 0.03, -0.03):
            arm.move_to([0.17, y, 0.2], within_m=0.1)
            with pytest.raises(rejoint.NotReachedError):
                arm.move_to([0.17, y, 0.2], within_m=1e-5, timeout_s=3.0)
    logs = sorted(run.logs.values(), key=lambda log: log.time[0])
    assert len(logs) >= 2
    for one, after in itertools.pairwise(logs):
        assert one.time[-1] <= after.time[0]
    assert sum(log.time[-1] - log.time[0] for log in logs) > 10.0
    assert not list((run.path / "logs").glob(".*.journal"))


def test_a_full_disk_is_told_once_and_the_next_piece_tries_again(run, monkeypatch):
    said: list[str] = []
    begin = driver.Journal
    full = FileError(run.path, "49 MB free on that disk, 50 MB needed", "free some space")
    outcomes = iter([None, full, full, None])

    def sometimes(*given):
        if error := next(outcomes):
            raise error
        return begin(*given)

    monkeypatch.setattr(driver, "Journal", sometimes)
    robot = open_robot("emulated:worn", arm=ARM)
    log = RunRecorder(run, said.append)
    log.begin(robot, "serve", "serve/posture")
    for _ in range(3):
        move(robot, ARM.rest, settle=0.2, on_cycle=log.see)
        log.turn()
    move(robot, ARM.rest, settle=0.2, on_cycle=log.see)
    log.end()
    robot.close()
    assert len(said) == 1
    assert "49 MB free" in said[0]
    assert "the arm goes on" in said[0]
    assert len(run.logs) == 2, "the first piece, and the one after there was room again"


def test_a_piece_in_which_nothing_came_is_not_kept(run):
    robot = open_robot("emulated:worn", arm=ARM)
    log = RunRecorder(run, print)
    log.begin(robot, "serve", "serve/posture")
    for keep in (False, True, False):
        move(robot, ARM.rest + 0.1, settle=0.2, on_cycle=log.see)
        log.turn(keep=keep)
    log.end()
    robot.close()
    assert len(run.logs) == 1
