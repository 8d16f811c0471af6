"""Calibrating with a camera: what is taken survives, what goes wrong is one line, and the same rig watches the arm."""

import time
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import rejoint
from rejoint.arms import Displacement, mycobot280, tcp_pose
from rejoint.camera import filming
from rejoint.camera.board import ON_TOOL
from rejoint.camera.film import Film, read_folder
from rejoint.camera.filming import CameraGauge
from rejoint.camera.rig import write_rig
from rejoint.camera.tracker import LiveEye
from rejoint.diagnosis.calibration.calibration import read_calibration
from rejoint.diagnosis.calibration.procedure import StandingDrive
from rejoint.runs.run import Run
from rejoint.session.motions import opened_eye
from rejoint.system.errors import InputError
from rejoint.system.files import write_bytes
from rejoint_lab.cameras import EmulatedCamera, beside, render
from standin import StandIn
from waiting import until

ARM = mycobot280()
SCENE = beside(ARM)


class Still(StandIn):
    """An arm whose encoders are where they were sent at once, and whose links are elsewhere, the same each time."""

    behind = replace(Displacement.none(ARM), compliance=np.full(6, 0.02), play=np.full(6, 0.02))

    def __init__(self):
        super().__init__(period=0.2)

    def moved(self, command):
        return np.round(command, 6)  # as encoders count

    def tool(self):
        return tcp_pose(ARM, self.behind.joints(ARM, self.position[0]))


@cache
def rendered(tool, number):
    """Picture of the ``tool`` (4, 4) in bytes: every film here has the same ones."""
    return render(SCENE, np.frombuffer(tool).reshape(4, 4), (3, number))


class Cut(EmulatedCamera):
    """A camera whose cable is pulled at some picture."""

    def __init__(self, robot, last=np.inf):
        super().__init__(SCENE, robot.tool, 3)
        self.last, self.taken = last, []

    def still(self, number):
        if number > self.last:
            raise InputError("camera 0 gives no pictures any more; check its cable")
        self.taken.append(number)
        return rendered(self.tool().tobytes(), number)


def film(robot, camera, run, **options):
    gauge = CameraGauge(camera=lambda _: nullcontext(camera), board=ON_TOOL)
    with rejoint.Session(robot, run=run) as session:
        return gauge.film(StandingDrive(session.robot, session.limits), run.folder, 1, 2, lambda *_: None, **options)


def test_an_interrupted_film_goes_on_to_the_same_end(tmp_path, monkeypatch):
    monkeypatch.setattr(filming, "SCOUTS", filming.FEWEST_SCOUTS)
    runs = [Run.create(tmp_path / name, Still.address, ARM) for name in ("whole", "cut")]
    whole = film(robot := Still(), Cut(robot), runs[0])
    for last in (3, filming.SCOUTS + 1):
        with pytest.raises(InputError, match="check its cable") as stopped:
            film(robot := Still(), Cut(robot, last=last), runs[1])
        assert "the same command goes on there" in stopped.value.__notes__[0]
        assert len(read_folder(str(runs[1].folder.pictures), ARM, ON_TOOL).shots) == last
    camera = Cut(robot := Still())
    found = film(robot, camera, runs[1])
    assert camera.taken == [filming.SCOUTS + 2]
    for one, other in zip(found.shots, whole.shots, strict=True):
        assert (one.name, one.posture) == (other.name, other.posture)
        np.testing.assert_allclose(one.position, other.position, atol=1e-12)  # means of more or fewer readings
        np.testing.assert_allclose(one.seen.pixel, other.seen.pixel, atol=1e-6)
    assert len(list(runs[1].folder.pictures.glob("*.png"))) == len(found.shots)
    for name in ("view-002.png", "view-004.png"):
        (runs[1].folder.pictures / name).unlink()
    again = film(robot := Still(), camera, runs[1])  # no fit has followed
    assert camera.taken == [filming.SCOUTS + 2, 2, 4]
    assert [shot.name for shot in again.shots] == [shot.name for shot in whole.shots]
    write_bytes(runs[1].folder.camera, b"of a fit")
    for fresh in (False, True):
        anew = Cut(robot := Still(), last=1)
        with pytest.raises(InputError, match="check its cable") as stopped:
            film(robot, anew, runs[1], fresh=fresh)
        assert anew.taken == [1]
    assert len(read_folder(str(runs[1].folder.pictures), ARM, ON_TOOL).shots) == 1
    assert "the same command without --fresh goes on there" in stopped.value.__notes__[0]
    assert list(runs[1].path.glob("pictures-*"))


