"""Cut a serial chain out of a URDF or MJCF file, which MuJoCo reads.

Meshes may be missing. Joints outside the chain are frozen.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from contextlib import suppress
from copy import copy
from itertools import compress, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms.arm import UNKNOWN, Arm, Array, Loaded
from rejoint.arms.inertia import ball_moment, inertia_matrix, pseudo_inertia, rigid_body, usable
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import inverse, pose_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import read_bounded, reading
from rejoint.system.shell import Late

mujoco = Late("mujoco")

_KINDS = ("free", "ball", "slide", "hinge")
"""mjtJoint"""

LEAST_MOMENT = 1e-12
"""[kg m^2] MuJoCo takes less for none"""

_NOTHING = 1e-9
"""[kg] placeholder of bodies without mass, which MuJoCo refuses to move"""

WORLD = 0
"""First body"""


class Joint(NamedTuple):
    """A joint of a model."""

    number: int
    name: str
    kind: str
    """``hinge``, ``slide``, ``ball``, ``free``, ``coupled`` (to its leader) or ``held`` (by the user)"""
    body: int
    leader: str
    """joint that it follows, or empty"""


class Tree(NamedTuple):
    """A model in the posture of its file. Places: its bodies, the world first, then its sites."""

    name: str
    model: Any
    data: Any
    names: list[str]
    """of places"""
    above: list[int]
    """bodies that carry the places"""
    joints: list[Joint]
    speeds: dict[str, float]
    """[rad/s] of joints, where the file gives them"""
    notes: tuple[str, ...]

    def path(self, place: int) -> list[int]:
        """Places from a root to ``place``."""
        return [] if place == WORLD else [*self.path(self.above[place]), place]

    def joints_of(self, places: Iterable[int]) -> list[Joint]:
        """Joints in order."""
        return [joint for place in places for joint in self.joints if joint.body == place]

    def listed(self, places: Iterable[int]) -> str:
        """Names."""
        return ", ".join(self.names[place] for place in places)


Places = Mapping[str, float | str]
"""Positions [rad] or [m] of joints, or text with a unit"""


def read_tree(path: Path, hold: Places | None = None) -> Tree:
    """Read a URDF or MJCF file, with ``hold`` at positions [rad] or [m].

    FileError; InputError for a joint that cannot be held.
    """
    root, notes = parse(path), []
    require("reading a URDF or MJCF file (a TOML file would do without)", "mujoco")
    urdf, name = root.tag == "robot", root.get("name") or root.get("model") or path.stem
    root.set("name", name)
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda said: notes.append(f"MuJoCo: {' '.join(said.split())}"))
    try:
        spec = (
            mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
            if urdf
            else mujoco.MjSpec.from_file(str(path))
        )
        coupled = {one.name1: one.name2 for one in spec.equalities if one.type == mujoco.mjtEq.mjEQ_JOINT}
        _strip(spec)
        _repair(spec, notes, urdf)
        _weigh(spec, notes, urdf)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise FileError(path, f"MuJoCo cannot use it: {' '.join(str(error).split())}", "correct the file") from error
    finally:
        mujoco.set_mju_user_warning(before)
    data, joints = mujoco.MjData(model), []
    for j, at in enumerate(model.jnt_qposadr):
        joint, kind = model.joint(j).name, _KINDS[model.jnt_type[j]]
        if model.jnt_limited[j] and kind in ("hinge", "slide"):
            data.qpos[at] = np.clip(data.qpos[at], *model.jnt_range[j])
        if kind == "hinge" and joint in coupled:
            kind = "coupled"
        joints.append(Joint(j, joint, kind, model.jnt_bodyid[j], coupled.get(joint, "")))
    for joint, position in (hold or {}).items():
        j = _index(joint, "joint", [one.name for one in joints])
        data.qpos[model.jnt_qposadr[j]], told = _held(model, j, joint, position)
        notes.append(f"joint {joint}: held at {told}, as given")
        joints[j] = joints[j]._replace(kind="held")
    mujoco.mj_kinematics(model, data)
    return Tree(
        name=name,
        model=model,
        data=data,
        names=[model.body(b).name for b in range(model.nbody)] + [model.site(s).name for s in range(model.nsite)],
        above=[*model.body_parentid.tolist(), *model.site_bodyid.tolist()],
        joints=joints,
        speeds=_speeds(root),
        notes=tuple(notes),
    )


def _strip(spec: Any) -> None:  # noqa: ANN401
    """Take away all but bodies, joints, named sites and shapes; name bodies and joints."""
    kinds = "keys sensors actuators tendons equalities pairs excludes skins flexes materials textures"
    _delete(spec, *(element for kind in kinds.split() for element in getattr(spec, kind)))
    for index, body in enumerate(spec.bodies):
        body.name = body.name or f"body{index}"
        _delete(spec, *(site for site in body.sites if not site.name))
        for element in [*body.geoms, *body.sites]:
            element.material = ""
    for index, joint in enumerate(spec.joints, start=1):
        joint.name = joint.name or f"joint{index}"
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True
    spec.compiler.boundmass, spec.compiler.boundinertia = _NOTHING, LEAST_MOMENT / 10
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _weigh(spec: Any, notes: list[str], urdf: bool) -> None:  # noqa: ANN401
    """Take meshes away; in an MJCF file, bodies without inertial get what MuJoCo makes of theirs."""
    shapes = mujoco.mjtGeom
    meshes = shapes.mjGEOM_MESH, shapes.mjGEOM_HFIELD, shapes.mjGEOM_SDF
    drawn = [one for body in spec.bodies for one in body.geoms if one.meshname or one.type in meshes]
    bare = [one for one in spec.bodies[1:] if not (urdf or one.explicitinertial)]
    bare = [one for one in bare if any(geom.parent == one for geom in drawn)]
    weighed = [one for one in drawn if one.parent in bare]
    used = {one.meshname for one in weighed}
    _delete(spec, *(one for one in drawn if one not in weighed), *(one for one in spec.meshes if one.name not in used))
    for one in weighed:
        one.contype = one.conaffinity = 0  # no hulls, which take seconds
    whole = spec.copy()
    whole.compiler.settotalmass = -1.0
    try:
        model = whole.compile() if bare else whole
        for body in bare:
            body.explicitinertial = True
            for name in ("mass", "ipos", "iquat", "inertia"):
                setattr(body, name, getattr(model, f"body_{name}")[model.body(body.name).id])
    except (ValueError, mujoco.FatalError):
        names = ", ".join(body.name for body in bare)
        notes.append(f"bodies {names}: no inertial, and MuJoCo cannot read the meshes; without their mass")
    _delete(spec, *weighed, *spec.meshes, *spec.hfields)


def _delete(spec: Any, *elements: Any) -> None:  # noqa: ANN401
    for element in elements:
        spec.delete(element)


def _repair(spec: Any, notes: list[str], urdf: bool) -> None:  # noqa: ANN401
    for joint in spec.joints if urdf else ():
        if joint.range[0] > joint.range[1]:
            notes.append(f"joint {joint.name}: its lower limit is above the upper one; they are exchanged")
            joint.range, joint.limited = joint.range[::-1].copy(), True
    for body in spec.bodies:
        full, mass, com = np.array(body.fullinertia), body.mass, np.array(body.ipos)
        inertia = inertia_matrix(full) if np.isfinite(full[0]) else np.diag(body.inertia)
        possible = mass >= 0.0 and np.isfinite([mass, *com]).all()
        sound = possible and mass > 0.0 and usable(inertia) and np.linalg.eigvalsh(inertia)[0] >= LEAST_MOMENT
        if sound or not body.explicitinertial or body.name == "world":
            continue
        if not possible:
            notes.append(f"body {body.name}: a mass of {mass:g} kg at {com} m cannot be; left out")
            body.mass, body.ipos = 0.0, np.zeros(3)
        elif mass > 0.0:
            notes.append(f"body {body.name}: its inertia belongs to no rigid body; that of a ball of its mass taken")
        body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, ball_moment(body.mass))
        body.iquat = (1.0, 0.0, 0.0, 0.0)


_UNITS = {"hinge": {"deg": np.pi / 180.0, "rad": 1.0}, "slide": {"mm": 1e-3, "m": 1.0}}


def _held(model: Any, j: int, name: str, place: float | str) -> tuple[float, str]:  # noqa: ANN401
    """Position [rad] or [m] of a joint that can be held there, and its text; InputError."""
    kind, (low, high) = _KINDS[model.jnt_type[j]], model.jnt_range[j]
    if kind not in _UNITS:
        raise InputError(f"joint {name} is a {kind} joint; only hinges and slides can be held")
    if isinstance(place, str):
        number = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+))\s*([a-z]+)", place)
        if number is None or number[2] not in _UNITS[kind]:
            raise InputError(
                f"joint {name} is a {kind}: expected a place in {' or '.join(_UNITS[kind])}, got {place!r}"
            )
        place = float(number[1]) * _UNITS[kind][number[2]]
    unit, scale = next(iter(_UNITS[kind].items()))
    if model.jnt_limited[j] and not low - 1e-9 <= place <= high + 1e-9:
        raise InputError(
            f"joint {name} cannot be held at {place / scale:.4g} {unit}: it goes from {low / scale:.4g} to "
            f"{high / scale:.4g} {unit}"
        )
    return place, f"{place / scale:.4g} {unit}"


def _index(name: str, kind: str, names: list[str]) -> int:
    if name in names:
        return names.index(name)
    raise InputError(f"the model has no {kind} called {name!r}; it has: {', '.join(names)}")


_PARTS: dict[str, tuple[str, ...]] = {
    "link": ("inertial",),
    "joint": ("parent", "child", "origin", "axis", "limit", "mimic"),
    "mujoco": ("compiler", "option", "size"),
}
"""of a URDF that count"""

_EXPRESSION = re.compile(r"\$[{(]")
"""Beginning of a xacro expression"""

_NO_INERTIA = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")

_PREFIX = re.compile(rb"(</?|\s)([A-Za-z_][\w.-]*):(?=[A-Za-z_][\w.-]*[\s=/>])")
"""namespace prefix of an element or attribute"""


def parse(path: Path) -> ET.Element:
    """Root of a model, of a URDF with links' masses and joints only; FileError."""
    remedy = "check the path of the arm"
    with reading(path, "it cannot be read", remedy):
        text = read_bounded(path, remedy)
    try:
        # Prefixes such as drake: are often used without being declared, which MuJoCo does not mind.
        root = ET.fromstring(_PREFIX.sub(rb"\1\2_", text.lstrip()))  # noqa: S314 - expat expands no external entities
    except (UnicodeError, LookupError, ET.ParseError) as error:
        raise FileError(path, f"it is no XML in the encoding that it declares: {error}", "correct the file") from error
    if root.tag not in ("robot", "mujoco"):
        raise FileError(path, f"its root element is <{root.tag}>", "give a URDF (<robot>) or an MJCF (<mujoco>) file")
    xacro = any(one.tag.startswith("xacro_") and one.tag != "xacro_property" for one in root.iter())
    if root.tag == "robot":
        for parent in (root, *root):
            kept = tuple(_PARTS) if parent is root else _PARTS.get(parent.tag, ())
            parent[:] = [part for part in parent if part.tag in kept]
        for link in root.iter("link"):
            link[:] = [inertial for inertial in link if inertial.find("mass") is not None]
            for inertial in link:
                if inertial.find("inertia") is None:  # MuJoCo wants one; a ball's is taken for zeros
                    ET.SubElement(inertial, "inertia", _NO_INERTIA)
        xacro = xacro or bool(_EXPRESSION.search(ET.tostring(root, encoding="unicode")))
    if xacro:
        name = path.name.split(".")[0]
        made = f"{name}{'-expanded' * (path.suffix != '.xacro')}.urdf"
        raise FileError(
            path,
            "it is a xacro file, from which a URDF is made",
            f"make that and give it: xacro {path.name} > {made} (xacro comes with ROS, or with: pip install xacro)",
        )
    return root


