"""The studio by clicks and typed text alone, in headless Chromium: from "find the arm" to "used with 0.5 mm", and stop.

    python -m benchmarks studio
    python -m benchmarks studio --arm so101 --stops 50 --pictures /tmp

The arm is emulated in another process, on its own wire and in wall-clock time. At the end the stop button is pressed in
the middle of motions. The emulator's own log tells when the arm was held: it counts from the click, until no joint
leaves its place by more than `STILL` in the second that follows. The browser's clock tells when it was clicked.
``--quick`` repairs with little of everything.
"""

import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.frame import process

sys.path.extend(str(Path(__file__).parents[1] / "tests" / room) for room in ("", "pages"))
from browser import chromium
from hand import Hand

from rejoint.pages.html import macros

STILL = np.radians(2.0)
"""[rad] by which the links of a held arm swing on their gears (chosen: worn ones swing by 1.3)"""
STOP = "[...document.querySelectorAll('button')].find((b) => b.innerText.trim() === 'STOP')"
MOVES = np.radians(5.0)
"""[rad/s] of an arm in motion (chosen)"""
NEWEST = 200_000
"""[bytes] of the log that are read: ten seconds and more"""
HELD = 0.3
"""[s] within which the arm is to be held"""
POINTS = {
    "mycobot280": ((170, -60, 210), (200, 60, 190), (180, 0, 230)),
    "so101": ((320, -60, 220), (350, 60, 200), (330, 0, 240)),
}
"""[mm] of the owner"""
FAR = {"mycobot280": ((160, -90, 160), (200, 90, 240)), "so101": ((300, -80, 190), (350, 80, 250))}
"""[mm] between which the arm is stopped"""


def read_truth(path: Path) -> Any:
    """Return times (T,) [s] and link angles (T, n) [rad] of the newest rows of the emulator's log."""
    with path.open() as file:
        names = file.readline().split(",")
        file.seek(max(path.stat().st_size - NEWEST, file.tell()))
        lines = file.read().splitlines()[1:-1]
    columns = [k for k, name in enumerate(names) if name.startswith("link")]
    rows = np.array([list(map(float, line.split(","))) for line in lines])
    return rows[:, 0], rows[:, columns]


def speed_at(when: Any, angles: Any, now: float) -> float:
    """Speed [rad/s] of the fastest joint in the tenth of a second before ``now``."""
    newest = (when > now - 0.1) & (when <= now)
    return float(np.ptp(angles[newest], axis=0).max() / 0.1) if newest.any() else 0.0


def held_after(path: Path, pressed: float) -> tuple[float, float]:
    """Time [s] from ``pressed`` until the arm is held, and speed [rad/s] of its fastest joint when it was pressed."""
    when, angles = read_truth(path)
    later = (when >= pressed) & (when < pressed + 1.5)
    away = np.abs(angles[later] - angles[later][-1]).max(axis=1)
    moving = np.flatnonzero(away > STILL)
    return (float(when[later][moving[-1]] - pressed) if len(moving) else 0.0), speed_at(when, angles, pressed)


def main(
    arm: Annotated[str, typer.Option(help="mycobot280 or so101.")] = "mycobot280",
    stops: Annotated[int, typer.Option(help="How often it is stopped in mid-motion.")] = 5,
    quick: Annotated[bool, typer.Option(help="Repair with little of everything.")] = False,
    pictures: Annotated[Path | None, typer.Option(help="Folder for pictures of every step.")] = None,
    width: Annotated[int, typer.Option(help="Of the window in px.")] = 1300,
) -> None:
    """Lead an emulated arm through the page."""
    with tempfile.TemporaryDirectory() as place, chromium(width, 850) as tab:
        truth = Path(place) / "truth.csv"
        metrics = {"width": width, "height": 850, "deviceScaleFactor": 1, "mobile": width < 600}
        tab.call("Emulation.setDeviceMetricsOverride", **metrics)
        emulator = ("emulate", "--arm", arm, "--port", "0", "--log", str(truth))
        folder = str(Path(place) / "runs")
        with (
            process(*emulator) as address,
            process("studio", "--listen", "127.0.0.1:0", "--folder", folder, "--quiet") as page,
        ):
            lead(Hand(tab), page, address, arm, quick=quick, pictures=pictures)
            press_stop(Hand(tab), arm, truth, stops)


