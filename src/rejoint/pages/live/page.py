"""The page itself, made by viser: a scene and a panel. The only module that knows it."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stdout

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, frames
from rejoint.arms.collision import collision_shape
from rejoint.arms.workspace import reach
from rejoint.pages.live.animation import GHOST, LINKS, TARGET, TRAIL, TRUE, Colour, cell_of
from rejoint.system.errors import InputError

GHOST_OPACITY = 0.4
GHOST_SHARE = 0.9
"""of the arm's thickness: where both agree, the arm is what one sees (chosen)"""
NARROWER = 0.97
"""Thickness of every other link, against flicker (chosen)"""
TOOL_SHARE = 0.3
"""Thickness of the tool over a link's (chosen)"""
UP = np.array([0.0, 0.0, 1.0])
PACES = {"real time": 1.0, "3 times as fast": 3.0, "10 times as fast": 10.0, "as fast as it goes": np.inf}
"""at which an arm of virtual time can be watched"""


class WebPage:
    """A page for any number of browsers."""

    def __init__(self, host: str, port: int, on_hold: Callable[[], None], on_pace: Callable[[float], None]) -> None:
        """Serve it; InputError if the port is taken or the host is another computer."""
        port = _free(host, port)
        for name in ("viser", "websockets"):  # browsers drop connections that they opened ahead: worth no traceback
            logging.getLogger(name).setLevel(logging.CRITICAL)
        with redirect_stdout(None):  # where results go
            self._server = viser.ViserServer(host=host, port=port, label="rejoint", verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(
            control_layout="collapsible", control_width="large", show_logo=False, show_share_button=False
        )
        gui.set_panel_label("rejoint live")
        scene.set_up_direction("+z")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=True)
        scene.add_light_ambient("/light", intensity=0.8)
        self._parts: list[viser.SceneNodeHandle] = []
        self._shows: tuple[Arm, float] | None = None
        self._texts = {"head": gui.add_html("")}
        self._bar = gui.add_progress_bar(0.0, color="teal")
        self._hold = gui.add_button("Hold the arm", color="red", hint="It stops and keeps its position, powered.")
        self._hold.on_click(lambda _: on_hold())
        self._pace = pace = gui.add_dropdown("Emulated arm", list(PACES), initial_value="real time", visible=False)
        pace.on_update(lambda _: on_pace(PACES[str(pace.value)]))
        self._texts |= {name: gui.add_html("") for name in ("error", "guard", "joints", "legend")}

    @property
    def watched(self) -> bool:
        """Whether anybody looks at the page."""
        return bool(self._server.get_clients())

    def atomic(self) -> AbstractContextManager[None]:
        """Send the changes inside at once."""
        return self._server.atomic()

    def show(self, arm: Arm, *, within: float, paced: bool) -> None:
        """Draw an arm and the accepted error ``within`` [m], in place of other ones."""
        self._pace.visible = paced
        if self._shows is not None and self._shows[0] is arm and self._shows[1] == within:
            return
        self._shows, scene, size = (arm, within), self._server.scene, reach(arm)
        for part in self._parts:
            part.remove()
        middle = 0.5 * (arm.targets.lower + arm.targets.upper)
        look = np.array([0.45 * middle[0], 0.45 * middle[1], 0.28 * size])
        side = np.arctan2(middle[1], middle[0]) - np.radians(52.0)
        camera = self._server.initial_camera
        camera.fov = np.radians(45.0)
        camera.up = (0.0, 0.0, 1.0)
        camera.look_at = look
        camera.position = look + size * np.array([1.25 * np.cos(side), 1.25 * np.sin(side), 0.55])
        cell = cell_of(size)
        wide, dot = np.ceil(2.4 * size / cell) * cell, max(size, 0.3) / 0.3
        grid = scene.add_grid(
            "/ground",
            width=wide,
            height=wide,
            cell_size=cell,
            section_size=2 * cell,
            cell_color=(225, 228, 232),
            section_color=(200, 205, 212),
            shadow_opacity=0.2,
        )
        self._arm = arm
        self._limbs = self._add_limbs("/arm", LINKS, 1.0, None)
        self._ghosts = self._add_limbs("/ghost", (GHOST, GHOST), GHOST_SHARE, GHOST_OPACITY)
        self._target = scene.add_icosphere("/target", 0.0025 * dot, TARGET, visible=False)
        scene.add_icosphere("/target/within", within, TARGET, opacity=0.25, cast_shadow=False)
        self._label = scene.add_label("/target/label", "", position=(0.0, 0.0, within + 0.015), anchor="bottom-center")
        self._true = scene.add_icosphere("/true", 0.003 * dot, TRUE, visible=False)
        nowhere = np.zeros((1, 2, 3), dtype=np.float32)
        self._trail = scene.add_line_segments("/trail", nowhere, TRAIL, thickness=3.0, thickness_units="screen")
        self._way = scene.add_line_segments("/way", nowhere, TARGET, thickness=2.0, thickness_units="screen")
        boxes = [
            scene.add_box(
                f"/keep_out/{k}",
                GHOST,
                box.upper - box.lower,
                position=0.5 * (box.lower + box.upper),
                opacity=GHOST_OPACITY,
            )
            for k, box in enumerate(arm.keep_out)
        ]
        self._parts = [grid, *boxes, *self._limbs, *self._ghosts, self._target, self._true, self._trail, self._way]
        self.pose(arm.rest, arm.rest)

    def _add_limbs(
        self, root: str, colours: tuple[Colour, Colour], share: float, opacity: float | None
    ) -> list[viser.FrameHandle]:
        """Add base and links, each a capsule from its frame's origin to the next."""
        scene, whole, found = self._server.scene, collision_shape(self._arm).radius, []
        for link, end in enumerate([*self._arm.offset[:, :3, 3], self._arm.tip[:3, 3]]):
            found.append(scene.add_frame(f"{root}/{link}", show_axes=False))
            radius, length = whole * (1.0 if link % 2 else NARROWER), float(np.linalg.norm(end))
            if link == self._arm.joints:  # the tool, whose round end is its tip
                radius = TOOL_SHARE * whole
                end = end * max(1.0 - radius / length, 0.0) if length > radius else end
                length = float(np.linalg.norm(end))
            shape = trimesh.creation.capsule(height=length, radius=share * radius, count=(12, 20))
            turn, _ = Rotation.align_vectors(end if length else UP, UP)
            scene.add_mesh_simple(
                f"{root}/{link}/link",
                shape.vertices.astype(np.float32),
                shape.faces.astype(np.uint32),
                position=0.5 * end,
                wxyz=turn.as_quat(scalar_first=True),
                color=colours[link % 2],
                opacity=opacity,
                cast_shadow=opacity is None,
                receive_shadow=opacity is None,
            )
        if opacity is None:
            height = 0.25 * whole
            scene.add_cylinder(f"{root}/0/foot", 1.7 * whole, height, colours[1], position=(0.0, 0.0, 0.5 * height))
        return found

    def pose(self, position: Array, ghost: Array) -> None:
        """Put the joints of arm and ghost (n,) [rad]."""
        for limbs, q in ((self._limbs, position), (self._ghosts, ghost)):
            found = frames(self._arm, q)
            turns = Rotation.from_matrix(found.rotation).as_quat(scalar_first=True)
            for limb, place, turn in zip(limbs[1:], found.position, turns, strict=True):
                limb.position, limb.wxyz = place, turn

    def aim(self, target: Array, true: Array, text: str) -> None:
        """Show target with a ``text``, and true tool, (3,) [m]; NaN hides either."""
        for handle, point in ((self._target, target), (self._true, true)):
            known = bool(np.isfinite(point).all())
            if handle.visible != known:
                handle.visible = known
            if known:
                handle.position = point
        if self._label.text != text:
            self._label.text = text

    def trail(self, tool: Array, target: Array) -> None:
        """Draw trails (P, 3) [m] of tool and moving target."""
        for handle, points in ((self._trail, tool), (self._way, target)):
            if len(points) > 1:
                handle.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            handle.visible = len(points) > 1

    def tell(self, share: float, **texts: str) -> None:
        """Write into the panel: HTML by name, and the ``share`` that is done."""
        for name, text in texts.items():
            if self._texts[name].content != text:
                self._texts[name].content = str(text)  # viser sends no subclass, such as a template's
        if abs(self._bar.value - 100.0 * share) > 0.05:
            self._bar.value = 100.0 * share  # type: ignore[misc]  # declared read-only, and is not

    def held(self, text: str) -> None:
        """Disable the button."""
        self._hold.label, self._hold.disabled = text, True

    def close(self) -> None:
        """Send what is left, and end."""
        self._server.flush()
        with redirect_stdout(None):
            self._server.stop()


def _free(host: str, port: int) -> int:
    """Return the port if it is free, and any free one for 0; InputError if it is taken."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            remedy = f"end what listens there, or choose another port, such as --live {host}:0"
            raise InputError(f"--live {host}:{port}: {error.strerror or error}; {remedy}") from error
        return int(probe.getsockname()[1])
