"""Read a URDF or an MJCF file into a tree of bodies, through MuJoCo's own loader.

MuJoCo is imported when a file is read, not before: running a policy on the arm's own computer needs
the modules beside this one, and no simulator. Meshes, textures, actuators, sensors, tendons and
constraints are removed before compiling, so that the files they name need not be there.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.chain import Body, Joint, Site, Tree
from rejoint.arms.inertia import NOTHING, SpatialInertia, ball, inertia_matrix, usable
from rejoint.arms.rotations import pose_of, rotation_of
from rejoint.system.errors import FileError
from rejoint.system.extras import require
from rejoint.system.files import MODEL_MOST, read_bounded

_KINDS = {0: "free", 1: "ball", 2: "slide", 3: "hinge"}
"""mjtJoint"""

_PREFIX = re.compile(r"(</?|\s)([A-Za-z_][\w.-]*):(?=[A-Za-z_][\w.-]*[\s=/>])")
"""namespace prefix of an element or attribute"""


def read_tree(path: Path) -> Tree:
    """Read a URDF or MJCF file. FileError names what is wrong with it, MissingExtraError a missing installation."""
    root = _parse(path)
    mujoco = _mujoco()
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise FileError(path, f"MuJoCo cannot read it: {_line(error)}", "correct the file") from error
    urdf = root.tag == "robot"
    notes: list[str] = []
    coupled = _coupled(mujoco, spec)
    _strip(mujoco, spec, every_geom=urdf, notes=notes)
    contents = _contents(spec, notes)
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise FileError(path, f"MuJoCo cannot compile it: {_line(error)}", "correct the file") from error
    bodies, data = _bodies(mujoco, model, contents)
    drives = _drives(model, coupled)
    speeds = _urdf_speeds(root) if urdf else {}
    return Tree(
        name=root.get("name") or root.get("model") or path.stem,
        bodies=bodies,
        joints=tuple(_joint(model, data, j, speeds, coupled, drives) for j in range(model.njnt)),
        sites=_sites(model, data),
        notes=tuple(notes),
    )


def _parse(path: Path) -> ET.Element:
    try:
        text = read_bounded(path, MODEL_MOST, "check the path of the arm").decode("utf-8-sig")
        # Prefixes such as drake: are often used without being declared, which MuJoCo does not mind.
        root = ET.fromstring(_PREFIX.sub(r"\1\2_", text))  # noqa: S314 - expat expands no external entities
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", "check the path of the arm") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"it cannot be read ({error})", "check the path of the arm") from error
    except ET.ParseError as error:
        raise FileError(path, f"it is not XML: {error}", "correct the file") from error
    if root.tag not in ("robot", "mujoco"):
        raise FileError(path, f"its root element is <{root.tag}>", "give a URDF (<robot>) or an MJCF (<mujoco>) file")
    if any(element.tag.startswith("xacro_") for element in root.iter()):
        raise FileError(path, "it is a xacro file", "expand it to URDF first: xacro FILE.xacro > FILE.urdf")
    return root


def _mujoco() -> ModuleType:
    require("reading a URDF or MJCF file (a TOML file would do without)", "mujoco")
    import mujoco

    return mujoco


def _strip(mujoco: ModuleType, spec: Any, *, every_geom: bool, notes: list[str]) -> None:  # noqa: ANN401
    """Remove what is not kinematics or mass; the mass of primitive shapes stays."""
    for kind in ("keys", "sensors", "actuators", "tendons", "equalities", "pairs", "excludes", "skins", "flexes"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    from_files = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
    for body in spec.bodies:
        dropped = 0
        for geom in list(body.geoms):
            if every_geom or geom.type in from_files or geom.meshname:
                spec.delete(geom)
                dropped += 1
            else:
                geom.material = ""
        for site in body.sites:
            site.material = ""
        if dropped and body.geoms and not body.explicitinertial:
            notes.append(f"body {body.name}: no inertial; its mass is that of its primitive shapes, without its meshes")
    for kind in ("meshes", "hfields", "materials", "textures"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    spec.compiler.fusestatic = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _contents(spec: Any, notes: list[str]) -> dict[str, SpatialInertia | None]:  # noqa: ANN401
    """Judge each body's mass and inertia; None where the compiled model's are good.

    A body whose numbers MuJoCo would refuse gets harmless ones for compiling; its chain link is
    completed later.
    """
    result: dict[str, SpatialInertia | None] = {}
    for index, body in enumerate(spec.bodies):
        body.name = body.name or f"body{index}"
        result[body.name] = None
        if body is spec.worldbody or body.name == "world":
            continue
        if not body.explicitinertial and body.geoms:
            continue
        full = np.array(body.fullinertia, dtype=float)
        inertia = inertia_matrix(full) if np.isfinite(full[0]) else np.diag(np.array(body.inertia, dtype=float))
        mass, com = float(body.mass), np.array(body.ipos, dtype=float)
        if not body.explicitinertial or mass == 0.0:
            result[body.name] = NOTHING
        elif not (np.isfinite(mass) and mass > 0 and np.isfinite(com).all()):
            result[body.name] = NOTHING
            notes.append(f"body {body.name}: a mass of {mass:g} kg at {com} m cannot be; left out")
        elif not usable(inertia):
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
    """Joints that follow another one (URDF ``mimic``, MJCF ``equality/joint``), and which; "" where they are held."""
    return {equality.name1: equality.name2 for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_JOINT}


def _drives(model: Any, coupled: dict[str, str]) -> set[str]:  # noqa: ANN401
    """Joints that another one follows which does not hang below them."""
    body = {model.joint(j).name: int(model.jnt_bodyid[j]) for j in range(model.njnt)}

    def hangs_below(lower: int, upper: int) -> bool:
        while lower != 0 and lower != upper:
            lower = int(model.body_parentid[lower])
        return lower == upper

    pairs = [(follower, leader) for follower, leader in coupled.items() if leader in body and follower in body]
    return {leader for follower, leader in pairs if not hangs_below(body[follower], body[leader])}


def _bodies(mujoco: ModuleType, model: Any, contents: dict[str, SpatialInertia | None]) -> tuple[tuple[Body, ...], Any]:  # noqa: ANN401
    """Bodies in the reference posture, or the nearest within the limits, and MuJoCo's data of that posture."""
    data = mujoco.MjData(model)
    for j in range(model.njnt):
        if model.jnt_limited[j] and _KINDS[int(model.jnt_type[j])] in ("hinge", "slide"):
            address = model.jnt_qposadr[j]
            data.qpos[address] = np.clip(data.qpos[address], *model.jnt_range[j])
    mujoco.mj_kinematics(model, data)
    bodies = []
    for b in range(model.nbody):
        name = model.body(b).name
        content = contents.get(name)
        bodies.append(
            Body(
                name=name,
                parent=int(model.body_parentid[b]),
                pose=pose_of(data.xmat[b].reshape(3, 3), data.xpos[b]),
                content=_compiled(model, b) if content is None else content,
            )
        )
    return tuple(bodies), data


