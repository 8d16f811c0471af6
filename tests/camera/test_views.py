"""Rendered pictures are where the projection says, and what is wrong with a picture is named."""

from dataclasses import replace
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from camera_scenes import ARM, facing, taken

from rejoint.arms import tcp_pose
from rejoint.camera import tracker
from rejoint.camera.board import ON_TOOL, Detector
from rejoint.camera.rig import Rig
from rejoint.camera.tracker import sighting
from rejoint.system.errors import InputError
from rejoint_lab.cameras import LENS, render

PLAIN = Rig(lens=LENS, board=ON_TOOL, carried="board", standing=np.eye(4), mounted=np.eye(4))
CLEAN = {"blur": 0.5, "noise": 0.0}


def pose_of(seed):
    return facing(np.random.default_rng(seed), tilt=0.5, aside=0.12)


def errors(looks=MappingProxyType({}), seeds=range(6)):
    detector, found = Detector(ON_TOOL), []
    for seed in seeds:
        view = detector.find("p", render(PLAIN, pose_of(seed), seed, **looks))
        points = ON_TOOL.corners[view.number] @ pose_of(seed)[:3, :3].T + pose_of(seed)[:3, 3]
        found.append(view.pixel - LENS.project(points))
    return np.concatenate(found)


def test_a_rendered_board_is_where_the_projection_says():
    off = errors(CLEAN)
    assert len(off) == 6 * 24
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.02)  # half a pixel would be 25 times that
    assert np.sqrt((off**2).mean()) < 0.05


def test_corners_are_as_good_as_the_fit_believes():
    assert 0.02 < np.sqrt((errors() ** 2).mean()) < 0.15


def test_a_board_out_of_sight_is_a_wall():
    behind = pose_of(0)
    behind[2, 3] = -0.5
    found = Detector(ON_TOOL).find("p", render(PLAIN, behind, 0))
    assert found.why.startswith("the board cannot be seen")


def test_the_tool_is_found_in_one_picture_and_not_where_the_board_is_hidden():
    rig, links = taken().rig, taken().links
    detector = Detector(rig.board)
    for i in (0, 7):
        seen = sighting(rig, detector.find("p", render(rig, tcp_pose(ARM, links[i]), i)), 5.0)
        truth = tcp_pose(ARM, links[i])[:3, 3]
        assert np.linalg.norm(seen.place - truth) < min(1e-3, 6 * seen.sigma)
        assert seen.time == 5.0
    wall = detector.find("p", np.full_like(render(rig, tcp_pose(ARM, links[0]), 0), 140))
    assert sighting(rig, wall, 0.0) == wall.why != ""
    view = taken().views[0]
    bent = replace(view, pixel=view.pixel + np.where(view.number % 2, 4.0, -4.0)[:, None])
    assert "px beside those of a flat board" in sighting(rig, bent, 0.0)


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
    monkeypatch.setattr(tracker, "PAUSE", 0.01)
    with tracker.LiveCamera(0) as camera:
        picture = camera.still(1)
        device.frames = 0
        with pytest.raises(InputError, match="gives no pictures any more"):
            camera.picture()
    assert picture.shape == (4, 6)
    assert 100 <= picture.min() <= picture.max() <= 101
    assert device.told[cv2.CAP_PROP_AUTOFOCUS] == device.told[cv2.CAP_PROP_AUTO_WB] == 0.0
    assert device.told["released"]
