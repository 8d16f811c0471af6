"""An arm that stands under one command will not come nearer: the rest of the wait is left out, and counted."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.protocols import STANDS_FOR, metrics_of, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Stillness
from standin import SaggingArms

ARM = mycobot280()
STEP = ARM.encoder_step
TARGETS = ARM.targets.sample(np.random.default_rng(3), (3, 2))
PROTOCOL = Protocol()


class Sagging(SaggingArms):
    """Arms with clocks of their own that go a third of the way to their command in a period, and sag."""

    stiffness = 4.0

    def __init__(self, periods):
        super().__init__(len(periods), period=periods)
        self.time = np.arange(self.count, dtype=float)

    def read(self):
        return replace(super().read(), position=np.rint(self.position / STEP) * STEP)


def test_stillness_by_hand():
    sent, position = np.zeros((1, 6)), np.zeros((1, 6))

    def at(time, moved=0.0, command=0.0):
        return still.look(np.array([time]), np.hstack([position + moved, sent + command]))[0].min()

    still = Stillness(np.repeat([1.5 * STEP, 0.0], ARM.joints))
    assert at(5.0) == 0.0
    assert at(6.0) == 1.0
    assert at(7.0, moved=STEP) == 2.0  # an encoder flickers
    assert at(8.0, moved=-STEP) == 3.0
    assert at(9.0, moved=2 * STEP) == 0.0
    assert at(9.5, moved=3 * STEP) == 0.5  # from where it stood last
    assert at(10.0, moved=3 * STEP, command=1e-9) == 0.0
    assert at(10.5, moved=3 * STEP, command=1e-9) == 0.5


def test_what_is_waited_for_would_have_shown_nothing_else():
    plan = Schedule(dwell=9.0, stop_below=1e-6)
    whole, short = (
        run(Sagging([0.025]), DefaultController(ARM), TARGETS[:1], schedule)
        for schedule in (plan, replace(plan, stands_for=2.0))
    )
    for k in range(2):
        ours, theirs = (rec.position[rec.target_index[:, 0] == k, 0] for rec in (short, whole))
        assert 2.0 / 0.025 < len(ours) < 0.5 * len(theirs)
        assert np.abs(ours[-1] - theirs[-1]).max() <= 1.5 * STEP
        since = short.since_target[short.target_index[:, 0] == k, 0]
        assert (np.diff(since[:-1]) > 0.0).all()
        assert since[-2] < 5.0
        assert since[-1] == pytest.approx(9.0, abs=1e-5)


def test_every_arm_of_a_batch_stands_for_itself():
    periods, plan = [0.02, 0.025, 0.03], Schedule(dwell=9.0, stop_below=1e-6, stands_for=2.0)
    batch = run(Sagging(periods), DefaultController(ARM), TARGETS, plan)
    for b, period in enumerate(periods):
        alone = run(Sagging([period]), DefaultController(ARM), TARGETS[b : b + 1], plan)
        assert batch.active[:, b].sum() == alone.active.sum()
        np.testing.assert_array_equal(batch.log(b, "x").position, alone.log(0, "x").position)


def test_a_missed_target_counts_as_waited_for():
    plan = schedule("crossing", PROTOCOL, keep_going=True, wait=False)
    recording = run(Sagging([0.025] * 3), DefaultController(ARM), TARGETS, plan)
    found = metrics_of(ARM, recording, TARGETS, PROTOCOL, ("crossing",))
    assert (found["crossed"] == 0.0).any()
    for b, k in np.argwhere(found["crossed"] == 0.0):
        assert found["crossing_time"][b, k] == pytest.approx(PROTOCOL.dwell, abs=1e-5)
        rows = recording.active[:, b] & (recording.target_index[:, b] == k)
        taken = np.ptp(recording.time[rows, b])
        assert STANDS_FOR < taken < 0.5 * PROTOCOL.dwell


class Restless(DefaultController):
    """Changes its command by next to nothing in every cycle."""

    def command(self, inputs):
        return super().command(inputs) + 1e-9 * inputs.state.time[:, None]


class Underway(TargetSequence):
    """Has arrived nowhere."""

    def advance(self, now):
        return replace(super().advance(now), arrived=np.zeros(1, dtype=bool))


@pytest.mark.parametrize(("controller", "reference"), [(Restless, TargetSequence), (DefaultController, Underway)])
def test_who_still_corrects_or_is_on_the_way_is_waited_for(controller, reference):
    plan = Schedule(dwell=6.0, stop_below=1e-6, stands_for=0.5)
    recording = run(Sagging([0.025]), controller(ARM), reference(ARM, TARGETS[:1]), plan)
    assert np.ptp(recording.time[:, 0]) == pytest.approx(12.0, abs=0.1)
