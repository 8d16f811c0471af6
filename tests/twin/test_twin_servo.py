"""Servos whose gears rub more under load, and logs that record gains and pauses."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from rejoint.arms import mycobot280
from rejoint.logs.exclusions import powered, recorded_gain, unpowered_joints
from rejoint.logs.runlog import RunLog
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.replay import Replay, cut
from rejoint.twin.simulation import ChainBatch, Draw
from rejoint.twin.table import TableBatch

ARM = mycobot280()
RUBBING = replace(nominal_parameters(ARM), load_friction=np.full(ARM.joints, 0.4))


def log(label, gain):
    """A slow swing, answered at once."""
    time = np.arange(0.0, 4.0, 0.02)
    command = ARM.rest + 0.2 * np.sin(time)[:, None]
    none = np.full((len(time), 3), np.nan)
    return RunLog(
        arm=ARM.name, joint_names=ARM.joint_names, robot="none", label=label, time=time, position=command,
        command=command, target=none, true_tcp=none, gain=np.broadcast_to(gain, command.shape),
    )  # fmt: skip


def swung(batch):
    batch.restart(ARM.rest[None])
    path = ARM.rest + 0.3 * np.sin(np.linspace(0.3, 6.0, 400))[:, None] * np.cos(np.arange(ARM.joints))
    return batch.rollout(path[None])[0]


def chain(twin):
    batch = ChainBatch(ARM, 1)
    batch.write(Draw.of(twin.repeat(1)))
    return swung(batch)


def test_friction_that_grows_with_load_is_that_of_mujoco():
    judge = swung(TableBatch(ARM, RUBBING.repeat(1)))
    ours, plain = chain(RUBBING), chain(nominal_parameters(ARM))
    assert np.abs(ours - plain).max() > 20 * ARM.encoder_step
    assert np.abs(ours - judge).max() < 0.012 * np.abs(ours - plain).max()


def test_a_log_is_replayed_at_the_gain_that_it_records():
    weak, strong = log("weak", 100.0), log("strong", 400.0)
    gain = recorded_gain([weak, strong])
    assert_array_equal(gain, np.full(ARM.joints, 400.0))
    soft = replace(RUBBING, stiffness=0.25 * RUBBING.stiffness)
    recorded = Replay(ARM, cut([weak], 9.0), gain=gain).predict(RUBBING.repeat(1))
    assert_allclose(recorded, Replay(ARM, cut([weak], 9.0)).predict(soft.repeat(1)))


def test_a_log_without_torque_at_its_end_is_cut_there_and_keeps_its_name():
    one = log("drop", np.where(np.arange(200) < 150, 100.0, 0.0)[:, None])
    (kept,) = powered(ARM, [one])
    assert (kept.label, len(kept)) == ("drop", 150)
    limp = np.where(np.arange(200)[:, None] < 150, one.position, 9.0 * np.sin(5.0 * one.time)[:, None])
    assert unpowered_joints(replace(one, position=limp)) == ()
