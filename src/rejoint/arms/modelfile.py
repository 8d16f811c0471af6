"""Cut a serial chain out of a URDF or MJCF file, which MuJoCo reads.

Only kinematics and masses are compiled: meshes may be missing. All joints but those of the chain are frozen.
"""

from __future__ import annotations

import difflib
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.draft import UNKNOWN, Loaded
from rejoint.arms.inertia import ball_moment, inertia_matrix, pseudo_inertia, rigid_body, usable
from rejoint.arms.rotations import inverse, pose_of, rotation_about, rotation_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import MODEL_MOST, read_bounded

_KINDS = ("free", "ball", "slide", "hinge")
"""mjtJoint"""

LEAST_MOMENT = 1e-12
"""[kg m^2] MuJoCo takes less for none"""

_NOTHING = 1e-9
"""[kg] placeholder of bodies without mass, which MuJoCo refuses to move"""

WORLD = 0
"""First body"""


class Tree(NamedTuple):
    """A model in the posture of its file. Places: its bodies, the world first, then its named sites."""

    name: str
    model: Any
    data: Any
    names: list[str]
    """of places"""
    poses: list[Array]
    """(4, 4) of places in the world"""
    content: list[Array]
    """pseudo-inertia (4, 4) of bodies in their frames"""
    doubtful: list[bool]
    """of bodies without a usable inertia"""
    joint_names: list[str]
    leaders: dict[str, str]
    """of coupled joints"""
    speeds: dict[str, float]
    """[rad/s] of joints, where the file gives them"""
    held: frozenset[str]
    """joints that the user holds"""
    notes: tuple[str, ...]

    def find(self, name: str, kind: str) -> int:
        """Return the place of a name; InputError."""
        return _index(name, kind, self.names)

    def parent(self, place: int) -> int:
        """Body that carries a place."""
        bodies = self.model.nbody
        return int(self.model.body_parentid[place] if place < bodies else self.model.site_bodyid[place - bodies])

    def path(self, place: int) -> list[int]:
        """Places from a root to ``place``."""
        return [] if place == WORLD else [*self.path(self.parent(place)), place]

    def joints_of(self, places: Iterable[int]) -> list[int]:
        """Joints in order."""
        bodies = self.model.jnt_bodyid.tolist()
        return [j for place in places for j, body in enumerate(bodies) if body == place]

    def kind(self, j: int) -> str:
        """``hinge``, ``slide``, ``ball``, ``free``, ``coupled`` (to another joint) or ``held`` (by the user)."""
        kind = _KINDS[self.model.jnt_type[j]]
        if self.joint_names[j] in self.held:
            return "held"
        return "coupled" if kind == "hinge" and self.leader(j) else kind

    def leader(self, j: int) -> str:
        """Joint that it follows, or empty."""
        return self.leaders.get(self.joint_names[j], "")

    def position(self, j: int) -> float:
        """[rad] or [m]."""
        return float(self.data.qpos[self.model.jnt_qposadr[j]])

    def listed(self, places: Iterable[int]) -> str:
        """Names."""
        return ", ".join(self.names[place] for place in places)


