"""An arm with known faults before a known camera, for the tests of this folder."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rejoint.arms import Displacement, mycobot280, tcp_pose
from rejoint.arms.rotations import turned
from rejoint.camera.board import ON_TABLE, BoardView
from rejoint.camera.film import Film, Shot
from rejoint.camera.filming import choose_postures
from rejoint_lab.cameras import LENS, beside, on_tool

ARM = mycobot280()
WORN = Displacement(
    offset=np.radians([0.0, 0.3, -0.3, 0.2, 0.0, 0.0]),
    compliance=np.array([0.013, 0.015, 0.018, 0.025, 0.026, 0.03]),
    play=np.radians([1.2, 1.6, 1.4, 1.2, 1.2, 1.0]),
    twist=np.zeros((7, 6)),
    gravity=np.array([0.0, 0.0, -9.81]),
)
"""What the emulated worn arm has, and zeros that are a little off"""


def facing(rng, tilt, aside):
    """Pose of a tool's board 60 cm before a camera, turned up to ``tilt`` [rad] and ``aside`` [m] off its axis."""
    pose = np.eye(4)
    pose[:3, :3] = turned(rng.uniform(-tilt, tilt, 3))
    pose[:3, 3] = [*rng.uniform(-aside, aside, 2), 0.6] - pose[:3, :3] @ [0.07, 0.05, 0.0]
    return pose


@dataclass
class Taken:
    rig: object
    position: np.ndarray
    links: np.ndarray
    views: list


def view_of(rig, name, links, rng):
    """Visible corners with noise of 0.1 px, without an image."""
    pose, corners = rig.sight(tcp_pose(ARM, links)), rig.board.corners
    pixel = rig.lens.project(corners @ pose[:3, :3].T + pose[:3, 3])
    return BoardView(name=name, number=np.arange(len(corners)), pixel=pixel + 0.1 * rng.standard_normal(pixel.shape))


@lru_cache
def taken(carried="board", count=24, seed=0):
    """Views of the worn arm in chosen postures; joints that float lie anywhere in their play."""
    rig = beside(ARM) if carried == "board" else on_tool(ARM, board=ON_TABLE)
    position = choose_postures(ARM, rig, count)
    rng = np.random.default_rng(seed)
    free = 1.0 - np.tanh(WORN.torque(ARM, position) / 0.004) ** 2
    links = WORN.joints(ARM, position) + 0.5 * WORN.play * free * rng.uniform(-1, 1, position.shape)
    links += np.radians(0.03) * rng.standard_normal(position.shape)
    views = [view_of(rig, f"view-{i:02}.png", q, rng) for i, q in enumerate(links)]
    return Taken(rig, position, links, views)


def film_of(t, carried="board", names=()):
    """Image sequence of these views; those of the ``names`` are swapped with one another."""
    film, place = Film(board=t.rig.board, carried=carried), {name: int(name[5:7]) for name in names}
    other = dict(zip(place.values(), reversed(place.values()), strict=True))
    for k, (view, position) in enumerate(zip(t.views, t.position, strict=True)):
        seen = t.views[other.get(k, k)]
        shot = Shot(
            position=position,
            posture=k,
            seen=replace(seen, name=view.name),
        )
        film = film.with_shot(shot, (LENS.width, LENS.height))
    return film
