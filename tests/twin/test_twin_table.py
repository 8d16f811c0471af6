"""The table under the tip, as MuJoCo simulates it: statics by hand."""

import numpy as np
import pytest
from benchmarks.mujocotwin import TableBatch, TablePlane
from motion_logs import ARM, TRUTH, surface

from rejoint.arms import gravity_torque, tcp_position
from rejoint.arms.kinematics import position_kinematics

PUSH = np.array([0.0, 0.9, 0.2, 0.4, 0.0])


def smooth(**changes):
    return TablePlane(
        **({"height": -0.09, "slope_x": 0.0, "slope_y": 0.0, "stiffness": 1000.0, "friction": 0.3} | changes)
    )


@pytest.mark.parametrize("table", [smooth(), smooth(stiffness=8000.0), smooth(friction=0.0, height=-0.08)])
def test_a_pressed_tip_gives_by_force_over_stiffness(table):
    nearly_smooth = {f: getattr(TRUTH, f) for f in ("stiffness", "damping", "armature", "torque_limit", "delay")}
    parameters = type(TRUTH)(**nearly_smooth, coulomb=[1e-3] * 5, offset=[0.0] * 5, ramp_speed=40.0)
    batch = TableBatch(ARM, parameters.repeat(1), [table], 0.01)
    batch.restart((PUSH - [0, 0.4, 0, 0, 0])[None])
    batch.rollout(np.tile(PUSH, (1, 1500, 1)))
    q = batch.qpos[0]
    motor = parameters.stiffness * (PUSH - q)
    force = np.linalg.lstsq(position_kinematics(ARM, q)[1].T, gravity_torque(ARM, q) - motor, rcond=None)[0]
    tip = tcp_position(ARM, q)
    assert force[2] > 3.0
    assert surface(table, tip) - tip[2] == pytest.approx(force[2] / table.stiffness, rel=0.02)
    assert np.hypot(force[0], force[1]) <= table.friction * force[2] + 0.05


def test_every_simulation_has_its_own_table():
    tables = [smooth(height=-0.09), smooth(height=-0.06), smooth(height=-0.09, slope_x=0.2)]
    batch = TableBatch(ARM, TRUTH.repeat(3), tables, 0.01)
    batch.restart(np.tile(PUSH - [0, 0.4, 0, 0, 0], (3, 1)))
    batch.rollout(np.tile(PUSH, (3, 600, 1)))
    tip = tcp_position(ARM, batch.qpos)
    for table, point in zip(tables, tip, strict=True):
        assert -0.03 < point[2] - surface(table, point) < 0.0
    assert tip[1, 2] > tip[0, 2] + 0.015
