"""Rendered pictures are where the projection says, and what is wrong with a picture is named."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_scenes import ARM, taken

import rejoint
from rejoint.arms import tcp_pose
from rejoint.arms.camera.board import ON_TOOL
from rejoint.arms.camera.lens import Lens
from rejoint.arms.camera.poses import turned
from rejoint.arms.camera.sighting import place
from rejoint.arms.camera.views import Detector, Unusable, read_picture
from rejoint.diagnosis.calibration.camera.track import ToolTracker
from rejoint.robots import livecamera
from rejoint.robots.lab.camera.rendering import Looks, render
from rejoint.robots.lab.camera.scene import LENS
from rejoint.system.errors import InputError

CLEAN = Looks(blur=0.5, noise=0.0)


def pose_of(seed, away=0.6):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = turned(rng.uniform(-0.5, 0.5, 3))
    pose[:3, 3] = [*rng.uniform(-0.12, 0.12, 2), away] - pose[:3, :3] @ [0.07, 0.05, 0.0]
    return pose


def errors(looks, seeds=range(6)):
    detector, found = Detector(ON_TOOL), []
    for seed in seeds:
        view = detector.find("p", render(ON_TOOL, LENS, pose_of(seed), seed, looks))
        points = ON_TOOL.corners[view.number] @ pose_of(seed)[:3, :3].T + pose_of(seed)[:3, 3]
        found.append(view.pixel - LENS.project(points))
    return np.concatenate(found)


def test_a_rendered_board_is_where_the_projection_says():
    off = errors(CLEAN)
    assert len(off) == 6 * 24
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.02)  # half a pixel would be 25 times that
    assert np.sqrt((off**2).mean()) < 0.05


def test_corners_are_as_good_as_the_fit_believes():
    assert 0.02 < np.sqrt((errors(Looks()) ** 2).mean()) < 0.15


def test_the_same_seed_gives_the_same_picture():
    first, again, other = (render(ON_TOOL, LENS, pose_of(1), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize(
    ("looks", "line"),
    [
        (Looks(blur=2.6), "blurred: its edges are"),
        (Looks(blur=6.0), "none of its markers is found, and nothing in the picture is sharp"),
        (Looks(shake=25.0), "blurred|none of its markers|corners of the board are seen"),
        (Looks(hidden=0.8), "of 24 corners of the board are seen|none of its markers"),
    ],
)
def test_what_is_wrong_with_a_picture_is_named(looks, line):
    found = Detector(ON_TOOL).find("third.png", render(ON_TOOL, LENS, pose_of(3), 3, looks))
    assert isinstance(found, Unusable)
    assert found.name == "third.png"
    assert re.search(line, found.why), found.why


def test_boards_that_are_not_the_one_described_are_named():
    shown = render(ON_TOOL, LENS, pose_of(3), 3, CLEAN)
    two = np.minimum(shown, np.roll(shown, 700, axis=1))
    two[:, :600] = np.roll(shown, -500, axis=1)[:, :600]
    narrow = replace(ON_TOOL, columns=5, rows=7)
    even = replace(ON_TOOL, rows=6)
    legacy = even.opencv()
    legacy.setLegacyPattern(True)
    printed = cv2.copyMakeBorder(legacy.generateImage((700, 600)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    for board, picture, line in (
        (ON_TOOL, shown[:, ::-1].copy(), "the picture is mirrored"),
        (ON_TOOL, two, "markers are seen twice"),
        (narrow, shown, "not where the board's description has them"),
        (even, printed, "pattern of OpenCV before 4.6"),
    ):
        found = Detector(board).find("p", picture)
        assert isinstance(found, Unusable)
        assert line in found.why


def test_a_phone_that_turns_its_pictures_does_not_turn_its_lens(tmp_path):
    shown = render(ON_TOOL, LENS, pose_of(3), 3, CLEAN)
    data = cv2.imencode(".jpg", shown)[1].tobytes()
    turned_half = bytes.fromhex("ffe100224578696600004d4d002a00000008000101120003000000010003000000000000")
    (tmp_path / "a.jpg").write_bytes(data[:2] + turned_half + data[2:])
    upside_down = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_GRAYSCALE)
    assert np.abs(upside_down[::-1, ::-1].astype(int) - shown).mean() < 3.0  # OpenCV reads the mark
    assert np.abs(read_picture(tmp_path / "a.jpg").astype(int) - shown).mean() < 3.0


def test_a_part_of_the_board_is_enough():
    view = Detector(ON_TOOL).find("p", render(ON_TOOL, LENS, pose_of(3), 3, Looks(hidden=0.4)))
    assert 8 <= len(view.number) < 24
    found = place(LENS, ON_TOOL.corners[view.number], view.pixel)
    np.testing.assert_allclose(found.pose[:3, 3], pose_of(3)[:3, 3], atol=1.5e-3)


def test_a_board_out_of_sight_is_a_wall():
    behind = pose_of(0)
    behind[2, 3] = -0.5
    found = Detector(ON_TOOL).find("p", render(ON_TOOL, LENS, behind, 0))
    assert found.why.startswith("the board cannot be seen")


def test_the_tool_is_found_in_one_picture_and_not_where_the_board_is_hidden():
    scene, links = taken().scene, taken().links
    tracker = ToolTracker(scene.rig)
    for i in (0, 7):
        seen = tracker.see(scene.picture(links[i], i), time=5.0)
        truth = tcp_pose(ARM, links[i])[:3, 3]
        assert np.linalg.norm(seen.place - truth) < min(1e-3, 6 * seen.sigma)
        assert tracker.why == ""
        assert seen.time == 5.0
    assert tracker.see(scene.picture(links[0], 0, Looks(hidden=0.9))) is None
    assert tracker.why
    view = taken().views[0]
    bent = type(view)(name="bent", number=view.number, pixel=view.pixel + np.where(view.number % 2, 4.0, -4.0)[:, None])
    assert tracker.sighting(bent) is None
    assert "px beside those of a flat board" in tracker.why


def test_no_camera_is_a_line():
    with pytest.raises(InputError, match="no camera answers as number 97"), livecamera.LiveCamera(97):
        pass


class Device:
    """A camera that shows its frame number, and then nothing."""

    def __init__(self, frames):
        self.frames, self.told = frames, {}

    def isOpened(self):  # noqa: N802
        return True

    def set(self, what, value):
        self.told[what] = value

    def read(self):
        self.frames -= 1
        return self.frames >= 0, np.full((4, 6, 3), 100 + self.frames % 2, np.uint8)

    def release(self):
        self.told["released"] = True


def test_a_live_camera_keeps_its_settings_and_is_given_back(monkeypatch):
    device = Device(500_000)
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: device)
    monkeypatch.setattr(livecamera, "PAUSE", 0.01)
    with livecamera.LiveCamera(0, exposure=80.0) as camera:
        picture = camera.still()
        device.frames = 0
        with pytest.raises(InputError, match="gives no pictures any more"):
            camera.picture()
    assert picture.shape == (4, 6)
    assert 100 <= picture.min() <= picture.max() <= 101
    assert device.told[cv2.CAP_PROP_AUTOFOCUS] == device.told[cv2.CAP_PROP_AUTO_WB] == 0.0
    assert (device.told[cv2.CAP_PROP_EXPOSURE], device.told["released"]) == (80.0, True)


MISSING_IN_SOME = {
    "calibrateHandEye", "calibrateRobotWorldHandEye",  # not in 5.0.0.93
    "estimatePoseSingleMarkers", "interpolateCornersCharuco", "calibrateCameraCharuco", "Dictionary_get",
    "CharucoBoard_create", "detectMarkersWithConfidence", "detectMarkersMultiDict",  # not in 4.7 and later, or 4.x
}  # fmt: skip


def test_only_what_opencv_4_and_5_both_have_is_used():
    used = set()
    for path in Path(rejoint.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                owner = ast.unparse(node.value)
                if owner in ("cv2", "cv2.aruco"):
                    used.add((owner, node.attr))
    assert len(used) > 20
    assert not MISSING_IN_SOME & {name for _, name in used}
    for owner, name in used:
        assert hasattr(cv2 if owner == "cv2" else cv2.aruco, name), name


def test_a_lens_has_a_picture():
    with pytest.raises(InputError, match="focal length above 0"):
        Lens(width=10, height=10, f=0.0, cx=0.0, cy=0.0)
