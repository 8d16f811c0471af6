"""The one list of robot families: ours, and those that other packages bring by an entry point.

A package brings one with ``[project.entry-points."rejoint.robots"]`` and ``SCHEME = "MODULE:FAMILY"``. Entry points are
looked at where a scheme is none of ours, or where all forms are listed: what nobody asked for is not imported.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from traceback import walk_tb
from typing import Any

from rejoint.robots import own
from rejoint.robots.family import Family, Place
from rejoint.system.errors import AddressError, first_line

GROUP = "rejoint.robots"
"""Entry points that name a `Family`"""

_OWN: dict[str, Family[Any]] = {family.scheme: family for family in own.FAMILIES}


def place_of(text: str) -> Place[Any]:
    """Read a robot's address; AddressError with its form, or with those of all families for what none of them reads."""
    scheme, colon, _ = text.partition(":")
    family = _family(scheme) if colon else None
    if family is None:
        raise AddressError(f"unknown robot address {text!r}; expected {forms()}")
    try:
        return Place(text=text, family=family, detail=family.parse(text))
    except ValueError as error:
        expected = "" if family.form in str(error) else f"; expected {family.form}"
        raise AddressError(f"robot address {text!r}: {error}{expected}") from error


def forms() -> str:
    """List the forms of address of all families, then the packages whose families cannot be used, each with why."""
    found, refused = list(_OWN.values()), []
    for point in entry_points(group=GROUP):
        try:
            found.append(_load(point))
        except AddressError as error:
            refused.append(f"; {error}")
    return ", ".join(family.form for family in found) + "".join(refused)


def driver_of(error: BaseException) -> str | None:
    """Name the package of another's driver that an error passed through; None where there was none."""
    drivers = {point.module.partition(".")[0]: point for point in entry_points(group=GROUP)}
    for frame, _ in walk_tb(error.__traceback__):
        point = drivers.get(str(frame.f_globals.get("__name__")).partition(".")[0])
        if point is not None:
            return f"{_package(point)} (driver of {point.name}:)"
    return None


def _family(scheme: str) -> Family[Any] | None:
    if scheme in _OWN:
        return _OWN[scheme]
    points = tuple(entry_points(group=GROUP, name=scheme))
    return _load(points[0]) if points else None


def _load(point: EntryPoint) -> Family[Any]:
    """Import a family; AddressError that names its package where it cannot be used or its scheme is taken."""
    who = f"{_package(point)} (entry point {point.name} = {point.value})"
    if point.name in _OWN:
        raise AddressError(f"{who} is refused: {point.name}: is one of rejoint's own schemes; it needs another")
    others = [_package(other) for other in entry_points(group=GROUP, name=point.name) if other != point]
    if others:
        raise AddressError(f"{who} is refused: {', '.join(others)} brings {point.name}: as well; remove one of them")
    try:
        family = point.load()
    except Exception as error:  # whatever another package does wrong is named as its own
        why = f"{type(error).__name__}: {first_line(error)}"
        raise AddressError(f"{who} cannot be imported ({why}); update or remove it") from error
    if not isinstance(family, Family) or family.scheme != point.name:
        found = f"the family of {family.scheme}:" if isinstance(family, Family) else f"a {type(family).__name__}"
        raise AddressError(f"{who} is refused: expected a Family of the scheme {point.name}, found {found}")
    return family


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name} {point.dist.version}" if point.dist else "a package"
