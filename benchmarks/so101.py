"""Emulated SO-101 on the law of their servos, in virtual time: `python -m benchmarks so101 shelf|tuned`.

`shelf`: the policy from the shelf against the classical controllers, on twenty arms that it never met, at two P.
`tuned`: what controllers gain from the gains of a search, with the twin of the gains before made as stiff as then.
"""

import numpy as np

from rejoint.arms import load_arm
from rejoint.control.comparison.protocols import metrics_of
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import shelf_controller
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.loop import Schedule, run
from rejoint.control.servogains import search
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.excitation import record
from rejoint.session.context import twin_under
from rejoint.twin.identify import identify
from rejoint.twin.predictive import PredictiveController
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM, PROTOCOL = load_arm("so101"), Protocol()
KINDS = ("worn", "so101")
"""Wear profiles: a worn small arm, and an SO-101 as one was found"""


def arms(count, first):
    """Names of ``count`` arms of each kind."""
    return [f"{kind}?seed={first + i}" for kind in KINDS for i in range(count)]


def robot(names, gains=None, seed=5, **options):
    """Emulated arms, each under its own ``gains``."""
    found = EmulatedRobot(ARM, [load_wear(name, ARM) for name in names], seed=seed, **options)
    for arm, own in enumerate(gains or ()):
        for name, values in own.items():
            found.plant.settings[name][arm] = values
    found.restart(ARM.rest)
    return found


def targets(count, each, seed):
    return ARM.targets.sample(np.random.default_rng(seed), (count, each))


def held(arm, controller, points):
    """Settled error [mm] and tremble [mm], both (B, K), and time [s] (B, K) to come and stay within 2 mm."""
    recording = run(arm, controller, points, Schedule(dwell=PROTOCOL.hold, keep_going=True))
    holds = metrics_of(ARM, recording, points, PROTOCOL)
    return 1e3 * holds["settled"], 1e3 * holds["oscillation"], holds[PROTOCOL.stay_names[-1]]


def tell(label, found, count):
    """Print what came out, for each kind of arm."""
    for place, kind in enumerate(KINDS):
        rows = slice(place * count, (place + 1) * count)
        settled, tremble, stay = (one[rows] for one in found)
        far = f"{np.nanmean(settled):.3f} (p95 {np.nanpercentile(settled, 95):.2f})"
        print(
            f"{label:22s} {kind:6s} settled {far}, within 2 mm after {np.median(stay):.2f}, trembles by "
            f"{np.nanmean(tremble):.3f}; {np.isnan(settled).sum()} cut short",
            flush=True,
        )


def shelf():
    names, points = arms(10, 100), targets(20, 4, 7)
    for p in (32, 16):
        for make in (DefaultController, IntegratorController, FeedforwardController, shelf_controller):
            controller = make(ARM)
            name = "shelf" if make is shelf_controller else controller.name
            tell(f"P = {p}, {name}", held(robot(names, [{"p": p}] * len(names)), controller, points), 10)


def known():
    """Return arms of both kinds, the gains that a search finds for each, and its twin under these."""
    points = draw_targets(ARM, sets=1, count=4, seed=0)[0]
    for name in arms(4, 1):
        found = search(robot([name], seed=11), points)
        twin = identify(ARM, [record(robot([name], seed=21), seed=0)[0].excitation])
        yield name, found, twin


def tuned():
    points, rows = targets(8, 6, 3), {}
    for arm, (name, found, twin) in enumerate(known()):
        for under, gains in (("before", found.found), ("tuned", found.under)):
            believed = twin_under(twin, found.found, gains)
            for label, controller in {
                "integrator": IntegratorController(ARM),
                "feedforward": FeedforwardController(ARM, believed.parameters.stiffness),
                "shelf": shelf_controller(ARM),
                "predictive": PredictiveController.of(ARM, [believed], shelf_controller(ARM)),
            }.items():
                settled, _, stay = held(robot([name], [gains], seed=50 + arm), controller, points[arm : arm + 1])
                rows.setdefault((label, under), []).append([np.nanmean(settled), np.median(stay)])
    for (label, under), found in rows.items():
        mean = np.mean(found, axis=0)
        print(f"{label:12s} gains {under:7s} settled {mean[0]:.3f}, within 2 mm after {mean[1]:.2f}")


def main(study: str) -> None:
    """Print one of the tables: shelf or tuned."""
    {"shelf": shelf, "tuned": tuned}[study]()
