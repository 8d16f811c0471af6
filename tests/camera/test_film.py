"""A film tells what lies behind the encoders, names what does not belong to it, and comes back from its files."""

from dataclasses import replace
from functools import partial

import camera_scenes
import cv2
import numpy as np
import pytest
from camera_scenes import ARM, WORN, taken

from rejoint.arms import tcp_pose, tcp_position
from rejoint.arms.rotations import inverse
from rejoint.camera.board import ON_TABLE, ON_TOOL
from rejoint.camera.film import (
    POSTURES,
    read_folder,
    write_postures,
)
from rejoint.system.errors import FileError, InputError
from rejoint_lab.cameras import LENS, render

SIZE = (LENS.width, LENS.height)
SWAPPED = ("view-05.png", "view-06.png")


def film_of(count):
    """Corners of the worn arm's board, two of whose pictures are swapped, and one picture that shows nothing."""
    film = camera_scenes.film_of(taken(count=count), names=SWAPPED)
    unseen = replace(film.shots[0].seen, name="white.jpg", why="the board cannot be seen")
    return film.with_shot(replace(film.shots[0], seen=unseen), SIZE)


@pytest.fixture(scope="module")
def filmed():
    return film_of(22).fit(ARM, date="2026-01-31")


def test_the_tool_lies_within_the_interval_of_a_displacement(filmed):
    found = filmed.calibration
    rng = np.random.default_rng(9)
    position = ARM.rest + rng.uniform(-0.3, 0.3, (40, ARM.joints))
    truth = tcp_position(ARM, WORN.joints(ARM, position))
    _, low, high = found.distance(position, truth)
    assert np.mean(low == 0.0) > 0.9  # the tool may be where it is
    assert (high < 0.01).all()
    assert found.used
    assert found.after < 0.7 * found.before
    assert (found.source, found.frame_name) == ("camera", "camera")


def test_what_does_not_belong_to_a_film_is_named(filmed):
    left = dict(filmed.left_out)
    assert set(left) == {*SWAPPED, "white.jpg"}
    assert any("swapped" in left[name] for name in SWAPPED)
    assert len(filmed.residuals) == len(filmed.measurements) == filmed.calibration.points == 20


def test_pictures_of_a_folder_are_read_with_their_postures(tmp_path):
    t, film, read = taken(), film_of(3), partial(read_folder, str(tmp_path), ARM, ON_TOOL)
    write_postures(tmp_path / POSTURES, ARM, film)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"view-0{k}.png"), render(t.rig, tcp_pose(ARM, t.links[k]), k))
    found = read()
    assert [shot.name for shot in found.shots] == [shot.name for shot in film.shots[:3]]
    for one, other in zip(found.usable, film.shots, strict=False):
        np.testing.assert_allclose(one.position, other.position, atol=1e-7)
    some = read_folder(f"{tmp_path}/view-0[12].png", ARM, ON_TOOL).shots
    assert [shot.name for shot in some] == ["view-01.png", "view-02.png"]
    (tmp_path / "view-02.png").write_bytes(b"no picture")
    (tmp_path / "notes.txt").write_text("skipped")
    unreadable = read().unusable
    assert unreadable == (("view-02.png", "is no picture that OpenCV can read"),)
    first = (tmp_path / "view-00.png").read_bytes()
    (tmp_path / "view-00.png").write_bytes(b"no picture")
    assert len(read().usable) == 1
    (tmp_path / "view-00.png").write_bytes(first)
    cv2.imwrite(str(tmp_path / "view-02.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(InputError, match=r"view-02.png has 640 x 480 px, those before it 1920 x 1080"):
        read()
    cv2.imwrite(str(tmp_path / "view-09.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(FileError, match=r"no joint positions for view-09.png \(1 pictures\)"):
        read()
    (tmp_path / POSTURES).write_text("picture,joint1\n")
    with pytest.raises(FileError, match=r"missing: position\.joint1_deg"):
        read()


def test_a_print_of_another_size_is_noticed_by_how_the_arm_moves():
    film = film_of(20)
    scouted = replace(film, shots=tuple(shot for shot in film.shots if shot.name not in SWAPPED))
    rig = scouted.located(ARM, 10)[0]
    assert np.linalg.norm((inverse(rig.standing) @ taken().rig.standing)[:3, 3]) < 0.03
    for larger in (1.03, ON_TABLE.square / ON_TOOL.square):
        board = replace(ON_TOOL, square=larger * ON_TOOL.square, marker=larger * ON_TOOL.marker)
        with pytest.raises(InputError, match=r"(19\.[6-9]|20\.[0-4]) mm"):
            replace(scouted, board=board).located(ARM, 10)


def test_a_bent_board_is_refused():
    """A bow of two percent moved the tool by 13 mm, though the corners fitted within 0.6 px."""
    t, rng = taken(count=22), np.random.default_rng(0)
    rig, views = t.rig, []
    corners = rig.board.corners
    corners[:, 2] = 0.02 * (2 * corners[:, 0] - rig.board.size[0]) ** 2 / rig.board.size[0]
    for view, pose in zip(t.views, rig.sight(tcp_pose(ARM, t.links)), strict=True):
        pixel = rig.lens.project(corners @ pose[:3, :3].T + pose[:3, 3])
        views.append(replace(view, pixel=pixel + 0.1 * rng.standard_normal(pixel.shape)))
    with pytest.raises(InputError, match="the board is not flat"):
        camera_scenes.film_of(replace(t, views=views)).fit(ARM)
