"""True error of worn arms, corrected by what a camera beside them sees of a board on the tool, and closed on it.

Every arm takes 40 postures and is measured at rest: by 20 touch points of 0.5 mm, and by the corners of the board in
40 pictures. Then it is sent to fresh targets: by its encoders alone, by each model, and by the model with the target
corrected by what six pictures show. ``--rendered`` renders every picture and looks for the board in it; without,
corners are projected and get more noise than rendered ones have.

    python -m benchmarks.camera --arms 10
"""

import argparse
import time

import numpy as np

from rejoint.arms import mycobot280, solve_position, tcp_position
from rejoint.arms.camera.views import Detector
from rejoint.control.controller import Situation
from rejoint.control.integrator import IntegratorController
from rejoint.diagnosis.calibration.camera.bundle import bundle
from rejoint.diagnosis.calibration.camera.choosing import choose_postures
from rejoint.diagnosis.calibration.camera.track import ToolTracker
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.camera.scene import beside
from rejoint.robots.lab.plant.wear import load_wear

ARM = mycobot280()
VIEWS, TOUCHES, TARGETS, FIRST = 40, 20, 25, 500
PERIOD = 0.025
SETTLE = 3.0  # s: the integrator needs that long on a worn arm
NOISE = 0.15  # px of a corner: what the fit believes, and more than rendered pictures have


def drive(robot, goal, seconds):
    """Bring the encoders to ``goal`` (B, n) by a ramp and an integral, as the classical controllers do."""
    steps = round(seconds / PERIOD)
    start, added = robot.read().position.copy(), np.zeros((robot.count, ARM.joints))
    for k in range(steps):
        share = min(1.0, k / (0.4 * steps))
        wanted = start + share * (goal - start)
        if share == 1.0:
            added += 0.12 * (goal - robot.read().position)
        robot.step(wanted + np.clip(added, -0.6, 0.6))
    return robot.read().position.copy(), robot.plant.link_position().copy()


def measured(robot, postures):
    came, told, links = robot.read().position.copy(), [], []
    approach = [came]
    for posture in postures:
        encoder, link = drive(robot, np.tile(posture, (robot.count, 1)), 2.5)
        told.append(encoder)
        links.append(link)
        approach.append(encoder)
    return np.array(told), np.array(links), np.array(approach[:-1])


class Driven:
    """Arms under the integrator, whose target may move at any time."""

    def __init__(self, robot):
        self.robot, self.law, self.sent = robot, IntegratorController(ARM), robot.plant.goal

    def go(self, command, seconds):
        """Bring the encoders' tool to ``command`` (B, 3) [m]; return the encoders (B, n) afterwards."""
        for k in range(round(seconds / PERIOD)):
            since = np.full(self.robot.count, k * PERIOD)
            state = self.robot.read()
            self.sent = self.law.command(Situation(state=state, target=command, sent=self.sent, since_target=since))
            self.robot.step(self.sent)
        return self.robot.read().position


def sent(robot, targets, models, see=None):
    """Return true errors (K, B) [m] at rest: aimed, and when settled aimed once more, or six times by a picture."""
    errors, driven = [], Driven(robot)
    for target in targets:
        start = robot.read().position.copy()
        shift = np.array([model(solve_position(ARM, target, s).q, s) for model, s in zip(models, start, strict=True)])
        encoder = driven.go(target - shift, SETTLE + 1.0)
        if see is None:
            shift = np.array([model(q, s) for model, q, s in zip(models, encoder, start, strict=True)])
            driven.go(target - shift, SETTLE)
        for _ in range(6 if see else 0):
            shift += 0.7 * (see(robot) - tcp_position(ARM, robot.read().position) - shift)
            driven.go(target - shift, 0.6)
        errors.append(np.linalg.norm(robot.true_tcp() - target, axis=-1))
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.camera", description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=10)
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--rendered", action="store_true", help="render every picture; ten times slower")
    options = parser.parse_args()
    scene, count = beside(ARM), options.arms
    robot = EmulatedRobot(ARM, [load_wear(f"worn?seed={FIRST + i}", ARM) for i in range(count)], seed=7)
    postures = choose_postures(ARM, scene.rig, options.views)
    told, links, approach = measured(robot, postures)
    rng, detector, begin = np.random.default_rng(11), Detector(scene.rig.board), time.perf_counter()

    def view(name, link, seed):
        if options.rendered:
            return detector.find(name, scene.picture(link, seed))
        return scene.view(name, link, rng, NOISE)

    bundles, touched, kept = [], [], []
    for i in range(count):
        views = [view(f"view {k}", links[k, i], (i, k)) for k in range(len(told))]
        rows = np.array([hasattr(one, "pixel") for one in views])
        kept.append(rows.sum())
        bundles.append(
            bundle(ARM, scene.rig.board, [views[k] for k in np.flatnonzero(rows)], told[rows, i],
                   approach=approach[rows, i], size=(scene.rig.lens.width, scene.rig.lens.height))
        )  # fmt: skip
        own = slice(0, TOUCHES)
        point = tcp_position(ARM, links[own, i]) + 5e-4 * rng.standard_normal((TOUCHES, 3))
        touched.append(fit(ARM, Measurements(
            position=told[own, i], approach=approach[own, i], point=point, sigma=np.full(TOUCHES, 5e-4),
            posture=np.arange(TOUCHES),
        )))  # fmt: skip
    left, rms = sum(len(one.left_out) for one in bundles), np.mean([one.rms for one in bundles])
    print(f"{count} arms, {np.mean(kept):.1f} views each, {left} of them left out; corners {rms:.3f} px rms")
    print(f"{(time.perf_counter() - begin) / count:.1f} s an arm for both fits")

    trackers = [ToolTracker(one.rig) for one in bundles]
    frame = iter(range(10**9))

    def see(arms):
        number, found = next(frame), []
        for i, (tracker, link) in enumerate(zip(trackers, arms.plant.link_position(), strict=True)):
            seen = view("one", link, (i, number))
            found.append(tracker.sighting(seen).place)
        apart.append(np.linalg.norm(np.array(found) - arms.true_tcp(), axis=-1))
        return np.array(found)

    targets = ARM.targets.sample(np.random.default_rng(5), (TARGETS,))
    by_camera = [lambda q, s, b=b: b.displacement.tool(ARM, q, s) - tcp_position(ARM, q) for b in bundles]
    ways = {
        "encoders alone": ([lambda *_: np.zeros(3)] * count, None),
        f"{TOUCHES} touch points": ([c.shift for c in touched], None),
        f"{options.views} views": (by_camera, None),
        "closed on the camera": (by_camera, see),
    }
    print(f"{'true error [mm]':22} {'mean':>6} {'95 %':>6} {'best arm':>9} {'worst arm':>9}")
    apart = []
    for name, (shift, eye) in ways.items():
        error = 1e3 * sent(robot, targets, shift, eye)
        arms = error.mean(axis=0)
        print(
            f"{name:22} {error.mean():6.2f} {np.quantile(error, 0.95):6.2f} {arms.min():9.2f} {arms.max():9.2f}",
            flush=True,
        )
    one = 1e3 * np.array(apart)
    print(f"{'seen in one picture':22} {one.mean():6.2f} {np.quantile(one, 0.95):6.2f}")


if __name__ == "__main__":
    main()
