"""The text of a URDF or an MJCF file: what it is, and what of it is needed."""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from rejoint.system.errors import FileError
from rejoint.system.files import MODEL_MOST, read_bounded

_JOINT_PARTS = ("parent", "child", "origin", "axis", "limit", "mimic")
"""What of a URDF's joint is read."""

_DECLARED = re.compile(rb"\s*<\?xml[^>]*\sencoding=[\"']([\w.-]+)")

_EXPRESSION = re.compile(r"\$[{(]")
"""Beginning of what xacro computes"""

_NO_INERTIA = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")

_PREFIX = re.compile(r"(</?|\s)([A-Za-z_][\w.-]*):(?=[A-Za-z_][\w.-]*[\s=/>])")
"""namespace prefix of an element or attribute"""


def parse(path: Path) -> ET.Element:
    """Return the root of a whole model; FileError for anything else."""
    try:
        text = _decoded(read_bounded(path, MODEL_MOST, "check the path of the arm"))
        # Prefixes such as drake: are often used without being declared, which MuJoCo does not mind.
        root = ET.fromstring(_PREFIX.sub(r"\1\2_", text))  # noqa: S314 - expat expands no external entities
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", "check the path of the arm") from error
    except OSError as error:
        raise FileError(path, f"it cannot be read ({error})", "check the path of the arm") from error
    except (UnicodeError, LookupError) as error:
        raise FileError(
            path, f"it is not in the encoding that it declares, or UTF-8 ({error})", "save it as UTF-8"
        ) from error
    except ET.ParseError as error:
        raise FileError(path, f"it is not XML: {error}", "correct the file") from error
    if root.tag == "mujocoinclude":
        raise FileError(path, "it is a fragment that other MJCF files include", f"give a whole one{_including(path)}")
    if root.tag not in ("robot", "mujoco"):
        raise FileError(path, f"its root element is <{root.tag}>", "give a URDF (<robot>) or an MJCF (<mujoco>) file")
    if _is_template(root):
        raise xacro_error(path)
    return root


def _is_template(root: ET.Element) -> bool:
    """Tell whether xacro has to be run on a file; URDFs of makers often declare a property that nothing uses."""
    used = {element.tag for element in root.iter() if element.tag.startswith("xacro_")}
    return bool(used - {"xacro_property"}) or (bool(used) and _EXPRESSION.search(bare(root)) is not None)


def _decoded(data: bytes) -> str:
    """Return the text of an XML file, in the encoding that it declares."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    declared = _DECLARED.match(data.removeprefix(codecs.BOM_UTF8))
    encoding = declared[1].decode() if declared else "utf-8"
    return data.decode("utf-8-sig" if encoding.lower() == "utf-8" else encoding)


def xacro_error(path: Path) -> FileError:
    """Say that a file is no URDF yet, and what makes one of it."""
    name = path.name.split(".")[0]
    made = f"{name}.urdf" if path.suffix == ".xacro" else f"{name}-expanded.urdf"
    return FileError(
        path,
        "it is a xacro file, from which a URDF is made",
        f"make that and give it: xacro {path.name} > {made} (xacro comes with ROS, or with: pip install xacro)",
    )


def _including(path: Path) -> str:
    """Name files beside a fragment, or one folder up, that include it, as a hint."""
    files = sorted({*path.parent.glob("*.xml"), *path.parent.parent.glob("*.xml")} - {path})
    wanted = re.compile(rb"<mujoco\b.*<include\s[^>]*" + re.escape(path.name.encode()), re.DOTALL)
    found = [file.name for file in files[:100] if wanted.search(file.read_bytes()[:MODEL_MOST])]
    return f", such as {', '.join(found[:3])}" if found else ""


def bare(root: ET.Element) -> str:
    """Keep of a URDF its links with their masses and its joints, as text: shapes, and what programs add, go."""
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
    """Speed limits [rad/s] by joint; MuJoCo does not read them."""
    result = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        try:
            result[joint.get("name", "")] = float(limit.get("velocity", "nan")) if limit is not None else np.nan
        except ValueError:
            result[joint.get("name", "")] = np.nan
    return result
