import dataclasses

import mujoco
import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280, tcp_position
from rejoint_lab.plant import plant as plants
from rejoint_lab.plant.plant import Plant, build_model
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
REST = ARM.rest[None]


def wear(name="worn", **changes):
    return dataclasses.replace(load_wear(name, ARM), **{field: np.full(6, value) for field, value in changes.items()})


def quiet(name="worn", **changes):
    return wear(name, ripple=0.0, torque_noise=0.0, **changes)


def rows(plant, command, seconds):
    """Positions (T, B, n) of the links every 10 ms on the way to a command."""
    plant.command(command)
    track = []
    for _ in range(round(seconds / 0.01)):
        plant.advance(0.01)
        track.append(np.concatenate([plant.link_position(), plant.speed], axis=1))
    return np.array(track)


def energy(plant, of):
    """Kinetic and potential energy [J] of arm 0, with the springs of gears, bristles and mechanical stops."""
    model, data = plant.batch.get_model(0), plant.batch.get_data(0)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    mujoco.mj_forward(model, data)
    gear = plant.qpos[0, 1::2]
    bent = gear - np.clip(gear, -of.play / 2, of.play / 2)
    servo_angle = plant.qpos[0, 0::2]
    stop = servo_angle - np.clip(servo_angle, ARM.lower - np.radians(3.0), ARM.upper + np.radians(3.0))
    bristle = of.reflected_inertia * 150.0**2 * plant.servos["bristle"][0] ** 2
    return float(data.energy.sum() + 0.5 * (of.link_stiffness * bent**2 + 60.0 * stop**2 + bristle).sum())


def test_the_chain_is_the_arm():
    model = build_model(ARM)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = rng.uniform(-1, 1, 12)
        mujoco.mj_forward(model, data)
        link = data.qpos[0::2] + data.qpos[1::2]
        np.testing.assert_allclose(data.qfrc_bias[0::2], gravity_torque(ARM, link), atol=1e-9)
        rotation = data.xmat[-1].reshape(3, 3)
        np.testing.assert_allclose(data.xpos[-1] + rotation @ ARM.tip[:3, 3], tcp_position(ARM, link), atol=1e-9)


@pytest.mark.parametrize("name", ["healthy", "worn", "play-in-loop"])
def test_with_the_motors_off_energy_is_only_lost(name):
    of = quiet(name)
    plant = Plant(ARM, [of], seed=0)
    plant.set_power(False)
    levels = [energy(plant, of)]
    for _ in range(100):
        plant.advance(0.01)
        levels.append(energy(plant, of))
        assert (plant.torque == 0).all()
    assert np.diff(levels).max() < 2e-4  # [J] explicit steps store the gear springs that inexactly
    assert levels[-1] < levels[0] - 0.05


def test_without_power_a_worn_arm_collapses_and_then_rests():
    plant = Plant(ARM, [quiet()], seed=0)
    plant.set_power(False)
    before = plant.true_tcp()[0, 2]
    plant.advance(4.0)
    assert plant.true_tcp()[0, 2] < before - 0.1
    settled = plant.encoder()
    plant.advance(0.5)
    assert np.abs(plant.encoder() - settled).max() <= ARM.encoder_step
    over = np.maximum(plant.link_position() - ARM.upper, ARM.lower - plant.link_position())
    assert over.max() < np.radians(6.0)


def test_power_on_holds_where_the_arm_is():
    plant = Plant(ARM, [wear("healthy")], seed=0)
    plant.set_power(False)
    plant.advance(0.1)
    plant.set_power(True)
    held = plant.encoder()
    plant.advance(1.0)
    np.testing.assert_allclose(plant.goal, held)
    assert np.abs(plant.encoder() - held).max() < np.radians(2.0)


@pytest.mark.parametrize("name", ["healthy", "worn", "worn-true", "play-in-loop", "worn?seed=5"])
def test_a_reset_arm_is_at_rest(name):
    plant = Plant(ARM, [load_wear(name, ARM)], seed=0)
    np.testing.assert_allclose(plant.encoder() - ARM.rest, 0.0, atol=np.radians(1.1))
    tcp, before = plant.true_tcp(), plant.encoder()
    plant.advance(2.0)
    assert np.abs(plant.encoder() - before).max() <= 2 * ARM.encoder_step
    assert np.linalg.norm(plant.true_tcp() - tcp) < 1.5e-3


@pytest.mark.parametrize("play_deg", [0.5, 2.0])
def test_the_play_has_the_width_it_claims(play_deg):
    """Gravity presses joint 5 to one flank, then, with the arm turned over, to the other."""
    of = quiet(play=np.radians(play_deg), link_stiffness=1e3)
    posture = np.radians([0.0, 0.0, 0.0, 90.0, 0.0, 0.0])
    sides = []
    for sign in (-1.0, 1.0):
        plant = Plant(ARM, [of], seed=0)
        plant.reset(posture[None] * sign)
        sides.append((plant.link_position() - plant.encoder())[0, 3])
        plant.advance(1.0)
        sides[-1] = (plant.link_position() - plant.encoder())[0, 3]
    width = abs(sides[1] - sides[0])
    assert width == pytest.approx(np.radians(play_deg), abs=ARM.encoder_step + 2 * 0.08 / 1e3)


def test_the_flex_gives_way_by_torque_over_stiffness():
    of = quiet(play=0.0, link_stiffness=20.0)
    plant = Plant(ARM, [of], seed=0)
    plant.advance(1.0)
    bent = plant.qpos[0, 1::2]
    np.testing.assert_allclose(bent, -gravity_torque(ARM, plant.link_position())[0] / 20.0, atol=2e-4)


