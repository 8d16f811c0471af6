"""The page itself, made by viser: a scene and a panel. The only module that knows it."""

import logging
from collections import deque
from collections.abc import Mapping
from contextlib import redirect_stdout
from socket import gethostname

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, frames, tcp_position
from rejoint.arms.inertia import LINK_RADIUS_RATIO
from rejoint.arms.workspace import reach
from rejoint.control.comparison.recommend import MEANINGS
from rejoint.control.correction import tool_error
from rejoint.control.guard import reason_names
from rejoint.pages.html import macros
from rejoint.pages.live.view import Doing, SeenCycle, Shown
from rejoint.system.shell import listen_tcp
from rejoint.system.stopping import ask
from rejoint.twin.simulation import Draw, Simulation
from rejoint.twin.twin import Twin

LINKS = (214, 219, 225), (168, 179, 192)
"""of the links in turn"""
GHOST = (47, 111, 237)
TRAIL = (235, 120, 30)
TARGET = (30, 160, 90)
TRUE = (200, 30, 160)
"""of the tool"""
TRAIL_POINTS = 400
"""(chosen: at `APART` that is 0.8 m)"""
APART = 2e-3
"""[m] between points of a trail (chosen)"""
MOVES = 5
"""Points of a moving target (chosen)"""
HOT = 55.0
"""[deg C] of a marked temperature (chosen: 10 below the guard's limit)"""
SLOWER = 6
"""frames per text (chosen)"""
KEPT = 1.5
"""[s] for which a limit is shown (chosen)"""
GHOST_OPACITY = 0.4
GHOST_SHARE = 0.9
"""of the arm's thickness: where both agree, the arm is what one sees (chosen)"""
NARROWER = 0.97
"""Thickness of every other link, against flicker (chosen)"""
TOOL_SHARE = 0.3
"""Thickness of the tool over a link's (chosen)"""
UP, SIDE = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
PACES = {"real time": 1.0, "3 times as fast": 3.0, "10 times as fast": 10.0, "as fast as it goes": np.inf}
"""at which an arm of virtual time can be watched"""


LONGEST = 0.5
"""[s] gap after which the twin restarts (chosen)"""


class Ghost:
    """A twin that receives the arm's commands."""

    def __init__(self, arm: Arm, twin: Twin) -> None:
        self._draw = Draw.of(twin.parameters.repeat(1), twin.acceleration)
        self._simulation = Simulation(arm, 1)
        self._last: SeenCycle | None = None

    def follow(self, seen: SeenCycle) -> Array:
        """Position (n,) [rad] of the twin at a cycle."""
        now, last, self._last = seen.cycle, self._last, seen
        passed = np.nan if last is None or last.arm != seen.arm else now.time - last.cycle.time
        if 0.0 < passed <= LONGEST:
            self._simulation.advance(np.array([passed]))
        elif passed != 0.0:
            self._simulation.place(self._draw, now.position[None], now.command[None])
        self._simulation.send(now.command[None])
        return self._simulation.measured[0]


class Limbs:
    """Base, links and tool of an arm, each a capsule from its frame's origin to the next."""

    def __init__(self, scene: viser.SceneApi, arm: Arm, root: str, *, ghost: bool = False) -> None:
        """Draw them below ``root``, at rest; a ``ghost`` is thinner, and lets one see through it."""
        whole = LINK_RADIUS_RATIO * reach(arm)
        self._scene, self._arm, self._aside = scene, arm, 1.5 * whole * SIDE
        self._meshes, self._marks = list[viser.MeshHandle](), dict[int, viser.LabelHandle]()
        colours, share, opacity = ((GHOST, GHOST), GHOST_SHARE, GHOST_OPACITY) if ghost else (LINKS, 1.0, None)
        for link, end in enumerate([*arm.offset[:, :3, 3], arm.tip[:3, 3]]):
            radius, length = whole * (1.0 if link % 2 else NARROWER), float(np.linalg.norm(end))
            if link == arm.joints:  # the tool, whose round end is its tip
                radius = TOOL_SHARE * whole
                end = end * max(1.0 - radius / max(length, radius), 0.0)
            turn, _ = Rotation.align_vectors(end if np.any(end) else UP, UP)
            shape = trimesh.creation.capsule(np.linalg.norm(end), share * radius, count=(12, 20))
            vertices, name, colour = turn.apply(shape.vertices) + 0.5 * end, f"{root}/{link}", colours[link % 2]
            mesh = scene.add_mesh_simple(name, vertices, shape.faces, color=colour, opacity=opacity)
            mesh.cast_shadow = mesh.receive_shadow = not ghost
            self._meshes.append(mesh)
        self.pose(arm.rest)

    def pose(self, position: Array) -> None:
        """Put the joints at ``position`` (n,) [rad]."""
        self._position, found = position, frames(self._arm, position)
        turns = Rotation.from_matrix(found.rotation).as_quat(scalar_first=True)
        for mesh, place, turn in zip(self._meshes[1:], found.position, turns, strict=True):
            mesh.position, mesh.wxyz = place, turn
        for joint, label in self._marks.items():
            label.position = found.position[joint] + self._aside

    def mark(self, words: Mapping[int, str]) -> None:
        """Write words at joints, by their number from 0, in place of others."""
        for label in self._marks.values():
            label.remove()
        add = self._scene.add_label
        self._marks = {joint: add(f"/marks/{joint}", text, anchor="center-left") for joint, text in words.items()}
        self.pose(self._position)