def _speeds(root: ET.Element) -> dict[str, float]:
    """Speed limits [rad/s] of a URDF's joints."""
    result = {}
    for joint in root.findall("joint"):
        for limit in joint.findall("limit"):
            with suppress(ValueError):
                result[joint.get("name", "")] = float(limit.get("velocity", "nan"))
    return result


def cut(tree: Tree, base: str | None, tip: str | None) -> Loaded:
    """Unfinished arm from body ``base`` to the body or site ``tip``, see `rejoint.arms.loading.finish`.

    Default ``tip``: last link of the longest chain of hinges without a gripper; ``base``: the root. Slides are held;
    other bodies add mass to their link. InputError for unknown names, an ambiguous choice, or an impossible joint.
    """
    notes = list(tree.notes)
    start = None if base is None else _index(base, "body", tree.names)
    end = _longest(tree, start, notes) if tip is None else _index(tip, "body or site", tree.names)
    if start is None:
        start = _root_of(tree, end, notes)
    path = [WORLD, *tree.path(end)]
    if start not in path:
        raise InputError(f"{tip} does not hang below {base}; the bodies above it are: {tree.listed(path)}")
    driven = _driven(tree, tree.joints_of(path[path.index(start) + 1 :]), notes)
    if not driven:
        raise InputError(
            f"{tree.name}: there is no revolute joint between {tree.names[start]} and {tree.names[end]}; "
            "choose another base or tip"
        )
    return Loaded(arm=_arm(tree, driven, start, end, notes), notes=tuple(notes))


