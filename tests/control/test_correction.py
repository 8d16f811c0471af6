"""Laws of aiming: what lies behind the encoders is taken out, by the same layer for every controller."""

from dataclasses import replace

import numpy as np
import pytest
from test_finishing import Watching

from madetwin import displaced
from rejoint.arms import Displacement, mycobot280, tcp_position
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.correction import MOST, Modelled
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import TargetSequence
from rejoint.control.seeing import Seen
from rejoint.system.errors import InputError
from standin import StandIn

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(4), (3, 2))
EVERY = np.ones(3, dtype=bool)
DISPLACED = displaced(ARM, seed=1, offset=0.01)


def _to(targets, correction):
    return TargetSequence(ARM, targets, correction=correction)


class PerfectServos(StandIn):
    """Arms whose encoders come to where they were sent, and whose tools do not."""

    def __init__(self, displacement, count=3):
        super().__init__(count)
        self.displacement = displacement

    def moved(self, command):
        return 0.5 * (command + self.position)

    def true_tcp(self):
        return self.displacement.tool(ARM, self.position)


def errors(recording):
    last = recording.since_target > 5.0
    by_encoders = np.linalg.norm(tcp_position(ARM, recording.position) - recording.target, axis=-1)[last]
    true = np.linalg.norm(recording.true_tcp - recording.target, axis=-1)[last]
    return by_encoders, true


@pytest.mark.parametrize("make", [DefaultController, IntegratorController])
def test_the_tool_arrives_and_the_encoders_see_it_beside_the_target(make):
    displacement = DISPLACED
    schedule = Schedule(dwell=6.0)
    plain = run(PerfectServos(displacement), make(ARM), TARGETS, schedule)
    aimed = run(PerfectServos(displacement), make(ARM), _to(TARGETS, Modelled(ARM, displacement)), schedule)
    assert errors(plain)[0].max() < 0.6e-3
    assert errors(plain)[1].mean() > 3e-3
    assert errors(aimed)[1].max() < 0.6e-3
    assert errors(aimed)[0].mean() > 3e-3
    np.testing.assert_array_equal(aimed.target, np.where(np.isfinite(plain.target), plain.target, aimed.target))


def test_without_a_correction_the_aim_is_the_target_and_the_log_has_none():
    recording = run(PerfectServos(DISPLACED), DefaultController(ARM), TARGETS, Schedule(dwell=0.5))
    np.testing.assert_array_equal(recording.aim, recording.target)
    assert recording.log(0, "one").aim is None


def test_a_shift_that_no_arm_needs_is_refused():
    huge = replace(Displacement.none(ARM), offset=np.full(ARM.joints, 0.4))
    with pytest.raises(InputError, match=f"at most {1e3 * MOST:.0f}"):
        Modelled(ARM, huge).aim(TARGETS[:, 0], np.tile(ARM.rest, (3, 1)), EVERY)


ALWAYS = (0.0, np.inf)


def seen_errors(displacement, believed, **seeing):
    robot = PerfectServos(displacement, count=1)
    correction = Seen(ARM, believed, eye=Watching(robot, rate=10.0, late=0.15, **seeing))
    recording = run(robot, DefaultController(ARM), _to(TARGETS[:1], correction), Schedule(dwell=6.0))
    return errors(recording)[1], correction


def test_what_the_model_does_not_know_is_seen_and_taken_out():
    truth, nothing = DISPLACED, Displacement.none(ARM)
    blind, _ = seen_errors(truth, nothing, hidden=ALWAYS)
    seen, correction = seen_errors(truth, nothing)
    assert blind.mean() > 3e-3
    assert seen.max() < 0.4e-3
    assert correction.used > 2


@pytest.mark.parametrize("seeing", [{"hidden": ALWAYS}, {"wrong": 1}])
def test_a_hidden_tool_or_a_sighting_of_something_else_leaves_the_model(seeing):
    seen, correction = seen_errors(DISPLACED, DISPLACED, **seeing)
    assert correction.used == 0
    assert seen.max() < 0.4e-3