def read_tree(path: Path, hold: Mapping[str, float] | None = None) -> Tree:
    """Read a URDF or MJCF file, with ``hold`` at positions [rad] or [m].

    FileError; InputError for a joint that cannot be held.
    """
    root, hold = parse(path), hold or {}
    mujoco = _mujoco()
    urdf = root.tag == "robot"
    notes: list[str] = []
    with _warnings_noted(mujoco, notes):
        try:
            spec = mujoco.MjSpec.from_string(bare(root)) if urdf else mujoco.MjSpec.from_file(str(path))
            joints = mujoco.mjtEq.mjEQ_JOINT
            leaders = {one.name1: one.name2 for one in spec.equalities if one.type == joints}
            _strip(mujoco, spec, every_geom=urdf, notes=notes)
            doubtful = _repair(spec, notes)
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            raise FileError(
                path, f"MuJoCo cannot use it: {' '.join(str(error).split())}", "correct the file"
            ) from error
    data, names = mujoco.MjData(model), [model.joint(j).name for j in range(model.njnt)]
    for j in range(model.njnt):
        if model.jnt_limited[j] and _KINDS[model.jnt_type[j]] in ("hinge", "slide"):
            address = model.jnt_qposadr[j]
            data.qpos[address] = np.clip(data.qpos[address], *model.jnt_range[j])
    for name, position in hold.items():
        j = _index(name, "joint", names)
        data.qpos[model.jnt_qposadr[j]] = position
        notes.append(f"joint {name}: held at {_holdable(model, j, name, position)}, as given")
    mujoco.mj_kinematics(model, data)
    sites = [s for s in range(model.nsite) if model.site(s).name]
    bodies = [model.body(b).name for b in range(model.nbody)]
    frames = [*zip(data.xmat, data.xpos, strict=True), *((data.site_xmat[s], data.site_xpos[s]) for s in sites)]
    return Tree(
        name=root.get("name") or root.get("model") or path.stem,
        model=model,
        data=data,
        names=bodies + [model.site(s).name for s in sites],
        poses=[pose_of(turn.reshape(3, 3), place) for turn, place in frames],
        content=[_content(model, b) for b in range(model.nbody)],
        doubtful=[name in doubtful for name in bodies],
        joint_names=names,
        leaders=leaders,
        speeds=urdf_speeds(root) if urdf else {},
        held=frozenset(hold),
        notes=tuple(notes),
    )


def _mujoco() -> ModuleType:
    require("reading a URDF or MJCF file (a TOML file would do without)", "mujoco")
    import mujoco

    return mujoco


@contextmanager
def _warnings_noted(mujoco: ModuleType, notes: list[str]) -> Iterator[None]:
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: notes.append(f"MuJoCo: {' '.join(text.split())}"))
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            yield
        notes += [f"MuJoCo: {' '.join(str(warning.message).split())}" for warning in said]
    finally:
        mujoco.set_mju_user_warning(before)


def _strip(mujoco: ModuleType, spec: Any, *, every_geom: bool, notes: list[str]) -> None:  # noqa: ANN401
    """Take away all but bodies, joints, sites and primitive shapes with masses; name bodies and joints."""
    for body in spec.bodies:
        dropped = False
        for geom in list(body.geoms):
            geom.material = ""
            drawn = geom.type in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
            if every_geom or drawn or geom.meshname:
                spec.delete(geom)
                dropped = True
        for site in body.sites:
            site.material = ""
        if dropped and body.geoms and not body.explicitinertial:
            notes.append(f"body {body.name}: no inertial; its mass is that of its primitive shapes, without its meshes")
    kinds = "keys sensors actuators tendons equalities pairs excludes skins flexes meshes hfields materials textures"
    for kind in kinds.split():
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for index, body in enumerate(spec.bodies):
        body.name = body.name or f"body{index}"
    for index, joint in enumerate(spec.joints, start=1):
        joint.name = joint.name or f"joint{index}"
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass, spec.compiler.boundinertia = _NOTHING, LEAST_MOMENT / 10
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _repair(spec: Any, notes: list[str]) -> set[str]:  # noqa: ANN401
    """Replace what no rigid body has; returns the bodies without a usable inertia."""
    doubtful = set()
    for body in spec.bodies:
        full, mass, com = np.array(body.fullinertia), float(body.mass), np.array(body.ipos)
        inertia = inertia_matrix(full) if np.isfinite(full[0]) else np.diag(body.inertia)
        if not body.explicitinertial or body.name == "world":
            continue
        possible = np.isfinite(mass) and mass >= 0.0 and np.isfinite(com).all()
        if not possible:
            notes.append(f"body {body.name}: a mass of {mass:g} kg at {com} m cannot be; left out")
        elif mass > 0.0 and usable(inertia) and np.linalg.eigvalsh(inertia)[0] >= LEAST_MOMENT:
            continue
        elif mass > 0.0:
            doubtful.add(body.name)
            notes.append(f"body {body.name}: its inertia belongs to no rigid body (moments {_moments(inertia)} kg m^2)")
        if not possible:
            body.mass, body.ipos = 0.0, np.zeros(3)
        body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, ball_moment(body.mass))
        body.iquat = (1.0, 0.0, 0.0, 0.0)
    return doubtful


