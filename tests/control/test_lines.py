"""The lines of load over error that the logs of an arm's own motion tell."""

from dataclasses import replace

import numpy as np
import pytest
from test_following import bands_of

from rejoint.arms import mycobot280
from rejoint.control import compiled
from rejoint.control.monitor import Following, Knowledge, servo_lines
from rejoint.diagnosis.excitation import record
from rejoint.logs.runlog import RunLog
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from standin import state_of

ARM = mycobot280()
STEP = ARM.encoder_step
GAIN = np.array([5.0, 8.0, 12.0, 20.0, 30.0, 60.0])


def standing_log(gain=GAIN, offset=0.01, noise=0.0, holds=20, lead=0.02):
    """A log of joints that stand while their commands are held, each hold at another lead up to ``lead`` [rad]."""
    rng, rows = np.random.default_rng(0), 20 * holds
    leads = np.repeat(rng.uniform(-lead, lead, (holds, 6)), 20, axis=0)
    time, position = 0.025 * np.arange(rows), np.tile(STEP * np.round(ARM.rest / STEP), (rows, 1))
    arrived = np.vstack([leads[:1], leads[:-1]])  # row k holds the command sent after its state was read
    load = np.clip(gain * arrived + offset + rng.normal(0.0, max(noise, 1e-12), arrived.shape), -1.0, 1.0)
    return replace(RunLog.of(time, position + leads, position, arm=ARM), servo_load=load)


def worn_logs(kind, count=2):
    wears = [load_wear(f"{kind}?seed={i}", ARM) for i in range(count)]
    return wears, [(log.excitation, log.targets) for log in record(EmulatedRobot(ARM, wears, seed=2), seed=0)]


def test_a_line_is_read_from_joints_that_stand():
    found = servo_lines(ARM, [standing_log()])
    np.testing.assert_allclose(found.gain, GAIN, rtol=1e-3)
    np.testing.assert_allclose(found.gain * found.offset, 0.01, atol=1e-4)
    assert (found.within < 0.15).all()


def test_the_noise_of_loads_is_told_and_makes_a_line_less_sure():
    gain = np.full(6, 10.0)
    quiet, noisy = (servo_lines(ARM, [standing_log(gain, noise=noise, lead=0.06)]) for noise in (0.001, 0.005))
    np.testing.assert_allclose(noisy.noise, 0.005, rtol=0.3)
    assert (noisy.within > quiet.within).all()
    assert (np.abs(noisy.gain / gain - 1.0) < noisy.within).all()


@pytest.mark.parametrize(("kind", "known"), [("worn", 12), ("healthy", 4)])
def test_a_diagnosis_tells_the_lines_of_joints_that_sag_or_stick(kind, known):
    wears, logs = worn_logs(kind)
    count = 0
    for wear, pair in zip(wears, logs, strict=True):
        found = servo_lines(ARM, pair)
        sure = np.isfinite(found.within)
        count += np.count_nonzero(sure)
        off = found.gain / (wear.position_gain / wear.torque_limit) - 1.0
        assert (np.abs(off[sure]) < found.within[sure]).all()
        assert sure[1], "the joint that carries most"
    assert count >= known


def watch(load_of, cycles=40, lead=0.02, within=0.02, sticks=None):
    """First cycle in which joint 1, at a ``lead`` [rad] over a reading that stands, is not believed; None: never."""
    position, told = np.tile(ARM.rest, (1, 1)), np.zeros((1, 6))
    begin = state_of(position, load=told)
    knowledge = Knowledge(gain=np.full(6, 10.0), within=within, noise=0.001)
    bands = None if sticks is None else bands_of(0.5 * np.degrees(sticks))
    monitor = Following(ARM, begin, position, knowledge, bands=bands)
    for k in range(1, cycles):
        sent = position.copy()
        sent[0, 0] += lead if k > 1 else 0.0
        load = told.copy()
        load[0, 0] = load_of(k)
        state = state_of(position, 0.025 * k, load=load)
        bad = monitor.check(state, sent, np.zeros(1, dtype=bool))
        if bad is not None:
            assert bad[0].tolist() == [True] + [False] * 5
            return k
    return None


def test_a_load_on_its_line_is_believed_and_one_off_it_the_sooner_the_farther_it_is():
    line, after = 10.0 * 0.02, 10
    assert watch(lambda _: line) is None
    assert watch(lambda k: line if k < after else line - 0.12) == after
    assert watch(lambda k: line if k < after else line - 0.12, sticks=np.radians(5.0)) == after + 1
    assert watch(lambda k: line if k < after else line - 0.06) == after + compiled.STRIKES - 1
    assert watch(lambda k: line if k < after else line - 0.03) == after + compiled.STEADY - 1
    assert watch(lambda k: line if k != after else line - 0.06) is None, "one cycle is an accident"


def test_a_joint_without_a_line_is_not_judged_by_its_load():
    assert watch(lambda _: -0.5, within=np.r_[np.inf, np.full(5, 0.1)]) is None
