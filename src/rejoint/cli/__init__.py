"""The command line: one command per stage, and `repair` for the whole chain.

Exit codes: 0 done; 2 input that cannot be used; 3 the guard stopped the motion; 4 the robot failed; 5 done, but not
all targets were reached; 128 and the number of the signal, such as 130 for Ctrl-C and 143 for SIGTERM, interrupted.
Results go to standard output, everything else to standard error.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable

import msgspec
import typer
from rich.console import Console

from rejoint.cli import chain, evaluation, foreign, measuring, offline, reproducing, serving, stages
from rejoint.system.errors import RejointError
from rejoint.system.extras import explain
from rejoint.system.stopping import Interrupted, install, interruption

app = typer.Typer(
    name="rejoint",
    help="Give a worn robot arm its accuracy back: diagnose it, fit a digital twin, train a policy, prove the gain.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
COMMANDS: tuple[Callable[..., None], ...] = (
    chain.repair, stages.diagnose, stages.identify, stages.train, stages.compare, stages.deploy, stages.report,
    offline.replay, foreign.import_, foreign.export, serving.emulate, reproducing.reproduce, evaluation.evaluate,
    evaluation.tune, measuring.board,
)  # fmt: skip
for command in COMMANDS:
    app.command(command.__name__.rstrip("_"), context_settings={"help_option_names": ["-h", "--help"]})(command)


def main() -> None:
    """Run the command line; every expected failure is one clear line and an exit code that means something."""
    json = "--json" in sys.argv
    install()
    try:
        result = app(standalone_mode=False)  # makes an exit code of every interruption, whichever signal it was
        code = result if isinstance(result, int) else 0
        if code == 128 + signal.SIGINT:
            code = _interrupted(interruption() or Interrupted(signal.SIGINT), json=json)
    except Interrupted as error:  # before the framework had begun, or after its end
        code = _interrupted(error, json=json)
    except RejointError as error:
        code = _fail(str(error), type(error).__name__, error.exit_code, json=json)
        _say_notes(error)
    except ImportError as error:
        line = explain(error)
        if line is None:  # not of an extra: the installation or the program is broken, and where is worth telling
            raise
        code = _fail(line, "MissingExtraError", 2, json=json)
    except typer.TyperException as error:
        told = getattr(error, "format_message", error.__str__)()  # names the option, which str() does not
        code = _fail(told, "UsageError", 2, json=json)
    except BrokenPipeError:
        code = 0  # whoever read our output has seen enough
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        code = _fail(
            f"{where}{error.strerror or error}; check the path, its permissions and the space left",
            "OSError",
            2,
            json=json,
        )
    except Exception:
        asked = interruption()
        if asked is None:
            raise
        code = _interrupted(asked, json=json)  # compiled code swallowed it and failed for want of what it asked for
    sys.exit(code)


def _interrupted(error: Interrupted, *, json: bool) -> int:
    kept = "finished stages are kept: `rejoint repair`, `rejoint train` and `rejoint compare` go on from there"
    code = _fail(f"{error}; {kept}", "Interrupted", error.exit_code, json=json)
    _say_notes(error)
    return code


def _say_notes(error: BaseException) -> None:
    for note in getattr(error, "__notes__", ()):
        _say(note)


def _fail(message: str, kind: str, code: int, *, json: bool) -> int:
    _say(f"error: {message}")
    if json:
        sys.stdout.write(msgspec.json.encode({"error": kind, "message": message, "exit_code": code}).decode() + "\n")
    return code


def _say(text: str) -> None:
    Console(file=sys.stderr, highlight=False, soft_wrap=True).print(text, markup=False)
