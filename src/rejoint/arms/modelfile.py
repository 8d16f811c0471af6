"""Read a URDF or MJCF file into a tree of bodies by MuJoCo.

Only kinematics and masses are compiled: meshes may be missing.
"""

from __future__ import annotations

import difflib
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.inertia import ball_moment, inertia_matrix, pseudo_inertia, usable
from rejoint.arms.rotations import pose_of, rotation_of
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
