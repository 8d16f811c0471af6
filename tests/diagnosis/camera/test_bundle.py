"""One adjustment finds lens, camera, board and arm, and names the views that do not belong to the others."""

from dataclasses import replace

import numpy as np
import pytest
from camera_scenes import ARM, WORN, taken

from rejoint.arms import tcp_pose, tcp_position
from rejoint.arms.camera.board import BoardView
from rejoint.arms.camera.poses import inverse, moved
from rejoint.arms.camera.views import Unusable
from rejoint.diagnosis.calibration.camera import suspects
from rejoint.diagnosis.calibration.camera.adjustment import Tip, difference
from rejoint.diagnosis.calibration.camera.bundle import bundle
from rejoint.diagnosis.calibration.camera.choosing import choose_postures
from rejoint.diagnosis.calibration.fit import fit
from rejoint.robots.lab.camera.scene import LENS, beside
from rejoint.system.errors import InputError

SIZE = (LENS.width, LENS.height)


@pytest.fixture(scope="module")
def found():
    t = taken()
    return bundle(ARM, t.scene.rig.board, t.views, t.position, size=SIZE)


def fresh(count=40):
    """Postures within the region of targets that no view shows, and where the links are there but for the play."""
    rng = np.random.default_rng(9)
    position = ARM.rest + rng.uniform(-0.3, 0.3, (count, ARM.joints))
    return position, WORN.joints(ARM, position)


def test_the_displacement_predicts_the_tool(found):
    position, links = fresh()
    before = np.linalg.norm(tcp_position(ARM, position) - tcp_position(ARM, links), axis=-1)
    after = np.linalg.norm(found.displacement.tool(ARM, position) - tcp_position(ARM, links), axis=-1)
    assert before.mean() > 6e-3
    assert after.mean() < 1.0e-3
    assert not found.left_out


def test_lens_camera_and_board_are_found(found):
    t = taken()
    told = found.intervals()
    rig = t.scene.rig
    for name, truth in zip(("f", "cx", "cy", "k1", "k2", "p1", "p2"), rig.lens.numbers, strict=True):
        value, sigma = told[name]
        assert abs(value - truth) < 4 * sigma, name
    off = difference(found.rig.standing, rig.standing)
    sigma = np.sqrt(np.diag(found.rig_covariance))
    assert (np.abs(off) < 4 * sigma[7:13]).all()
    assert (np.abs(difference(found.rig.mounted, rig.mounted)) < 4 * sigma[13:]).all()
    assert told["f"][1] < 0.01 * rig.lens.f
    assert found.rms == pytest.approx(0.1, rel=0.3)  # of the corners' noise


def test_every_number_has_an_interval(found):
    told = found.intervals()
    assert len(told) == 19 + len(found.vector)
    assert all(sigma > 0 for _, sigma in told.values())
    truth = {f"{kind} {j + 1}": getattr(WORN, kind)[j] for kind in ("offset", "compliance", "play") for j in range(6)}
    inside = [abs(told[name][0] - value) < 2 * told[name][1] for name, value in truth.items()]
    assert np.mean(inside) > 0.85


def test_one_picture_tells_where_the_tool_is(found):
    t = taken()
    _, links = fresh()
    truth = tcp_pose(ARM, links)
    # what counts is what the camera shows, and the lens and the poses that were found belong together
    pixel = t.scene.rig.lens.project
    off = []
    for pose, true in zip(t.scene.rig.sight(truth), truth, strict=True):
        seen = pixel(t.scene.rig.board.corners @ pose[:3, :3].T + pose[:3, 3])
        off.append(_seen(found, seen) - true[:3, 3])
    assert np.linalg.norm(off, axis=1).mean() < 0.8e-3


def _seen(found, pixel):
    from rejoint.arms.camera.sighting import place

    return found.rig.tool(place(found.rig.lens, found.rig.board.corners, pixel).pose[None])[0, :3, 3]


def test_what_was_seen_is_a_measurement_like_any_other(found):
    m = found.measurements()
    assert (m.source, m.frame, len(m)) == ("camera", "base", 24)
    assert m.sigma.max() < 0.5e-3
    position, links = fresh()
    off = fit(ARM, m).tool(position) - tcp_position(ARM, links)
    assert np.linalg.norm(off, axis=-1).mean() < 1.2e-3


