"""MuJoCo's own model of one twin, as the judge of the batches."""

import mujoco
import numpy as np

from rejoint.twin.batch import FRICTION_SOFTNESS, TIMESTEP, model_fields, twin_spec


def twin_model(arm, parameters, timestep=TIMESTEP, gravity_scale=1.0):
    """Compile the model of one twin, with the arm's joint order and names."""
    model = twin_spec(arm).compile()
    for name, value in model_fields(parameters, np.asarray(timestep), np.asarray(gravity_scale)):
        if name == "opt.timestep":
            model.opt.timestep = float(value)
        elif name == "opt.gravity":
            model.opt.gravity = value
        else:
            getattr(model, name)[:] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.dof_invweight0 *= FRICTION_SOFTNESS
    return model
