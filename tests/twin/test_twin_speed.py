"""What makes the twin's physics fast must not change its results."""

import mujoco
import numpy as np

from rejoint.arms import mycobot280
from rejoint.twin.parameters import nominal_parameters
from twinmodel import twin_model

ARM = mycobot280()


def swing(solver):
    """Positions (400, n) [rad] of a twin that follows a slow swing and sticks at its turning points."""
    model = twin_model(ARM, nominal_parameters(ARM))
    model.opt.solver = solver
    data = mujoco.MjData(model)
    data.qpos[:] = ARM.rest
    positions = []
    for k in range(400):
        data.ctrl[:] = ARM.rest + 0.2 * np.sin(0.02 * k + np.arange(ARM.joints))
        mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
    return np.array(positions)


def test_both_solvers_of_dry_friction_agree_far_below_an_encoder_step():
    ours = swing(twin_model(ARM, nominal_parameters(ARM)).opt.solver)
    newton = swing(mujoco.mjtSolver.mjSOL_NEWTON)
    assert np.ptp(newton, axis=0).min() > 0.05
    assert np.abs(ours - newton).max() < 1e-3 * ARM.encoder_step
