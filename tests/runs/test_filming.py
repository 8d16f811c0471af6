"""Calibrating with a camera: what is taken survives, what goes wrong is one line, and the same rig watches the arm."""

import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import rejoint
from rejoint.arms import Displacement, mycobot280, tcp_pose
from rejoint.arms.camera.board import ON_TOOL, write_board
from rejoint.arms.camera.rigfile import write_rig
from rejoint.cli import main
from rejoint.cli.console import Terminal
from rejoint.cli.measuring import gauge_by_word
from rejoint.control.robot import JointState
from rejoint.diagnosis.calibration.camera import filming
from rejoint.diagnosis.calibration.camera.filmfile import read_film, read_folder
from rejoint.diagnosis.calibration.camera.filming import CameraGauge, FilmDrive, UnseenBoardError
from rejoint.diagnosis.calibration.file import read_calibration
from rejoint.robots.emulatedcamera import EmulatedCamera
from rejoint.robots.lab.camera.rendering import Looks
from rejoint.robots.lab.camera.scene import beside
from rejoint.robots.livecamera import LiveCamera
from rejoint.runs.run import Run
from rejoint.runs.stages.eyes import opened_eye
from rejoint.runs.stages.filming import film_of
from rejoint.runs.stages.liveeye import LiveEye
from rejoint.system.errors import InputError
from rejoint.system.extras import EXTRAS

ARM = mycobot280()
SCENE = beside(ARM)


class Still:
    """An arm whose encoders are where they were sent at once, and whose links are elsewhere, the same each time."""

    arm, address, count = ARM, "test:still", 1

    def __init__(self):
        self.position, self.time = ARM.rest[None].copy(), np.zeros(1)
        self.behind = Displacement(
            offset=np.zeros(6), compliance=np.full(6, 0.02), play=np.full(6, 0.02), twist=np.zeros((7, 6)),
            gravity=np.array([0.0, 0.0, -9.81]),
        )  # fmt: skip

    def read(self):
        return JointState(time=self.time.copy(), position=self.position.copy(), age=np.zeros(1))

    def step(self, command, active=None):  # noqa: ARG002 - one arm
        self.position, self.time = np.round(command, 6), self.time + 0.2  # as encoders count
        return self.read()

    def tool(self):
        return tcp_pose(ARM, self.behind.joints(ARM, self.position[0]))

    def true_tcp(self):
        return np.full((1, 3), np.nan)

    def stop(self):
        pass

    def close(self):
        pass


class Cut(EmulatedCamera):
    """A camera whose cable is pulled at some picture."""

    def __init__(self, robot, last=np.inf, looks=None):
        super().__init__(SCENE, robot.tool, 3)
        self.last, self.looks, self.taken = last, looks, []

    def still(self, number):
        if number > self.last:
            raise InputError("camera 0 gives no pictures any more; check its cable")
        self.taken.append(number)
        return SCENE.shows(self._tool(), (3, number), self.looks)


def film(robot, camera, run, **options):
    gauge = CameraGauge(camera=lambda _: nullcontext(camera), board=ON_TOOL)
    return film_of(robot, gauge, run, None, 1, 2, lambda *_: None, **options)


def test_an_interrupted_film_goes_on_to_the_same_end(tmp_path, monkeypatch):
    monkeypatch.setattr(filming, "SCOUTS", filming.FEWEST_SCOUTS)
    runs = [Run.create(tmp_path / name, "test:still", ARM) for name in ("whole", "cut")]
    whole = film(robot := Still(), Cut(robot), runs[0])
    for last in (3, filming.SCOUTS + 1):
        with pytest.raises(InputError, match="check its cable") as stopped:
            film(robot := Still(), Cut(robot, last=last), runs[1])
        assert "the same command goes on there" in stopped.value.__notes__[0]
        kept, ended = read_film(runs[1].folder.views, ARM)
        assert (len(kept), ended) == (last, False)
    camera = Cut(robot := Still())
    found = film(robot, camera, runs[1])
    assert camera.taken == [filming.SCOUTS + 2]
    assert [shot.number for shot in found.shots] == list(range(1, filming.SCOUTS + 3))
    for one, other in zip(found.shots, whole.shots, strict=True):
        assert (one.name, one.posture, one.side) == (other.name, other.posture, other.side)
        np.testing.assert_allclose(one.position, other.position, atol=1e-12)  # means of more or fewer readings
        np.testing.assert_allclose(one.seen.pixel, other.seen.pixel, atol=1e-6)
    assert len(list(runs[1].folder.pictures.glob("*.jpg"))) == len(found)
    anew = Cut(robot := Still(), last=1)
    with pytest.raises(InputError, match="check its cable"):
        film(robot, anew, runs[1], afresh=True)
    assert len(read_film(runs[1].folder.views, ARM)[0]) == 1
    assert read_film(runs[1].folder.views, ARM)[0].afresh
    with pytest.raises(InputError, match="check its cable") as stopped:  # without --afresh, and still so
        film(robot := Still(), Cut(robot, last=2), runs[1])
    assert "the same command without --afresh goes on there" in stopped.value.__notes__[0]
    kept, _ = read_film(runs[1].folder.views, ARM)
    assert (len(kept), kept.afresh) == (2, True)
    assert list(runs[1].path.glob("views-*.parquet"))