def test_swapped_and_crooked_views_are_named_and_left_out():
    t = taken()
    views = list(t.views)
    views[4], views[9] = (
        BoardView(name=views[a].name, number=views[b].number, pixel=views[b].pixel) for a, b in ((4, 9), (9, 4))
    )
    rng = np.random.default_rng(0)
    views[15] = BoardView(
        name="bent", number=views[15].number, pixel=views[15].pixel + 3.0 * rng.standard_normal((24, 2))
    )
    found = bundle(ARM, t.scene.rig.board, views, t.position, size=SIZE)
    why = {one.name: one.why for one in found.left_out}
    assert set(why) == {"view-04.png", "view-09.png", "bent"}
    assert "belongs to the joint positions of view-09.png; swapped?" in why["view-04.png"]
    assert "of a flat board" in why["bent"]
    position, links = fresh()
    off = found.displacement.tool(ARM, position) - tcp_position(ARM, links)
    assert np.linalg.norm(off, axis=-1).mean() < 1.0e-3


def test_a_view_that_fits_once_the_lens_is_settled_is_taken_back(monkeypatch):
    """A board seen from its front seemed turned by degrees through the lens of the first round, and stayed out."""
    t, calls = taken(), []

    def hasty(state, vector):
        told = suspects.judge(state, vector)
        if not calls:
            out = Unusable(name=t.views[2].name, why="shows the tool elsewhere")
            told = replace(told, good=np.arange(12) != 2, bad=(out,))
        calls.append(len(state.views))
        return told

    monkeypatch.setattr("rejoint.diagnosis.calibration.camera.bundle.judge", hasty)
    found = bundle(ARM, t.scene.rig.board, t.views[:12], t.position[:12], size=SIZE)
    assert found.left_out == ()
    assert len(found.views) == len(found.residuals) == 12
    assert calls[:2] == [12, 12]


def test_a_camera_on_the_tool_does_as_well():
    t = taken("camera", 20)
    found = bundle(ARM, t.scene.rig.board, t.views, t.position, size=SIZE, carried="camera")
    position, links = fresh()
    off = found.displacement.tool(ARM, position) - tcp_position(ARM, links)
    assert np.linalg.norm(off, axis=-1).mean() < 1.2e-3
    np.testing.assert_allclose(found.rig.standing[:3, 3], t.scene.rig.standing[:3, 3], atol=6e-3)


def test_a_measured_tip_is_believed():
    t = taken()
    tip = inverse(t.scene.rig.mounted)[:3, 3]
    found = bundle(ARM, t.scene.rig.board, t.views[:16], t.position[:16], size=SIZE, tip=Tip(place=tip, sigma=1e-4))
    np.testing.assert_allclose(inverse(found.rig.mounted)[:3, 3], tip, atol=3e-4)
    with pytest.raises(InputError, match="where the tool carries the board only"):
        bundle(ARM, t.scene.rig.board, t.views, t.position, size=SIZE, carried="camera", tip=Tip(place=tip))


def test_views_that_cannot_do_are_refused():
    t = taken()
    board = t.scene.rig.board
    with pytest.raises(InputError, match="expected at least 10"):
        bundle(ARM, board, t.views[:9], t.position[:9], size=SIZE)
    with pytest.raises(InputError, match="one row a view"):
        bundle(ARM, board, t.views, t.position[:5], size=SIZE)
    with pytest.raises(InputError, match="expected one of: board, camera"):
        bundle(ARM, board, t.views, t.position, size=SIZE, carried="nothing")
    still = np.tile(ARM.rest, (12, 1))
    views = [t.scene.view(f"{i}", ARM.rest, np.random.default_rng(i)) for i in range(12)]
    with pytest.raises(InputError, match="turned too little"):
        bundle(ARM, board, views, still, size=SIZE)


def test_postures_show_the_board_and_tell_more_than_others():
    t = taken()
    assert t.scene.rig.shows(tcp_pose(ARM, t.position)).all()
    assert (np.ptp(t.position, axis=0) > np.radians(40)).all()  # all joints take part
    away = beside(ARM)
    turned_off = type(away.rig)(
        lens=LENS, board=away.rig.board, carried="board",
        standing=moved(away.rig.standing, np.array([0, 0, 0, 0, 0, np.pi])), mounted=away.rig.mounted,
    )  # fmt: skip
    with pytest.raises(InputError, match="turn the camera to the tool"):
        choose_postures(ARM, turned_off, 10)
