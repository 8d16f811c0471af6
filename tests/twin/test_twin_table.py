"""The table under the tip: statics by hand, and its fit to known truth."""

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, pressing, record, surface

from rejoint.arms import gravity_torque, tcp_position
from rejoint.arms.kinematics import position_kinematics
from rejoint.logs.exclusions import find_exclusions
from rejoint.twin.replay import Replay, cut_windows
from rejoint.twin.table import TableBatch, fit_table
from rejoint.twin.twin import TablePlane

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


def test_the_fit_finds_the_table():
    truth = TablePlane(height=-0.02, slope_x=0.03, slope_y=-0.02, stiffness=1500.0, friction=0.25)
    logs = [record("press", *pressing(), table=truth), record("aside", *pressing(18.0, 0.55), table=truth)]
    rows = find_exclusions(ARM, logs, truth.height)
    replay = Replay(ARM, cut_windows(rows, 8.0, contact=True), 0.01)
    found = fit_table(replay, TRUTH, height=-0.03)
    points = tcp_position(ARM, np.concatenate([log.position[r.contact] for log, r in zip(logs, rows, strict=True)]))
    assert np.abs(surface(found, points) - surface(truth, points)).max() < 0.002
    assert found.stiffness == pytest.approx(truth.stiffness, rel=0.3)
