"""Emulated SO-101 on the law of their servos, in virtual time: `python -m benchmarks.so101 shelf|push|loads|tuned`.

`shelf`: the policy from the shelf against the classical controllers, on twenty arms that it never met, at two P.
`push`: shares of the friction push and of its dither, under gains that a search found.
`loads`: what a servo's load, and its current, do for the identification of arms whose links are 15 % heavier than
described; a number behind it is the `OWN` of `rejoint.twin.loads`, by which motors of one type are believed to differ.
`tuned`: what controllers gain from the gains of a search, with the twin of the gains before made as stiff as then.
"""

import sys
from dataclasses import replace

import numpy as np

from rejoint.arms import load_arm
from rejoint.control.comparison.protocols import measure_holds
from rejoint.control.comparison.result import Protocol
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.gainsearch import search
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.push import PushController, PushGains
from rejoint.control.shelf import shelf_controller
from rejoint.diagnosis.record import record
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.sts3215 import STALL_CURRENT
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.runs.stages.known import twin_under
from rejoint.twin import loads as told_by_loads
from rejoint.twin.identify import identify
from rejoint.twin.parameters import Layout, pack
from rejoint.twin.predictive import PredictiveController

ARM, PROTOCOL = load_arm("so101"), Protocol()
MOTOR_CONSTANTS = (1.08, 1.178, 1.275, 3.60)
"""[N m/A] of an STS3215: its data sheet (C018), Rhoban/bam's fits m1 and m6 (7.4 V), kscalelabs/sysid (12 V)"""
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
            found.plant.settings["integral_limit" if name == "limit" else name][arm] = values
    found.restart(ARM.rest)
    return found


def targets(count, each, seed):
    return np.random.default_rng(seed).uniform(ARM.targets.lower, ARM.targets.upper, (count, each, 3))


def held(arm, controller, points):
    """Settled error [mm] and tremble [mm], both (B, K), and time [s] (B, K) to come and stay within 2 mm."""
    recording = run(arm, controller, points, Schedule(dwell=PROTOCOL.hold, keep_going=True))
    holds = measure_holds(ARM, recording, points, PROTOCOL)
    return 1e3 * holds.settled, 1e3 * holds.oscillation, holds.stay[int(np.argmin(PROTOCOL.within))]


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


def searched(names):
    """Return what the search for gains finds for each arm."""
    points = draw_targets(ARM, sets=1, count=4, seed=0)[0]
    return [search(robot([name], seed=11), points) for name in names]


def known():
    """Return arms of both kinds, the gains that a search finds for each, and its twin under these."""
    names = arms(4, 1)
    for name, found in zip(names, searched(names), strict=True):
        twin = identify(ARM, [record(robot([name], seed=21), seed=0)[0].excitation])
        yield name, found, twin


def push():
    points, rows = targets(8, 24, 100), {}
    for arm, (name, found, twin) in enumerate(known()):
        believed = twin_under(twin, found.found, found.under).parameters
        for share, dither in ((0, 0), (0.5, 0), (0, 0.3), (0.3, 0.3), (0.5, 0.3), (0.8, 0.3)):
            gains = PushGains(push=share, dither=dither)
            controller = PushController(ARM, believed.stiffness, believed.coulomb, gains)
            seen = held(robot([name], [found.under], seed=50 + arm), controller, points[arm : arm + 1])
            rows.setdefault((share, dither), []).append(seen)
    table = {pair: [np.concatenate(one) for one in zip(*found, strict=True)] for pair, found in rows.items()}
    for (share, dither), found in table.items():
        tell(f"push {share}, dither {dither}", found, 4)
        nearer = (found[0] - table[0, 0][0]).reshape(len(KINDS), -1)
        error = nearer.std(axis=1) / np.sqrt(nearer.shape[1])
        print(
            "  settled beside none: "
            + ", ".join(f"{d:+.3f} +- {e:.3f}" for d, e in zip(nearer.mean(1), error, strict=True))
        )


