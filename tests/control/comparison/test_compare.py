"""Laws of the comparison: what is measured is what happened, batch equals single trials, verdicts are honest."""

import re

import numpy as np
import pytest

import rejoint
from comparisons import refilled
from rejoint.arms import clearances, gravity_torque, mycobot280, tcp_position
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.recommend import difference, recommend
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.targets import draw_targets
from rejoint.system.errors import GuardTripError
from standin import SaggingArms, StandIn

ARM = mycobot280()
PROTOCOL = Protocol(dwell=4.0, hold=5.0)
TARGETS = draw_targets(ARM, sets=2, count=2, seed=1)
STIFFNESS = 4.0
OFFSET = np.array([0.0, 0.0, -0.006])


class SaggingRobot(SaggingArms):
    """Servos with lag and sag and seeded noise; the tool is truly 6 mm below where the encoders put it."""

    stiffness = STIFFNESS

    def __init__(self, count=1, seed=0, *, know_truth=True, hot=np.inf):
        super().__init__(count)
        self.know_truth, self.hot = know_truth, np.array(hot)
        self.rngs = [np.random.default_rng([seed, b]) for b in range(count)]

    def read(self):
        heat = np.where(self.time > self.hot, 90.0, 30.0)
        return super().read(temperature=np.tile(heat[:, None], (1, ARM.joints)))

    def moved(self, command):
        return super().moved(command) + [1e-4 * rng.normal(size=ARM.joints) for rng in self.rngs]

    def true_tcp(self):
        return self.tcp() + OFFSET if self.know_truth else super().true_tcp()


def compared(open_robot, controllers, targets=TARGETS, *, hooks=None, **settings):
    """The comparison in a batch, or on the one arm that is given in place of a function that opens some."""
    batched = isinstance(open_robot, type) or not isinstance(open_robot, StandIn)
    chosen = Settings(**{"batched": batched, "protocol": PROTOCOL} | settings)
    opening = open_robot if batched else lambda *_: open_robot
    return TrialRunner(opening, controllers, targets, chosen, **hooks or {}).compare()


def factories(*names):
    return {name: (lambda arm, name=name: make_controller(name, arm)) for name in names}


@pytest.fixture(scope="module")
def comparison():
    opened, trials = [], []

    def open_robot(count, seed):
        opened.append(SaggingRobot(count, seed))
        return opened[-1]

    found = compared(
        open_robot,
        factories("default", "integrator"),
        repetitions=3,
        seed=7,
        hooks={"on_trial": lambda *trial: trials.append(trial)},
    )
    return found, opened, trials


def test_batch_has_one_arm_per_trial_and_closes_it(comparison):
    found, opened, trials = comparison
    assert [robot.count for robot in opened] == [6] * 4  # 2 controllers x 2 protocols
    assert all(robot.closed == 1 for robot in opened)
    assert {(driven.key.kind, driven.key.controller) for driven, _ in trials} == {
        (kind, name) for kind in ("crossing", "hold") for name in ("default", "integrator")
    }
    for driven, recording in trials:
        assert set(driven.key.places) == {(s, r) for s in range(2) for r in range(3)}
        for b, (s, _) in enumerate(driven.key.places):
            assert (recording.target[recording.active[:, b], b][0] == TARGETS[s, 0]).all()
    assert found.clusters == "trials"
    assert found.true_known


def test_results_per_target_are_those_of_single_trials(comparison):
    """Recompute one trial of the hold protocol from its run log alone."""
    found, _, trials = comparison
    driven, recording = next(
        (one, seen) for one, seen in trials if (one.key.kind, one.key.controller) == ("hold", "integrator")
    )
    log = recording.log(driven.key.places.index((1, 2)), "hold")
    error = np.linalg.norm(tcp_position(ARM, log.position) - log.target, axis=-1)
    true = np.linalg.norm(log.true_tcp - log.target, axis=-1)
    for k in range(2):
        rows = (log.target == TARGETS[1, k]).all(axis=1)
        last = rows & (log.time >= log.time[rows][-1] - PROTOCOL.window)
        assert found.array("settled", "integrator")[1, 2, k] == pytest.approx(error[last].mean(), rel=0.02)
        assert found.array("settled_true", "integrator")[1, 2, k] == pytest.approx(true[last].mean(), rel=0.02)


def test_numbers_are_those_of_the_robot(comparison):
    found, *_ = comparison
    default, integrator = found.row("default"), found.row("integrator")
    assert integrator.success.value == 1.0
    assert default.success.value == 0.0
    # Nothing is reached: each of the two targets lasts its dwell, up to one period more.
    assert default.cycle_time.mean.value == pytest.approx(8.0, abs=0.06)
    assert (found.array("crossing_error", "integrator") < PROTOCOL.threshold).all()
    assert integrator.settled.mean.value < 5e-4
    assert integrator.settled_true.mean.value == pytest.approx(0.006, abs=3e-4)
    assert [stay.within for stay in integrator.stays] == [0.01, 0.005, 0.002]
    medians = [stay.median for stay in integrator.stays]
    assert medians == sorted(medians)
    assert all(stay.median is None for stay in default.stays)
    assert (found.array("stay_10mm", "default") == PROTOCOL.hold).all()
    assert integrator.failures == 0
    assert set(default.guard) == {"lead", "step"}


def test_same_seed_same_numbers_and_noise_shared_by_the_controllers():
    two = dict.fromkeys(("one", "two"), IntegratorController)
    first, again = (compared(SaggingRobot, two, repetitions=2, seed=3) for _ in range(2))
    assert first == again
    for name in first.results:
        np.testing.assert_array_equal(first.array(name, "one"), first.array(name, "two"))
    settled = first.array("settled", "one")
    assert (settled[:, 0] != settled[:, 1]).all()  # repetitions differ by their noise