@pytest.mark.parametrize("done", [0, 3])
def test_a_film_that_was_killed_between_the_two_files_of_a_picture_goes_on(tmp_path, monkeypatch, done):
    run, left = Run.create(tmp_path, Still.address, ARM), [None] * done
    with monkeypatch.context() as patch:
        patch.setattr(filming, "write_bytes", lambda *given: left.pop() or write_bytes(*given))
        with pytest.raises(IndexError):
            film(robot := Still(), Cut(robot), run)
    camera = Cut(robot := Still(), last=done + 2)
    with pytest.raises(InputError, match="check its cable"):
        film(robot, camera, run)
    assert camera.taken == [done + 1, done + 2]


def test_pictures_that_do_not_fit_are_kept_for_another_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(CameraGauge, "film", lambda *_, **__: Film(board=ON_TOOL, carried="board"))
    gauge = CameraGauge(camera=lambda _: nullcontext(), board=ON_TOOL)
    with pytest.raises(InputError) as refused:
        rejoint.calibrate("emulated:worn", run=Run.create(tmp_path, "emulated:worn", ARM), gauge=gauge)
    assert "--fresh" in refused.value.__notes__[0]


def test_an_emulated_arm_is_calibrated_by_rendered_pictures(tmp_path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("calibrate", "emulated:worn", "run", "--measure", "camera=emulated", "--count", "2", "--once")
    done = cli(*words)
    assert "12 pictures come first" in done.err
    run = Run.open(tmp_path / "run")
    found = read_calibration(run.folder.calibration, ARM)
    assert (found.source, found.used) == ("camera", True)
    assert "The correction clearly helps" in done.out
    robot = rejoint.open_robot("emulated:worn")
    position, truth = robot.read().position, robot.true_tcp()
    assert np.linalg.norm(found.tool(position) - truth) < 0.5 * np.linalg.norm(
        tcp_pose(ARM, position)[0, :3, 3] - truth
    )
    kept = read_folder(str(run.folder.pictures), ARM, ON_TOOL)
    assert len(kept.usable) >= found.points > 10


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
        return True, cv2.cvtColor(render(SCENE, self.robot.tool(), (5, self.number)), cv2.COLOR_GRAY2BGR)

    def release(self):
        self.released = True


@pytest.mark.realtime
def test_a_camera_watches_a_real_arm_until_its_cable_is_pulled(tmp_path, monkeypatch, caplog):
    robot, run = Still(), Run.create(tmp_path, "test:still", ARM)
    device = FakeCapture(robot)
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: device)
    with pytest.raises(InputError, match="it is not known where it stands"), opened_eye("0", robot, run, 0):
        pass
    write_rig(run.folder.camera, ARM, SCENE, np.full(19, 1e-3), "")
    with opened_eye("0", robot, run, 0) as eye:
        until(lambda: eye.sighting(100.0) is not None)
        seen, now = eye.sighting(100.0), time.monotonic()
        assert np.linalg.norm(seen.place - robot.tool()[:3, 3]) < min(1.5e-3, 8 * seen.sigma)
        assert 90.0 < seen.time < 100.0  # on the robot's clock, somewhat earlier
        robot.position = robot.position + 0.05
        until(lambda: np.linalg.norm(eye.sighting(now).place - robot.tool()[:3, 3]) < 1.5e-3)
        device.pulled = True
        until(lambda: "check its cable" in eye.why)
    assert device.released
    assert "camera 0: camera 0 gives no pictures any more; check its cable" in caplog.text


@pytest.mark.realtime
def test_a_camera_that_hangs_is_not_believed(caplog):
    """It told for ever that the tool stood where it was, and the arm was pulled after it."""
    robot = Still()
    first, second = (render(SCENE, robot.tool(), (5, number)) for number in (0, 1))
    shown = [first]
    stream = SimpleNamespace(number=0, picture=lambda: (shown[-1], time.monotonic()))
    with LiveEye(stream, SCENE) as eye:
        until(lambda: "same picture for ever" in eye.why)

        def taken():
            return eye.sighting(100.0).time - 100.0 + time.monotonic()

        before = taken()
        time.sleep(0.1)
        assert taken() == pytest.approx(before, abs=0.02)  # it grows old
        shown.append(second)
        until(lambda: taken() > before + 0.05)
        until(lambda: "same picture for ever" in eye.why)
    assert "camera 0: gives the same picture for ever; plug it in again; the arm was driven by" in caplog.text
