"""One fit finds lens, camera, board and arm, and names the views that do not belong to the others."""

from dataclasses import replace

import numpy as np
import pytest
from camera_scenes import ARM, WORN, film_of, taken

from rejoint.arms import tcp_pose, tcp_position
from rejoint.camera.board import BoardView
from rejoint.camera.rig import place


@pytest.fixture(scope="module")
def found():
    return film_of(taken()).fit(ARM)


def fresh():
    """Postures within the region of targets that no view shows, and where the links are there but for the play."""
    rng = np.random.default_rng(9)
    position = ARM.rest + rng.uniform(-0.3, 0.3, (40, ARM.joints))
    return position, WORN.joints(ARM, position)


def test_the_displacement_predicts_the_tool(found):
    position, links = fresh()
    before = np.linalg.norm(tcp_position(ARM, position) - tcp_position(ARM, links), axis=-1)
    assert before.mean() > 6e-3
    assert error_of(found) < 1.0e-3
    assert not found.left_out


def test_lens_camera_and_board_are_found(found):
    rig = taken().rig
    sigma = found.rig_sigma[:7]
    assert (np.abs(found.rig.lens.numbers - rig.lens.numbers) < 4 * sigma).all()
    assert sigma[0] < 0.01 * rig.lens.f
    np.testing.assert_allclose(found.rig.standing[:3, 3], rig.standing[:3, 3], atol=6e-3)
    np.testing.assert_allclose(found.rig.mounted[:3, 3], rig.mounted[:3, 3], atol=1.5e-3)
    assert np.mean([one.rms for one in found.residuals]) == pytest.approx(0.1, rel=0.3)  # of the corners' noise


def test_every_number_has_an_interval(found):
    own = found.calibration
    sigma = np.sqrt(np.diag(own.covariance))
    assert (sigma > 0).all()
    inside = [
        np.abs(getattr(own.displacement, kind) - getattr(WORN, kind)) < 2 * sigma[own.layout.at(kind)]
        for kind in ("offset", "compliance", "play")
    ]
    assert np.mean(inside) > 0.85


def test_one_picture_tells_where_the_tool_is(found):
    t = taken()
    _, links = fresh()
    truth = tcp_pose(ARM, links)
    # what counts is what the camera shows, and the lens and the poses that were found belong together
    pixel = t.rig.lens.project
    off = []
    for pose, true in zip(t.rig.sight(truth), truth, strict=True):
        corners = t.rig.board.corners
        seen = pixel(corners @ pose[:3, :3].T + pose[:3, 3])
        view = BoardView(name="seen", number=np.arange(len(corners)), pixel=seen)
        put = found.rig.tool(place(found.rig.lens, found.rig.board, view).pose[None])[0]
        off.append(put[:3, 3] - true[:3, 3])
    assert np.linalg.norm(off, axis=1).mean() < 0.8e-3


def test_swapped_and_crooked_views_are_named_and_left_out():
    t = taken()
    views = list(t.views)
    views[4], views[9] = (replace(views[b], name=views[a].name) for a, b in ((4, 9), (9, 4)))
    rng = np.random.default_rng(0)
    views[15] = replace(views[15], name="bent", pixel=views[15].pixel + 3.0 * rng.standard_normal((24, 2)))
    found = film_of(replace(t, views=views)).fit(ARM)
    why = dict(found.left_out)
    assert set(why) == {"view-04.png", "view-09.png", "bent"}
    assert "not taken there, swapped" in why["view-04.png"]
    assert "of a flat board" in why["bent"]
    assert error_of(found) < 1.0e-3


def error_of(found):
    position, links = fresh()
    return np.linalg.norm(found.calibration.displacement.tool(ARM, position) - tcp_position(ARM, links), axis=-1).mean()


def test_a_camera_on_the_tool_does_as_well():
    t = taken("camera", 20, 1)
    found = film_of(t, "camera").fit(ARM)
    assert error_of(found) < 1.0e-3
    np.testing.assert_allclose(found.rig.standing[:3, 3], t.rig.standing[:3, 3], atol=6e-3)