class WebPage:
    """A page for any number of browsers."""

    label, stop_label = "rejoint live", "Hold the arm"
    """above the panel, and of its first button"""

    def __init__(self, host: str, port: int) -> None:
        """Serve it; InputError if the port is taken or the host is another computer."""
        with listen_tcp(host, port) as probe:  # viser would take another port
            port = probe.getsockname()[1]
        for name in ("viser", "websockets"):  # browsers drop connections that they opened ahead: worth no traceback
            logging.getLogger(name).setLevel(logging.CRITICAL)
        with redirect_stdout(None):  # where results go
            self.server = self.serve(host, port)
        # the address that means every network opens on no other device
        self.address = f"http://{gethostname() if host == '0.0.0.0' else host}:{self.server.get_port()}"  # noqa: S104
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(self.label)
        scene.configure_environment_map(None)
        scene.configure_default_lights()
        self._built: tuple[Arm, float] | None = None
        self.shown: Shown | None = None
        """the run that is drawn"""
        self._count, self._recent = -1, list[SeenCycle]()
        self._panel = macros("live.html")
        self.furnish()

    def serve(self, host: str, port: int) -> viser.ViserServer:
        """Begin to listen."""
        return viser.ViserServer(host=host, port=port, label="rejoint", verbose=False)

    def furnish(self) -> None:
        """Put everything into the panel."""
        self.add_stop()
        self.add_state()

    def add_stop(self) -> None:
        """Add the button that stops the arm, and what is being done."""
        gui = self.server.gui
        hint = "The arm stops and keeps its position, powered."
        self._stop = gui.add_button(self.stop_label, color="red", hint=hint, icon=viser.Icon.HAND_STOP)
        self._stop.on_click(lambda _: self.stop())
        self._head, self._bar = gui.add_html(""), gui.add_progress_bar(0.0, color="teal")

    def add_state(self) -> None:
        """Add what follows the arm."""
        self.state = self.server.gui.add_html("")
        self._pace = self.server.gui.add_dropdown("Emulated arm", list(PACES), visible=False)

    @property
    def pace(self) -> float:
        """Chosen simulated seconds per second."""
        return PACES[str(self._pace.value)]

    @property
    def watched(self) -> bool:
        """Whether anybody looks at the page."""
        return bool(self.server.get_clients())

    def rest(self) -> None:
        """Act while no browser is connected."""
        self.shown = None

    def show(self, shown: Shown) -> None:
        """Begin to draw a run, in place of another one."""
        self.shown, self._count, self._recent = shown, 0, list[SeenCycle]()
        self._ghost = None if shown.twin is None else Ghost(shown.robot.arm, shown.twin)
        while len(shown.cycles) > 1:  # what came before anyone looked
            shown.cycles.popleft()
        self._pace.visible = shown.paced
        arm, within = shown.robot.arm, shown.within
        if self._built != (arm, within):
            self.build(arm, within)
        for trail in (self._tool, self._aims):
            trail.points.clear()

    def build(self, arm: Arm, within: float) -> None:
        """Draw an arm and the accepted error ``within`` [m], in place of other ones."""
        scene, size = self.server.scene, reach(arm)
        scene.reset()
        self._built = arm, within
        scene.add_light_ambient("/light", intensity=0.8)
        look, camera = size * np.array([0.25, 0.0, 0.28]), self.server.initial_camera
        camera.fov, camera.up, camera.look_at = np.radians(45.0), UP, look
        camera.position = look + size * np.array([0.8, -1.0, 0.55])
        cell, dot = cell_of(size), max(size, 0.3) / 0.3
        scene.add_grid("/ground", cell_size=cell, section_size=2 * cell, infinite_grid=True, fade_distance=4 * size)
        self.limbs, self._ghosts = Limbs(scene, arm, "/arm"), Limbs(scene, arm, "/ghost", ghost=True)
        self._target = scene.add_icosphere("/target", 0.0025 * dot, TARGET, visible=False)
        scene.add_icosphere("/target/within", within, TARGET, opacity=0.25, cast_shadow=False)
        self._label = scene.add_label("/target/label", "", position=(0.0, 0.0, within + 0.015), anchor="bottom-center")
        self._true = scene.add_icosphere("/true", 0.003 * dot, TRUE, visible=False)
        self._tool, self._aims = Trail(scene, "/trail", TRAIL), Trail(scene, "/way", TARGET)
        for k, box in enumerate(arm.keep_out):
            extent = box.upper - box.lower
            scene.add_box(f"/keep_out/{k}", GHOST, extent, position=box.middle, opacity=GHOST_OPACITY)

    def draw(self, shown: Shown | None, doing: Doing) -> None:
        """Draw new cycles of the run, if there is one."""
        self._count += 1
        if shown is None:
            return
        if shown is not self.shown:
            self.show(shown)
        cycles, ghost = shown.cycles, None
        for seen in [SeenCycle.of(*cycles.popleft()) for _ in range(len(cycles))]:
            ghost = seen.cycle.command if self._ghost is None else self._ghost.follow(seen)
            self._tool.extend(tcp_position(shown.robot.arm, seen.cycle.position))
            self._aims.extend(seen.cycle.aim)
            self._recent.append(seen)
        newest = self._recent[-1] if self._recent else None
        moves = len(self._aims.points) > MOVES
        with self.server.atomic():
            if newest is not None and ghost is not None:
                now, since = newest.cycle, newest.cycle.time - KEPT
                self._recent = [one for one in self._recent if one.arm == newest.arm and one.cycle.time > since]
                known = np.isfinite(now.target).all()
                self.limbs.pose(now.position)
                self._ghosts.pose(ghost)
                _place(self._target, now.aim)
                _place(self._true, now.aim + now.true_tcp - now.target if known else now.true_tcp)
                self._label.text = "target" if moves else f"target {int(now.target_index) + 1}"
            if self._count % SLOWER == 0:
                self._tool.draw(1)
                self._aims.draw(MOVES)
                self.write(shown, newest, doing)

    def write(self, shown: Shown, seen: SeenCycle | None, doing: Doing) -> None:
        """Write what changed into the panel."""
        robot = shown.robot
        several = f", arm {seen.arm + 1} of {robot.count} side by side" if seen is not None and robot.count > 1 else ""
        # viser sends no subclass of str, such as a template's
        self._head.content = str(self._panel.head(f"{robot.address}{several}", shown.controller, doing))
        self._bar.value = 100.0 * doing.share  # type: ignore[misc]  # declared read-only, and is not
        self.write_state(shown, seen, doing)

    def write_state(self, shown: Shown, seen: SeenCycle | None, doing: Doing) -> None:
        """Write what follows the arm: its errors, the guard, the joints, and what colours mean."""
        arm, write = shown.robot.arm, self._panel
        error, true, joints = np.nan, np.nan, ""
        if seen is not None:
            now = seen.cycle
            error = float(tool_error(arm, now.position, now.aim))
            true = float(np.linalg.norm(now.target - now.true_tcp))
            joints = write.joints(arm.joint_names, now, seen.temperature, HOT)
        actions = dict[str, str]()  # of the guard, each with the joint whose command it changed most
        for one in self._recent:
            joint = arm.joint_names[np.argmax(np.abs(one.wanted - one.cycle.command))]
            actions |= dict.fromkeys(reason_names(int(one.cycle.reasons)), joint)
        guarded = write.guard(actions, MEANINGS, doing.stopped)
        colours = [f"rgb{colour}" for colour in (LINKS[1], GHOST, TRAIL, TARGET, TRUE)]
        legend = write.legend(colours, self._ghost is not None, cell_of(reach(arm)))
        self.state.content = f"{write.error(error, true, shown.within)}{guarded}{joints}{legend}"

    def stop(self) -> None:
        """Ask the arm to hold."""
        ask("the button of the live view")

    def close(self) -> None:
        """Send what is left, and end."""
        self.server.flush()
        with redirect_stdout(None):
            self.server.stop()


