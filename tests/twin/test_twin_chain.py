"""The compiled step of free twins: MuJoCo is its judge, and every arm moves as if it were alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rejoint.arms import mycobot280, so101
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import ChainBatch, Draw
from rejoint.twin.step import GROUP, LANES
from rejoint.twin.table import TableBatch

ARMS = {"mycobot280": mycobot280(), "so101": so101()}


def drawn(arm, count, rng, **changes):
    """Twins that differ, states of fast motion and references beside them."""
    twins = nominal_parameters(arm).repeat(count)
    names = ("stiffness", "damping", "armature", "torque_limit", "coulomb")
    shape = (count, arm.joints)
    spread = {name: getattr(twins, name) * rng.uniform(0.5, 2.0, shape) for name in names}
    twins = replace(twins, **spread, offset=rng.normal(0.0, 0.01, shape))
    position, velocity = rng.uniform(-2.0, 2.0, shape), rng.normal(0.0, 2.0, shape)
    return (
        replace(twins, **{name: value + 0.0 * twins.stiffness for name, value in changes.items()}),
        position,
        velocity,
    )


def both(arm, twins, position, velocity, timestep=0.005, gravity_scale=1.0):
    judge, chain = TableBatch(arm, twins, (), timestep), ChainBatch(arm, len(position))
    scale = np.broadcast_to(gravity_scale, len(position))
    judge._batch.expand("opt.gravity")[:] *= scale[:, None]
    chain.write(replace(Draw.of(twins), gravity_scale=scale))
    chain.timestep[:] = timestep
    for batch in (judge, chain):
        batch.restart(position, velocity)
    return judge, chain


@pytest.mark.parametrize("name", ARMS)
def test_a_step_without_friction_is_that_of_mujoco(name):
    arm, rng = ARMS[name], np.random.default_rng(1)
    twins, position, velocity = drawn(arm, 40, rng, coulomb=1e-12)
    judge, chain = both(
        arm, twins, position, velocity, timestep=rng.uniform(0.002, 0.009, 40), gravity_scale=rng.uniform(0.8, 1.2, 40)
    )
    for batch in (judge, chain):
        control = position + np.random.default_rng(2).normal(0.0, 0.3, position.shape)
        batch.rollout(np.repeat(control[:, None], 20, axis=1))
    assert np.abs(chain.qvel - velocity).max() > 1.0
    assert_allclose(chain.qvel, judge.qvel, rtol=0.0, atol=1e-11)
    assert_allclose(chain.qpos, judge.qpos, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_joints_that_stick_and_slip_are_those_of_mujoco_where_its_own_law_is_exact(name):
    """Without damping both solve the same regularised law; MuJoCo takes the damping out of what friction meets."""
    arm, rng = ARMS[name], np.random.default_rng(3)
    twins, _, _ = drawn(arm, 40, rng, damping=1e-12)
    start = np.tile(arm.rest, (40, 1))
    judge, chain = both(arm, twins, start, 0.0)
    reference = start + rng.normal(0.0, 0.05, start.shape)
    stuck = 0
    for _ in range(30):
        for batch in (judge, chain):
            batch.rollout(reference[:, None])
        stuck += np.count_nonzero(np.abs(chain.qvel) < 1e-6)
        assert_allclose(chain.qvel, judge.qvel, rtol=0.0, atol=1e-5)
    assert 50 < stuck < 30 * start.size / 2


def test_friction_holds_a_joint_for_ten_minutes_and_lets_it_go_at_its_limit():
    arm = ARMS["mycobot280"]
    start = np.tile(arm.rest, (2, 1))
    twins = replace(nominal_parameters(arm).repeat(2), armature=np.full((2, 6), 0.02))
    load = np.zeros((2, 6))
    load[:, 0] = np.array([0.999, 1.001]) * twins.coulomb[:, 0] / twins.stiffness[:, 0]  # joint 1 carries no weight
    chain = ChainBatch(arm, 2, timestep=0.01)
    chain.write(replace(Draw.of(twins), gravity_scale=np.zeros(2)))
    chain.restart(start)
    chain.rollout(np.repeat((start + load)[:, None], 60_000, axis=1))
    assert abs(chain.qpos[0, 0] - start[0, 0]) < arm.encoder_step
    assert chain.qpos[1, 0] - start[1, 0] > 0.0


@pytest.mark.parametrize("threads", [1, 3])
def test_every_arm_moves_to_the_bit_as_it_does_alone(threads):
    arm, rng, count = ARMS["mycobot280"], np.random.default_rng(4), 3 * LANES + 5
    twins, position, velocity = drawn(arm, count, rng)
    control = position[:, None] + rng.normal(0.0, 0.2, (count, 12, 6))
    twins = replace(twins, stiction=rng.uniform(1.0, 2.0, (count, 6)))
    together = ChainBatch(arm, count, threads=threads)
    together.write(Draw.of(twins))
    together.restart(position, velocity)
    path = together.rollout(control)
    for i in (0, GROUP, LANES - 1, LANES, count - GROUP, count - 1):
        alone = ChainBatch(arm, 1)
        alone.write(Draw.of(twins[i : i + 1]))
        alone.restart(position[i : i + 1], velocity[i : i + 1])
        assert_array_equal(alone.rollout(control[i : i + 1])[0], path[i])
