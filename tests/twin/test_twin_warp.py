"""Twins that a GPU would step, on the processor: the kernel is that of the compiled step, to the last digits."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rejoint.arms import load_arm
from rejoint.system.errors import InputError
from rejoint.twin.chain.batch import ChainBatch
from rejoint.twin.friction import friction_terms
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import Draw, Simulation

pytest.importorskip("warp", reason="the extra gpu is not installed")

from rejoint.twin.chain.warpbatch import WarpBatch, device_at_hand

STEPS = 60


@pytest.mark.parametrize(("name", "stiction"), [("mycobot280", 1.8), ("so101", 1.0)])
def test_the_kernel_steps_as_the_compiled_loop_does(name, stiction):
    arm, rng, count = load_arm(name), np.random.default_rng(1), 37
    twins = nominal_parameters(arm).repeat(count)
    twins = replace(twins, stiffness=twins.stiffness * rng.uniform(0.5, 2.0, twins.stiffness_shape))
    position, velocity = rng.uniform(-2.0, 2.0, (2, count, arm.joints))
    control = position[:, None] + rng.normal(0.0, 0.3, (count, STEPS, arm.joints))
    terms, timestep, gravity = (
        friction_terms(twins, stiction),
        rng.uniform(0.002, 0.009, count),
        rng.uniform(0, 2, count),
    )
    paths = []
    for batch in (ChainBatch(arm, count), WarpBatch(arm, count, device="cpu")):
        batch.write(twins, timestep=timestep, gravity_scale=gravity)
        batch.restart(position, velocity)
        paths.append((batch.rollout(control, terms), batch.rollout(control), batch.qvel.copy(), batch.ctrl.copy()))
    assert np.ptp(paths[0][0], axis=1).max() > 0.5
    for ours, theirs in zip(*paths, strict=True):
        assert_allclose(theirs, ours, rtol=0.0, atol=1e-9)


def test_a_driven_simulation_is_the_same_on_either():
    """Delays, servo references, backlash and stiction around the step, as in training."""
    arm, rng, count = load_arm("so101"), np.random.default_rng(2), 5
    draw = replace(
        Draw.of(nominal_parameters(arm).repeat(count), stiction=1.5), backlash=np.full((count, arm.joints), 0.02),
        grease=np.full(count, 0.1),
    )  # fmt: skip
    start = np.tile(arm.rest, (count, 1))
    seen = []
    goals = start + rng.normal(0.0, 0.2, (12, count, arm.joints))
    for device in (None, "cpu"):
        simulation = Simulation(arm, count, device=device)
        simulation.place(draw, start, start)
        for goal in goals:
            simulation.send(goal)
            simulation.advance(np.full(count, 0.03))
        seen.append(simulation.twins.qpos.copy())
    assert np.abs(seen[0] - start).max() > 0.1
    assert_allclose(seen[1], seen[0], rtol=0.0, atol=1e-9)


def test_without_a_gpu_the_processors_simulate_and_a_warning_says_so(monkeypatch, caplog):
    import warp

    monkeypatch.setattr(warp, "get_cuda_devices", list)
    with caplog.at_level(logging.WARNING, "rejoint"):
        assert device_at_hand("cpu") is None
        assert not caplog.records
        assert device_at_hand("cuda:3") is None
    assert "cuda:3: there is no GPU" in caplog.text
    monkeypatch.setattr(warp, "get_cuda_devices", lambda: ["cuda:0"])
    assert device_at_hand("cuda") == "cuda:0"
    with pytest.raises(InputError, match="expected cpu, cuda"):
        device_at_hand("tpu")
