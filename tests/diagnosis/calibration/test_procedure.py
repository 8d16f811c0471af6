"""Laws of the measuring drive: slow, from both sides, nothing lost, and what it brings when it is believed."""

from dataclasses import replace

import numpy as np
import pytest

import rejoint
from madetwin import made_calibration
from rejoint.arms import Displacement, mycobot280, tcp_position
from rejoint.diagnosis.calibration.measurements import Measurements, read_measurements
from rejoint.diagnosis.calibration.procedure import (
    BEFORE,
    SPEED,
    EmulatedGauge,
    StandingDrive,
    measure,
    reversals,
    suggest,
)
from rejoint.runs.run import Run
from rejoint.system.errors import ContractError, NotReadyError

ARM = mycobot280()
PLAN = suggest(ARM, 4, visits=2)


def measured_by(robot, gauge):
    drive = StandingDrive(robot)
    *_, (found, done) = measure(drive, gauge, PLAN)
    assert done == len(PLAN.posture)
    drive.rest()
    return found


def test_postures_are_come_to_from_both_sides_and_measured_standing_still():
    robot = rejoint.open_robot("emulated:healthy")
    commands = []
    step = robot.step

    def watched(command, active=None):
        before = robot.read()
        after = step(command, active)
        commands.append((after.time[0] - before.time[0], command[0]))
        return after

    robot.step = watched
    found = measured_by(robot, EmulatedGauge(seed=1))
    assert list(found.posture) == list(PLAN.posture)
    assert np.abs(found.position - PLAN.postures).max() < np.radians(3.0)
    period, sent = np.array([c[0] for c in commands]), np.array([c[1] for c in commands])
    rested = sent[5:][(sent[5:] == sent[:-5]).all(axis=1)]
    stood = rested[np.append(True, np.diff(rested, axis=0).any(axis=1))]
    sides = PLAN.postures + BEFORE * np.array([[-1.0], [1.0], [-1.0], [1.0]])
    np.testing.assert_allclose(stood[1:9], np.stack([sides, PLAN.postures], axis=1).reshape(8, 6), atol=1e-9)
    speed = np.abs(np.diff(sent, axis=0)).max(axis=1) / period[1:]
    assert np.median(speed[speed > 0]) < 1.2 * SPEED
    assert np.linalg.norm(found.point - tcp_position(ARM, found.position), axis=1).max() < 6e-3


class Pushing(EmulatedGauge):
    """Pushes the arm while it measures its first ``pushes`` times, and notes what it is told."""

    def __init__(self, pushes):
        super().__init__(seed=1)
        self.pushes, self.told = pushes, []

    def measure(self, robot, stop):
        self.told.append(stop.again)
        point = super().measure(robot, stop)
        if len(self.told) <= self.pushes:
            for _ in range(5):
                robot.step(robot.read().position + np.radians([0.0, 0.0, 0.0, 0.0, 12.0, 0.0]))
            for _ in range(20):
                robot.step(robot.read().position)
        return point


def test_a_posture_that_was_not_kept_while_it_was_measured_is_measured_again():
    gauge = Pushing(1)
    found = measured_by(rejoint.open_robot("emulated:healthy"), gauge)
    assert list(found.posture) == list(PLAN.posture)
    first, second, *others = gauge.told
    assert "while the arm was measured" in second
    assert not any([first, *others])
    with pytest.raises(NotReadyError, match=r"went .* 3 times"):
        measured_by(rejoint.open_robot("emulated:healthy"), Pushing(99))


def test_reversal_is_the_difference_of_two_sides_that_the_encoders_do_not_see():
    position = np.stack([ARM.rest, ARM.rest + 0.01, ARM.rest])
    point = tcp_position(ARM, position) + np.array([[1e-3, 0, 0], [-2e-3, 0, 0], [5e-3, 0, 0]])
    turned = np.array(
        [[0.0, -1, 0, 0.3], [1, 0, 0, -0.1], [0, 0, 1, 0.05], [0, 0, 0, 1]]
    )  # measuring frame in the base
    seen = (point - turned[:3, 3]) @ turned[:3, :3]
    measured = Measurements(
        position=position,
        point=seen,
        sigma=np.full(3, 1e-3),
        posture=[4, 4, 5],
        frame="room",
    )
    assert reversals(made_calibration(ARM, Displacement.none(ARM), frame=turned), measured) == pytest.approx((3e-3,))


def test_a_calibrated_arm_hits_what_it_missed(tmp_path):
    run = Run.create(tmp_path, "emulated:worn?seed=5", ARM)
    found = rejoint.calibrate("emulated:worn?seed=5", run=run, count=6)
    assert found.calibration.used
    assert found.before > 5e-3
    assert found.after < 0.4 * found.before
    assert len(found.reversal) == 6
    kept = read_measurements(run.folder.measurements, ARM)
    np.testing.assert_array_equal(kept.point, found.measurements.point)

    targets = ARM.targets.sample(np.random.default_rng(8), (3,))
    usual = rejoint.Settings(controller="integrator")
    plain, aimed, other = (
        rejoint.deploy(f"emulated:worn?seed={seed}", targets, run=run, settings=settings)
        for seed, settings in ((5, replace(usual, calibration="none")), (5, usual), (6, usual))
    )
    error = [np.mean([visit.true_error.value for visit in done.visits]) for done in (plain, aimed)]
    assert error[1] < 0.4 * error[0]
    assert [done.log.aim is None for done in (plain, aimed, other)] == [True, False, True]

    again = rejoint.calibrate(run=run, gauge=run.folder.measurements)  # without what they told before
    np.testing.assert_array_equal(again.calibration.displacement.offset, found.calibration.displacement.offset)
    with pytest.raises(ContractError, match="calibration of arm"):
        rejoint.deploy("emulated:so101", settings=replace(usual, calibration=found.calibration))
