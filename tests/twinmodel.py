"""MuJoCo's own model of one twin, as the judge of the batches, and the replay of one log."""

from rejoint.twin.replay import Replay, Window
from rejoint.twin.table import TableBatch


def twin_model(arm, parameters, timestep=0.005, gravity_scale=1.0):
    """Compile the model of one twin, with the arm's joint order and names."""
    batch = TableBatch(arm, parameters.repeat(1), timestep=timestep)._batch
    batch.expand("opt.gravity")[:] *= gravity_scale
    return batch.get_model(0)


def predict(arm, parameters, log, timestep=0.005):
    """Open-loop positions (T, n) [rad] from the first measured state."""
    return Replay(arm, [Window(log=log, first=0, last=len(log))], timestep).predict(parameters.repeat(1))[0]