def test_one_arm_interleaves_and_returns_to_the_start():
    robot, starts, order = SaggingRobot(know_truth=False), [], []

    def note(driven, recording):
        order.append((driven.key.places[0][1], driven.key.places[0][0], driven.key.controller, driven.key.kind))
        starts.append(recording.position[0, 0])

    three = dict.fromkeys(("one", "two", "three"), IntegratorController)
    found = compared(robot, three, TARGETS[:1, :1], repetitions=4, seed=2, hooks={"on_trial": note})
    assert robot.closed == 1
    assert [entry[0] for entry in order] == [r for r in range(4) for _ in range(6)]
    firsts = {tuple(entry[2] for entry in order[6 * r : 6 * r + 6 : 2]) for r in range(4)}
    assert len(firsts) > 1  # not always the same order
    assert all(sorted(each) == ["one", "three", "two"] for each in firsts)
    sag = gravity_torque(ARM, ARM.rest) / STIFFNESS
    np.testing.assert_allclose(np.array(starts), np.tile(ARM.rest - sag, (24, 1)), atol=0.02)
    np.testing.assert_allclose(np.array(starts), np.tile(starts[0], (24, 1)), atol=2e-3)
    assert not found.true_known
    assert found.row("one").settled_true is None
    assert found.row("one").crossing_true is None


def test_own_targets_are_driven_on_clear_ways_whose_time_counts():
    around = [[0.017, -0.268, 0.138], [0.022, 0.195, 0.220], [0.272, -0.003, 0.205]]
    plan = rejoint.TrialPlan(repetitions=1, protocol=Protocol(hold=3.0, crossings=False))
    found = rejoint.compare("emulated:worn", ["feedforward"], around, plan=plan)
    (log,), results = found.logs.values(), found.comparison.results
    assert clearances(ARM, log.position).min() > 0.0
    near = np.linalg.norm(tcp_position(ARM, log.position) - log.target, axis=1) < PROTOCOL.threshold
    times = [log.time[rows[near[rows]][0]] - log.time[max(rows[0] - 1, 0)] for rows in log.visits()]
    np.testing.assert_allclose(results["crossing_time"], times, atol=1e-6)
    assert max(results["settled"]) < 3e-3


def test_a_trip_on_one_arm_ends_the_comparison():
    robot = SaggingRobot(hot=6.0)
    with pytest.raises(GuardTripError):
        compared(robot, factories("integrator"))
    assert robot.closed == 1


def test_a_trip_in_a_batch_is_a_failure_of_its_trial():
    found = compared(lambda *given: SaggingRobot(*given, hot=[np.inf, 6.0]), factories("default"))
    row = found.row("default")
    assert row.failures == 2
    assert "temperature" in row.guard
    settled = found.array("settled", "default")
    assert np.isfinite(settled[0]).all()
    assert np.isfinite(settled[1, 0, 0])  # held before it got hot
    assert np.isnan(settled[1, 0, 1])
    assert np.isnan(found.array("crossing_error", "default")[1, 0, 1])
    assert row.cycle_time.count == 1


def alike(errors):
    """Comparison of controllers whose settled errors are given; all else equal."""
    same = dict.fromkeys(errors, IntegratorController)
    found = compared(SaggingRobot, same, draw_targets(ARM, sets=6, count=1))
    rng = np.random.default_rng(0)
    for name, error in errors.items():
        found = refilled(found, name, settled=error * (1 + 0.2 * rng.normal(size=6)))
    return found


def test_the_better_one_is_recommended_and_a_tie_goes_to_the_simpler():
    clear = alike({"default": 0.02, "integrator": 0.001, "policy": 0.0003})
    assert recommend(clear).controller == "policy"
    assert any(line.startswith("integrator: ") and "settled error, against" in line for line in recommend(clear).why)
    tie = alike({"default": 0.02, "policy": 0.00101, "integrator": 0.001})
    assert recommend(tie).controller == "integrator"
    assert recommend(tie).tied == ("policy",)
    assert recommend(tie).why[1] == (
        "A tie of integrator and policy: no measurable difference. integrator is recommended because it is simpler."
    )
    assert recommend(clear).tied == ()
    worse = alike({"policy": 0.004, "integrator": 0.001})
    assert recommend(worse).controller == "integrator"
    found = difference(clear, "integrator", "policy")
    assert found.low > 0.0
    assert found.value == pytest.approx(0.0007, rel=0.3)


def test_of_those_that_tie_at_the_narrowest_distance_who_is_near_much_sooner_is_recommended():
    found = alike({"integrator": 0.001, "policy": 0.001})

    def sooner_by(seconds):
        made = found
        for name in found.controllers:
            near = [1.0 - (seconds if name == "policy" else 0.0)] * 6
            made = refilled(made, name, settled=[0.001] * 6, stay_10mm=near, stay_5mm=near, stay_2mm=[3.0] * 6)
        return recommend(made)

    assert sooner_by(0.3).controller == "policy"
    why = " ".join(sooner_by(0.3).why)
    assert re.search(r"integrator: 1.00 s on average to stay within 5 mm .*, against 0.70 s of policy", why)
    assert sooner_by(0.1).controller == "integrator", "nobody sees a tenth of a second"


def test_reaching_the_targets_and_whole_holds_count_before_settling():
    found = alike({"integrator": 0.0001, "policy": 0.001})
    verdict = recommend(refilled(found, "integrator", crossed=[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    assert verdict.controller == "policy"
    assert any("integrator: 67 % of the targets missed, against 0 % of policy" in line for line in verdict.why)
    cut = [None] + [0.0001] * 5  # by the guard
    assert recommend(refilled(found, "integrator", settled=cut)).controller == "policy"