def _arm(tree: Tree, driven: list[Joint], start: int, end: int, notes: list[str]) -> Arm:
    """Arm of the ``driven`` joints between two places, by MuJoCo's kinematics at their zeros."""
    model, data, joints = tree.model, copy(tree.data), [joint.number for joint in driven]
    data.qpos[model.jnt_qposadr[joints]] = 0.0
    mujoco.mj_kinematics(model, data)
    turns, places = np.concatenate([data.xmat, data.site_xmat]), np.concatenate([data.xpos, data.site_xpos])
    poses, bodies = pose_of(turns.reshape(-1, 3, 3), places), model.jnt_bodyid[joints]
    upright = poses[start, 2, 2]
    if upright < _UPRIGHT:
        notes.append(
            f"base: {tree.names[start]} is tilted by {np.degrees(np.arccos(max(upright, -1.0))):.0f} deg in the file; "
            "gravity, floor and targets are taken as if it stood upright, which is right only where the arm itself does"
        )
    unlike = np.round(model.opt.gravity - GRAVITY, 1), model.jnt_stiffness[joints], model.body_gravcomp
    if left := ", ".join(compress(("gravity", "springs", "gravcomp"), map(np.any, unlike))):
        notes.append(f"{left} in the file left out: gravity is taken as downwards, and held by the motors")
    frames = pose_of(poses[bodies, :3, :3], data.xanchor[joints])
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], np.nan).T
    mass, com, inertia = zip(*_links(model, data, bodies.tolist(), inverse(frames)), strict=True)
    return Arm(
        name=tree.name,
        joint_names=tuple(joint.name for joint in driven),
        offset=inverse(np.array([poses[start], *frames[:-1]])) @ frames,
        axis=(data.xaxis[joints, None] @ frames[:, :3, :3])[:, 0],
        tip=inverse(frames[-1]) @ poses[end],
        lower=low,
        upper=high,
        max_speed=np.array([tree.speeds.get(joint.name, np.nan) for joint in driven]),
        mass=np.array(mass),
        com=np.array(com),
        inertia=np.array(inertia),
        rest=np.full(len(driven), np.nan),
        targets=UNKNOWN,
        floor=np.nan,
        encoder_step=np.nan,
    )


