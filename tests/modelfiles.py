"""Descriptions of arms that nobody here wrote: files inside packages of the extra dev, which are not imported."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Box, Loaded, load_arm
from rejoint.arms.loading import finish
from rejoint.arms.modelfile import cut, read_tree


def packaged(package: str, path: str) -> Path:
    found = find_spec(package)
    assert found is not None, f"the extra dev brings {package}"
    return Path(found.submodule_search_locations[0]) / path


def ur5e() -> Arm:
    return load_arm(packaged("airo_models", "arms/ur5e/ur5e.urdf"))


def without_workspace(path: Path, base: str | None, tip: str) -> Arm:
    """Read an arm without deriving its workspace, which takes a second or more."""
    draft = cut(read_tree(path), base, tip).arm
    middle, box = np.nan_to_num((draft.lower + draft.upper) / 2), Box(lower=-np.ones(3), upper=np.ones(3))
    return finish(Loaded(arm=replace(draft, rest=middle, targets=box))).arm


def resized(arm, length, mass=1.0):
    """The same arm, with lengths and masses times a factor."""
    offset, tip = arm.offset.copy(), arm.tip.copy()
    offset[:, :3, 3] *= length
    tip[:3, 3] *= length
    return replace(
        arm,
        name="resized",
        offset=offset,
        tip=tip,
        com=length * arm.com,
        mass=mass * arm.mass,
        inertia=mass * length**2 * arm.inertia,
        floor=length * arm.floor,
        targets=Box(lower=length * arm.targets.lower, upper=length * arm.targets.upper),
    )
