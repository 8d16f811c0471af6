"""The command line: one command per stage, and `repair` for the whole chain.

Exit codes: 0 done; 1 a bug; 2 unusable input; 3 the guard stopped the motion; 4
the robot failed; 5 targets not reached, or the path not followed; 6 the arm drifts; 7 alarm, or the tolerance is
reached; 128 and the number of the signal (130 Ctrl-C, 143 SIGTERM). Results go to standard output, everything else to
standard error.
"""

import io
import logging
import os
import re
import signal
import sys
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from rejoint.cli.console import Terminal, into_nothing, with_place
from rejoint.system.errors import RejointError
from rejoint.system.extras import require_compiler
from rejoint.system.shell import __version__
from rejoint.system.stopping import Interrupted, close, install, interruption

HELP = {"help_option_names": ["-h", "--help"]}


@cache
def texts(package: str) -> dict[str, Any]:
    """Return the commands of a package, and help, flags and limits of all their options and arguments."""
    return tomllib.loads((files(package) / "options.toml").read_text(encoding="utf-8"))


class _Helped:
    """Shows that flags take no value."""

    def get_params(self, ctx: Any) -> Any:  # noqa: ANN401 - the framework's own kind
        """Return options and arguments."""
        found = super().get_params(ctx)  # type: ignore[misc]
        for one in found:
            if getattr(one, "is_flag", False):
                one.metavar = ""
        return found


class _Command(_Helped, TyperCommand):
    """A single command."""


class LazyCommand(TyperCommand):
    """A command, or a group of commands, by its line in the list; its module is loaded when it is wanted."""

    def __init__(self, name: str, entry: Mapping[str, Any]) -> None:
        """Take its ``entry`` in `texts`."""
        super().__init__(name, help=entry["help"], rich_help_panel=entry["panel"])
        self._entry = entry

    def loaded(self) -> Any:  # noqa: ANN401 - the framework's own kind
        """Return the function or the group of this name in the module."""
        name, module = str(self.name), import_module(self._entry["module"])
        function = getattr(module, name, None) or getattr(module, f"{name}_")
        if isinstance(function, typer.Typer):
            return typer.main.get_command(function)
        alone = typer.Typer(add_completion=False, rich_markup_mode="markdown")
        about = texts(str(module.__package__))[name]["about"]
        alone.command(name, cls=_Command, help=about, context_settings=HELP | self._entry.get("settings", {}))(function)
        return typer.main.get_command(alone)

    def make_context(self, *given: Any, **words: Any) -> Any:  # noqa: ANN401
        """Make the context of the command itself."""
        return self.loaded().make_context(*given, **words)


class CommandGroup(_Helped, TyperGroup):
    """The commands of a ``table``, in its order."""

    table: Mapping[str, Any] = texts(__name__)["commands"]

    def __init__(self, **words: Any) -> None:  # noqa: ANN401
        super().__init__(**words)
        self.commands = {name: LazyCommand(name, entry) for name, entry in self.table.items()}


def command_group(kind: type[CommandGroup], name: str, text: str, *, completion: bool = False) -> typer.Typer:
    """Return a group of commands with help ``text``, perhaps with options that install a shell's ``completion``."""
    group = typer.Typer(
        name=name,
        cls=kind,
        help=text,
        no_args_is_help=True,
        add_completion=completion,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings=HELP,
    )
    group.callback(help=text)(lambda: None)
    return group


app = command_group(
    CommandGroup,
    "rejoint",
    "Give a worn robot arm its accuracy back: diagnose it, fit a digital twin, train a policy, prove the gain.",
    completion=True,
)


VERBOSE = ("-v", "--verbose")
"""Words that are taken anywhere on a command line"""


def _version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"rejoint {__version__}\n")
        raise typer.Exit


@app.callback(help=app.info.help)
def _whole(
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_version, is_eager=True, help="Show the version and exit."),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(*VERBOSE, help="Say more: what the libraries log, and where an error comes from."),
    ] = False,
) -> None: ...


def main() -> None:
    """Run the command line; every expected failure is one clear line and an exit code that means something."""
    json = "--json" in sys.argv
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal of another alphabet
    install()
    try:
        words = [word for word in sys.argv[1:] if word not in VERBOSE]
        if len(words) + 1 < len(sys.argv):
            logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
        if words[:1] != ["doctor"]:  # which says it itself
            require_compiler()
        alone = ["studio"] if sys.stdin and sys.stdin.isatty() and sys.stdout.isatty() else []
        result = app(args=with_place(with_home(words)) or alone, standalone_mode=False)
        code = result if isinstance(result, int) else 0
        if code == 128 + signal.SIGINT:  # so it ends every interruption, whichever signal it was
            code = _ended(interruption() or Interrupted(signal.SIGINT), json=json)
    except BrokenPipeError:
        into_nothing(sys.stdout)
        code = 0  # the reader of our output has seen enough
    except (Exception, Interrupted) as error:  # noqa: BLE001 - a bug, wherever it is, ends in one line
        code = _ended(error, json=json)
    sys.exit(code)


def _misused(error: BaseException) -> str:
    told = getattr(error, "format_message", error.__str__)()  # names the option, which str() does not
    told = told.replace("Value error, ", "").replace("Input should be", "expected")  # of the library behind typer
    if option := re.match(r"Invalid value for '(--[\w-]+)': expected", told):
        given = re.search(rf"\0{option[1]}[\0=]([^\0]*)", "\0" + "\0".join(sys.argv[1:]))
        told += f", found {given[1]!r}" if given else ""
    context = getattr(error, "ctx", None)
    told = told.rstrip(".") or "no command given"
    return told + f"{' See' if told.endswith('?') else '; see'} {context.command_path if context else 'rejoint'} --help"


def with_home(words: Sequence[str]) -> list[str]:
    """Replace ``~`` where the shell left it: quoted, or right after an option, as in ``--run=~/mine``."""
    home = os.path.expanduser("~")  # noqa: PTH111 - that of Path fails where there is no home folder
    return [re.sub(r"^(--[a-z-]+=)?~(?=/|$)", lambda at: f"{at[1] or ''}{home}", word) for word in words]


RESUMED = ("repair", "compare", "fleet")
"""Commands that go on where they were interrupted"""


def _ended(error: BaseException, *, json: bool) -> int:
    """Say in a line, and the notes of an error, how a command ended early; return its exit code."""
    if not isinstance(error, Interrupted | RejointError | typer.TyperException | OSError | MemoryError):
        error = interruption() or error  # compiled code may have swallowed it, and failed for want of what it asked for
    if isinstance(error, Interrupted):
        close()  # a signal that was swallowed is sent again, at a time of its own
    from rejoint.runs.failure import failure_of

    misused, terminal = isinstance(error, typer.TyperException), Terminal(json=json)
    text, kind, code = (_misused(error), "UsageError", 2) if misused else failure_of(error)
    if isinstance(error, Interrupted) and sys.argv[1:2] and sys.argv[1] in RESUMED:
        text += f"; what is finished is kept: the same `rejoint {sys.argv[1]}` goes on from there"
    if not {*VERBOSE}.isdisjoint(sys.argv):
        terminal.message("".join(traceback.format_exception(error)).rstrip())
    terminal.message(f"error: {text}")
    try:
        terminal.finish({"error": kind, "message": text, "exit_code": code})
    except OSError:  # its disk is full: what is left in its buffer has nowhere to go either
        into_nothing(sys.stdout)
    for note in getattr(error, "__notes__", ()):
        terminal.message(note)
    return code
