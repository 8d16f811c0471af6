"""Arms by name or from a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from rejoint.arms.arm import Arm
from rejoint.arms.chain import cut
from rejoint.arms.draft import Loaded, finish
from rejoint.arms.modelfile import read_tree
from rejoint.arms.modeltext import xacro_error
from rejoint.arms.mycobot280 import mycobot280
from rejoint.arms.so101 import so101
from rejoint.arms.tomlfile import read_draft
from rejoint.system.errors import InputError

CATALOGUE: dict[str, Callable[[], Arm]] = {"mycobot280": mycobot280, "so101": so101}

SUFFIXES = (".toml", ".urdf", ".xml", ".mjcf")


def load_arm(
    source: str | Path, *, base: str | None = None, tip: str | None = None, hold: Mapping[str, float] | None = None
) -> Arm:
    """Load an arm: by its name, or from its TOML, URDF or MJCF file.

    Parameters
    ----------
    source
        ``mycobot280``, ``so101``, or a path that ends in ``.toml``, ``.urdf``, ``.xml`` or ``.mjcf``
    base
        body of a URDF or MJCF file at which the arm begins; by default its root
    tip
        body or site of such a file at which the arm ends; by default the end of its only chain
    hold
        joints of such a file that are not driven and stay where they are, with their positions [rad], of slides [m];
        slides between base and tip are held in any case, at zero where nothing is said

    Returns
    -------
    Arm
        geometry, limits and masses; what the file leaves out is estimated, and `read_arm` names it

    Raises
    ------
    InputError, FileError
        for an unknown name, or a file or chain that cannot be used, with the reason

    Examples
    --------
    >>> arm = rejoint.load_arm("ur5e.urdf", base="base_link", tip="tool0")
    >>> rejoint.repair("emulated:worn", arm=arm)
    """
    return read_arm(source, base=base, tip=tip, hold=hold).arm


def read_arm(
    source: str | Path, *, base: str | None = None, tip: str | None = None, hold: Mapping[str, float] | None = None
) -> Loaded:
    r"""Load an arm as `load_arm` does, and tell what had to be assumed.

    Parameters
    ----------
    source
        as for `load_arm`; names of the catalogue are taken in any case
    base, tip, hold
        as for `load_arm`

    Returns
    -------
    Loaded
        ``arm``, and ``notes``: a sentence for each value that the file does not give, or gives wrongly

    Raises
    ------
    InputError, FileError
        as `load_arm`

    Examples
    --------
    >>> loaded = rejoint.read_arm("ur5e.urdf")
    >>> print(*loaded.notes, sep="\n")
    """
    path, source = Path(source), str(source)
    is_file = path.suffix.lower() in SUFFIXES
    if (base or tip or hold) and (not is_file or path.suffix.lower() == ".toml"):
        raise InputError(f"base, tip and hold choose a chain of a URDF or MJCF file; {source} is one already")
    if source.lower() in CATALOGUE:
        return Loaded(arm=CATALOGUE[source.lower()]())
    if path.suffix.lower() == ".xacro":
        raise xacro_error(path)
    if not is_file:
        raise InputError(
            f"no arm is called {source!r}; known arms: {', '.join(sorted(CATALOGUE))}, "
            f"or give a file that ends in {', '.join(SUFFIXES)}"
        )
    return finish(read_draft(path) if path.suffix.lower() == ".toml" else cut(read_tree(path, hold), base, tip))