@pytest.mark.parametrize("limit_deg", [30.0, 60.0])
def test_a_motion_runs_at_the_speed_limit(limit_deg):
    plant = Plant(ARM, [quiet("healthy")], seed=0)
    plant.set_speed_limit(np.array([np.radians(limit_deg)]))
    goal = REST.copy()
    goal[0, 0] += np.radians(90.0)
    track = rows(plant, goal, 0.9)
    middle = track[40:80, 0, 6]
    assert middle.mean() == pytest.approx(np.radians(limit_deg), rel=0.02)


def test_readings_are_whole_counts_and_the_past_can_be_read():
    plant = Plant(ARM, [wear()] * 3, seed=0)
    plant.command(np.tile(ARM.rest, (3, 1)) + 0.3)
    past = []
    for _ in range(100):
        plant.advance(0.001)
        past.append(plant.encoder())
    counts = np.array(past) / ARM.encoder_step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    ages = np.array([0.0, 0.013, 0.050])
    for i, age in enumerate(ages):
        np.testing.assert_array_equal(plant.encoder(ages)[i], past[-1 - round(age * 1e3)][i])


@pytest.mark.parametrize("delay_ms", [0, 1, 9, 13])
def test_a_command_has_no_effect_before_its_delay(delay_ms):
    moved, still = (Plant(ARM, [wear()], seed=0) for _ in range(2))
    moved.command(REST + 0.3, np.array([delay_ms * 1e-3]))
    differs = []
    for _ in range(20):
        moved.advance(0.001)
        still.advance(0.001)
        differs.append((moved.link_position() != still.link_position()).any())
    assert not any(differs[:delay_ms])
    assert differs[delay_ms]


def test_a_halted_arm_stays_and_forgets_what_was_on_its_way():
    plant = Plant(ARM, [wear("healthy")], seed=0)
    goal = REST.copy()
    goal[0, 0] += np.radians(60.0)
    plant.command(goal)
    plant.advance(0.25)
    plant.command(REST, 0.01)
    plant.halt()
    there = plant.encoder()
    plant.advance(2.0)
    assert np.abs(plant.encoder() - there).max() < np.radians(6.0)
    assert np.abs(plant.speed).max() < 1e-2


def play(plant, where=None, steps=40):
    """Drive a batch about at random, each arm by its own number, and return what happened."""
    track = []
    for k in range(steps):
        numbers = np.arange(plant.count) if where is None else where
        wanted = ARM.rest + 0.3 * np.sin(0.4 * k + numbers[:, None] + np.arange(6))
        plant.command(wanted, 0.008 + 0.001 * (numbers % 4))
        plant.advance(0.02 + 0.001 * ((numbers + k) % 7))
        track.append(np.concatenate([plant.qpos, plant.qvel, plant.encoder(), plant.temperature], axis=1))
    return np.array(track)


FAMILY = [load_wear(f"worn?seed={i}", ARM) for i in range(5)]


def test_the_same_seed_gives_the_same_trajectory_bit_for_bit_at_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(plants, "ARMS_PER_THREAD", 1)
    one = play(Plant(ARM, FAMILY, seed=7))
    monkeypatch.setattr(plants, "free_cores", lambda: 2)
    np.testing.assert_array_equal(play(Plant(ARM, FAMILY, seed=7)), one)
    other = play(Plant(ARM, FAMILY, seed=8))
    assert (other[-1] != one[-1]).any(axis=1).all()


def test_an_arm_in_a_batch_is_the_same_arm_alone_bit_for_bit():
    batch = play(Plant(ARM, FAMILY, seed=7))
    for i in (0, 3):
        alone = play(Plant(ARM, [FAMILY[i]], seed=7, first=i), where=np.array([i]))
        np.testing.assert_array_equal(alone[:, 0], batch[:, i])


def test_a_frozen_encoder_tells_the_same_while_its_joint_goes_where_it_is_sent():
    plant = Plant(ARM, [quiet("healthy")] * 2, seed=0)
    plant.freeze(np.array([[False, True, False, False, False, False], [False] * 6]))
    before = plant.encoder()
    plant.command(np.tile(REST + 0.3, (2, 1)))
    plant.advance(2.0)
    assert plant.encoder()[0, 1] == before[0, 1]
    np.testing.assert_allclose(plant.link_position()[0], plant.link_position()[1], atol=1e-12)
    np.testing.assert_allclose(np.delete(plant.encoder()[0], 1), np.delete(plant.encoder()[1], 1), atol=1e-12)


def test_a_blind_servo_runs_to_its_stop_as_soon_as_it_is_moved():
    plant = Plant(ARM, [quiet("worn")], seed=0)
    joint = np.arange(6) == 0
    plant.blind(joint[None])
    plant.advance(1.0)
    assert plant.link_position()[0, 0] == pytest.approx(ARM.rest[0], abs=1e-2)  # nobody moves it
    plant.command(REST + np.where(joint, 0.2, 0.0))
    plant.advance(5.0)
    assert plant.link_position()[0, 0] > ARM.upper[0]
    assert plant.encoder()[0, 0] == pytest.approx(ARM.rest[0], abs=ARM.encoder_step)
    plant.reset(REST)
    plant.command(REST + 0.2)
    plant.advance(1.0)
    assert plant.encoder()[0, 0] > ARM.rest[0] + 0.05, "a reset brings a new encoder"
