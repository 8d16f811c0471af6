"""Commands that open a page: the studio, and a demonstration."""

from __future__ import annotations

import secrets
import webbrowser
from pathlib import Path

from rejoint.cli.console import HERE, is_loopback
from rejoint.cli.options import Call, takes
from rejoint.robots import place_of
from rejoint.runs.run import RUNS
from rejoint.session.inputs import FIRST_ROBOT
from rejoint.system.extras import require
from rejoint.system.shell import host_and_port


@takes()
def studio(call: Call, listen: str = HERE, folder: Path = RUNS, quiet: bool = False) -> object:
    """Open the page that guides through a repair."""
    require("rejoint studio", "live")
    from rejoint.studio import jobs
    from rejoint.studio.machine import Studio
    from rejoint.studio.page import StudioView

    host, port = host_and_port("--listen", listen)
    machine = Studio(folder)
    token = "" if is_loopback(host) else secrets.token_urlsafe(16)
    with StudioView(machine, host, port, token) as view:
        call.result(f"Studio: {view.address}  (Ctrl-C ends it; the arm then holds)")
        machine.do("Looking for arms", jobs.look)
        if not quiet:
            webbrowser.open(view.address)
        try:
            machine.left.wait()
        finally:
            machine.leave()
    return {"address": view.address}


@takes()
def demo(call: Call, listen: str = HERE, rounds: int = 10, quiet: bool = False) -> object:
    """Show a worn arm that misses its targets, and the same arm with a policy."""
    require("rejoint demo", "live", *place_of(FIRST_ROBOT).family.needs)
    from rejoint.pages.live.view import LiveView
    from rejoint.studio.demo import demonstrate

    with LiveView(*host_and_port("--listen", listen)) as view:
        call.result(f"Demonstration: {view.address}  (Ctrl-C ends it)")
        if not quiet:
            webbrowser.open(view.address)
        demonstrate(view, call.result, rounds)
    return {"address": view.address}
