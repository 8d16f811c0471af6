"""Laws of the guard: finite, bounded, idempotent, transparent, the same for one arm and for many."""

import dataclasses

import numpy as np
import pytest

from modelfiles import resized
from rejoint.arms import frames, mycobot280, tcp_position
from rejoint.arms.collision import clearances, collision_shape
from rejoint.control.guard import RAMP, GuardLimits, Reason, clear_by, guard, reason_names
from rejoint.system.errors import InputError
from standin import state_of

ARM = mycobot280()
LIMITS = GuardLimits.of(ARM)
PERIOD = 0.025
REACH = ARM.max_speed * PERIOD


def one(command, sent=None, position=None, limits=LIMITS):
    sent = ARM.rest if sent is None else sent
    position = sent if position is None else position
    return guard(limits, np.atleast_2d(command), np.atleast_2d(sent), np.zeros((1, 6)), state_of(position), PERIOD)


def posture_at(height):
    """Shoulder angle at which the stretched arm's TCP is at ``height`` [m]."""
    angles = np.linspace(0.0, np.radians(139.0), 20_000)
    q = np.zeros((len(angles), 6))
    q[:, 1] = -angles
    heights = tcp_position(ARM, q)[:, 2]
    return q[np.argmax(heights < height)]


def test_a_sagging_arm_is_not_brought_nearer_than_its_margin_by_any_joint():
    rng, cases = np.random.default_rng(4), 0
    while cases < 60:
        measured = rng.uniform(LIMITS.lower, LIMITS.upper)
        here = clearances(ARM, measured).min(axis=-1)
        if not 0.0 < here < 0.02:
            continue
        sent = measured + np.radians(8.0) * rng.uniform(-1.0, 1.0, 6)
        if clearances(ARM, sent).min(axis=-1) < 0.03 or not (clear_by(LIMITS, sent)[:6] > 0.0).all():
            continue
        cases += 1
        command = sent + np.radians(3.0) * rng.uniform(-1.0, 1.0, 6)
        step = np.diag(one(command, sent=sent, position=measured).command[0] - sent)
        before, after = clear_by(LIMITS, measured)[6:], clear_by(LIMITS, measured + step)[:, 6:]
        assert (after > np.minimum(before, LIMITS.near[6:]) - 1e-5).all()


def test_floor_scales_the_step_back_and_lets_the_arm_leave():
    limits = dataclasses.replace(LIMITS, collisions=False)
    sent = posture_at(ARM.floor + 0.002)
    down = posture_at(ARM.floor - 0.01)
    down = sent + (down - sent) * min(1.0, 0.9 * REACH[1] / np.abs(down - sent).max())
    out = one(down, sent=sent, limits=limits)
    assert out.reasons[0] == Reason.FLOOR
    assert 0.0 <= tcp_position(ARM, out.command[0])[2] - ARM.floor < 0.001
    below = posture_at(ARM.floor - 0.005)
    up = below + 0.5 * (sent - below)
    assert (one(up, sent=below, limits=limits).command[0] == up).all()
    held = one(below - 0.3 * (sent - below), sent=below, limits=limits)
    assert held.reasons[0] == Reason.FLOOR
    np.testing.assert_allclose(held.command[0], below, atol=1e-6)


def elbow(degrees):
    """Posture whose wrist comes near the upper arm: it touches from 139.2 deg on, see test_collision.py."""
    return np.radians([0.0, 0, degrees, -degrees, 0, 0])


def test_a_contact_ends_the_step_and_may_be_left():
    radius = collision_shape(ARM).radius
    touching = np.degrees(np.pi - np.arcsin(2 * radius / 0.096))  # forearm of 96 mm, capsules two radii thick
    out = one(elbow(touching + 1.0), sent=elbow(touching - 1.0))
    assert out.reasons[0] == Reason.COLLISION
    assert touching - 0.13 < np.degrees(out.command[0, 2]) <= touching
    deeper = one(elbow(touching + 2.0), sent=elbow(touching + 1.0))
    assert deeper.reasons[0] == Reason.COLLISION
    np.testing.assert_allclose(deeper.command[0], elbow(touching + 1.0), atol=1e-6)
    back = one(elbow(touching), sent=elbow(touching + 1.0))
    assert back.reasons[0] == 0
    assert (back.command[0] == elbow(touching)).all()


def test_the_table_is_a_contact_of_housings():
    # Stretched out level the arm is 131 mm high; turned down about its shoulder, the wrist's housing comes first.
    level = np.radians([0.0, -90, 0, 0, 0, 0])
    sent, speed = level[None], np.zeros((1, 6))
    for _ in range(100):
        sent, reasons, speed = guard(LIMITS, sent - [0, 0.03, 0, 0, 0, 0], sent, speed, state_of(sent), PERIOD)
    assert reasons[0] & Reason.COLLISION
    shape = collision_shape(ARM)
    ends = np.append(frames(ARM, sent[0]).position[2:, 2], tcp_position(ARM, sent[0])[2])
    assert ends.min() == pytest.approx(shape.radius, abs=1e-3)
    assert ends.min() >= shape.radius


def test_a_ground_that_the_tool_may_pass_is_no_ground():
    pedestal = dataclasses.replace(ARM, floor=-0.4)
    down = np.radians([0.0, -135, 0, 0, 0, 0])
    on_table, above = (
        guard(GuardLimits.of(arm), down[None], down[None] + 0.01, np.zeros((1, 6)), state_of(down), PERIOD)
        for arm in (ARM, pedestal)
    )
    assert on_table.reasons[0] & (Reason.COLLISION | Reason.FLOOR)
    assert above.reasons[0] == 0


@pytest.mark.parametrize("period", [RAMP, 0.025, 0.05])
def test_regular_periods_let_an_arm_start_and_stop_at_once(period):
    rest, full = ARM.rest[None], ARM.max_speed[None]
    for speed, wanted in ((0 * full, full), (full, 0 * full), (full, full), (full, 0.1 * full)):
        assert guard(LIMITS, rest + 0.999 * period * wanted, rest, speed, state_of(rest), period).reasons[0] == 0
    back = guard(LIMITS, rest - 0.999 * period * full, rest, full, state_of(rest), period)
    assert back.reasons[0] == (Reason.ACCELERATION if period < 2 * RAMP else 0)


def test_names_and_bad_limits():
    assert reason_names(Reason.STEP | Reason.NOT_FINITE) == ("step", "not finite")
    assert reason_names(0) == ()
    no = np.full(6, np.nan)
    for wrong in ({"lower": LIMITS.upper}, {"max_speed": no}, {"max_acceleration": no}, {"floors": no}):
        with pytest.raises(InputError, match="lower must be below upper"):
            dataclasses.replace(LIMITS, **wrong)


def test_clearances_go_with_the_size_of_the_arm_and_follow_its_floor():
    assert LIMITS.floors[-2:].tolist() == [0.03, 0.02]
    double = GuardLimits.of(dataclasses.replace(resized(ARM, 2.0), floor=0.04))
    assert double.floors[0] == pytest.approx(2 * LIMITS.floors[0])
    on_a_pedestal = GuardLimits.of(dataclasses.replace(ARM, floor=-0.5))
    assert on_a_pedestal.floors[0] == pytest.approx(-0.49)
