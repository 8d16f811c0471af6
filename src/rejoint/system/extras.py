"""Extras of `pyproject.toml`: their modules, and how to install them."""

import json
import os
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from urllib.parse import urlsplit
from urllib.request import url2pathname

from rejoint.system.errors import InputError, MissingExtraError, first_line

EXTRAS: dict[str, tuple[str, ...]] = {
    "train": ("mujoco", "torch", "skrl", "onnx", "cmaes"),
    "report": ("matplotlib", "jinja2", "PIL"),
    "logs": ("mcap", "mcap_protobuf", "mcap_ros2", "rosbags"),
    "camera": ("cv2", "PIL"),
    "feetech": ("scservo_sdk",),
    "dynamixel": ("dynamixel_sdk",),
    "fleet": ("ray",),
    "live": ("viser", "trimesh", "jinja2", "websockets"),
}
"""Imported modules per extra"""


def installed(module: str) -> bool:
    """Whether a module can be imported, without doing so."""
    return find_spec(module) is not None


def require(what: str, *needs: str) -> None:
    """Raise MissingExtraError unless all ``needs``, extras or modules, are installed for ``what``."""
    missing = {module: _extra(need) for need in needs for module in EXTRAS.get(need, (need,)) if not installed(module)}
    if missing:
        raise MissingExtraError(_line(what, missing))


def explain(error: BaseException) -> str | None:
    """Name a missing module's extra, or what is wrong with Numba's cache, or None."""
    if not isinstance(error, ImportError):
        return _explain_cache(error)
    module = (error.name or "").partition(".")[0]
    known = any(module in modules for modules in EXTRAS.values())
    return _line("this", {module: _extra(module)}) if known and not installed(module) else None


def _extra(need: str) -> str:
    return need if need in EXTRAS else next(extra for extra, modules in EXTRAS.items() if need in modules)


def _line(what: str, missing: dict[str, str]) -> str:
    return (
        f"{what} needs more than the base installation (missing: {', '.join(missing)}); "
        f"add it with: {install_line(missing.values())}"
    )


def install_line(extras: Iterable[str]) -> str:
    """Return the command that installs ``extras``."""
    url = json.loads(distribution("rejoint").read_text("direct_url.json") or "{}").get("url", "")
    source = url2pathname(urlsplit(url).path) if url.startswith("file:") else f"rejoint @ {url}" if url else "rejoint"
    return f"pip install '{source}[{','.join(dict.fromkeys(extras))}]'"


_OFF, _PLACE = "NUMBA_DISABLE_JIT", "NUMBA_CACHE_DIR"
_NO_PLACE = "no locator available"  # so Numba says it, in a RuntimeError
_KEEPER = ("numba", "core", "caching.py")  # of Numba, which reads and writes what is kept


def require_compiler() -> None:
    """Raise InputError where compiling is off."""
    if os.environ.get(_OFF, "0").strip() not in ("", "0"):
        raise InputError(f"{_OFF} is set: uncompiled, no arm can be driven or simulated in time; unset it")


def compiles_first() -> bool:
    """Whether no compiled loops are kept yet, so that the first motion compiles them."""
    kept = os.environ.get(_PLACE) or Path(__file__).parent.parent
    return next(Path(kept).rglob("compiled.*.nbi"), None) is None  # of the control loop; plants have some more


def _explain_cache(error: BaseException) -> str | None:
    """Explain a failure of Numba's cache, or None; remove its index, which may be damaged."""
    if isinstance(error, RuntimeError) and _NO_PLACE in str(error):
        return f"no place for compiled loops can be written; set {_PLACE} to a folder that can"
    for one in filter(None, (error, error.__cause__, error.__context__)):
        for frame, _ in walk_tb(one.__traceback__):
            if Path(frame.f_code.co_filename).parts[-3:] == _KEEPER and "cache_path" in dir(frame.f_locals.get("self")):
                folder = Path(frame.f_locals["self"].cache_path)
                with suppress(OSError):
                    for index in folder.glob("*.nbi"):
                        index.unlink()
                return (
                    f"{folder}: compiled loops are damaged or cannot be kept there ({first_line(error)}); the same "
                    f"command compiles them again; if this comes again, free some space or set {_PLACE}"
                )
    return None
