"""The page of the studio: the scene of the live view, a stop button, and the panel of the step.

Each panel shows the status, and offers what one can do next.
"""

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import partial
from http import HTTPStatus
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import viser
import websockets.asyncio.server as sockets
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rejoint.arms import CATALOGUE, Array, load_arm
from rejoint.control.comparison.result import Protocol
from rejoint.control.recording import Observers
from rejoint.pages.html import macros
from rejoint.pages.live.page import SLOWER, TARGET, WebPage
from rejoint.pages.live.view import Doing, LiveView, Shown
from rejoint.robots import DEFAULT_ARM
from rejoint.runs.exports import KINDS
from rejoint.studio import jobs
from rejoint.studio.machine import Status, Studio
from rejoint.system.errors import InputError
from rejoint.system.shell import is_loopback

PING = 2.0
"""[s] between signs of life of a browser; one that stays silent for twice that is gone (chosen)"""
AWAY = 4.0
"""[s] without a page before the arm holds, if the owner wants that (chosen: a reload takes less)"""
HOLDS = "stops and holds"


def _text(status: HTTPStatus, text: str, kind: str = "plain") -> Response:
    return Response(status, status.phrase, Headers({"Content-Type": f"text/{kind}; charset=utf-8"}), text.encode())


TITLES = {
    "find": "1  Find the arm",
    "check": "2  Check it",
    "diagnose": "3  What is wrong?",
    "repair": "4  Repair",
    "calibrate": "5  Calibrate the tool",
    "prove": "6  Before and after",
    "use": "7  Use it",
}


