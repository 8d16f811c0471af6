"""The pushes at which joints stand, read from the logs of an arm's own motion."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.guard import GuardLimits, Reason
from rejoint.control.loop import Schedule, run
from rejoint.control.monitor import Bands, doubted, standing_bands
from rejoint.diagnosis.excitation import record
from rejoint.diagnosis.measurement import measure
from rejoint.logs.runlog import RunLog
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
DWELL = Schedule(dwell=2.0, keep_going=True)


def sticky_log(lead, offset=0.0, period=0.025):
    """A log in which every joint follows a slow wave once its lead is ``lead`` [rad] beyond what gravity takes."""
    time = np.arange(0.0, 60.0, period)
    phase = 2.0 * np.pi * time / 10.0
    command = ARM.rest + 0.3 * np.sin(phase)[:, None] * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    position = command.copy()
    for k in range(1, len(time)):
        balance = 0.1 * gravity_torque(ARM, position[k - 1]) + offset
        push = command[k - 1] - position[k - 1] - balance
        position[k] = position[k - 1] + np.sign(push) * np.maximum(np.abs(push) - lead, 0.0)
    return RunLog.of(time, command, np.round(position / ARM.encoder_step) * ARM.encoder_step, arm=ARM)


SOFT, FLAT = np.full(6, 0.1), np.zeros(6)


@pytest.mark.parametrize("lead_deg", [1.0, 3.0])
@pytest.mark.parametrize("period", [0.025, 0.05])
def test_width_is_read_from_a_log(lead_deg, period):
    log = sticky_log(np.radians(lead_deg), offset=0.02, period=period)
    found = standing_bands(ARM, [log], SOFT, FLAT + 0.02)
    np.testing.assert_allclose(np.degrees(found.width), lead_deg, atol=0.5)


def test_a_joint_whose_law_is_unknown_stays_unknown():
    law = np.where(np.arange(6) == 2, np.nan, FLAT)
    width = standing_bands(ARM, [sticky_log(np.radians(1.0))], SOFT, law).width
    assert np.isinf(width).tolist() == np.isnan(law).tolist()
    assert np.isinf(standing_bands(ARM, [], SOFT, FLAT).width).all()


def test_a_servo_that_gives_no_more_has_a_short_reach():
    """A joint that stood at a lead of 19 deg against gravity stands inside a narrow band if its servo gives no more."""
    moving = sticky_log(np.radians(1.0))
    position = np.tile(moving.position[:1], (80, 1))
    command = position + np.radians(19.0) * np.sign(gravity_torque(ARM, position))
    nowhere = np.full((80, 3), np.nan)
    stood = replace(moving, time=moving.time[:80], position=position, command=command, target=nowhere, true_tcp=nowhere)
    weak, strong = (standing_bands(ARM, logs, SOFT, FLAT) for logs in ([moving, stood], [moving]))
    assert np.degrees(weak.reach[1]) < 10.0
    assert np.degrees(weak.width[1]) < 5.0
    assert np.degrees(strong.reach).min() > 15.0


def bands_of(logs):
    """Bands of an arm by what its diagnosis measures."""
    return standing_bands(ARM, (logs.excitation, logs.targets), *measure(ARM, logs.excitation).balance(ARM))


WORN = 6


@pytest.fixture(scope="module")
def diagnosed():
    """Worn arms, a healthy one, one with play: their wears, logs and bands."""
    names = [*(f"worn?seed={500 + i}" for i in range(WORN)), "healthy?seed=70", "play-in-loop?seed=70"]
    wears = [load_wear(name, ARM) for name in names]
    logs = record(EmulatedRobot(ARM, wears, seed=4, tells_load=False), seed=0)
    return wears, logs, [bands_of(log) for log in logs]


def test_bands_of_emulated_arms_hold_their_friction_and_none_is_overdue_in_its_own_diagnosis(diagnosed):
    for wear, logs, bands in list(zip(*diagnosed, strict=True))[WORN:]:
        friction = wear.stiction[:3] / wear.position_gain[:3]
        assert (bands.width[:3] > 0.5 * friction).all()
        assert (bands.width[:3] < 2.5 * friction + np.radians(0.5)).all()
        assert not doubted(ARM, (logs.excitation, logs.targets), bands).any()


@pytest.fixture(scope="module")
def worn(diagnosed):
    """Worn arms, the limits by their bands, and what they do when nothing is broken."""
    wears, bands = diagnosed[0][:WORN], diagnosed[2][:WORN]
    bands = Bands(**{f: np.array([getattr(b, f) for b in bands]) for f in ("slope", "offset", "reach", "width")})
    limits = replace(GuardLimits.of(ARM), bands=bands)
    return wears, limits, drive(wears, limits)


@pytest.mark.parametrize("blind", [False, True])
def test_dead_encoders_of_worn_arms_that_tell_no_load_are_noticed(worn, blind):
    wears, limits, whole = worn
    assert (whole.tripped == 0).all(), "nothing is broken"
    broken, near = drive(wears, limits, 0.7, blind), 0
    for b in range(WORN):
        mine = [np.flatnonzero(one.active[:, b]) for one in (broken, whole)]
        trip = np.flatnonzero(broken.reasons[mine[0], b] & Reason.NOT_FOLLOWING)
        last = trip[0] + 1 if len(trip) else len(mine[0])
        off = broken.true_tcp[mine[0][:last], b] - whole.true_tcp[mine[1][:last], b]
        near += np.linalg.norm(off, axis=-1).max() < 0.030
    assert near >= (4 if blind else WORN), "docs/faults.md has the figures of many"
    assert np.count_nonzero(broken.tripped) >= 5


def drive(wears, limits, at=np.inf, blind=False):
    robot = EmulatedRobot(ARM, wears, seed=9, tells_load=False)
    dead = np.arange(ARM.joints) == (np.arange(WORN) % 3)[:, None]

    def break_it(cycle):
        if cycle.time[0] >= at:
            (robot.plant.blind if blind else robot.plant.freeze)(dead)

    targets = ARM.targets.sample(np.random.default_rng(1), (len(wears), 2))
    return run(robot, make_controller("integrator", ARM), targets, DWELL, limits=limits, on_cycle=break_it)
