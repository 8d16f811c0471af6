"""``camera.toml``: how camera, board and arm stood to each other when they were found, for pictures to come.

SI units and px. A digest in the first line covers the whole text, so that a changed or damaged file is noticed. It
holds as long as neither camera nor board is shifted, and the lens not focused anew.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit

from rejoint.arms.arm import Arm, Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import TERMS, Lens
from rejoint.arms.camera.rig import Rig
from rejoint.system.errors import ContractError, FileError, InputError, first_line
from rejoint.system.files import CHANGED, TOML_MOST, digest, read_bounded, write_whole

FORMAT = 1
"""Version of the layout; a reader refuses others"""

_REMEDY = "calibrate with the camera again"
_SEAL = re.compile(rb"\A# digest of the text below: ([0-9a-f]{16})\n")


def write_rig(path: Path, arm: Arm, rig: Rig, sigma: Array, date: str = "") -> None:
    """Write the ``rig`` of ``arm``.

    ``sigma`` (19,) are standard deviations of the lens's `TERMS`, and of shift [m] and turn [rad] of what stands and of
    what is mounted.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment("A camera, a board and one robot arm. SI units and px; sigma: standard deviations."))
    document.add("format", tomlkit.item(FORMAT))
    document.add("arm", tomlkit.item(arm.name))
    document.add("date", tomlkit.item(date))
    document.add("carried", tomlkit.item(rig.carried).comment("what the tool carries: board or camera"))
    document.add("board", tomlkit.item(asdict(rig.board)))
    n = len(TERMS)
    lens = tomlkit.item(asdict(rig.lens))
    lens.add("sigma", dict(zip(TERMS, map(float, sigma[:n]), strict=True)))
    document.add("lens", lens)
    for name, pose, spread in (
        ("standing", rig.standing, sigma[n : n + 6]), ("mounted", rig.mounted, sigma[n + 6 :])
    ):  # fmt: skip
        table = tomlkit.table()
        table.comment("pose in the base of the arm" if name == "standing" else "pose in the frame of the tool")
        rows = tomlkit.array()
        for row in pose[:3].tolist():
            rows.append(row)
        table.add("pose", rows.multiline(True))
        table.add("sigma_shift", spread[:3].tolist())
        table.add("sigma_turn", spread[3:].tolist())
        document.add(name, table)
    text = tomlkit.dumps(document)
    text = f"# digest of the text below: {digest(text.encode()).decode()}\n{text}"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_rig(path: Path, arm: Arm) -> Rig:
    """Read the rig of ``arm``; FileError if it is missing or damaged, ContractError if it is of another arm."""
    try:
        text = read_bounded(path, TOML_MOST, _REMEDY)
        sealed = _SEAL.search(text)
        if sealed and digest(text[sealed.end() :]) != sealed[1]:
            raise FileError(path, CHANGED, _REMEDY)
        data = tomllib.loads(text.decode())
        if data["format"] != FORMAT:
            raise FileError(path, f"a rig of format {data['format']!r}, expected {FORMAT}", _REMEDY)
        if data["arm"] != arm.name:
            raise ContractError(f"camera of arm {data['arm']!r}, expected one of {arm.name!r}; calibrate this arm")
        lens = {name: value for name, value in data["lens"].items() if name != "sigma"}
        return Rig(
            lens=msgspec.convert(lens, Lens), board=msgspec.convert(data["board"], Board),
            carried=str(data["carried"]), standing=_pose(data["standing"]), mounted=_pose(data["mounted"]),
        )  # fmt: skip
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "calibrate with the camera first") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileError(path, f"not a readable TOML file ({first_line(error)})", _REMEDY) from error
    except (KeyError, TypeError, ValueError, AttributeError, InputError, msgspec.MsgspecError) as error:
        raise FileError(path, f"no rig ({type(error).__name__}: {first_line(error)})", _REMEDY) from error


def _pose(table: dict[str, Any]) -> Array:
    rows = np.array(table["pose"], dtype=float)
    if rows.shape != (3, 4) or not np.isfinite(rows).all():
        raise InputError(f"a pose of finite numbers of shape (3, 4) was expected, found {rows.shape}")
    pose = np.eye(4)
    pose[:3] = rows
    return pose