class StudioPage(WebPage):
    """Shows a studio to any number of browsers."""

    label, stop_label = "rejoint studio", "STOP"

    def __init__(self, studio: Studio, host: str, port: int, token: str) -> None:
        """Serve it; InputError if the port is taken."""
        self.studio = studio
        self.form: dict[str, Any] = {}
        """what was typed and chosen"""
        self._token, self._guarded = token, False
        self._drawn: tuple[object, ...] = ()
        self._busy = False  # when it was drawn: a job may be over before the next look
        self._alone: float | None = np.inf  # [s] when the last page was closed; infinite: before the first
        self._marked: object = None
        self._words = macros("studio.html")
        super().__init__(host, port)
        if token:
            self.address += f"/?token={token}"

    def serve(self, host: str, port: int) -> viser.ViserServer:
        """Ask `admit` in the server of WebSockets that begins inside; viser has no option for that."""
        serve = sockets.serve

        def guarded(*given: Any, process_request: Callable[..., Any], **words: Any) -> Any:  # noqa: ANN401
            def ask(connection: Any, request: Request) -> Any:  # noqa: ANN401
                return self.admit(request) or process_request(connection, request)

            self._guarded = True
            return serve(*given, process_request=ask, ping_interval=PING, ping_timeout=2.0 * PING, **words)

        sockets.serve = guarded  # type: ignore[assignment, misc]
        try:
            server = super().serve(host, port)
        finally:
            sockets.serve = serve  # type: ignore[misc]
        if not self._guarded:
            raise InputError("this version of viser listens in another way; install the one that rejoint names")
        return server

    def admit(self, request: Request) -> Response | None:
        """Refuse a request, or answer it; None where it may go on to the page.

        Pages of other sites may not, and from other computers only with the token.
        """
        head, path = request.headers, urlsplit(request.path)
        host, origin = head.get("Host", ""), head.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _text(HTTPStatus.FORBIDDEN, "This page is used from its own address alone.")
        if self._token:
            given = parse_qs(path.query).get("token", [""])[0]
            if secrets.compare_digest(given.encode(), self._token.encode()):
                cookie = f"rejoint={self._token}; HttpOnly; SameSite=Strict; Path=/"
                return Response(HTTPStatus.FOUND, "Found", Headers({"Location": "/", "Set-Cookie": cookie}))
            crumb = SimpleCookie(head.get("Cookie", "")).get("rejoint")
            if crumb is None or not secrets.compare_digest(crumb.value.encode(), self._token.encode()):
                return _text(HTTPStatus.FORBIDDEN, "Open the address with the token that rejoint studio has printed.")
        elif not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return _text(HTTPStatus.FORBIDDEN, "This page is for this computer alone.")
        if path.path == "/report":
            run = self.studio.run
            if run is None or not run.page.exists():
                return _text(HTTPStatus.NOT_FOUND, "There is no report yet.")
            return _text(HTTPStatus.OK, run.page.read_text(encoding="utf-8"), "html")
        return None

    def furnish(self) -> None:
        """Put the parts that never change into the panel, in the order of what matters."""
        gui = self.server.gui
        gui.add_html(str(self._words.style()))
        self.add_stop()
        self._step = gui.add_dropdown("Step", list(TITLES.values()))
        self._step.on_update(lambda event: self._go(event.client is not None))
        self._panel_of_step = gui.add_folder("Find the arm")
        with gui.add_folder("The arm now", expand_by_default=False):
            self.add_state()
        with gui.add_folder("When the browser is closed", expand_by_default=False):
            self._closed = gui.add_dropdown("The arm", [HOLDS, "goes on"])
        self.build(load_arm(DEFAULT_ARM), Protocol.threshold)
        self.server.scene.on_click()(lambda event: self._clicked(event.ray_origin, event.ray_direction))

    def stop(self) -> None:
        """Stop the job."""
        self.studio.stop()

    # --- parts of a panel ---------------------------------------------------------------------------

    def button(self, label: str, act: Callable[[], object], *, first: bool = False, anyway: bool = False) -> None:
        """Add a button that does ``act``; during a job it is off, unless ``anyway``."""
        off = self._busy and not anyway
        made = self.server.gui.add_button(label, color="teal" if first else "gray", disabled=off)
        made.on_click(lambda _: self._act(act))

    def _act(self, act: Callable[[], object]) -> None:
        act()
        self._drawn = ()

    def job(self, label: str, job: Callable[..., object], *keys: str, first: bool = False) -> None:
        """Add a button that begins a job of the same name, with what is typed and chosen under ``keys``."""

        def work(studio: Studio) -> None:
            job(studio, *(copy(self.form[key]) for key in keys))

        self.button(label, lambda: self.studio.do(label, work), first=first)

    def go(self, studio: Studio) -> None:
        """Go to the typed point: a job."""
        jobs.go_to(studio, point(self.form), 1e-3 * self.form["within"])

    def field(self, label: str, key: str, usual: str | float = "", step: float = 1.0) -> None:
        """Add a line to type into, a box to tick or a number, by the kind of its ``usual`` value."""
        value, gui = self.form.setdefault(key, usual), self.server.gui
        if isinstance(usual, bool):
            self._keep(key, gui.add_checkbox(label, value))
        elif isinstance(usual, str):
            self._keep(key, gui.add_text(label, value))
        else:
            self._keep(key, gui.add_number(label, float(value), step=step))

    def choice(self, label: str, key: str, options: Sequence[str]) -> None:
        """Add a list of options, the first by default."""
        value = self.form.get(key)
        self.form[key] = value = value if value in options else options[0]
        self._keep(key, self.server.gui.add_dropdown(label, list(options), initial_value=value))

    def _keep(self, key: str, made: Any) -> None:  # noqa: ANN401
        made.on_update(lambda _: self.form.update({key: made.value}))

    def upload(self, label: str, job: Callable[[Studio, bytes], object]) -> None:
        """Add a button that takes a file and begins a job with its content."""
        made = self.server.gui.add_upload_button(label, mime_type=".csv", disabled=self._busy)
        made.on_upload(
            lambda _: self._act(lambda: self.studio.do(label, lambda studio: job(studio, made.value.content)))
        )

    def html(self, macro: str, *given: object) -> None:
        """Add text by a macro of the template."""
        self.server.gui.add_html(str(getattr(self._words, macro)(*given)))

    def question(self, status: Status) -> None:
        """Add what the job shows and asks: a button for each choice, or a line to type into."""
        if status.picture is not None:
            self.server.gui.add_image(status.picture.astype(np.uint8))
        if not status.question:
            return
        answer = partial(self.studio.answer, status.question)
        self.html("question", status.question)
        for choice in status.choices:
            self.button(choice.capitalize(), partial(answer, choice), anyway=True)
        if not status.choices:
            self.form["answer"] = ""
            self.field("Answer", "answer")
            self.button("Enter", lambda: answer(self.form["answer"]), first=True, anyway=True)

    # --- drawing ------------------------------------------------------------------------------------

    def show(self, shown: Shown) -> None:
        """Begin to draw a run."""
        super().show(shown)
        self._marked = None

    def rest(self) -> None:
        """Stop the arm if the page is gone for long, and its owner wants that."""
        super().rest()
        now = time.monotonic()
        if self._alone is None:
            self._alone = now
        elif now - self._alone > AWAY and self._closed.value == HOLDS and not self.studio.status.stopping:
            self._alone = np.inf
            self.studio.stop("the studio, as its page was closed")

    def draw(self, shown: Shown | None, doing: Doing) -> None:
        """Draw new cycles, and what has changed in the studio."""
        self._alone = None
        super().draw(shown, doing)
        if self._count % SLOWER == 0:
            self.render()

    write = WebPage.write_state  # `render` writes the rest

    def render(self) -> None:
        """Show the status."""
        status, studio = self.studio.status, self.studio
        self._head.content = str(self._words.now(status, jobs.left(studio), TITLES))
        self._bar.visible = status.busy
        self._bar.value = 100.0 * status.share  # type: ignore[misc]  # declared read-only, and is not
        self._stop.label = "Stopping ..." if status.stopping else self.stop_label
        title = TITLES[status.step]
        if self._step.value != title:
            self._step.value = title  # type: ignore[misc]  # declared read-only, and is not
        shape = (status.step, status.busy, status.question, status.address, status.found, status.picture is None)
        if shape != self._drawn:
            self._drawn = shape
            self._furnish_step(status)
        found = status.found.get("diagnosis")
        if self.shown is not None and self._marked is not found:
            self._marked = found
            self.limbs.mark(jobs.marks(self.shown.robot.arm, found))
        seen = studio.seen  # the job may forget it meanwhile
        if self.shown is not None and not self._recent and seen is not None:
            self.limbs.pose(seen.position[0])

    def _furnish_step(self, status: Status) -> None:
        self._busy = status.busy
        before = self._panel_of_step
        self._panel_of_step = self.server.gui.add_folder(TITLES[status.step], order=before.order)
        before.remove()
        with self._panel_of_step:
            self.question(status)
            if not status.question:
                PANELS[status.step](self, status)

    def _go(self, by_hand: bool) -> None:
        step = next(name for name, title in TITLES.items() if title == self._step.value)
        if by_hand and step != self.studio.status.step:
            self.studio.change(step=step, done="", lines=())

    def _clicked(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Take a click onto the plane at the chosen height as a point."""
        height, (start, way) = 1e-3 * float(self.form.get("z", 100.0)), np.array([origin, direction])
        if self.studio.status.step not in ("prove", "use") or way[2] >= 0.0:
            return
        place = start + (height - start[2]) / way[2] * way
        self.form |= {"x": round(1e3 * place[0]), "y": round(1e3 * place[1])}
        self.server.scene.add_icosphere("/clicked", 0.006, TARGET, position=place)
        self._drawn = ()
        if self.form.get("at once"):
            self.studio.do("Go", self.go)


def studio_view(studio: Studio, host: str, port: int, token: str = "") -> LiveView:
    """Return the view of a ``studio``; with a ``token`` other computers may use the page."""
    view = LiveView(host, port, partial(StudioPage, studio, token=token))
    studio.observer = Observers(studio, view)
    return view


QUICK = "A quick try takes little of everything, and gives no result to rely on."


def find(page: StudioPage, status: Status) -> None:
    """Choose an arm, or type its address."""
    known: dict[str, str] = status.found.get("arms") or {}
    page.html("hint", "Connect the arm and switch it on. Or try everything with an emulated one.")
    if known:
        page.choice("Arm", "arm", list(known))
    page.field("or its address", "address")
    page.choice("Kind", "kind", ["as its address says", *CATALOGUE])

    def connect(studio: Studio) -> None:
        typed, listed = page.form["address"].strip(), known.get(page.form.get("arm", ""), "")
        jobs.choose(studio, typed or listed, page.form["kind"] if page.form["kind"] in CATALOGUE else None)
        page.form.pop("load", None)

    page.job("Connect", connect, first=True)
    page.job("Look for arms again", jobs.look)


def check(page: StudioPage, status: Status) -> None:
    """Look at servos and surroundings, and confirm a small motion."""
    page.html("checks", status.found.get("checks") or ())
    page.html("surroundings")
    page.job("The table is clear: move one joint", jobs.nudge, first=True)
    page.job("Look again", jobs.see)


def diagnose(page: StudioPage, status: Status) -> None:
    """Find out what is wrong."""
    found = status.found.get("diagnosis")
    page.html("hint", f"The arm goes to ten targets and turns each joint. {QUICK}")
    page.field("Quick try", "quick", False)
    page.job("Diagnose", jobs.diagnose, "quick", first=found is None)
    if found is not None:
        page.html("diagnosis", found)
        page.button("Next: repair", lambda: page.studio.change(step="repair"), first=True)


def repair(page: StudioPage, status: Status) -> None:
    """Repair the arm."""
    done = status.found.get("repaired")
    page.html(
        "hint", f"It fits a simulation of this arm, trains a policy, and compares all controllers on the arm. {QUICK}"
    )
    page.field("Quick try", "quick", False)
    page.job("Repair", jobs.repair, "quick", first=done is None)
    if done is not None:
        page.html("repaired", done, status.found.get("advice"))
        page.button("Next: before and after", lambda: page.studio.change(step="prove"), first=True)
        page.job("Begin a new repair", jobs.again)


def calibrate(page: StudioPage, status: Status) -> None:
    """Measure where the tool really is."""
    page.html("hint", "Encoders do not see everything. A few measured points show where the tool really is.")
    page.choice("Measure with", "gauge", jobs.gauges(status.address))
    page.field("Postures", "count", 10)
    page.field("Board", "board", "board.toml")
    page.field("Camera", "camera", 0)
    page.job("Calibrate", jobs.calibrate, "gauge", "count", "board", "camera", first=True)


def prove(page: StudioPage, status: Status) -> None:
    """Compare before and after on points of the owner."""
    page.html("hint", "Your own points, in mm from the middle of the base. A click on the table fills in x and y.")
    places(page, status)
    points = page.form.setdefault("points", [])
    page.html("points", points)
    page.button("Add the point", lambda: points.append(point(page.form)))
    page.button("Remove all points", points.clear)
    page.job("Compare before and after", jobs.prove, "points", first=True)
    if status.found.get("proof"):
        page.html("proof", status.found["proof"])
        page.button("Next: use it", lambda: page.studio.change(step="use"), first=True)


def places(page: StudioPage, status: Status) -> None:
    """Type a point."""
    targets = (status.arm or load_arm(DEFAULT_ARM)).targets
    for name, usual in zip("xyz", 1e3 * targets.middle, strict=True):
        page.field(f"{name} mm", name, round(usual))


def use(page: StudioPage, status: Status) -> None:
    """Drive the arm, let others drive it, and look after it."""
    page.html("hint", "Type a point, or click on the table: the height is that of z.")
    places(page, status)
    page.field("Accept mm", "within", 2.0, step=0.1)
    page.field("Click to go", "at once", False)
    page.job("Go", page.go, first=True)
    path = page.form.setdefault("path", [])
    page.html("points", path)
    page.button("Record the point", lambda: path.append(point(page.form)))
    page.job("Record where the tool is", lambda studio: path.append(studio.session().state.tool_m))
    page.button("Forget the path", path.clear)
    page.field("Times", "times", 1.0)
    page.job("Play the path", jobs.play, "path", "times")
    page.upload("Play a path file (CSV)", jobs.play_file)
    page.field("Load g", "load", 0.0)
    page.job("The hand carries this load", jobs.carry, "load")
    page.field("For programs", "listen", "127.0.0.1:9001")
    page.job("Let programs drive it", jobs.serve, "listen")
    page.choice("Export", "export", KINDS)
    page.field("LeRobot file", "lerobot")
    page.job("Write the file", jobs.export, "export", "lerobot")
    page.job("Check again", jobs.check_again)
    page.job("History of all arms", jobs.history)
    page.html("history", status.found.get("history") or ())


PANELS = dict(zip(TITLES, (find, check, diagnose, repair, calibrate, prove, use), strict=True))


def point(form: Mapping[str, Any]) -> Array:
    """Return the typed point (3,) [m]."""
    return np.array([1e-3 * float(form[name]) for name in "xyz"])
