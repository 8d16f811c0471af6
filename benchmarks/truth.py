"""Twins of emulated worn arms, whose parameters are known: how far off they are, and whether their intervals say so.

    python -m benchmarks truth
    python -m benchmarks truth --arms 6 --masses 0.3

Every other arm has links of other masses than the fit assumes. Their structure is another than any twin's.
"""

from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, gravity_torque, mycobot280
from rejoint.diagnosis.excitation import record
from rejoint.logs.runlog import RunLog
from rejoint.twin.identify import identify
from rejoint.twin.parameters import PARAMETERS, Layout, TwinParameters, pack
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import RAMP_SHARE
from rejoint_lab.plant.wear import lifting_torque, load_wear

SPEED_FILTER = 0.01
"""[s] by which an emulated servo knows its speed late: of its derivative gain that takes inertia away"""


def heavier(arm: Arm, rng: np.random.Generator, spread: float) -> Arm:
    """Draw links of other masses."""
    factor = np.exp(spread * rng.standard_normal(arm.joints))
    return replace(arm, mass=arm.mass * factor, inertia=arm.inertia * factor[:, None, None])


def emulated(arm: Arm, seeds: range, masses: float) -> list[tuple[list[RunLog], TwinParameters]]:
    """Emulate worn arms, every other with links of other masses; return logs, and the twin that each should have.

    A twin's damping contains back-EMF, its dry friction that by the mean load; its delay the servo's cycle.
    """
    wears, bodies, found = [], [], []
    for seed in seeds:
        body = heavier(arm, np.random.default_rng([7, seed]), masses if seed % 2 else 0.0)
        wear = load_wear(f"worn?seed={seed}", arm)
        bodies.append(body)
        wears.append(replace(wear, torque_limit=np.maximum(wear.torque_limit, 1.03 * lifting_torque(wear, body))))
    robot = EmulatedRobot(arm, wears, seed=1, bodies=bodies, tells_load=False)
    for wear, body, logs in zip(wears, bodies, record(robot, seed=0), strict=True):
        load = np.abs(gravity_torque(body, logs.excitation.position)).mean(axis=0)
        truth = TwinParameters(
            stiffness=wear.position_gain,
            damping=wear.damping_gain + wear.torque_limit / robot.plant.joints["no_load_speed"][0],
            coulomb=wear.coulomb + wear.load_friction * load,
            stiction=(wear.stiction + wear.load_friction * load) / (wear.coulomb + wear.load_friction * load),
            armature=wear.reflected_inertia - SPEED_FILTER * wear.damping_gain,
            torque_limit=wear.torque_limit,
            offset=wear.offset,
            delay=0.021,
            ramp_speed=RAMP_SHARE * arm.max_speed.min(),
        )
        found.append(([logs.excitation, logs.targets], truth))
    return found


def main(arms: int = 12, masses: float = 0.15, seed: int = 100) -> None:
    """Print for each parameter of emulated worn arms how often its interval holds what was injected."""
    arm, rows = mycobot280(), []
    for logs, truth in emulated(arm, range(seed, seed + arms), masses):
        twin = identify(arm, logs)
        off = pack(twin.parameters) - pack(truth)
        rows.append(np.stack([off, np.sqrt(np.diag(twin.covariance)), np.asarray(twin.identified)]))
        print(
            f"held out {np.degrees(twin.held_out.twin.joint):.2f} deg, {1e3 * twin.held_out.twin.tcp:.1f} mm",
            flush=True,
        )
    for p in PARAMETERS:
        off, sigma, known = np.array(rows)[:, :, Layout(arm.joints).at(p.name)].swapaxes(0, 1)
        off, sigma = off[known > 0.0], sigma[known > 0.0]
        if len(off):
            inside = 100 * np.mean(np.abs(off) < 1.96 * sigma)
            print(
                f"{p.name:13} identified {len(off):3}, within the intervals {inside:3.0f} %, "
                f"off by {np.median(np.abs(off)):.3f} in the median, sigma {np.median(sigma):.3f}"
            )
