"""One real arm is not driven for nothing: who fails is stopped, is told apart, and counts for what was driven."""

from dataclasses import replace

import numpy as np
import pytest
from test_compare import ARM, PROTOCOL, STIFFNESS, SaggingRobot, factories

from rejoint.control.comparison.compare import Settings, compare
from rejoint.control.comparison.elimination import MISSES, Elimination
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import recording_of
from rejoint.control.start import Stance
from rejoint.system.errors import ContractError, GuardTripError, NotReadyError
from rejoint.system.files import read_json, write_json
from rejoint.training.presets import DEFAULT
from rejoint.training.train import policy_contract

TARGETS = draw_targets(ARM, sets=2, count=5, seed=1)


class Breaks(IntegratorController):
    """An integrator whose command is not a number from some time into every target on."""

    value, since = np.nan, 1.0

    def command(self, inputs):
        wanted = super().command(inputs)
        return np.where(inputs.since_target[:, None] > self.since, self.value, wanted)


class LateInfinity(Breaks):
    value, since = -np.inf, 2.0


def on_one_arm(controllers, targets=TARGETS, repetitions=1, **robot):
    trials, progress = [], []
    arm = SaggingRobot(1, 0, **robot)
    found = compare(
        lambda *_: arm, controllers, targets, Settings(repetitions=repetitions, batched=False, protocol=PROTOCOL),
        on_trial=trials.append, on_progress=lambda *step: progress.append(step),
    )  # fmt: skip
    return found, trials, progress, arm


@pytest.fixture(scope="module")
def one_arm():
    return on_one_arm(factories("default", "integrator") | {"policy": Breaks}, repetitions=2)


def test_three_misses_in_a_row_end_it(one_arm):
    found, trials, progress, _ = one_arm
    driven = [trial for trial in trials if trial.controller == "default"]
    assert [trial.kind for trial in driven] == ["crossing"], "no hold and no further trial"
    rows = driven[0].recording
    assert rows.target_index.max() == MISSES - 1
    assert rows.time[-1, 0] - rows.time[0, 0] < MISSES * PROTOCOL.dwell, "an arm that stands is not waited for"
    assert rows.since_target[-1, 0] >= PROTOCOL.dwell
    assert (rows.command[-1] == rows.command[-2]).all(), "nothing is sent for the target that is not driven"
    row = found.row("default")
    assert row.out == "missed 3 targets in a row (set 1, repetition 1, up to target 3)"
    assert (row.failures, row.ended) == (0, ())
    assert progress[-1][0] == 1.0


def test_what_was_not_driven_counts_neither_way(one_arm):
    row = one_arm[0].row("default")
    crossed = row.outcomes.array("crossed")
    assert crossed[0, 0, :MISSES].tolist() == [0.0] * MISSES
    assert np.isnan(crossed).sum() == crossed.size - MISSES
    assert row.crossing.success.value == 0.0
    assert row.crossing.success.high > 0.5, "three targets do not prove much about the share"
    assert row.crossing.cycle_time is None
    assert (row.hold.settled, row.hold.stays) == (None, ())
    assert set(row.outcomes.stayed[0]) == {None}


def test_the_others_are_driven_to_the_end(one_arm):
    found, trials, _, _ = one_arm
    row = found.row("integrator")
    assert sum(trial.controller == "integrator" for trial in trials) == 2 * 2 * 2
    assert (row.out, row.crossing.success.value) == ("", 1.0)
    assert np.isfinite(row.outcomes.array("settled")).all()
    assert row.hold.settled.mean.low < row.hold.settled.mean.high


def test_a_command_that_is_not_a_number_costs_the_trial_and_not_the_comparison(one_arm):
    found, trials, _, arm = one_arm
    driven = [trial for trial in trials if trial.controller == "policy"]
    row = found.row("policy")
    assert len(driven) <= 2
    assert (row.failures, len(row.ended)) == (1, 1)
    assert row.ended[0].why == "not finite"
    assert row.out.startswith("gave a command that is not a number (")
    last = driven[-1].recording
    assert np.isfinite(last.command).all()
    assert (last.command[-1] == last.command[-3]).all(), "the arm holds"
    assert [count.reason for count in row.guard][-1] == "not finite"
    assert arm.closed == 1


def test_the_recommendation_leaves_out_who_is_out_and_says_why(one_arm, tmp_path):
    found = one_arm[0]
    advice = recommend(found)
    assert advice.controller == "integrator"
    for name in ("default", "policy"):
        assert failure(found.row(name)) in advice.why
    write_json(tmp_path / "comparison.json", found)
    assert read_json(tmp_path / "comparison.json", Comparison) == found


def test_infinite_commands_are_as_bad():
    found, *_ = on_one_arm({"integrator": IntegratorController, "policy": LateInfinity}, TARGETS[:1, :2])
    assert found.row("policy").failures == 1
    assert "not a number" in found.row("policy").out
    assert recommend(found).controller == "integrator"


def test_where_all_fail_one_of_them_is_named_with_a_warning():
    found, *_ = on_one_arm(factories("default"), TARGETS[:1])
    advice = recommend(found)
    assert advice.controller == "default"
    assert advice.why[0] == "Every controller was stopped; this one got farthest."


def test_a_fault_of_the_arm_still_ends_the_comparison():
    with pytest.raises(GuardTripError, match="temperature"):
        on_one_arm({"policy": Breaks}, TARGETS[:1], hot=[(0, 0.5)])


