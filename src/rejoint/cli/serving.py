"""Commands that serve arms on the vendor's wire protocol: an emulated one, and a real one with a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import rejoint
from rejoint.arms import load_arm
from rejoint.cli import options as opt
from rejoint.cli.console import Terminal
from rejoint.cli.live import live_view
from rejoint.cli.options import Json, Seed
from rejoint.robots import SIMULATOR
from rejoint.system.errors import InputError
from rejoint.system.extras import require

SERVED = {"mycobot280": ("A myCobot 280", "worn"), "so101": ("An SO-101", "so101")}
"""How the arms that can be served are called, and their usual wear profile"""


def emulate(
    arm: Annotated[
        str, typer.Option(help="mycobot280, on its vendor's protocol, or so101, on its servos' own bus.")
    ] = ("mycobot280"),
    wear: Annotated[
        str | None,
        typer.Option(
            help="Wear profile: healthy, worn, `play-in-loop`, so101, `worn?seed=N`, or a .toml file; by default worn, "
            "of an SO-101 so101."
        ),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0 takes a free one.", min=0, max=65535)] = 9000,
    pty: Annotated[bool, typer.Option("--pty", help="Serve a serial line (pseudo terminal) instead of TCP.")] = False,
    log: Annotated[Path | None, typer.Option(help="Write the true tool position here, as CSV.")] = None,
    fault: Annotated[str, typer.Option(help="What goes wrong, comma separated; see above.")] = "",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Serve a worn arm in real time on its own wire protocol, until Ctrl-C.

    Example: `rejoint emulate --wear worn --port 9000`, then in another terminal
    `rejoint repair tcp://127.0.0.1:9000`; or `rejoint emulate --arm so101` and `rejoint repair feetech://127.0.0.1:9000`.

    `--fault drop=0.05,stall=1.5/4,freeze=3@5,die@20` loses 5 % of the answers, lets the link stand still for 1.5 s
    every 4 s, freezes the encoder of joint 3 after 5 s and ends without a word after 20 s, counted from the first
    byte of a client. Shares of answers: drop=P, garbage=P, stale=P, split=P, half=P, double=P, echo=P. The link:
    slow=S, stall=D/E, gone=T/D (closed at T, back after D), silent@T, die@T. Joints, from 1: freeze=J@T (the encoder),
    blind=J@T (its servo too), jump=J@T, limit=J@T, overheat=J@T, current=J@T, overload=J@T, voltage@T.
    On the bus of an SO-101 alone: mute=J@T/D (a servo that is silent for D), sag=R (a supply of R ohm).
    """
    require("rejoint emulate", SIMULATOR)
    from rejoint.robots.lab.emulator.emulate import emulate as emulate_mycobot
    from rejoint.robots.lab.emulator.faults import parse_faults
    from rejoint.robots.lab.emulator.feetech.emulate import emulate_bus
    from rejoint.robots.lab.emulator.servers import beyond_loopback

    terminal = Terminal(json=json)
    served: list[str] = []
    chosen = load_arm(arm)
    if chosen.name not in SERVED:
        raise InputError(f"no wire protocol is known for {chosen.name}; expected --arm {' or '.join(SERVED)}")
    name, profile = SERVED[chosen.name]
    wear = wear or profile
    faults = parse_faults(fault, chosen.joints)
    serve = emulate_bus if chosen.name == "so101" else emulate_mycobot

    def announce(address: str) -> None:
        served.append(address)
        terminal.say(f"{name} with the wear profile '{wear}' answers at {address}  (Ctrl-C ends it)")
        if beyond_loopback(address):
            terminal.say(f"Other machines can drive it too, without a password: it listens on {host}.")
        if fault:
            terminal.say(f"Faults: {fault}")

    serve(chosen, wear, host=host, port=port, pty=pty, seed=seed, announce=announce, log=log, faults=faults)
    terminal.say("Emulator ended.")
    terminal.finish({"wear": wear, "address": served[-1], "faults": fault})


def serve(
    robot: opt.Robot,
    run: opt.Run,
    listen: Annotated[str, typer.Option(help="HOST:PORT; 0.0.0.0:9000 lets other machines in.")] = "127.0.0.1:9000",
    pty: Annotated[bool, typer.Option("--pty", help="Serve a serial line (pseudo terminal) instead of TCP.")] = False,
    stdio: Annotated[
        bool,
        typer.Option("--stdio", help="Follow joint goals from standard input, a line of JSON each, as from LeRobot."),
    ] = False,
    calibration: opt.Calibration = None,
    payload: opt.Payload = None,
    tool: opt.Tool = None,
    period: opt.Period = None,
    live: opt.Live = None,
    json: Json = False,
) -> None:
    """Let programs written for the vendor's client drive a worn arm as if it were a new one, until Ctrl-C.

    They speak to this address instead of the arm's; `send_angles`, `send_coords`, jog and all others mean what they
    always meant. One client at a time, every command guarded; the arm holds when the client goes.

    Example: `rejoint serve tcp://192.168.1.20:9000 runs/mine --listen 127.0.0.1:9001`
    """
    terminal = Terminal(json=json)
    if stdio:
        if pty or json or any(given is not None for given in (calibration, payload, tool, live)):
            raise InputError("--stdio goes with --period alone")
        from rejoint.cli.lines import serve_lines

        serve_lines(robot, run, period=opt.period_seconds(period), say=terminal.say)
        return

    def announce(address: str) -> None:
        terminal.say(f"The arm at {robot} is served at {address}  (Ctrl-C brings it to a hold and ends)")
        if address.startswith("tcp://") and not address.startswith("tcp://127."):
            terminal.say("Other machines can drive it too, without a password.")

    with live_view(terminal, live, "serve") as view:
        done = rejoint.serve(
            robot, run, listen=listen, pty=pty, payload=opt.payload_of(payload), tool=opt.tool_of(tool),
            calibration=calibration, period=opt.period_seconds(period), say=terminal.say, on_address=announce,
            live=view,
        )  # fmt: skip
    terminal.say(f"Serving ended after {done.orders} orders; they are in {done.log}")
    terminal.finish(done)
