"""Parameter sets that somebody has published, as a short TOML file, to be judged beside one's own twin.

name = "arm maker's simulation model"
stiffness = 998.22                          # N m/rad: one value, or one for each joint
damping = [2.7, 2.7, 2.7, 2.7, 2.7]         # N m s/rad
coulomb = 0.052                             # N m
armature = 0.028                            # kg m^2
torque_limit = 2.94                         # N m; may be left out, as all that follows
offset = 0.0                                # rad
delay = 0.0                                 # s
ramp_speed = 50.0                           # rad/s
stiction = 1.0
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import TOML_MOST, read_bounded
from rejoint.twin.judge import Candidate
from rejoint.twin.parameters import PARAMETERS, TwinParameters, pack, unpack
from rejoint.twin.unknown import unknown_prior

_OPTIONAL = {"offset": 0.0, "delay": 0.0}
_LIMITLESS = ("torque_limit", "ramp_speed")
_REMEDY = "docs/published holds examples"


def read_published(path: Path, arm: Arm) -> Candidate:
    """Read a published set; FileError names a file that is missing or not one, or the value that is wrong."""
    try:
        data = tomllib.loads(read_bounded(path, TOML_MOST, _REMEDY).decode())
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, UnicodeDecodeError, RecursionError, tomllib.TOMLDecodeError) as error:
        raise FileError(path, f"not a readable TOML file ({error})", _REMEDY) from error
    unknown = sorted(set(data) - {p.name for p in PARAMETERS} - {"name", "stiction", "source"})
    if unknown:
        raise FileError(path, f"unknown {', '.join(unknown)}; known: {', '.join(p.name for p in PARAMETERS)}", _REMEDY)
    values = {p.name: _value(path, data, p.name, arm.joints if p.per_joint else None, arm) for p in PARAMETERS}
    parameters = TwinParameters(**values)
    positive = [getattr(parameters, p.name) for p in PARAMETERS if p.log]
    if not all((value > 0).all() for value in positive) or not np.isfinite(pack(parameters)).all():
        raise FileError(path, "every value but offset and delay must be above zero", _REMEDY)
    stiction = data.get("stiction", 1.0)
    if not isinstance(stiction, int | float) or not stiction >= 1.0:
        raise FileError(path, f"stiction is {stiction!r}, expected a number of at least 1", _REMEDY)
    return Candidate(name=str(data.get("name", path.stem)), parameters=parameters, stiction=float(stiction))


def _value(path: Path, data: dict[str, Any], name: str, joints: int | None, arm: Arm) -> Array:
    if name in data:
        given: Any = data[name]
    elif name in _OPTIONAL:
        given = _OPTIONAL[name]
    elif name in _LIMITLESS:  # where the wide ranges end, a limit is out of reach
        given = float(np.ravel(getattr(unpack(unknown_prior(arm).upper, arm.joints), name))[0])
    else:
        raise FileError(path, f"no {name}", _REMEDY)
    try:
        return np.array(np.broadcast_to(np.asarray(given, dtype=float), () if joints is None else (joints,)))
    except (TypeError, ValueError, InputError) as error:
        expected = "a number" if joints is None else f"a number or a list of {joints}"
        raise FileError(path, f"{name} is {given!r}, expected {expected}", _REMEDY) from error