def test_a_board_that_is_not_seen_at_rest_is_a_line_before_anything_else_moves(tmp_path):
    run = Run.create(tmp_path / "run", "test:still", ARM)
    camera = Cut(robot := Still(), looks=Looks(hidden=0.95))
    with pytest.raises(UnseenBoardError, match="in the rest posture, where the arm stands now"):
        film(robot, camera, run)
    assert camera.taken == [1]
    np.testing.assert_allclose(robot.position[0], ARM.rest, atol=1e-6)
    assert not run.folder.views.exists()  # camera or board will be moved


def test_a_board_that_is_hardly_seen_is_a_line(monkeypatch):
    monkeypatch.setattr(filming, "SCOUTS", 3)
    camera = Cut(robot := Still())
    drive = FilmDrive(robot=robot, camera=camera, film=filming.Film(board=ON_TOOL, carried="board"))
    with pytest.raises(UnseenBoardError, match="in 3 of the 3 pictures about the rest posture, expected at least 6"):
        drive.take(1)


def run_cli(words, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["rejoint", *map(str, words)])
    with pytest.raises(SystemExit) as stopped:
        main()
    told = capsys.readouterr()
    return stopped.value.code, told.out, told.err


def test_an_emulated_arm_is_calibrated_by_rendered_pictures(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("calibrate", "emulated:worn", "run", "--camera", "emulated", "--count", "2", "--once")
    code, out, err = run_cli(words, capsys, monkeypatch)
    assert code == 0, err
    assert "14 pictures: 12 about the rest posture" in err
    run = Run.open(tmp_path / "run")
    found = read_calibration(run.folder.calibration, ARM)
    assert (found.source, found.used) == ("camera", True)
    assert "The correction clearly helps" in out
    kept, ended = read_film(run.folder.views, ARM)
    assert ended
    robot = rejoint.connect("emulated:worn")
    position, truth = robot.read().position, robot.true_tcp()
    assert np.linalg.norm(found.tool(position) - truth) < 0.5 * np.linalg.norm(
        tcp_pose(ARM, position)[0, :3, 3] - truth
    )
    again = read_folder(str(run.folder.pictures), ARM, ON_TOOL)  # the pictures alone tell the same
    for one, other in zip(again.usable, kept.usable, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-7)
        assert np.sqrt(np.mean((one.seen.pixel - other.seen.pixel) ** 2)) < 0.1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--camera", "0"), "cannot see emulated:worn; watch an emulated arm with --camera emulated"),
        (("--camera", "emulated", "--board-on", "wall"), "expected one of tool, table"),
        (("--camera", "emulated=truth.csv"), "truth.csv: no such file"),
        (("--camera", "pictures"), "which board is it?"),
        (("--camera", "pictures", "--board", "board.toml"), "no such pictures"),
        (("--camera", "emulated", "--touch"), "one of --touch, --tracker FILE, --camera WORD and --points FILE"),
        (("--board", "board.toml"), "go with --camera"),
    ],
)
def test_what_cannot_be_is_a_line(words, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "--board" in words:
        write_board(tmp_path / "board.toml", ON_TOOL)
    code, _, err = run_cli(("calibrate", "emulated:worn", "run", *words), capsys, monkeypatch)
    assert code == 2
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_without_opencv_a_line_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(EXTRAS, "camera", ("cv3",))
    code, _, err = run_cli(("calibrate", "emulated:worn", "run", "--camera", "emulated"), capsys, monkeypatch)
    assert code == 2
    assert err.startswith("error: rejoint calibrate --camera needs more than the base installation (missing: cv3)")
    assert "pip install 'rejoint[camera]'" in err


def test_a_repair_is_told_of_a_camera_by_a_word(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert isinstance(gauge_by_word(Terminal(), "emulated:worn", "camera", 0), CameraGauge)
    with pytest.raises(InputError, match="which board is it"):
        gauge_by_word(Terminal(), "tcp://10.0.0.1:9000", "camera=1", 0)
    write_board(tmp_path / "board.toml", ON_TOOL)
    gauge = gauge_by_word(Terminal(), "tcp://10.0.0.1:9000", "camera=1", 0)
    camera = gauge.camera(None)
    assert isinstance(camera, LiveCamera)
    assert (camera.number, gauge.board) == (1, ON_TOOL)


class FakeCapture:
    """What OpenCV opens: rendered frames of an arm, a few times a second, until the cable is pulled."""

    def __init__(self, robot):
        self.robot, self.number, self.pulled = robot, 0, False

    def isOpened(self):  # noqa: N802 - as OpenCV calls it
        return True

    def set(self, what, value):
        pass

    def read(self):
        time.sleep(0.01)
        self.number += 1
        if self.pulled:
            return False, None
        return True, cv2.cvtColor(SCENE.shows(self.robot.tool(), (5, self.number)), cv2.COLOR_GRAY2BGR)

    def release(self):
        self.released = True


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


def test_a_camera_watches_a_real_arm_until_its_cable_is_pulled(tmp_path, monkeypatch, caplog):
    robot, run = Still(), Run.create(tmp_path / "run", "test:still", ARM)
    device = FakeCapture(robot)
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: device)
    with pytest.raises(InputError, match="it is not known where it stands"), opened_eye("0", robot, run, 0):
        pass
    write_rig(run.folder.camera, ARM, SCENE.rig, np.full(19, 1e-3))
    with opened_eye("0", robot, run, 0) as eye:
        wait_for(lambda: eye.sighting(100.0) is not None)
        seen, now = eye.sighting(100.0), time.monotonic()
        assert np.linalg.norm(seen.place - robot.tool()[:3, 3]) < min(1.5e-3, 8 * seen.sigma)
        assert 90.0 < seen.time < 100.0  # on the robot's clock, somewhat earlier
        robot.position = robot.position + 0.05
        wait_for(lambda: np.linalg.norm(eye.sighting(now).place - robot.tool()[:3, 3]) < 1.5e-3)
        device.pulled = True
        wait_for(lambda: "check its cable" in eye.why)
    assert device.released
    assert "camera 0: camera 0 gives no pictures any more; check its cable" in caplog.text


def test_a_camera_that_hangs_is_not_believed(caplog):
    """It told for ever that the tool stood where it was, and the arm was pulled after it."""
    robot = Still()
    first, second = (SCENE.shows(robot.tool(), (5, number)) for number in (0, 1))
    shown = [first]
    stream = SimpleNamespace(picture=lambda: (shown[-1], time.monotonic()))
    with LiveEye(stream, SCENE.rig, name="camera 0") as eye:
        wait_for(lambda: "same picture for ever" in eye.why)
        before = eye.sighting(100.0).time - 100.0 + time.monotonic()
        time.sleep(0.1)
        assert eye.sighting(100.0).time - 100.0 + time.monotonic() == pytest.approx(before, abs=0.02)  # it grows old
        shown.append(second)
        wait_for(lambda: eye.sighting(100.0).time - 100.0 + time.monotonic() > before + 0.05)
        wait_for(lambda: "same picture for ever" in eye.why)
    assert "camera 0: gives the same picture for ever; plug it in again; the arm was driven by" in caplog.text


def test_a_camera_with_other_pictures_or_before_an_emulated_arm_is_refused(tmp_path, monkeypatch):
    robot, run = Still(), Run.create(tmp_path / "run", "test:still", ARM)
    write_rig(run.folder.camera, ARM, SCENE.rig, np.full(19, 1e-3))
    small = SimpleNamespace(
        isOpened=lambda: True, set=lambda *_: None, release=lambda: None,
        read=lambda: (True, np.zeros((480, 640, 3), np.uint8)),
    )  # fmt: skip
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: small)
    with pytest.raises(InputError, match="pictures of 640 x 480 px, it was calibrated with 1920 x 1080"), \
            opened_eye("0", robot, run, 0):  # fmt: skip
        pass
    with pytest.raises(InputError, match="watch an emulated arm with --camera emulated"), \
            opened_eye("0", rejoint.connect("emulated:worn"), run, 0):  # fmt: skip
        pass
    with pytest.raises(InputError, match="expected the number of a camera, or emulated"), \
            opened_eye("webcam", robot, run, 0):  # fmt: skip
        pass
