"""One real arm is not driven for nothing: who fails is stopped, is told apart, and counts for what was driven."""

from dataclasses import replace

import numpy as np
import pytest
from test_compare import ARM, PROTOCOL, STIFFNESS, SaggingRobot, compared, factories
from test_ledger import stop_after

import rejoint
from rejoint.arms import Box
from rejoint.arms.inertia import loaded
from rejoint.control.comparison.compare import BLOCK, LEVEL, Ledger, Settings, TrialRunner, worse
from rejoint.control.comparison.recommend import failure, recommend
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import recording_of
from rejoint.control.start import Stance
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import read_effort
from rejoint.pages.report.tables import columns, plain_table
from rejoint.runs.run import Run
from rejoint.runs.stages.compare import ComparisonJob, open_loop_trials
from rejoint.system.errors import ContractError, GuardTripError, NoReplyError, NotReadyError
from rejoint.training.task import DEFAULT
from rejoint.training.train import policy_contract

TARGETS = draw_targets(ARM, sets=2, count=5, seed=1)


class Breaks(IntegratorController):
    """An integrator whose command is not a number from some time into every target on."""

    value, since = np.nan, 1.0

    def command(self, inputs):
        wanted = super().command(inputs)
        return np.where(inputs.since_target[:, None] > self.since, self.value, wanted)


@pytest.fixture(scope="module")
def one_arm():
    trials, progress, arm = [], [], SaggingRobot()
    hooks = {"on_trial": lambda *trial: trials.append(trial), "on_progress": lambda *step: progress.append(step)}
    three = factories("default", "integrator") | {"policy": Breaks}
    return compared(arm, three, TARGETS, repetitions=2, hooks=hooks), trials, progress, arm


def test_three_misses_in_a_row_end_it(one_arm):
    found, trials, progress, _ = one_arm
    ((driven, _),) = (trial for trial in trials if trial[0].key.controller == "default")
    assert driven.key.kind == "crossing", "no hold and no further trial"
    row = found.row("default")
    assert row.out == "missed 3 targets in a row (set 1, repetition 1)"
    assert (row.failures, row.ended) == (0, ())
    assert progress[-1][0] == 1.0


def test_what_was_not_driven_counts_neither_way(one_arm):
    row, crossed = one_arm[0].row("default"), one_arm[0].array("crossed", "default")
    assert crossed[0, 0].tolist() == [0.0] * 5
    assert np.isnan(crossed).sum() == crossed.size - 5
    assert row.success.value == 0.0
    assert row.success.high > 0.3, "five targets do not prove much about the share"
    assert (row.settled, row.stays, row.held) == (None, (), 0)


def test_the_others_are_driven_to_the_end(one_arm):
    found, trials, _, _ = one_arm
    row = found.row("integrator")
    assert sum(driven.key.controller == "integrator" for driven, _ in trials) == 2 * 2 * 2
    assert (row.out, row.success.value) == ("", 1.0)
    assert np.isfinite(found.array("settled", "integrator")).all()
    assert row.settled.mean.low < row.settled.mean.high


def test_a_command_that_is_not_a_number_costs_the_trial_and_not_the_comparison(one_arm):
    found, trials, _, arm = one_arm
    driven = [recording for driven, recording in trials if driven.key.controller == "policy"]
    row = found.row("policy")
    assert len(driven) <= 2
    assert (row.failures, len(row.ended)) == (1, 1)
    assert row.ended[0] == "not finite"
    assert row.out.startswith("gave a command that is not a number (")
    last = driven[-1]
    assert np.isfinite(last.command).all()
    assert (last.command[-1] == last.command[-2]).all(), "the arm holds"
    assert list(row.guard)[-1] == "not finite"
    assert arm.closed == 1


def test_a_measured_position_that_is_not_a_number_is_not_the_controllers_fault():
    class Blind(SaggingRobot):
        def read(self):
            state = super().read()
            return replace(state, position=np.where(self.time[0] > 4.0, np.nan, state.position))

    with pytest.raises(GuardTripError, match="not finite") as caught:
        compared(Blind(), {"policy": IntegratorController}, TARGETS)
    assert recording_of(caught.value) is not None


def test_a_batch_is_driven_to_the_end_and_a_bad_command_costs_the_same_there():
    found = compared(SaggingRobot, factories("default", "integrator") | {"policy": Breaks}, TARGETS[:1])
    assert np.isfinite(found.array("crossed", "default")).all()
    row = found.row("policy")
    assert (found.row("default").out, row.out, row.failures) == ("", "", 2)
    assert set(row.ended) == {"not finite"}
    assert failure(row) == "policy: 2 runs ended early, because a command or a measured position was not a number."
    assert failure(found.row("default")).startswith("default reached none of its targets in time; it comes to rest ")
    assert failure(found.row("integrator")) == ""
    assert recommend(found).controller == "integrator"


