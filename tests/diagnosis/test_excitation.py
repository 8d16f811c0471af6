"""The plan of the excitation is safe, reproducible, and excites what it says."""

import numpy as np
import pytest

from rejoint.arms import frames, gravity_torque, mycobot280
from rejoint.arms.workspace import heaviest_load
from rejoint.diagnosis.excitation import Plan, plan_excitation

ARM = mycobot280()


@pytest.mark.parametrize("seed", range(5))
def test_every_posture_is_safe_and_slow_enough(seed):
    excitation = plan_excitation(ARM, seed=seed)
    time = np.arange(0.0, excitation.duration, 0.01)
    q = excitation.command(time)
    f = frames(ARM, q)
    assert (q > ARM.lower + np.radians(5)).all()
    assert (q < ARM.upper - np.radians(5)).all()
    assert f.position[:, 1:, 2].min() > ARM.floor + 0.04
    assert f.tcp_position[:, 2].min() > ARM.floor + 0.04
    assert np.abs(np.diff(q, axis=0)).max() / 0.01 <= 2.0 + 1e-9
    assert (np.abs(gravity_torque(ARM, q)).max(axis=0) <= heaviest_load(ARM) + 0.021).all()


def test_segments_follow_each_other_and_are_named_once():
    excitation = plan_excitation(ARM, seed=3)
    names = [s.name for s in excitation.segments]
    assert len(set(names)) == len(names)
    for before, after in zip(excitation.segments, excitation.segments[1:], strict=False):
        assert before.start < before.stop <= after.start
    assert {s.kind for s in excitation.segments} == {"approach", "still", "sweep", "step", "multisine", "hold"}
    for kind, least in (("sweep", 12), ("step", 4), ("multisine", 1), ("hold", 8)):
        for joint in range(ARM.joints):
            assert sum(s.kind == kind and joint in s.joints for s in excitation.segments) >= least


def test_command_is_held_before_and_after_and_takes_any_shape():
    excitation = plan_excitation(ARM, seed=0)
    assert np.array_equal(excitation.command(-1.0), excitation.position[0])
    assert np.array_equal(excitation.command(1e6), excitation.position[-1])
    assert excitation.command(np.zeros((2, 3))).shape == (2, 3, ARM.joints)


def test_sweeps_move_at_their_speeds_and_holds_stand_still():
    excitation = plan_excitation(ARM, seed=0)
    for segment in excitation.segments:
        middle = (segment.start + segment.stop) / 2
        speed = (excitation.command(middle + 0.01) - excitation.command(middle - 0.01)) / 0.02
        if segment.kind == "sweep":
            expected = Plan().sweep_speeds[int(segment.name.split("/")[1])]
            assert np.allclose(np.abs(speed[list(segment.joints)]), expected)
        elif segment.kind in ("hold", "still"):
            assert np.allclose(speed, 0.0)


def test_multisine_has_no_line_above_its_band():
    excitation = plan_excitation(ARM, seed=0)
    (segment,) = [s for s in excitation.segments if s.kind == "multisine"]
    time = np.arange(segment.start, segment.start + Plan().multisine_period, 0.02)
    spectrum = np.abs(np.fft.rfft(excitation.command(time) - ARM.rest, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(time), 0.02)
    assert (spectrum[frequency > Plan().multisine_band + 0.5].sum(axis=0) < 1e-3 * spectrum.sum(axis=0)).all()
