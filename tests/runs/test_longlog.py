"""A drive of weeks: what it keeps comes in pieces, idle arms fill no disk, and a full disk ends nothing."""

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.guard import GuardLimits
from rejoint.control.playback import move
from rejoint.control.posture import PostureController
from rejoint.control.recording import Recording
from rejoint.robots import open_robot
from rejoint.robots.serving.drive import ServedDrive, ServedWay
from rejoint.robots.serving.relay import Relay
from rejoint.robots.serving.served import ServedArm
from rejoint.runs.run import Run
from rejoint.runs.stages import longlog
from rejoint.runs.stages.longlog import LongLog
from rejoint.system.errors import FileError

ARM = mycobot280()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path / "run", "emulated:worn", ARM, 0)


def test_motions_of_one_connection_come_in_pieces(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rejoint.runs.stages.armdrive.PIECE", 4.0)
    with rejoint.connect("emulated:worn", run=run.path, controller="default") as arm:
        for y in (0.03, -0.03, 0.03, -0.03):
            arm.move_to([0.17, y, 0.2], within_m=0.1)
            with pytest.raises(rejoint.NotReachedError):
                arm.move_to([0.17, y, 0.2], within_m=1e-5, timeout_s=3.0)
            kept = sum(len(piece.time) for piece in arm._drive._pieces)
    logs = sorted(run.logs.values(), key=lambda log: log.time[0])
    assert len(logs) >= 2
    assert kept < 4.0 / 0.02, "what is on file is not in memory any more"
    for one, after in itertools.pairwise(logs):
        assert one.time[-1] <= after.time[0]
    assert sum(log.time[-1] - log.time[0] for log in logs) > 10.0
    assert not list((run.path / "logs").glob(".*.journal"))


def test_a_full_disk_is_told_once_and_the_next_piece_tries_again(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    begin, full = longlog.start_journal, FileError(run.path, "49 MB free on that disk, 50 MB needed", "free some space")
    outcomes = iter([None, full, full, None])

    def sometimes(*given):
        if error := next(outcomes):
            raise error
        return begin(*given)

    monkeypatch.setattr(longlog, "start_journal", sometimes)
    robot = open_robot("emulated:worn", arm=ARM)
    log = LongLog(run, robot, "serve", "serve/posture", said.append)
    piece = move(robot, ARM.rest, settle=0.2)
    for _ in range(3):
        log.turn(piece)
    log.end(piece)
    robot.close()
    assert len(said) == 1
    assert "49 MB free" in said[0]
    assert "the arm goes on" in said[0]
    assert len(run.logs) == 2, "the first piece, and the one after there was room again"


def test_a_drive_does_not_begin_on_a_full_disk(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(run.path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10_000_000))
    robot = open_robot("emulated:worn", arm=ARM)
    with pytest.raises(FileError, match=r"10\.0 MB free on that disk, 50\.0 MB needed"):
        LongLog(run, robot, "serve", "serve/posture", print)
    robot.close()


class Pieces:
    """A log that only remembers what it was told to keep."""

    def __init__(self) -> None:
        self.kept: list[Recording | None] = []

    def see(self, cycle: object) -> None:
        pass

    def turn(self, piece: Recording | None) -> None:
        self.kept.append(piece)

    def rescue(self, piece: Recording | None) -> str:
        raise AssertionError(piece)


def test_an_arm_without_orders_leaves_no_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rejoint.robots.serving.drive.PIECE", 1.0)
    robot, served, log = open_robot("emulated:worn", arm=ARM), ServedArm(ARM, ARM.rest), Pieces()
    orders = 0

    def count() -> int:
        nonlocal orders
        if len(log.kept) == 1 and orders == 0:  # nothing came in the first piece; a move does in the second
            orders = 1
            served.move_joints(ARM.rest + 0.1, 1.0)
            return 0
        return orders

    way = ServedWay(served)
    drive = ServedDrive(
        robot=robot, served=served, controller=PostureController(ARM, way), way=way, limits=GuardLimits.of(ARM),
        relay=Relay(None), over=lambda: len(log.kept) == 4, orders=count,
    )  # fmt: skip
    drive.until_over(robot.read().position.copy(), log)
    robot.close()
    assert [piece is not None for piece in log.kept] == [False, True, False, False]
    assert np.ptp(log.kept[1].command, axis=0).max() > 0.05
