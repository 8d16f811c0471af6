"""What the base installation lacks: which modules each extra of `pyproject.toml` brings, and how to ask for them."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

from rejoint.system.errors import MissingExtraError

EXTRAS: dict[str, tuple[str, ...]] = {
    "train": ("mujoco", "torch", "skrl", "gymnasium", "onnx", "tensorboard", "cmaes"),
    "report": ("matplotlib", "jinja2", "PIL"),
    "logs": ("mcap", "mcap_protobuf", "mcap_ros2", "rosbags"),
    "camera": ("cv2", "PIL"),
    "feetech": ("scservo_sdk",),
    "history": ("duckdb",),
    "fleet": ("ray",),
    "live": ("viser", "trimesh", "jinja2"),
}
"""Modules that this package imports, by the extra that installs them"""


_NAMED = 3  # missing modules that a line names (chosen: it stays one line)


def installed(module: str) -> bool:
    """Tell whether a module could be imported, without doing so."""
    return find_spec(module) is not None


def require(what: str, *needs: str) -> None:
    """Raise MissingExtraError where one of ``needs``, extras or modules, is not installed for ``what``."""
    modules = [module for need in needs for module in EXTRAS.get(need, (need,))]
    missing = [module for module in modules if not installed(module)]
    if missing:
        raise MissingExtraError(_line(what, missing))


def explain(error: ImportError) -> str | None:
    """Say in a line which extra brings the module that could not be imported; None if it is of no extra."""
    module = (error.name or "").partition(".")[0]
    known = any(module in modules for modules in EXTRAS.values())
    return _line("this", [module]) if known and not installed(module) else None


def _line(what: str, missing: Iterable[str]) -> str:
    missing = list(missing)
    named = ", ".join(missing[:_NAMED]) + (f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else "")
    extras, left = set(), set(missing)
    while left:  # the extra that brings most of it, until nothing is missing
        extras.add(best := max(EXTRAS, key=lambda extra: len(left.intersection(EXTRAS[extra]))))
        left.difference_update(EXTRAS[best])
    return (
        f"{what} needs more than the base installation (missing: {named}); "
        f"add it with: pip install 'rejoint[{','.join(filter(extras.__contains__, EXTRAS))}]'"
    )
