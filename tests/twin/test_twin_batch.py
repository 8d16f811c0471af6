"""One writer for one model and for a batch: both move the same, bit for bit."""

import mujoco
import numpy as np

from rejoint.arms import mycobot280, tcp_position
from rejoint.twin.batch import TCP_SITE, TwinBatch
from rejoint.twin.parameters import nominal_parameters, prior, unpack
from twinmodel import twin_model

ARM = mycobot280()


def random_parameters(rng, count):
    p = prior(ARM)
    return unpack(p.mean + p.sigma * rng.standard_normal((count, len(p.mean))), ARM.joints)


def test_batch_equals_single_models_bit_for_bit():
    rng = np.random.default_rng(3)
    count, steps = 7, 150
    parameters = random_parameters(rng, count)
    timestep = rng.uniform(0.003, 0.009, count)
    gravity = rng.uniform(0.85, 1.15, count)
    start = ARM.rest + rng.normal(0, 0.1, (count, ARM.joints))
    control = start[:, None] + np.cumsum(rng.normal(0, 0.02, (count, steps, ARM.joints)), axis=1)

    batch = TwinBatch(ARM, count, threads=2)
    batch.write(parameters, timestep=timestep, gravity_scale=gravity)
    batch.restart(start)
    for k in range(steps):
        batch.ctrl[:] = control[:, k]
        batch.step()

    for i in range(count):
        model = twin_model(ARM, parameters[i], float(timestep[i]), float(gravity[i]))
        data = mujoco.MjData(model)
        data.qpos[:] = start[i]
        for k in range(steps):
            data.ctrl[:] = control[i, k]
            mujoco.mj_step(model, data)
        np.testing.assert_array_equal(batch.qpos[i], data.qpos)
        np.testing.assert_array_equal(batch.qvel[i], data.qvel)


def test_partial_write_equals_full_write_and_leaves_the_others_alone():
    rng = np.random.default_rng(4)
    parameters = random_parameters(rng, 5)
    control = ARM.rest + 0.3 * rng.standard_normal((5, 80, ARM.joints)).cumsum(axis=1) * 0.1
    whole, partial = TwinBatch(ARM, 5), TwinBatch(ARM, 5)
    whole.write(parameters, timestep=0.004, gravity_scale=1.1)
    partial.write(parameters[np.array([1, 3])], np.array([1, 3]), timestep=0.004, gravity_scale=1.1)
    mask = np.array([True, False, True, False, True])
    partial.write(parameters[mask], mask, timestep=np.full(3, 0.004), gravity_scale=np.full(3, 1.1))
    for batch in (whole, partial):
        batch.restart(np.tile(ARM.rest, (5, 1)))
    np.testing.assert_array_equal(whole.rollout(control), partial.rollout(control))

    before = partial.model(0).dof_frictionloss.copy()
    partial.write(parameters[2], np.array([4]))
    np.testing.assert_array_equal(partial.model(0).dof_frictionloss, before)
    np.testing.assert_array_equal(partial.model(4).dof_frictionloss, parameters.coulomb[2])
    assert partial.timestep.tolist() == [0.004] * 5


def test_tcp_site_agrees_with_the_arms_kinematics():
    model = twin_model(ARM, nominal_parameters(ARM))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for q in rng.uniform(ARM.lower, ARM.upper, (20, ARM.joints)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site(TCP_SITE).xpos, tcp_position(ARM, q), atol=1e-9)
