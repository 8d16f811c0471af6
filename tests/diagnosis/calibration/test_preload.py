"""What presses floating joints: the wedge that is recommended does it in the plant, and is told where it helps."""

from dataclasses import replace

import numpy as np

from madetwin import made_calibration
from rejoint.arms import Displacement, mycobot280
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import turned
from rejoint.arms.workspace import posture_grid
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.loop import Schedule, run
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import WEDGE, DisplacementLayout, preload
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
RAISED = {"-x": (0.0, 1.0), "+x": (0.0, -1.0), "-y": (-1.0, 0.0), "+y": (1.0, 0.0)}


LOOSE = replace(Displacement.none(ARM), play=0.03 * np.eye(6)[0])
FLOATING = made_calibration(ARM, LOOSE, covariance=1e-8 * np.eye(DisplacementLayout(ARM).body), floor=1e-4)


def lies(gravity):
    """Places (A, K) of the links of joint 1 after motions of worn arms, in units of half their play."""
    robot = EmulatedRobot(ARM, [load_wear(f"worn?seed={seed}", ARM) for seed in range(5)], gravity=gravity)
    targets, places = draw_targets(ARM, sets=5, count=2, seed=0), []
    half = 0.5 * robot.plant.joints["play"][:, 0]
    driven = run(
        robot,
        make_controller("feedforward", ARM),
        targets,
        Schedule(dwell=2.5, keep_going=True),
        on_cycle=lambda _: places.append(robot.plant.qpos[:, 1] / half),
    )
    rows = [np.flatnonzero(driven.target_index[:, i] == k)[-1] for i in range(5) for k in range(2)]
    return np.array(places)[rows, np.repeat(np.arange(5), 2)].reshape(5, 2)


def test_the_recommended_wedge_presses_the_base_joints_of_emulated_arms_to_one_flank():
    what = preload(FLOATING, posture_grid(ARM, 3).q)
    turn = turned(-WEDGE * np.array([*RAISED[what.side], 0.0]))
    pressed, free = lies(turn @ GRAVITY), lies(GRAVITY)
    assert np.abs(pressed).min() > 0.95
    assert len(np.unique(np.sign(pressed))) == 1
    assert np.abs(free).min() < 0.8
