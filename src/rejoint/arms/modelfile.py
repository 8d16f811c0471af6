"""Read a URDF or MJCF file into a tree of bodies by MuJoCo.

Only kinematics and masses are compiled: meshes may be missing.
"""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.chain import Joint, ModelBody, Tree, unknown
from rejoint.arms.inertia import NOTHING, SpatialInertia, ball, ball_radius, inertia_matrix, usable
from rejoint.arms.rotations import pose_of, rotation_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import MODEL_MOST, read_bounded

_KINDS = {0: "free", 1: "ball", 2: "slide", 3: "hinge"}
"""mjtJoint"""

LEAST_MOMENT = 1e-12
"""[kg m^2] MuJoCo takes less for none"""


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
            coupled = _coupled(mujoco, spec)
            _strip(mujoco, spec, every_geom=urdf, notes=notes)
            contents = _contents(spec, notes)
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            raise FileError(
                path, f"MuJoCo cannot use it: {' '.join(str(error).split())}", "correct the file"
            ) from error
    bodies, data = _bodies(mujoco, model, contents, hold)
    speeds = urdf_speeds(root) if urdf else {}
    joints = tuple(_joint(model, data, j, speeds, coupled) for j in range(model.njnt))
    notes += [f"joint {joint.name}: held at {_place(joint)}, as given" for joint in joints if joint.name in hold]
    return Tree(
        name=root.get("name") or root.get("model") or path.stem,
        bodies=bodies + _sites(model, data),
        joints=tuple(replace(joint, kind="held") if joint.name in hold else joint for joint in joints),
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
    for kind in ("keys", "sensors", "actuators", "tendons", "equalities", "pairs", "excludes", "skins", "flexes"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    from_files = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
    for body in spec.bodies:
        dropped = weighed = 0
        for geom in list(body.geoms):
            if every_geom or geom.type in from_files or geom.meshname:
                if not every_geom and geom.mass > 0.0:
                    _as_ball(mujoco, geom)
                    weighed += 1
                else:
                    spec.delete(geom)
                    dropped += 1
            else:
                geom.material = ""
        for site in body.sites:
            site.material = ""
        if dropped and body.geoms and not body.explicitinertial:
            notes.append(f"body {body.name}: no inertial; its mass is that of its primitive shapes, without its meshes")
        elif weighed and not body.explicitinertial:
            notes.append(f"body {body.name}: no inertial; the masses of its meshes are taken as balls at their places")
    for kind in ("meshes", "hfields", "materials", "textures"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    spec.compiler.fusestatic = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _as_ball(mujoco: ModuleType, geom: Any) -> None:  # noqa: ANN401
    geom.type, geom.meshname, geom.material = mujoco.mjtGeom.mjGEOM_SPHERE, "", ""
    geom.size = np.array([ball_radius(float(geom.mass)), 0.0, 0.0])


def _massless(geom: Any) -> bool:  # noqa: ANN401
    return bool(geom.mass == 0.0 or (not geom.mass > 0.0 and geom.density == 0.0))


def _contents(spec: Any, notes: list[str]) -> dict[str, SpatialInertia | None]:  # noqa: ANN401
    result: dict[str, SpatialInertia | None] = {}
    for index, body in enumerate(spec.bodies):
        body.name = body.name or f"body{index}"
        result[body.name] = None
        if body is spec.worldbody or body.name == "world":
            continue
        if not body.explicitinertial and not all(map(_massless, body.geoms)):
            continue
        full = np.array(body.fullinertia, dtype=float)
        inertia = inertia_matrix(full) if np.isfinite(full[0]) else np.diag(np.array(body.inertia, dtype=float))
        mass, com = float(body.mass), np.array(body.ipos, dtype=float)
        if not body.explicitinertial or mass == 0.0:
            result[body.name] = NOTHING
        elif not (np.isfinite(mass) and mass > 0 and np.isfinite(com).all()):
            result[body.name] = NOTHING
            notes.append(f"body {body.name}: a mass of {mass:g} kg at {com} m cannot be; left out")
        elif not usable(inertia) or np.linalg.eigvalsh(inertia)[0] < LEAST_MOMENT:
            result[body.name] = SpatialInertia(mass=mass, com=com, inertia=ball(mass), doubtful=True)
            notes.append(f"body {body.name}: its inertia belongs to no rigid body (moments {_moments(inertia)} kg m^2)")
        else:
            continue
        body.explicitinertial, body.mass, body.ipos = True, 1.0, np.zeros(3)
        body.fullinertia, body.inertia = np.full(6, np.nan), np.ones(3)
        body.iquat = (1.0, 0.0, 0.0, 0.0)
    spec.compiler.balanceinertia = True
    return result


def _coupled(mujoco: ModuleType, spec: Any) -> dict[str, str]:  # noqa: ANN401
    return {equality.name1: equality.name2 for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_JOINT}


def _bodies(
    mujoco: ModuleType,
    model: Any,  # noqa: ANN401
    contents: dict[str, SpatialInertia | None],
    hold: Mapping[str, float],
) -> tuple[tuple[ModelBody, ...], Any]:
    data = mujoco.MjData(model)
    for j in range(model.njnt):
        if model.jnt_limited[j] and _KINDS[int(model.jnt_type[j])] in ("hinge", "slide"):
            address = model.jnt_qposadr[j]
            data.qpos[address] = np.clip(data.qpos[address], *model.jnt_range[j])
    for name, position in hold.items():
        data.qpos[model.jnt_qposadr[_holdable(model, name, position)]] = position
    mujoco.mj_kinematics(model, data)
    bodies = []
    for b in range(model.nbody):
        name = model.body(b).name
        content = contents.get(name)
        bodies.append(
            ModelBody(
                name=name,
                parent=int(model.body_parentid[b]),
                pose=pose_of(data.xmat[b].reshape(3, 3), data.xpos[b]),
                content=_compiled(model, b) if content is None else content,
            )
        )
    return tuple(bodies), data


def _holdable(model: Any, name: str, position: float) -> int:  # noqa: ANN401
    """Index of a joint held at ``position`` [rad] or [m]."""
    names = [model.joint(j).name for j in range(model.njnt)]
    if name not in names:
        raise InputError(unknown(name, "joint", names))
    j = names.index(name)
    kind, (low, high) = _KINDS[int(model.jnt_type[j])], model.jnt_range[j]
    if kind not in ("hinge", "slide"):
        raise InputError(f"joint {name} is a {kind} joint; only hinges and slides can be held")
    if model.jnt_limited[j] and not low - 1e-9 <= position <= high + 1e-9:
        unit = "m" if kind == "slide" else "rad"
        raise InputError(f"joint {name} cannot be held at {position:g} {unit}: it goes from {low:g} to {high:g}")
    return j


def _place(joint: Joint) -> str:
    return f"{1e3 * joint.position:g} mm" if joint.kind == "slide" else f"{np.degrees(joint.position):.4g} deg"


def _sites(model: Any, data: Any) -> tuple[ModelBody, ...]:  # noqa: ANN401
    found = []
    for s in range(model.nsite):
        pose = pose_of(data.site_xmat[s].reshape(3, 3), data.site_xpos[s])
        found.append(ModelBody(name=model.site(s).name, parent=int(model.site_bodyid[s]), pose=pose, site=True))
    return tuple(site for site in found if site.name)


def _joint(
    model: Any,  # noqa: ANN401
    data: Any,  # noqa: ANN401
    j: int,
    speeds: dict[str, float],
    coupled: dict[str, str],
) -> Joint:
    name, kind = model.joint(j).name or f"joint{j + 1}", _KINDS[int(model.jnt_type[j])]
    limited = bool(model.jnt_limited[j])
    return Joint(
        name=name,
        kind="coupled" if kind == "hinge" and name in coupled else kind,
        body=int(model.jnt_bodyid[j]),
        anchor=data.xanchor[j].copy(),
        axis=data.xaxis[j].copy(),
        position=float(data.qpos[model.jnt_qposadr[j]]) if kind in ("hinge", "slide") else 0.0,
        lower=float(model.jnt_range[j, 0]) if limited else np.nan,
        upper=float(model.jnt_range[j, 1]) if limited else np.nan,
        speed=speeds.get(name, np.nan),
        follows=coupled.get(name, ""),
    )


def _compiled(model: Any, b: int) -> SpatialInertia:  # noqa: ANN401
    turn = rotation_of(model.body_iquat[b])
    inertia = (turn * model.body_inertia[b]) @ turn.T
    return SpatialInertia(mass=float(model.body_mass[b]), com=model.body_ipos[b].copy(), inertia=inertia)


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
    if _is_template(root):
        raise xacro_error(path)
    return root


def _is_template(root: ET.Element) -> bool:
    used = {element.tag for element in root.iter() if element.tag.startswith("xacro_")}
    return bool(used - {"xacro_property"}) or (bool(used) and _EXPRESSION.search(bare(root)) is not None)


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
