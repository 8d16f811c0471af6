"""Pages from ``templates/``, and one look per controller in every figure and theme."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rejoint.control.servogains import RIVALS, inner_name
from rejoint.pages import words
from rejoint.system.files import read_shipped, write_text
from rejoint.system.shell import __version__

if TYPE_CHECKING:
    import jinja2

INK = "#1b1f24"
"""Text and axes"""


class Look(NamedTuple):
    """Look of a series."""

    colour: str
    """on light ground"""
    dark: str
    """on dark ground"""
    dash: str | tuple[float, tuple[float, ...]]
    controller: str = ""
    """whose it is"""


LOOKS = read_shipped(__file__, "looks.toml", dict[str, Look])
CONTROLLERS = {look.controller: look for look in LOOKS.values() if look.controller}


def look_of(controller: str) -> Look:
    """Look of a controller, under tuned servo gains with other dashes; unknown: brown."""
    look = CONTROLLERS.get(inner_name(controller), LOOKS["brown"])
    return look._replace(dash=(0, (9, 2, 1.5, 2))) if controller in RIVALS else look


def colour_number(controller: str) -> int:
    """Index in `LOOKS` of a controller's colours."""
    return [look.colour for look in LOOKS.values()].index(look_of(controller).colour)


def render(template: str, **values: object) -> str:
    """Fill a template; a missing value is an error."""
    return _environment().get_template(template).render(**values)


def templates(below: str) -> list[str]:
    """Names of all templates in a folder, such as ``export/ros2/``."""
    return _environment().list_templates(filter_func=lambda name: name.startswith(below))


def write_page(path: Path, template: str, **values: object) -> Path:
    """Fill a template and write the page, whole or not at all."""
    write_text(path, render(template, **values).rstrip() + "\n")
    return path


def macros(template: str) -> Any:  # noqa: ANN401 - what the template has
    """Macros of a template."""
    return _environment().get_template(template).module


@cache
def _environment() -> jinja2.Environment:
    import jinja2  # of the extra report; numbers and words need no pages

    found = jinja2.Environment(
        loader=jinja2.PackageLoader("rejoint.pages", "templates"),
        autoescape=jinja2.select_autoescape(("html", "svg")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    plain = ("cycles", "day_and_time", "ends", "grouped", "listed", "number", "parameter_name", "plural", "sentence")
    found.filters |= {name: getattr(words, name) for name in plain}
    found.filters |= {
        "cell": words.measured,
        "degrees": np.degrees,
        "mm": lambda one, digits=2, unit="mm": words.number(None if one is None else words.MM * one, digits, unit),
        "quoted": lambda names: words.listed([f"“{name}”" for name in names]),
    }
    found.globals |= {
        "looks": LOOKS.values(),
        "unknown": words.UNKNOWN,
        "never": words.NEVER,
        "interval": words.interval,
        "version": __version__,
    }
    found.globals["m"] = found.get_template("macros.html").module
    return found
