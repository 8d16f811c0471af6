"""Extras of `pyproject.toml`: their modules, and how to install them."""

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
    "fleet": ("ray",),
    "live": ("viser", "trimesh", "jinja2"),
}
"""Imported modules per extra"""


_NAMED = 3  # missing modules that a line names (chosen: it stays one line)


def installed(module: str) -> bool:
    """Whether a module can be imported, without doing so."""
    return find_spec(module) is not None


def require(what: str, *needs: str) -> None:
    """Raise MissingExtraError unless all ``needs``, extras or modules, are installed for ``what``."""
    modules = [module for need in needs for module in EXTRAS.get(need, (need,))]
    missing = [module for module in modules if not installed(module)]
    if missing:
        raise MissingExtraError(_line(what, missing))


def explain(error: ImportError) -> str | None:
    """Name the extra of a missing module, or None."""
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
