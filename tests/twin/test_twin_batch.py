"""One writer for one model and for a batch: both move the same, bit for bit."""

from dataclasses import replace

import mujoco
import numpy as np

from rejoint.arms import mycobot280
from rejoint.twin.parameters import prior, unpack
from rejoint.twin.table import TableBatch
from twinmodel import twin_model

ARM = mycobot280()


def random_parameters(rng, count):
    p = prior(ARM)
    drawn = unpack(p.mean + p.sigma * rng.standard_normal((count, len(p.mean))))
    none = 0.0 * drawn.coulomb
    return replace(drawn, load_friction=none, stiction=none + 1.0)  # as in MuJoCo's models


def test_batch_equals_single_models_bit_for_bit():
    rng = np.random.default_rng(3)
    count, steps = 7, 150
    parameters = random_parameters(rng, count)
    timestep = rng.uniform(0.003, 0.009, count)
    gravity = rng.uniform(0.85, 1.15, count)
    start = ARM.rest + rng.normal(0, 0.1, (count, ARM.joints))
    control = start[:, None] + np.cumsum(rng.normal(0, 0.02, (count, steps, ARM.joints)), axis=1)

    batch = TableBatch(ARM, parameters, timestep=timestep)
    batch._batch.expand("opt.gravity")[:] *= gravity[:, None]
    batch.restart(start)
    batch.rollout(control)

    for i in range(count):
        model = twin_model(ARM, parameters[i], float(timestep[i]), float(gravity[i]))
        data = mujoco.MjData(model)
        data.qpos[:] = start[i]
        for k in range(steps):
            data.ctrl[:] = control[i, k]
            mujoco.mj_step(model, data)
        np.testing.assert_array_equal(batch.qpos[i], data.qpos)
        np.testing.assert_array_equal(batch.qvel[i], data.qvel)
