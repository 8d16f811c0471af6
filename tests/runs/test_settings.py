"""Settings: refused where they cannot be meant, kept by a run, and the same words at the command line."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import rejoint
from hearing import Hears
from rejoint.arms import Box, mycobot280
from rejoint.arms.inertia import LoadedArm, Payload, loaded
from rejoint.runs.run import Run, mark
from rejoint.session.driver import RehearsedRobot
from rejoint.session.inputs import keep, settled
from rejoint.session.session import Session
from runs.test_connect import HERE, WALL, a_twin

ARM = mycobot280()
GIVEN = rejoint.Settings(payload=0.1, tool=[0.0, 0.0, 0.05], keep_out=[WALL], period=(0.02, 0.03), within=0.003)


@pytest.fixture
def run(tmp_path):
    return Run.create(tmp_path, "emulated:worn", ARM)


@pytest.mark.parametrize(
    "call",
    [
        partial(rejoint.Settings, within=2.0),
        partial(rejoint.Settings, within=np.nan),
        partial(rejoint.Settings, payload=-1.0),
        partial(rejoint.Settings, tool=[0.0, 0.0, 50.0]),
        partial(rejoint.load_arm, 3),
        partial(rejoint.Run.open, None),
        partial(rejoint.train, 3),
        partial(rejoint.compare, "emulated:worn", plan={}),
        partial(rejoint.check, "emulated:worn", notes=rejoint.CheckNotes(when="2027-01-01")),
        lambda: rejoint.connect("emulated:so101", settings=rejoint.Settings(twin=a_twin())).robot,
    ],
)
def test_what_cannot_be_meant_is_refused_at_once(call):
    with pytest.raises((rejoint.InputError, rejoint.ContractError)):
        call()


def test_arguments_of_another_kind_are_refused_before_anything_moves():
    for call in (rejoint.connect, rejoint.deploy, rejoint.diagnose, rejoint.repair):
        for wrong in ({"settings": {"payload": 0.1}}, {"arm": 3}, {"run": 3}, {"observer": rejoint.Observer}):
            with pytest.raises(rejoint.InputError):
                call("emulated:worn", **wrong)
        with pytest.raises(rejoint.InputError, match=r"'5'|got 5"):
            call(5)


def test_a_run_keeps_the_settings_of_its_diagnosis_and_others_go_before_them(run):
    keep(run, GIVEN)
    found, said = settled(None, run, "emulated:worn")
    assert said
    assert isinstance(found.payload, Payload)
    assert (found.payload.mass, found.payload.com) == (0.1, (0.0, 0.0, 0.0))
    assert (found.period, found.within) == (GIVEN.period, GIVEN.within)
    np.testing.assert_array_equal(found.tool, GIVEN.tool)
    np.testing.assert_array_equal(found.keep_out[0].upper, WALL.upper)
    other = rejoint.Settings(payload=0.0, tool=np.zeros(3), keep_out=[WALL], period=(0.03, 0.04), within=0.001)
    both = settled(replace(other, keep_out=[Box(lower=np.zeros(3), upper=np.ones(3))]), run, "emulated:worn")[0]
    assert (len(both.keep_out), both.period) == (2, other.period), "boxes add up"
    walled = Run.create(f"{run.path}-2", "emulated:worn", replace(ARM, keep_out=(WALL,)))
    for robot in ("emulated:worn", rejoint.open_robot("emulated:worn")):
        assert len(Session(robot, run=walled, arm=walled.arm).arm.keep_out) == 1
    own = settled(None, run, rejoint.open_robot("emulated:worn"))[0]
    assert own.payload is own.tool is None, "an open robot has its own"
    assert own.period == GIVEN.period
    assert settled(GIVEN, None, "emulated:worn") == (GIVEN, "")


def test_a_rehearsal_gathers_speed_as_the_twin_does():
    robot, ways = rejoint.open_robot("emulated:worn"), []
    for acceleration in (np.inf, 5.0):
        rehearsed = RehearsedRobot(robot, replace(a_twin(), acceleration=acceleration), None)
        start = rehearsed.read().position
        for cycle in range(10):
            state = rehearsed.step(start + 0.02 * cycle)
        ways.append(np.abs(state.position - start).max())
    assert ways[1] < 0.7 * ways[0]


def test_kept_settings_drive_the_arm_and_are_named(run):
    a_twin().save(run.path / "twin.toml")
    keep(run, rejoint.Settings(payload=0.05, keep_out=[WALL]))
    mark(run.folder.quick)
    said = list[str]()
    with rejoint.connect("emulated:worn", run=run.path, observer=Hears(message=said.append)) as arm:
        assert isinstance(arm.arm, LoadedArm)
        np.testing.assert_array_equal(arm.arm.mass, loaded(ARM, 0.05).mass)
        assert len(arm.arm.keep_out) == len(ARM.keep_out) + 1
        assert any("--payload 0.05 " in line for line in said)
        assert any("quick" in line for line in said)
    with rejoint.connect("emulated:worn", run=run.path, settings=rejoint.Settings(payload=0.0)) as arm:
        np.testing.assert_array_equal(arm.arm.mass, ARM.mass)


def test_what_an_arm_does_is_recorded_in_motions_and_between(run):
    with rejoint.connect("emulated:worn", run=run) as arm:
        with arm.recording("idle") as idle:
            assert arm.state.time_s == 0.0
        assert not idle.log.commanded, "nothing was sent"
        held = arm.record(1.0)
        assert np.ptp(held.time) >= 1.0
        assert np.abs(np.diff(held.position, axis=0)).max() < np.radians(5.0)
        with arm.recording("pick") as taken:
            arm.move_to(HERE, within_m=0.01)
            end = arm.move_joints(arm.state.joints_rad + 0.05, within_rad=0.1)
        assert taken.log.commanded
        np.testing.assert_allclose(taken.log.position[-1], end.joints_rad, atol=1e-9)
        assert np.isfinite(taken.log.target).all(axis=-1).any()
        arm.move_to([0.17, 0.0, 0.2], within_m=1e-6, timeout_s=600.0, wait=False)
        assert len(arm.record(0.5)) > 10, "a motion is recorded as it is"
        arm.stop()
        for wrong in (0.0, np.nan, None, "10 s"):
            with pytest.raises(rejoint.InputError, match="duration in seconds"):
                arm.record(wrong)
    logs = Run.open(run.path).logs
    assert {name.split("-")[0] for name in logs} >= {"idle", "record", "pick", "move"}
    whole = next(log for name, log in logs.items() if name.startswith("pick"))
    np.testing.assert_array_equal(whole.position, taken.log.position)


def test_a_session_drives_by_what_the_stages_find_with_the_load_that_the_run_was_told(tmp_path, few_targets):
    run = Run.create(tmp_path, "emulated:worn", ARM)
    stage = {"run": run, "settings": rejoint.Settings(payload=0.05, keep_out=[WALL])}
    assert "joint" in rejoint.diagnose("emulated:worn", quick=True, **stage).verdict
    assert rejoint.identify(run=run).arm == ARM.name
    once = rejoint.TrialPlan(repetitions=1)
    rejoint.compare("emulated:worn", ["default", "predictive"], [HERE], plan=once, **stage)
    with rejoint.connect("emulated:worn", run=run) as arm:
        assert arm.controller == "predictive"
        arm.move_to(HERE, within_m=0.003)
    assert settled(None, run, "emulated:worn")[0].payload.mass == 0.05
    robot = rejoint.open_robot("emulated:worn", arm=loaded(ARM, 0.05))
    for other in (rejoint.Settings(payload=0.1), rejoint.Settings(tool=[0.0, 0.0, 0.05])):
        with pytest.raises(rejoint.InputError, match="not with an open one"):
            rejoint.deploy(robot, [HERE], settings=other)


def test_a_dry_repair_moves_nothing_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, said = rejoint.open_robot("emulated:worn"), list[str]()
    before, dry = robot.read(), rejoint.Settings(dry_run=True)
    rejoint.repair(robot, quick=True, settings=dry, observer=Hears(message=said.append))
    np.testing.assert_array_equal(robot.read().time, before.time)
    assert sum("nothing moved" in line for line in said) == 2
    assert list(tmp_path.iterdir()) == []