def _sites(model: Any, data: Any) -> tuple[Site, ...]:  # noqa: ANN401
    return tuple(
        Site(
            name=model.site(s).name,
            body=int(model.site_bodyid[s]),
            pose=pose_of(data.site_xmat[s].reshape(3, 3), data.site_xpos[s]),
        )
        for s in range(model.nsite)
        if model.site(s).name
    )


def _joint(
    model: Any,  # noqa: ANN401
    data: Any,  # noqa: ANN401
    j: int,
    speeds: dict[str, float],
    coupled: dict[str, str],
    drives: set[str],
) -> Joint:
    name, kind = model.joint(j).name or f"joint{j + 1}", _KINDS[int(model.jnt_type[j])]
    limited = bool(model.jnt_limited[j])
    return Joint(
        name=name,
        kind="coupled" if kind == "hinge" and name in coupled else kind,
        body=int(model.jnt_bodyid[j]),
        anchor=data.xanchor[j].copy(),
        axis=data.xaxis[j].copy(),
        angle=float(data.qpos[model.jnt_qposadr[j]]) if kind == "hinge" else 0.0,
        lower=float(model.jnt_range[j, 0]) if limited else np.nan,
        upper=float(model.jnt_range[j, 1]) if limited else np.nan,
        speed=speeds.get(name, np.nan),
        drives=name in drives,
    )


def _compiled(model: Any, b: int) -> SpatialInertia:  # noqa: ANN401
    turn = rotation_of(model.body_iquat[b])
    inertia = (turn * model.body_inertia[b]) @ turn.T
    return SpatialInertia(mass=float(model.body_mass[b]), com=model.body_ipos[b].copy(), inertia=inertia)


def _urdf_speeds(root: ET.Element) -> dict[str, float]:
    """Speed limits [rad/s] by joint; MuJoCo does not read them."""
    result = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        try:
            result[joint.get("name", "")] = float(limit.get("velocity", "nan")) if limit is not None else np.nan
        except ValueError:
            result[joint.get("name", "")] = np.nan
    return result


def _moments(inertia: Array) -> str:
    if not np.isfinite(inertia).all():
        return "not finite"
    return ", ".join(f"{value:.2g}" for value in np.linalg.eigvalsh(inertia))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
