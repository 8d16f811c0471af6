"""What the live view costs: the control loop, cycle by cycle, and the process, while a browser looks on.

The browser is a headless Chromium, which draws with this computer's processors and so gets what others leave of them:
its own time is not counted. The control loop waits for nobody, so what it can lose is the interpreter, for as
long as the thread of the view holds it: the lateness of its cycles, beside that of the same drive without a view.
"""

import time

import numpy as np

from benchmarks.browser import CHROMIUM, chromium
from benchmarks.timing import best_of
from rejoint.arms import mycobot280
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.pages.live.ring import SLOTS, Ring
from rejoint.pages.live.view import RATE, LiveView
from rejoint.robots import open_robot
from rejoint.robots.wallclock import WallClock
from rejoint.twin.parameters import nominal_parameters

ROUNDS, DWELL, SECONDS = 201, 2.0, 30.0


class Nominal:
    """A twin with the parameters of an arm of this build, for the ghost."""

    parameters, stiction, acceleration = nominal_parameters(mycobot280()), 1.2, np.inf


class Late:
    """A robot that notes when its commands come."""

    def __init__(self, robot) -> None:
        self._robot, self.due, self.late = robot, None, []

    def __getattr__(self, name):
        return getattr(self._robot, name)

    def step(self, command, active=None):  # noqa: D102
        before = self._robot.read().time[0]
        state = self._robot.step(command, active)
        now = time.monotonic()
        self.due = now if self.due is None else self.due + state.time[0] - before
        self.late.append(now - self.due)
        return state


def drive(robot, seconds: float) -> int:
    targets = np.tile(robot.arm.targets.sample(np.random.default_rng(0), (1, 3)), (1, 20, 1))
    count = max(round(seconds / 3.0), 1)
    return len(run(robot, IntegratorController(robot.arm), targets[:, :count], Schedule(dwell=seconds / count)).time)


def processor(robot) -> float:
    """Time [s] of the processor that a drive takes."""
    before = time.thread_time()
    drive(robot, DWELL)
    return time.thread_time() - before


def in_the_loop() -> None:
    view, rng = LiveView(), np.random.default_rng(0)
    taken = {"alone": [], "alone, once more": [], "watched": []}
    for _ in range(ROUNDS):
        for name in rng.permutation(list(taken)):
            robot = open_robot("emulated:worn")
            taken[name].append(processor(view.watch(robot, paced=False) if name == "watched" else robot))
    cycles = drive(open_robot("emulated:worn"), DWELL)
    times = {name: np.array(each[1:]) / cycles for name, each in taken.items()}
    alone = times["alone"].min()
    print(f"a cycle of the loop with an emulated arm: {1e6 * alone:.0f} us of processor")
    for name in ("alone, once more", "watched"):
        ratio = times[name] / times["alone"]
        spread = 1.25 * np.std(np.sort(ratio)[ROUNDS // 10 : -ROUNDS // 10]) / np.sqrt(ROUNDS)
        print(f"  {name}: {np.median(ratio):.4f} +- {spread:.4f} of that (median of {ROUNDS - 1} turns)")
    ring, parts = Ring(6), (None, None, np.zeros((1, 6)))
    write = best_of(5, lambda: [ring.write(0, *parts) for _ in range(100 * SLOTS)]) / (100 * SLOTS)
    print(f"  a record by itself: {1e6 * write:.2f} us, {100 * write / alone:.2f} % of that")
    print(f"  and {100 * write / 0.020:.4f} % of a control period of 20 ms")


def paced(view: LiveView | None, twin: object) -> tuple[float, np.ndarray]:
    """Share of a core that a drive in real time takes, and how late [s] its commands went out."""
    robot = Late(WallClock(open_robot("emulated:worn")))
    shown = robot if view is None else view.watch(robot, twin=twin, paced=False)
    wall, cpu = time.monotonic(), time.process_time()
    drive(shown, SECONDS)
    return (time.process_time() - cpu) / (time.monotonic() - wall), np.array(robot.late)


def of_the_process() -> None:
    print(f"{SECONDS:.0f} s in real time at {RATE:.0f} Hz, arm and ghost of 6 joints:")
    plain, late = paced(None, None)
    tell("nobody looks on", plain, late)
    with LiveView(port=0) as view:
        share, late = paced(view, Nominal)
        tell("a view, but no browser", share, late, plain)
        if CHROMIUM is None:
            print("no chromium here: what a browser that looks on costs is not measured")
            return
        with chromium(modest=True) as tab:
            tab.call("Page.navigate", url=view.address)
            tab.wait_for("document.querySelector('canvas') && document.body.innerText.includes('Hold the arm')")
            before, began = view.frames, time.monotonic()
            share, late = paced(view, Nominal)
            rate = (view.frames - before) / (time.monotonic() - began)
            tell(f"a browser looks on, {rate:.1f} frames a second", share, late, plain)
            print(f"  a frame takes {1e3 * (share - plain) / rate:.1f} ms of processor")


def tell(what: str, share: float, late: np.ndarray, plain: float = 0.0) -> None:
    middle, most = 1e3 * np.percentile(late, [50, 99])
    more = f", the view's part {100 * (share - plain):.1f} %" if plain else ""
    print(
        f"  {what}: {100 * share:.1f} % of a core{more}; commands late by {middle:.1f} ms (median), {most:.1f} ms (p99)"
    )


def main() -> None:
    in_the_loop()
    of_the_process()