def _content(model: Any, b: int) -> Array:  # noqa: ANN401
    """Pseudo-inertia (4, 4) of a body."""
    turn = rotation_of(model.body_iquat[b])
    if model.body_mass[b] <= _NOTHING:
        return np.zeros((4, 4))
    return pseudo_inertia(model.body_mass[b], model.body_ipos[b], (turn * model.body_inertia[b]) @ turn.T)


def _holdable(model: Any, j: int, name: str, position: float) -> str:  # noqa: ANN401
    """Text of a ``position`` [rad] or [m] of a joint that can be held there; InputError."""
    kind, (low, high) = _KINDS[model.jnt_type[j]], model.jnt_range[j]
    if kind not in ("hinge", "slide"):
        raise InputError(f"joint {name} is a {kind} joint; only hinges and slides can be held")
    if model.jnt_limited[j] and not low - 1e-9 <= position <= high + 1e-9:
        unit = "m" if kind == "slide" else "rad"
        raise InputError(f"joint {name} cannot be held at {position:g} {unit}: it goes from {low:g} to {high:g}")
    return f"{1e3 * position:g} mm" if kind == "slide" else f"{np.degrees(position):.4g} deg"


def _index(name: str, kind: str, names: list[str]) -> int:
    if name in names:
        return names.index(name)
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    shown = [known for known in names if known][:40]
    raise InputError(f"the model has no {kind} called {name!r}; {hint}it has: {', '.join(shown)}")


def _moments(inertia: Array) -> str:
    if not np.isfinite(inertia).all():
        return "not finite"
    return ", ".join(f"{value:.2g}" for value in np.linalg.eigvalsh(inertia))


_JOINT_PARTS = ("parent", "child", "origin", "axis", "limit", "mimic")

_EXPRESSION = re.compile(r"\$[{(]")
"""Beginning of a xacro expression"""

_NO_INERTIA = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")

_PREFIX = re.compile(rb"(</?|\s)([A-Za-z_][\w.-]*):(?=[A-Za-z_][\w.-]*[\s=/>])")
"""namespace prefix of an element or attribute"""


def parse(path: Path) -> ET.Element:
    """Root of a model; FileError."""
    try:
        text = read_bounded(path, MODEL_MOST, "check the path of the arm")
        # Prefixes such as drake: are often used without being declared, which MuJoCo does not mind.
        root = ET.fromstring(_PREFIX.sub(rb"\1\2_", text))  # noqa: S314 - expat expands no external entities
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror or error})", "check the path of the arm") from error
    except (UnicodeError, LookupError, ET.ParseError) as error:
        raise FileError(path, f"it is no XML in the encoding that it declares: {error}", "correct the file") from error
    if root.tag not in ("robot", "mujoco"):
        raise FileError(path, f"its root element is <{root.tag}>", "give a URDF (<robot>) or an MJCF (<mujoco>) file")
    tags = {element.tag for element in root.iter()} - {"xacro_property"}
    if any(tag.startswith("xacro_") for tag in tags) or _EXPRESSION.search(bare(root)):
        raise xacro_error(path)
    return root


def xacro_error(path: Path) -> FileError:
    """FileError for xacro, with the command that makes a URDF."""
    name = path.name.split(".")[0]
    made = f"{name}.urdf" if path.suffix == ".xacro" else f"{name}-expanded.urdf"
    return FileError(
        path,
        "it is a xacro file, from which a URDF is made",
        f"make that and give it: xacro {path.name} > {made} (xacro comes with ROS, or with: pip install xacro)",
    )


