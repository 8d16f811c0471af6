"""Descriptions of arms that nobody here wrote: files inside packages of the extra dev, which are not imported."""

from importlib.util import find_spec
from pathlib import Path

from rejoint.arms import Arm, load_arm


def packaged(package: str, path: str) -> Path:
    found = find_spec(package)
    assert found is not None, f"the extra dev brings {package}"
    return Path(found.submodule_search_locations[0]) / path


def ur5e() -> Arm:
    return load_arm(packaged("airo_models", "arms/ur5e/ur5e.urdf"))
