"""The twin's physics: sag, friction, saturation and energy have the values they must have."""

from dataclasses import replace

import mujoco
import numpy as np

from rejoint.arms import gravity_torque
from rejoint.twin.parameters import (
    PARAMETERS,
    Layout,
    healthy_parameters,
    nominal_parameters,
    prior,
    unpack,
    vector_names,
)
from rejoint.twin.simulation import Draw, Simulation
from rejoint.twin.table import TableBatch
from twinmodel import twin_model


def changed(arm, **values):
    start = nominal_parameters(arm)
    fields = {p.name: getattr(start, p.name) for p in PARAMETERS}
    shaped = {name: np.broadcast_to(value, fields[name].shape) for name, value in values.items()}
    return type(start)(**(fields | shaped))


def settle(arm, parameters, command, seconds=8.0):
    batch = TableBatch(arm, parameters.repeat(1))
    batch.restart(command[None])
    batch.rollout(np.tile(command, (1, int(seconds / 0.005), 1)))
    return batch


def test_static_sag_is_gravity_torque_over_stiffness(arm):
    parameters = changed(arm, coulomb=1e-9, torque_limit=5.0, offset=0.01, damping=1.0)
    q = settle(arm, parameters, arm.rest).qpos[0]
    sag = arm.rest + 0.01 - q
    np.testing.assert_allclose(sag, gravity_torque(arm, q) / parameters.stiffness, atol=1e-6)
    assert np.abs(sag).max() > np.radians(1.0)


def test_a_saturated_servo_gives_its_limit(arm):
    parameters = changed(arm, torque_limit=0.3)
    model = twin_model(arm, parameters)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = arm.rest, arm.rest + 1.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, 0.3)
    data.ctrl[:] = arm.rest - 0.01
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, -0.01 * parameters.stiffness, rtol=1e-9)


def test_a_joint_at_rest_sticks_under_a_load_that_a_moving_one_yields_to(arm):
    parameters = changed(arm, coulomb=0.1, stiffness=5.0, damping=0.2, torque_limit=5.0)
    lead = np.zeros(6)
    lead[5] = 0.12 / 5.0  # 0.12 N m on the joint that gravity does not load: between 0.10 and 0.15
    moved = []
    for stiction in (1.0, 1.5):
        simulation = Simulation(arm, 1)
        simulation.place(
            Draw.of(replace(parameters, stiction=np.full(6, stiction)).repeat(1)), arm.rest[None], arm.rest[None]
        )
        moved.append(np.abs(simulation.twins.rollout(np.tile(arm.rest + lead, (1, 100, 1)))[0, -1, 5] - arm.rest[5]))
    assert moved[0] > 1e-3
    assert moved[1] < 1e-5


def test_prior_scales_with_the_arm_and_contains_its_twins(arm):
    belief, names = prior(arm), vector_names(arm.joint_names)
    assert len(names) == len(belief.mean) == 9 * arm.joints + 2
    fitted = Layout(arm.joints).is_fitted
    assert (belief.lower <= belief.mean)[fitted].all()
    assert (belief.mean < belief.upper).all()
    nominal, healthy = nominal_parameters(arm), healthy_parameters(arm)
    np.testing.assert_allclose(nominal.stiffness, [7, 7, 5.6, 5.6, 5.6, 5.6], rtol=0.02)
    assert (healthy.stiffness > 3 * nominal.stiffness).all()
    drawn = unpack(np.clip(belief.mean + 9 * belief.sigma, belief.lower, belief.upper))
    assert (drawn.stiffness <= 200.1).all()