def test_a_measured_position_that_is_not_a_number_is_not_the_controllers_fault():
    class Blind(SaggingRobot):
        def read(self):
            state = super().read()
            return replace(state, position=np.where(self.time[0] > 4.0, np.nan, state.position))

    robot = Blind(1, 0)
    with pytest.raises(GuardTripError, match="not finite") as caught:
        compare(lambda *_: robot, {"policy": IntegratorController}, TARGETS, Settings(batched=False, protocol=PROTOCOL))
    assert recording_of(caught.value) is not None


def test_a_batch_is_driven_to_the_end_and_a_bad_command_costs_the_same_there():
    found = compare(
        SaggingRobot, factories("default", "integrator") | {"policy": Breaks}, TARGETS[:1],
        Settings(batched=True, protocol=PROTOCOL),
    )  # fmt: skip
    assert np.isfinite(found.row("default").outcomes.array("crossed")).all()
    row = found.row("policy")
    assert (found.row("default").out, row.out, row.failures) == ("", "", 2)
    assert {end.why for end in row.ended} == {"not finite"}
    assert failure(row) == "policy: 2 of 2 runs ended early, because a command or a measured position was not a number."
    assert failure(found.row("default")).startswith("default reached none of its targets in time; it comes to rest ")
    assert failure(found.row("integrator")) == ""
    assert recommend(found).controller == "integrator"


def test_who_is_out_follows_from_results_alone():
    """So that a comparison can be taken up again: noting the trials anew leads to the same."""
    rules = Elimination(PROTOCOL)
    rules.note("a", "crossing", (0, 0), [1.0, 0.0, 0.0], failed=False)
    assert rules.out("a") == ""
    rules.note("a", "hold", (0, 0), [1.0, 0.0, 0.0], failed=False)
    rules.note("a", "crossing", (0, 1), [1.0, 0.0, 0.0], failed=False)
    assert rules.out("a") == "", "a target that was reached ends the row"
    rules.note("a", "crossing", (1, 1), [0.0, np.nan, np.nan], failed=False)
    assert rules.out("a") == "missed 3 targets in a row (set 2, repetition 2, up to target 1)"
    rules.note("b", "hold", (0, 0), [], failed=True)
    assert rules.out("b") == "gave a command that is not a number (hold protocol, set 1, repetition 1)"
    assert rules.out("c") == ""


def test_a_run_can_be_given_up_arm_by_arm():
    asked = []

    def second_after_a_second(inputs):
        asked.append(inputs.since_target.copy())
        return np.array([False, inputs.since_target[1] >= 1.0])

    robot = SaggingRobot(2, 0)
    plan = Schedule(dwell=2.0, give_up=second_after_a_second)
    recording = run(robot, IntegratorController(ARM), TARGETS[:, :1], plan)
    ends = [recording.time[recording.active[:, b], b][-1] for b in range(2)]
    assert ends == pytest.approx([2.0, 1.0], abs=0.03)
    assert (recording.tripped == 0).all()
    assert robot.time.tolist() == pytest.approx(ends), "an arm that is done is not stepped"
    assert len(asked) == len(recording.time)


def test_an_arm_that_does_not_stand_as_its_twin_says_is_not_compared_on():
    def on(stiffness, trials):
        return compare(
            lambda *_: SaggingRobot(1, 0), factories("integrator"), TARGETS[:1, :1],
            Settings(batched=False, protocol=PROTOCOL), on_trial=trials.append,
            stance=Stance(stiffness=np.full(6, stiffness), offset=np.zeros(6)),
        )  # fmt: skip

    on(STIFFNESS, tried := [])
    assert len(tried) == 2, "a crossing and a hold"
    with pytest.raises(NotReadyError, match="from where the twin of this run expects it"):
        on(0.5, tried := [])
    assert tried == []


def trained_for(low, high):
    """An integrator that says it is a policy which met control periods from ``low`` to ``high`` [s]."""

    def make(arm):
        controller = IntegratorController(arm)
        controller.contract = replace(policy_contract(arm, None, DEFAULT, 0), min_period=low, max_period=high)
        return controller

    return make


def test_a_policy_whose_period_does_not_suit_is_left_out_or_refused():
    def on(controllers, **settings):
        return compare(
            lambda *_: SaggingRobot(1, 0), controllers, TARGETS[:1, :1],
            Settings(batched=False, protocol=PROTOCOL, **settings), on_trial=trials.append,
        )  # fmt: skip

    trials, slow, quick = [], trained_for(0.040, 0.060), trained_for(0.020, 0.030)
    found = on(factories("integrator") | {"policy": slow}, leave_out=True)
    assert [row.controller for row in found.rows] == ["integrator"]
    assert {trial.controller for trial in trials} == {"integrator"}
    (said,) = found.left_out
    assert said.startswith(
        "policy did not take part: the robot's control period is 25 ms, the policy was trained for 40"
    )
    assert on(factories("integrator") | {"policy": quick}, leave_out=True).left_out == ()
    trials.clear()
    for controllers, settings in (
        (factories("integrator") | {"policy": slow}, {}),
        ({"policy": slow}, {"leave_out": True}),
    ):
        with pytest.raises(ContractError, match="trained for 40 to 60 ms"):
            on(controllers, **settings)
    assert trials == [], "asked for by name, or the only one: refused"