def lead(hand: Hand, page: str, address: str, arm: str, *, quick: bool, pictures: Path | None) -> None:
    """Go through all steps; the arm is used with 0.5 mm at the end."""
    began = time.monotonic()

    def done(step: str) -> None:
        print(f"{time.monotonic() - began:6.0f} s  {step}", flush=True)
        if pictures is not None:
            time.sleep(1.0)
            (pictures / f"studio-{arm}-{step.replace(' ', '-')}.png").write_bytes(hand.tab.picture())

    hand.open(page)
    hand.reads("Connect")
    done("found")
    hand.type("or its address", address)
    hand.press("Connect")
    hand.press("The table is clear: move one joint")
    done("checked")
    hand.press("Yes")
    if quick:
        hand.tick("Quick try")
    hand.press("Diagnose")
    time.sleep(20.0)
    done("diagnosing")
    ends(hand, "Next: repair", 600)
    done("diagnosed")
    hand.press("Repair")
    time.sleep(20.0)
    done("repairing")
    ends(hand, "Next: before and after", 3600)
    done("repaired")
    for point in POINTS[arm]:
        for name, value in zip("xyz", point, strict=True):
            hand.type(f"{name} mm", str(value))
        hand.press("Add the point")
        time.sleep(1.0)
    hand.press("Compare before and after")
    ends(hand, "Next: use it", 300)
    done("proved")
    hand.type("Accept mm", "0.5")
    go(hand, POINTS[arm][0])
    hand.reads("There, ")
    done("used with 0.5 mm")
    print(next(line for line in hand.tab.text().splitlines() if line.startswith("There, ")))


def ends(hand: Hand, following: str, seconds: float) -> None:
    """Wait for the end of a job, and press what follows it; an error on the page ends the benchmark."""
    error = f"(document.querySelector('span[style=\"color:{macros('live.html').red}\"]') || {{}}).innerText"
    button = (
        f"[...document.querySelectorAll('button')].some((b) => b.innerText.trim() === '{following}' && !b.disabled)"
    )
    hand.tab.wait_for(f"{error} || {button}", seconds)
    if found := hand.tab.ask(error):
        raise SystemExit(f"the page says: {found}")
    hand.press(following)


def go(hand: Hand, point: tuple[float, ...]) -> None:
    """Type a point and press Go."""
    for name, value in zip("xyz", point, strict=True):
        hand.type(f"{name} mm", str(value))
    hand.press("Go")


def press_stop(hand: Hand, arm: str, truth: Path, stops: int) -> None:
    """Press stop in mid-motion, so many times, and print when the arm was held."""
    took, draw = list[float](), random.Random(0)
    hand.type("Accept mm", "0.1")
    for number in range(10 * stops):
        if len(took) == stops:
            break
        go(hand, FAR[arm][number % 2])
        until = time.monotonic() + 20.0
        while time.monotonic() < until and speed_at(*read_truth(truth), time.monotonic()) < MOVES:
            time.sleep(0.02)
        time.sleep(draw.uniform(0.0, 0.4))
        clicked = f"(() => {{ const now = Date.now(); {STOP}.click(); return now; }})()"
        pressed = 1e-3 * hand.tab.ask(clicked) - time.time() + time.monotonic()
        hand.reads("stopped by the stop button", 20.0)
        time.sleep(2.0)
        seconds, speed = held_after(truth, pressed)
        if speed > MOVES:  # it was in motion
            took.append(seconds)
            if seconds > HELD:
                print(f"  late: {seconds:.3f} s after the click, from {np.degrees(speed):.0f} deg/s", flush=True)
    late = sum(one > HELD for one in took)
    spread = ", ".join(f"{quantile:.0%}: {np.quantile(took, quantile):.3f} s" for quantile in (0.5, 0.95, 1.0))
    print(f"stop in mid-motion: held within {HELD} s in {len(took) - late} of {len(took)} ({spread})", flush=True)