def bare(root: ET.Element) -> str:
    """Links with masses and joints, as text."""
    kept = ET.Element("robot", {"name": root.get("name") or "robot"})
    for element in root:
        if element.tag not in ("link", "joint", "mujoco"):
            continue
        copy = ET.SubElement(kept, element.tag, element.attrib)
        for part in element:
            if element.tag == "link" and (part.tag != "inertial" or part.find("mass") is None):
                continue
            if element.tag != "joint" or part.tag in _JOINT_PARTS:
                copy.append(part)
            if part.tag == "inertial" and part.find("inertia") is None:  # MuJoCo wants one; zeros are estimated later
                copy[-1] = ET.Element("inertial", part.attrib)
                copy[-1].extend([*part, ET.Element("inertia", _NO_INERTIA)])
    return ET.tostring(kept, encoding="unicode")


def urdf_speeds(root: ET.Element) -> dict[str, float]:
    """Speed limits [rad/s] of joints; NaN: none."""
    result = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        with suppress(ValueError):
            result[joint.get("name", "")] = float("nan" if limit is None else limit.get("velocity", "nan"))
    return result


def cut(tree: Tree, base: str | None, tip: str | None) -> Loaded:
    """Unfinished arm from body ``base`` to the body or site ``tip``, see `rejoint.arms.draft.finish`.

    Default ``tip``: last link of the longest chain of hinges without a gripper; default ``base``: the root. Slides are
    held; other bodies add mass to their link. InputError for unknown names, an ambiguous choice, or a joint that can be
    neither driven nor held.
    """
    notes = list(tree.notes)
    start = None if base is None else tree.find(base, "body")
    end = _longest(tree, start, notes) if tip is None else tree.find(tip, "body or site")
    if start is None:
        start = _root_of(tree, end, notes)
    path = tree.path(end)
    if start != WORLD and start not in path:
        raise InputError(f"{tip} does not hang below {base}; the bodies above it are: {tree.listed(path)}")
    links = path if start == WORLD else path[path.index(start) + 1 :]
    joints = _hinges(tree, tree.joints_of(links), f"{tree.names[start]} and {tree.names[end]}", notes)
    frame = tree.poses[start]
    if frame[2, 2] < 1 - 1e-9:
        tilt = np.degrees(np.arccos(np.clip(frame[2, 2], -1.0, 1.0)))
        notes.append(
            f"base: {tree.names[start]} is tilted by {tilt:.0f} deg in the file; gravity, floor and targets are "
            "taken as if it stood upright, which is right only where the arm itself does"
        )
    return Loaded(arm=_arm(tree, joints, frame, tree.poses[end]), notes=tuple(notes))


def _arm(tree: Tree, joints: list[int], frame: Array, tip: Array) -> Arm:
    """``frame`` of the base and ``tip``: (4, 4) in the world."""
    model, data, n = tree.model, tree.data, len(joints)
    bodies = model.jnt_bodyid[joints]
    poses = [
        pose_of(tree.poses[body][:3, :3], anchor) for body, anchor in zip(bodies, data.xanchor[joints], strict=True)
    ]
    axes = [pose[:3, :3].T @ axis for pose, axis in zip(poses, data.xaxis[joints], strict=True)]
    at_zero = [
        pose @ pose_of(rotation_about(axis, -tree.position(j)), np.zeros(3))
        for pose, axis, j in zip(poses, axes, joints, strict=True)
    ]
    offsets = inverse(np.array([frame, *poses[:-1]])) @ np.array(at_zero)
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], np.nan).T
    mass, com, inertia = zip(*_links(tree, bodies.tolist(), poses), strict=True)
    return Arm(
        name=tree.name,
        joint_names=tuple(tree.joint_names[j] for j in joints),
        offset=offsets,
        axis=np.array(axes),
        tip=inverse(poses[-1]) @ tip,
        lower=low,
        upper=high,
        max_speed=np.array([tree.speeds.get(tree.joint_names[j], np.nan) for j in joints]),
        mass=np.array(mass),
        com=np.array(com),
        inertia=np.array(inertia),
        rest=np.full(n, np.nan),
        targets=UNKNOWN,
        floor=np.nan,
        encoder_step=np.nan,
    )


