"""Commands that serve: the emulated arm on the vendor's wire protocol."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rejoint.arms import load_arm
from rejoint.cli.console import Terminal
from rejoint.cli.options import Json, Seed
from rejoint.extras import require
from rejoint.robots import SIMULATOR


def emulate(
    wear: Annotated[str, typer.Option(help="Wear profile: a name, `worn?seed=N`, or a .toml file.")] = "worn",
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0 takes a free one.", min=0, max=65535)] = 9000,
    pty: Annotated[bool, typer.Option("--pty", help="Serve a serial line (pseudo terminal) instead of TCP.")] = False,
    log: Annotated[Path | None, typer.Option(help="Write the true tool position here, as CSV.")] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Serve a worn arm in real time on the myCobot's own wire protocol, until Ctrl-C.

    Example: `rejoint emulate --wear worn --port 9000`, then in another terminal
    `rejoint repair tcp://127.0.0.1:9000`.
    """
    require("rejoint emulate", SIMULATOR)
    from rejoint.emulator.emulate import emulate as serve

    terminal = Terminal(json=json)
    served: list[str] = []

    def announce(address: str) -> None:
        served.append(address)
        terminal.say(f"A myCobot 280 with the wear profile '{wear}' answers at {address}  (Ctrl-C ends it)")

    serve(load_arm("mycobot280"), wear, host=host, port=port, pty=pty, seed=seed, announce=announce, log=log)
    terminal.say("Emulator ended.")
    terminal.finish({"wear": wear, "address": served[-1]})