def with_current(values, covariance):
    """Return what is believed of a twin (k,), (k, k) once currents are read by a published motor constant.

    Where a joint stands, its current is its duty times voltage over the winding's resistance. So it tells nothing that
    the duty does not, but for the torque at stall, as well as the constant is known that turns a current into one.
    """
    place, constant = Layout(ARM.joints).at("torque_limit"), np.log(MOTOR_CONSTANTS)
    row = np.eye(len(values))[place]
    error = constant.std(ddof=1) ** 2 + told_by_loads.OWN**2 * np.eye(ARM.joints)
    share = covariance @ row.T @ np.linalg.inv(row @ covariance @ row.T + error)
    seen = constant.mean() + np.log(STALL_CURRENT)
    return values + share @ (seen - row @ values), covariance - share @ row @ covariance


def loads(own=told_by_loads.OWN):
    told_by_loads.OWN = float(own)
    heavier = replace(ARM, mass=1.15 * ARM.mass, inertia=1.15 * ARM.inertia)
    drawn, layout = arms(3, 1), Layout(ARM.joints)
    logs = [one.excitation for one in record(robot(drawn, seed=31, bodies=[heavier] * len(drawn)), seed=0)]
    found = {}
    for name, log in zip(drawn, logs, strict=True):
        gain, kind = load_wear(name, ARM).position_gain, name.partition("?")[0]
        truth = {"stiffness": gain, "torque_limit": 0.97 * gain / (0.163 * 32)}
        plain, loaded = (identify(ARM, [one]) for one in (replace(log, servo_load=None), log))
        believed = {
            "no load": (pack(plain.parameters), plain.covariance),
            "load": (pack(loaded.parameters), loaded.covariance),
            "load, current": with_current(pack(loaded.parameters), loaded.covariance),
        }
        for told, (values, covariance) in believed.items():
            sigma = np.sqrt(np.diag(covariance))
            for what, true in truth.items():
                place = layout.at(what)
                found.setdefault((kind, what, told), []).append((values[place] - np.log(true), sigma[place]))
    for (kind, what, told), rows in found.items():
        error, sigma = np.stack([np.array(row) for row in rows], axis=1)
        outside = np.abs(error) >= 1.96 * sigma
        names = ", ".join(np.array(ARM.joint_names)[np.nonzero(outside)[1]])
        print(
            f"{kind:6s} {what:12s} {told:13s}: logarithm off by {np.median(np.abs(error)):.2f} (median), one sigma "
            f"{np.median(sigma):.2f} (largest {sigma.max():.2f}), truth within 95 % in "
            f"{(~outside).sum()} of {error.size}; outside: {names or 'none'}",
            flush=True,
        )


def tuned():
    points, rows = targets(8, 6, 3), {}
    for arm, (name, found, twin) in enumerate(known()):
        for under, gains in (("before", found.found), ("tuned", found.under)):
            believed = twin_under(twin, found.found, gains)
            stiffness, friction = believed.parameters.stiffness, believed.parameters.coulomb
            for label, controller in {
                "integrator": IntegratorController(ARM), "feedforward": FeedforwardController(ARM, stiffness),
                "push": PushController(ARM, stiffness, friction), "shelf": shelf_controller(ARM),
                "predictive": PredictiveController.of(ARM, believed, shelf_controller(ARM)),
            }.items():  # fmt: skip
                settled, _, stay = held(robot([name], [gains], seed=50 + arm), controller, points[arm : arm + 1])
                rows.setdefault((label, under), []).append([np.nanmean(settled), np.median(stay)])
    for (label, under), found in rows.items():
        mean = np.mean(found, axis=0)
        print(f"{label:12s} gains {under:7s} settled {mean[0]:.3f}, within 2 mm after {mean[1]:.2f}")


if __name__ == "__main__":
    {"shelf": shelf, "push": push, "loads": loads, "tuned": tuned}[sys.argv[1]](*sys.argv[2:])