def _links(model: Any, data: Any, carriers: list[int], seen: Array) -> list[tuple[float, Array, Array]]:  # noqa: ANN401
    """Mass, centre and inertia of each link, ``seen`` (n, 4, 4) from its joint's frame."""
    owner = {body: i for i, body in enumerate(carriers)}  # of several joints of a body the last carries it
    whole, poses = np.zeros((len(seen), 4, 4)), pose_of(data.ximat.reshape(-1, 3, 3), data.xipos)
    for body in range(1, model.nbody):
        link = owner.get(body, owner.get(model.body_parentid[body]))
        if link is None:
            continue
        owner[body] = link
        if model.body_mass[body] > _NOTHING:
            pose = seen[link] @ poses[body]
            content = pseudo_inertia(model.body_mass[body], np.zeros(3), np.diag(model.body_inertia[body]))
            whole[link] += pose @ content @ pose.T
    return [rigid_body(one) for one in whole]


def _driven(tree: Tree, joints: list[Joint], notes: list[str]) -> list[Joint]:
    """Hinges of a chain; a note for each slide."""
    driven = [joint for joint in joints if joint.kind == "hinge"]
    for j, name, kind, _, leader in joints:
        if kind == "slide":
            low, high = 1e3 * tree.model.jnt_range[j]
            span = f" ({low:.0f} to {high:.0f} mm)" if tree.model.jnt_limited[j] else ""
            place = f"{1e3 * tree.data.qpos[tree.model.jnt_qposadr[j]]:.0f}"
            notes.append(
                f"joint {name} slides{span} and is not driven, only revolute joints are; it is taken as fixed at "
                f"{place} mm, which the arm has to keep; if it stands elsewhere: --hold {name}={place}mm"
            )
        elif kind not in ("hinge", "held") or leader in {other.name for other in driven}:
            follows = f" that follows {leader}" if leader else ""
            way = f", or hold both: --hold {name}=0deg,{leader}=0deg" if leader else ""
            raise InputError(
                f"{tree.name}: joint {name} is a {kind} joint{follows}, and only revolute joints of their own can be "
                f"driven; choose a base and a tip with it outside of the chain{way}"
            )
    return driven


