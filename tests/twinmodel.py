"""MuJoCo's own model of one twin, as the judge of the batches."""

from rejoint.twin.table import TableBatch


def twin_model(arm, parameters, timestep=0.005, gravity_scale=1.0):
    """Compile the model of one twin, with the arm's joint order and names."""
    return TableBatch(arm, parameters.repeat(1), timestep=timestep, gravity_scale=gravity_scale).model(0)