def _links(tree: Tree, carriers: list[int], poses: list[Array]) -> list[tuple[float, Array, Array]]:
    """Mass, centre and inertia of each link, in its joint's frame; NaN where most of the mass has no usable inertia."""
    owner = {body: i for i, body in enumerate(carriers)}  # of several joints of a body the last carries it
    whole, doubtful = np.zeros((len(poses), 4, 4)), np.zeros(len(poses))
    for body in range(1, tree.model.nbody):
        link = owner.get(body, owner.get(int(tree.model.body_parentid[body])))
        if link is not None:
            owner[body] = link
            pose = inverse(poses[link]) @ tree.poses[body]
            whole[link] += pose @ tree.content[body] @ pose.T
            doubtful[link] += tree.content[body][3, 3] * tree.doubtful[body]
    found = [rigid_body(one) for one in whole]
    unknown = doubtful > whole[:, 3, 3] / 2
    return [(m, com, np.where(doubt, np.nan, own)) for (m, com, own), doubt in zip(found, unknown, strict=True)]


def _hinges(tree: Tree, joints: list[int], between: str, notes: list[str]) -> list[int]:
    driven = [j for j in joints if tree.kind(j) == "hinge"]
    for j in joints:
        name, kind, leader = tree.joint_names[j], tree.kind(j), tree.leader(j)
        follower = f", or hold it with the joint that it follows: --hold {name}=0deg,{leader}=0deg" if leader else ""
        if kind == "slide":
            notes.append(_slide_held(tree, j))
        elif kind not in ("hinge", "held"):
            raise InputError(
                f"{tree.name}: joint {name} between {between} is a {kind} joint, and only revolute joints "
                f"of their own can be driven; choose a base and a tip with it outside of the chain{follower}"
            )
        elif leader in {tree.joint_names[other] for other in driven}:
            raise InputError(
                f"{tree.name}: joint {name} cannot be held alone: it follows {leader}, which is driven{follower}"
            )
    if not driven:
        raise InputError(f"{tree.name}: there is no revolute joint between {between}; choose another base or tip")
    return driven


def _slide_held(tree: Tree, j: int) -> str:
    low, high = 1e3 * tree.model.jnt_range[j]
    span = f" ({low:.0f} to {high:.0f} mm)" if tree.model.jnt_limited[j] else ""
    name, place = tree.joint_names[j], f"{1e3 * tree.position(j):.0f}"
    return (
        f"joint {name} slides{span} and is not driven, only revolute joints are; it is taken as fixed at {place} "
        f"mm, which the arm has to keep; if it stands elsewhere: --hold {name}={place}mm"
    )


