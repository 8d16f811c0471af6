"""The panels of the steps: each shows the status and offers what one can do next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import CATALOGUE, Array
from rejoint.runs.exports import KINDS
from rejoint.studio import jobs
from rejoint.studio.machine import Status, StepName, Studio

if TYPE_CHECKING:
    from rejoint.studio.page import StudioPage

TITLES: dict[StepName, str] = {
    "find": "1  Find the arm",
    "check": "2  Check it",
    "diagnose": "3  What is wrong?",
    "repair": "4  Repair",
    "calibrate": "5  Calibrate the tool",
    "prove": "6  Before and after",
    "use": "7  Use it",
}


QUICK = "A quick try takes little of everything, and gives no result to rely on."


def find(page: StudioPage, status: Status) -> None:
    """Choose an arm, or type its address."""
    known: dict[str, str] = status.found.get("arms") or {}
    page.html("hint", "Connect the arm and switch it on. Or try everything with an emulated one.")
    if known:
        page.choice("Arm", "arm", list(known))
    page.text("or its address", "address")
    page.choice("Kind", "kind", ["as its address says", *CATALOGUE])
    page.job("Connect", "Connecting", lambda studio: connect(studio, page.form, known), first=True)
    page.job("Look for arms again", "Looking for arms", jobs.look)


def connect(studio: Studio, form: Mapping[str, Any], known: Mapping[str, str]) -> None:
    """Connect to the typed address, else to the chosen arm, of the chosen kind."""
    kind = form["kind"] if form["kind"] in CATALOGUE else None
    jobs.choose(studio, str(form["address"] or known.get(form.get("arm", ""), "")), kind)


def check(page: StudioPage, status: Status) -> None:
    """Look at servos and surroundings, and confirm a small motion."""
    page.html("checks", status.found.get("checks") or ())
    if status.question:
        page.html("question", status.question)
        page.button("Yes", lambda: page.studio.answer("yes"), first=True, anyway=True)
        page.button("No", lambda: page.studio.answer("no"), anyway=True)
        return
    page.html("surroundings")
    page.job("The table is clear: move one joint", "A small motion", jobs.nudge, first=True)
    page.job("Look again", "Looking at the servos", jobs.see)


def diagnose(page: StudioPage, status: Status) -> None:
    """Find out what is wrong."""
    found = status.found.get("diagnosis")
    page.html("hint", f"The arm goes to ten targets and turns each joint. {QUICK}")
    page.tick("Quick try", "quick")
    page.job(
        "Diagnose",
        "Diagnosis",
        lambda studio: jobs.diagnose(studio, quick=bool(page.form["quick"])),
        first=found is None,
    )
    if found is not None:
        page.html("diagnosis", found)
        page.button("Next: repair", lambda: page.studio.change(step="repair"), first=True)


def repair(page: StudioPage, status: Status) -> None:
    """Repair the arm."""
    done = status.found.get("repaired")
    page.html(
        "hint", f"It fits a simulation of this arm, trains a policy, and compares all controllers on the arm. {QUICK}"
    )
    page.tick("Quick try", "quick")
    page.job("Repair", "Repair", lambda studio: jobs.repair(studio, quick=bool(page.form["quick"])), first=done is None)
    if done is not None:
        page.html("repaired", done, status.found.get("advice"))
        page.button("Next: before and after", lambda: page.studio.change(step="prove"), first=True)
        page.job("Begin a new repair", "Another repair", jobs.again)


def calibrate(page: StudioPage, status: Status) -> None:
    """Measure where the tool really is."""
    if status.picture is not None:
        page.picture(status.picture)
    if status.question:
        page.html("question", status.question)
        page.form["measured"] = ""
        page.text("x y z in mm", "measured")
        page.button("Enter", lambda: page.studio.answer(str(page.form["measured"])), first=True, anyway=True)
        return
    page.html("hint", "Encoders do not see everything. A few measured points show where the tool really is.")
    page.choice("Measure with", "gauge", jobs.gauges(status.address))
    page.number("Postures", "count", 10)
    page.text("Board", "board", "board.toml")
    page.number("Camera", "camera", 0)
    page.job("Calibrate", "Calibration", lambda studio: measure(studio, page.form), first=True)


def measure(studio: Studio, form: Mapping[str, Any]) -> None:
    """Calibrate with what was typed."""
    jobs.calibrate(studio, form["gauge"], max(int(form["count"]), 2), Path(form["board"]), int(form["camera"]))


def prove(page: StudioPage, status: Status) -> None:
    """Compare before and after on points of the owner."""
    page.html("hint", "Your own points, in mm from the middle of the base. A click on the table fills in x and y.")
    places(page, status)
    points = page.form.setdefault("points", [])
    page.html("points", points)
    page.button("Add the point", lambda: points.append(point(page.form)))
    page.button("Remove all points", points.clear)
    page.job(
        "Compare before and after", "Before and after", lambda studio: jobs.prove(studio, list(points)), first=True
    )
    if status.found.get("proof"):
        page.html("proof", status.found["proof"])
        page.button("Next: use it", lambda: page.studio.change(step="use"), first=True)


def places(page: StudioPage, status: Status) -> None:
    """Type a point."""
    middle = (
        [150.0, 0.0, 150.0] if status.arm is None else 500.0 * (status.arm.targets.lower + status.arm.targets.upper)
    )
    for name, usual in zip("xyz", middle, strict=True):
        page.number(f"{name} mm", name, round(float(usual)))


def use(page: StudioPage, status: Status) -> None:
    """Drive the arm, let others drive it, and look after it."""
    page.html("hint", "Type a point, or click on the table: the height is that of z.")
    places(page, status)
    page.number("Accept mm", "within", 2.0, step=0.1)
    page.tick("Click to go", "at once")
    page.job(
        "Go",
        "Going to the point",
        lambda studio: jobs.go_to(studio, point(page.form), 1e-3 * page.form["within"]),
        first=True,
    )
    path = page.form.setdefault("path", [])
    page.html("points", path)
    page.button("Record the point", lambda: path.append(point(page.form)))
    page.job("Record where the tool is", "Recording", lambda studio: jobs.record(studio, path))
    page.button("Forget the path", path.clear)
    page.number("Times", "times", 1.0)
    page.job("Play the path", "Path", lambda studio: jobs.play(studio, list(path), max(int(page.form["times"]), 1)))
    page.upload("Play a path file (CSV)", "Path", jobs.play_file)
    page.number("Load g", "load", 0.0)
    page.job(
        "The hand carries this load", "Payload", lambda studio: jobs.carry(studio, 1e-3 * max(page.form["load"], 0.0))
    )
    page.text("For programs", "listen", "127.0.0.1:9001")
    page.job("Let programs drive it", "Serving", lambda studio: jobs.serve(studio, str(page.form["listen"])))
    page.choice("Export", "export", KINDS)
    page.text("LeRobot file", "lerobot")
    page.job(
        "Write the file", "Export", lambda studio: jobs.export(studio, page.form["export"], str(page.form["lerobot"]))
    )
    page.job("Check again", "Check", jobs.check_again)
    page.job("History of all arms", "History", jobs.history)
    page.html("history", status.found.get("history") or ())


PANELS: dict[StepName, Callable[[Any, Status], None]] = {
    "find": find,
    "check": check,
    "diagnose": diagnose,
    "repair": repair,
    "calibrate": calibrate,
    "prove": prove,
    "use": use,
}


def point(form: Mapping[str, Any]) -> Array:
    """Return the typed point (3,) [m]."""
    return np.array([1e-3 * float(form[name]) for name in "xyz"])
