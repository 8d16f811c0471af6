"""Emulated SO-101 on the law of their servos, in virtual time: `python -m benchmarks so101 shelf|tuned`.

`shelf`: the policy from the shelf against the classical controllers, on twenty arms that it never met, at two P.
`tuned`: what controllers gain from the gains of a search, with the twin of the gains before made as stiff as then.
"""

import numpy as np

from rejoint.arms import choose_postures, load_arm
from rejoint.control.comparison.protocols import metrics_of
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import shelf_controller
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import TargetSequence, with_ways
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


def robot(names, gains=None, seed=5):
    """Emulated arms, each under its own ``gains``."""
    found = EmulatedRobot(ARM, [load_wear(name, ARM) for name in names], seed=seed)
    for arm, own in enumerate(gains or ()):
        for name, values in own.items():
            found.plant.settings[name][arm] = values
    found.restart(ARM.rest)
    return found


def targets(count, each, seed):
    return ARM.targets.sample(np.random.default_rng(seed), (count, each))


def held(arm, controller, points):
    """Settled error [mm] and time [s] after the way, both (B, K), to come and stay within 2 mm."""
    ways = [with_ways(ARM, choose_postures(ARM, own, ARM.rest, chained=True).q, ARM.rest) for own in points]
    recording = run(
        arm, controller, TargetSequence(ARM, points, ways=ways), Schedule(dwell=PROTOCOL.hold, keep_going=True)
    )
    holds = metrics_of(ARM, recording, points, PROTOCOL)
    return 1e3 * holds["settled"], holds[PROTOCOL.stay_names[-1]]


def tell(label, found):
    """Print what came out, for each kind of arm."""
    for kind, settled, stay in zip(KINDS, *(np.split(one, 2) for one in found), strict=True):
        print(
            f"{label:22s} {kind:6s} settled {np.nanmean(settled):.3f} (p95 {np.nanpercentile(settled, 95):.2f}), "
            f"within 2 mm after {np.nanmedian(stay):.2f}; {np.isnan(settled).sum()} cut short"
        )


def shelf():
    names, points = arms(10, 100), targets(20, 4, 7)
    for p in (32, 16):
        for make in (DefaultController, IntegratorController, FeedforwardController, shelf_controller):
            tell(f"P = {p}, {make.__name__}", held(robot(names, [{"p": p}] * 20), make(ARM), points))


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
                settled, stay = held(robot([name], [gains], seed=50 + arm), controller, points[arm : arm + 1])
                rows.setdefault((label, under), []).append([np.nanmean(settled), np.median(stay)])
    for (label, under), found in rows.items():
        mean = np.mean(found, axis=0)
        print(f"{label:12s} gains {under:7s} settled {mean[0]:.3f}, within 2 mm after {mean[1]:.2f}")


def main(study: str) -> None:
    """Print one of the tables: shelf or tuned."""
    {"shelf": shelf, "tuned": tuned}[study]()