_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""Joints of grippers (URDFs of SO-100, WidowX, Koch)"""

_FLANGE = "tool0"
"""Flange in URDFs of ROS-Industrial"""

_TOOL = re.compile(r"tool|tcp|grasp|end_?effector|(^|_)eef?(_|$)", re.IGNORECASE)
"""Tool frames (URDFs of Universal Robots, Kinova, PAL, Franka Emika)"""

_ACROSS = 1e-6
"""Largest product of orthogonal unit vectors (rounding)"""


def _root_of(tree: Tree, end: int, notes: list[str]) -> int:
    """First body of the arm to ``end``: the root, the load of a mobile base, or the world."""
    path = tree.path(end)
    moving = _mobile_base(tree, tree.joints_of(path))
    if moving:
        root = int(tree.model.jnt_bodyid[moving[-1]])
        names = ", ".join(tree.joint_names[j] for j in moving)
        notes.append(f"base: none given; {tree.names[root]} taken; {names} before it move all of it")
        return root
    first = path[0] if path else WORLD
    root = WORLD if any(tree.kind(j) not in ("free", "slide") for j in tree.joints_of([first])) else first
    notes.append(f"base: none given; {tree.names[root]} taken, the root of the tree")
    return root


def _mobile_base(tree: Tree, joints: list[int]) -> list[int]:
    """Two slides or more, and a hinge across them, at the beginning of a chain."""
    slides = list(takewhile(lambda j: tree.kind(j) == "slide", joints))
    axes, turn = tree.data.xaxis, joints[len(slides) : len(slides) + 1]
    across = all(tree.kind(j) == "hinge" and (np.abs(axes[slides] @ axes[j]) < _ACROSS).all() for j in turn)
    return [] if len(slides) < 2 else slides + (turn if across else [])


def _longest(tree: Tree, start: int | None, notes: list[str]) -> int:
    """Last link of the longest chain of hinges below ``start`` (None: anywhere), without gripper."""
    hinges = _chains(tree, start)
    leaves = hinges.keys() - {tree.parent(body) for body in hinges if body not in (start, WORLD)}
    most = max(hinges[body] for body in leaves)
    ends = [body for body in sorted(leaves) if hinges[body] == most]
    if most == 0:
        raise InputError(f"{tree.name}: no chain of hinges was found; the bodies are: {tree.listed(hinges)}")
    carried: dict[int, list[int]] = {}  # ends by the last joint before them
    for body in ends:
        carried.setdefault(tree.joints_of(tree.path(body))[-1], []).append(body)
    if len(carried) > 1:
        names = tree.listed(_frame(tree, bodies) for bodies in carried.values())
        raise InputError(
            f"{tree.name}: several links could be the tip of the arm ({most} joints each): {names}; name the tip"
        )
    end = _frame(tree, ends)
    behind = [place for place in range(len(tree.names)) if place != WORLD and tree.parent(place) in (end, *ends)]
    others = [body for body in ends if body != end] + [place for place in behind if place >= tree.model.nbody]
    more = f" (beside it are {tree.listed(others)}, which can be named instead)" if others else ""
    notes.append(f"tip: none given; {tree.names[end]} taken, the end of the longest chain{more}")
    beyond = ", ".join(tree.joint_names[j] for j in tree.joints_of(behind) if tree.kind(j) == "hinge")
    if beyond:
        notes.append(f"tip: {beyond} behind it taken for a gripper's and held; name a tip to drive it")
    return end


def _chains(tree: Tree, start: int | None) -> dict[int, int]:
    """Hinges before each body that a chain from ``start`` can end at: not behind a slide."""
    hinges = {}
    for body in range(tree.model.nbody):
        path = tree.path(body)
        if start not in (None, WORLD, *path):
            continue
        joints = tree.joints_of(path[path.index(start) + 1 :] if start in path else path)
        if start is None and joints and tree.kind(joints[0]) == "free":
            del joints[0]
        if all(_passable(tree, j) for j in joints) and not (joints and tree.kind(joints[-1]) == "slide"):
            hinges[body] = sum(tree.kind(j) == "hinge" for j in joints)
    return hinges


def _passable(tree: Tree, j: int) -> bool:
    """Whether a chain goes on behind a joint: not behind those of grippers, which lead joints of other branches."""
    bodies = tree.model.jnt_bodyid.tolist()
    led = [other for other in range(tree.model.njnt) if tree.leader(other) == tree.joint_names[j]]
    leads = any(bodies[j] not in tree.path(bodies[other]) for other in led)
    gripper = leads or _GRIPPER.search(tree.joint_names[j])
    return tree.kind(j) == "held" or (tree.kind(j) in ("hinge", "slide") and not gripper)


def _frame(tree: Tree, ends: Iterable[int]) -> int:
    """Choose the tool's frame of bodies on one link, else the last body before all of them."""
    named = {tree.names[body]: body for body in ends}
    tools = [body for name, body in named.items() if _TOOL.search(name)]
    if _FLANGE in named:
        return named[_FLANGE]
    if len(named) == 1 or len(tools) == 1:
        return (tools or list(named.values()))[0]
    return [bodies[0] for bodies in zip(*map(tree.path, named.values()), strict=False) if len(set(bodies)) == 1][-1]