def test_a_run_can_be_given_up():
    asked = []

    def after_a_second(inputs):
        asked.append(inputs.since_target.copy())
        return inputs.since_target[0] >= 1.0

    robot = SaggingRobot(2)
    recording = run(robot, IntegratorController(ARM), TARGETS[:, :1], Schedule(dwell=2.0, give_up=after_a_second))
    ends = [recording.time[recording.active[:, b], b][-1] for b in range(2)]
    assert ends == pytest.approx([1.0, 1.0], abs=0.03)
    assert (recording.tripped == 0).all()
    assert robot.time.tolist() == pytest.approx(ends), "an arm that is done is not stepped"
    assert len(asked) == len(recording.time)


def test_an_arm_that_does_not_stand_as_its_twin_says_is_not_compared_on():
    def on(stiffness, trials):
        stance = Stance(stiffness=np.full(6, stiffness), offset=np.zeros(6))
        hooks = {"on_trial": lambda *trial: trials.append(trial), "stance": stance}
        compared(SaggingRobot(), factories("integrator"), TARGETS[:1, :1], hooks=hooks)

    on(STIFFNESS, tried := [])
    assert len(tried) == 2, "a crossing and a hold"
    with pytest.raises(NotReadyError):
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
        hooks = {"on_trial": lambda driven, _: trials.append(driven)}
        return compared(SaggingRobot(), controllers, TARGETS[:1, :1], hooks=hooks, **settings)

    trials, slow, quick = [], trained_for(0.040, 0.060), trained_for(0.020, 0.030)
    found = on(factories("integrator") | {"policy": slow}, leave_out=True)
    assert [row.controller for row in found.rows] == ["integrator"]
    assert {trial.key.controller for trial in trials} == {"integrator"}
    (said,) = found.left_out
    assert said.startswith("policy did not take part: the control period is 25 ms, this controller is made for 40")
    assert on(factories("integrator") | {"policy": quick}, leave_out=True).left_out == ()
    trials.clear()
    for controllers, settings in (
        (factories("integrator") | {"policy": slow}, {}),
        ({"policy": slow}, {"leave_out": True}),
    ):
        with pytest.raises(ContractError):
            on(controllers, **settings)
    assert trials == [], "asked for by name, or the only one: refused"


QUICK = replace(PROTOCOL, hold=1.5, window=0.3, crossings=False)
SETTLING = replace(QUICK, hold=3.0)
"""Long enough for an integrator to come to rest"""
TWENTY = draw_targets(ARM, sets=2, count=10, seed=1)


class Beside(IntegratorController):
    """An integrator that reaches every target and comes to rest three millimetres beside it."""

    def command(self, inputs):
        return super().command(replace(inputs, target=inputs.target + np.array([0.0, 0.0, 0.003])))


def in_blocks(controllers, targets=TWENTY, *, measured=None, ledger=None, on_trial=None, protocol=QUICK):
    order = []

    def note(driven, _):
        order.append((driven.key.controller, driven.key.kind, driven.key.places[0][0], driven.key.first))
        if on_trial is not None:
            on_trial(driven)

    hooks = {"on_trial": note, "ledger": ledger or Ledger(), "measured": measured}
    rules = {"protocol": protocol, "block": BLOCK}
    return compared(SaggingRobot(), controllers, targets, hooks=hooks, **rules), order


def results(rng, factor, count=10):
    return factor * 1e-3 * np.exp(0.3 * rng.normal(size=count))


def test_equal_controllers_hardly_ever_leave_and_a_factor_of_three_is_found():
    rng, left, found = np.random.default_rng(0), 0, 0
    for _ in range(300):
        equal = {name: results(rng, 1.0) for name in "abcd"}
        left += bool(worse(equal, 6))
        clear = {"a": results(rng, 3.0, 5), "b": results(rng, 1.0, 5)}
        found += "a" in worse(clear, 2)
    assert left / 300 < 2.0 * LEVEL, "the best one is known by the same targets"
    assert found / 300 > 0.9


def test_a_worse_one_leaves_after_a_block_and_the_comparison_ends():
    found, order = in_blocks({"default": Beside, "integrator": IntegratorController}, protocol=SETTLING)
    row = found.row("default")
    assert row.beaten
    assert failure(row).startswith("default was worse than integrator (")
    assert (row.held, found.row("integrator").held) == (5, 5)
    assert found.block == 5
    assert order == [(name, "hold", 0, 0) for name, *_ in order], "the same targets in turns"
    advice = recommend(found)
    assert (advice.controller, advice.tied) == ("integrator", ())
    assert failure(row) in advice.why


