"""One control period of randomised twins: what passes between two decisions of whoever drives them."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.training.play import Play
from rejoint.training.wire import Wire, follow
from rejoint.twin.batch import TwinBatch

SUBSTEPS = 6
"""Physics steps in a control cycle: 3 ms each at the shortest period, 9 ms at the longest."""


def pass_period(
    twins: TwinBatch, play: Play, wire: Wire, reference: Array, *, ramp: Array, time: Array, period: Array
) -> Array:
    """Let ``period`` (N,) [s] pass for N twins whose clocks show ``time`` (N,) [s].

    Their servos' ``reference`` (N, n) [rad] follows the commands on the ``wire`` at ``ramp`` (N,) [rad/s]; returns
    where it ends. The positions that are passed are recorded on the wire.
    """
    substep = period / SUBSTEPS
    twins.set_timestep(substep)
    starts = time[:, None] + substep[:, None] * np.arange(SUBSTEPS)
    references = follow(reference, wire.in_force(starts), ramp * substep)
    passed = np.empty_like(references)
    for k in range(SUBSTEPS):
        twins.ctrl[:] = references[:, k]
        play.drive(twins, substep)
        twins.step()
        passed[:, k] = twins.qpos
    wire.record(starts + substep[:, None], passed)
    return references[:, -1].copy()