_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""Joints of grippers (URDFs of SO-100, WidowX, Koch)"""

_FLANGE = "tool0"
"""Flange in URDFs of ROS-Industrial"""

_TOOL = re.compile(r"tool|tcp|grasp|end_?effector|(^|_)eef?(_|$)", re.IGNORECASE)
"""Tool frames (URDFs of Universal Robots, Kinova, PAL, Franka Emika)"""

_ACROSS = 1e-6
"""Largest product of orthogonal unit vectors (rounding)"""


_UPRIGHT = 1 - 1e-9
"""Least cosine of no tilt (rounding)"""


def _root_of(tree: Tree, end: int, notes: list[str]) -> int:
    """First body of the arm to ``end``: an upright root, else the world, or the load of a mobile base.

    That is two slides or more, and a hinge across them.
    """
    path, axes = tree.path(end), tree.data.xaxis
    joints = tree.joints_of(path)
    moving = list(takewhile(lambda joint: joint.kind == "slide", joints))
    if len(moving) > 1:
        slides = axes[[joint.number for joint in moving]]
        for joint in joints[len(moving) :][:1]:
            if joint.kind == "hinge" and (np.abs(slides @ axes[joint.number]) < _ACROSS).all():
                moving.append(joint)
        root, names = moving[-1].body, ", ".join(joint.name for joint in moving)
        notes.append(f"base: none given; {tree.names[root]} taken; {names} before it move all of it")
        return root
    root = path[0] if path else WORLD
    if tree.data.xmat[root, 8] < _UPRIGHT or any(one.kind not in ("free", "slide") for one in tree.joints_of([root])):
        root = WORLD
    notes.append(f"base: none given; {tree.names[root]} taken, the root of the tree")
    return root


def _longest(tree: Tree, start: int | None, notes: list[str]) -> int:
    """Last link of the longest chain of hinges below ``start`` (None: anywhere), without gripper."""
    hinges = _chains(tree, start)
    leaves = hinges.keys() - {tree.above[body] for body in hinges if body not in (start, WORLD)}
    most = max(hinges[body] for body in leaves)
    ends = [body for body in sorted(leaves) if hinges[body] == most]
    if not most:
        every = tree.listed(range(tree.model.nbody))
        raise InputError(f"{tree.name}: no chain of hinges was found outside of grippers; name the tip, of {every}")
    carried: dict[Joint, list[int]] = {}  # ends by the last joint before them
    for body in ends:
        carried.setdefault(tree.joints_of(tree.path(body))[-1], []).append(body)
    if len(carried) > 1:
        names = tree.listed(_frame(tree, bodies) for bodies in carried.values())
        raise InputError(
            f"{tree.name}: several links could be the tip of the arm ({most} joints each): {names}; name the tip"
        )
    ends += [place for place in range(tree.model.nbody, len(tree.names)) if tree.above[place] in ends]  # sites
    end = _frame(tree, ends)
    behind = [place for place in range(1, len(tree.names)) if tree.above[place] in (end, *ends)]
    others = [place for place in ends if place != end]
    more = f" (beside it are {tree.listed(others)}, which can be named instead)" if others else ""
    notes.append(f"tip: none given; {tree.names[end]} taken, the end of the longest chain{more}")
    if beyond := ", ".join(joint.name for joint in tree.joints_of(behind) if joint.kind == "hinge"):
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
        kinds, names = [joint.kind for joint in joints], [joint.name for joint in joints]
        if start is None and kinds[:1] == ["free"]:
            del joints[0]
        # Where a joint of an arm follows another one of it, what comes later refuses both.
        if kinds[-1:] not in (["slide"], ["coupled"]) and all(j.leader in names or _passable(tree, j) for j in joints):
            hinges[body] = kinds.count("hinge")
    return hinges


def _passable(tree: Tree, joint: Joint) -> bool:
    """Whether a chain goes on behind a joint: not behind grippers', which lead joints of other branches."""
    led = [other.body for other in tree.joints if other.leader == joint.name]
    gripper = _GRIPPER.search(joint.name) or any(joint.body not in tree.path(body) for body in led)
    return joint.kind == "held" or (joint.kind in ("hinge", "slide") and not gripper)


def _frame(tree: Tree, ends: Iterable[int]) -> int:
    """Choose the tool's frame of bodies on one link, else the last body before all."""
    named = {tree.names[body]: body for body in ends}
    tools = [body for name, body in named.items() if _TOOL.search(name)]
    if _FLANGE in named:
        return named[_FLANGE]
    if len(named) == 1 or len(tools) == 1:
        return (tools or list(named.values()))[0]
    return [bodies[0] for bodies in zip(*map(tree.path, named.values()), strict=False) if len(set(bodies)) == 1][-1]