def cell_of(size: float) -> float:
    """[m] edge of a ground square under an arm of reach ``size`` [m]."""
    return 0.05 if size < 1.0 else 0.1


def _place(handle: viser.IcosphereHandle, point: Array) -> None:
    """Put a ball at ``point`` (3,) [m]; NaN hides it."""
    handle.visible = bool(np.isfinite(point).all())
    if handle.visible:
        handle.position = point


class Trail:
    """The way of a point."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: tuple[int, int, int]) -> None:
        nowhere = np.zeros((1, 2, 3), dtype=np.float32)
        self._line = scene.add_line_segments(name, nowhere, colour, thickness=2.5, thickness_units="screen")
        self.points = deque[Array](maxlen=TRAIL_POINTS)

    def extend(self, point: Array) -> None:
        """Add a ``point`` (3,) [m]; after a jump the trail starts again."""
        if not np.isfinite(point).all():
            return
        way = np.inf if not self.points else np.linalg.norm(point - self.points[-1])
        if way > 25.0 * APART:
            self.points.clear()
        if way > APART:
            self.points.append(point.copy())

    def draw(self, fewest: int) -> None:
        """Draw it, from so many points on."""
        self._line.visible = len(self.points) > fewest
        if self._line.visible:
            points = np.array(self.points, dtype=np.float32)
            self._line.points = np.stack([points[:-1], points[1:]], axis=1)