def test_equal_ones_are_driven_to_all_targets_and_the_simpler_is_recommended():
    found, order = in_blocks(dict.fromkeys(("integrator", "policy"), IntegratorController), TWENTY[:1])
    assert [(row.out, row.held) for row in found.rows] == [("", 10)] * 2
    assert sorted(order) == sorted((name, "hold", 0, k) for name in ("integrator", "policy") for k in (0, 5))
    advice = recommend(found)
    assert (advice.controller, advice.tied) == ("integrator", ("policy",))


def open_loop():
    return run(SaggingRobot(1, 3), DefaultController(ARM), TWENTY[:1], Schedule(dwell=QUICK.hold)).log(0, "targets")


def test_what_was_measured_open_loop_is_not_driven_again():
    log = open_loop()
    before = open_loop_trials(ARM, log, QUICK)
    found, order = in_blocks(factories("default", "integrator"), measured=before.driven)
    row = found.row("default")
    assert {entry[0] for entry in order} == {"integrator"}
    assert (row.source, row.held) == ("the diagnosis", 10)
    whole = compared(SaggingRobot, factories("default"), TWENTY[:1], protocol=QUICK, seed=3)
    assert row.settled.mean.value == pytest.approx(whole.row("default").settled.mean.value, rel=0.02)
    assert row.cycle_time is None, "the targets were not waited for"
    assert open_loop_trials(ARM, log, replace(QUICK, hold=3.0)) is None, "held shorter than that"


def test_a_real_arm_is_compared_in_blocks_and_goes_on_from_its_diagnosis(tmp_path):
    log = open_loop()
    about = Run.create(tmp_path, SaggingRobot.address, ARM, seed=2)
    log.save(about.folder.log("targets"))
    quick = rejoint.TrialPlan(protocol=QUICK)
    found = rejoint.compare(SaggingRobot(), run=about, plan=quick).comparison
    assert found.controllers == ("default", "integrator", "feedforward", "shelf"), "the paper's PIDs only on request"
    np.testing.assert_array_equal(found.targets[0], TWENTY[0])
    assert about.comparison == found
    assert about.folder.log("hold/default/0/0").exists(), "for the figures"
    (spent,) = read_effort(about.folder).stages
    assert spent.moving > sum(row.held for row in found.rows if not row.source) * QUICK.hold
    assert plain_table(columns(found), found.rows)[1][0][0] == "default (by diagnosis)"
    other = rejoint.compare(SaggingRobot(), ["default"], TWENTY[1, :3], run=about, plan=quick).comparison
    assert other.rows[0].source == "", "at other targets it is driven"
    full = rejoint.compare(SaggingRobot(), ["integrator"], TWENTY[0, :2], plan=replace(quick, full=True)).comparison
    assert (full.block, full.rows[0].source) == (0, "")


def test_trials_with_another_load_or_other_boxes_are_not_gone_on_from(tmp_path):
    run, box = Run.create(tmp_path, "emulated:worn", ARM), Box(lower=np.full(3, 0.5), upper=np.ones(3))
    arms = ARM, loaded(ARM, 0.1), loaded(ARM, 0.2), loaded(ARM, 0.1, [0.0, 0.0, 0.01]), replace(ARM, keep_out=(box,))
    trials = TrialRunner(SaggingRobot, {}, TWENTY, Settings(batched=True))
    jobs = [ComparisonJob(robot=run.robot, arm=arm, trials=trials) for arm in (*arms, ARM)]
    assert len({job.fingerprint(run) for job in jobs}) == len(arms)


class Unfinished(DefaultController):
    """Cannot command yet."""

    def command(self, *_):
        raise NotReadyError("not finished")


def test_a_comparison_with_own_controllers_begins_anew_for_they_may_have_changed(tmp_path):
    run, plan = Run.create(tmp_path, "emulated:worn", ARM), rejoint.TrialPlan(sets=1, repetitions=1, protocol=QUICK)

    def driven(**own):
        return rejoint.compare("emulated:worn", own, TWENTY[0, :2], run=run, plan=plan).comparison

    with pytest.raises(NotReadyError):
        driven(one=IntegratorController, two=Unfinished)
    assert run.folder.trials.exists()
    found = driven(one=DefaultController, two=DefaultController)
    assert found.row("one").settled == found.row("two").settled, "nothing of the version before"
    with rejoint.connect("emulated:worn", run=run) as arm:
        assert arm.controller == "shelf", "only a program has the other"


def test_an_interrupted_comparison_in_blocks_goes_on_where_it_was(tmp_path):
    controllers, targets = dict.fromkeys(("integrator", "policy"), IntegratorController), TWENTY[:1]
    whole, order = in_blocks(controllers, targets)
    with pytest.raises(NoReplyError):
        in_blocks(controllers, targets, ledger=Ledger(tmp_path / "trials", "one"), on_trial=stop_after(2))
    again, rest = in_blocks(controllers, targets, ledger=Ledger(tmp_path / "trials", "one"))
    assert rest == order[2:], "the same trials in the same order"
    assert [row.held for row in again.rows] == [row.held for row in whole.rows]
