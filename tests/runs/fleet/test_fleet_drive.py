"""Who does what next, with a executor that writes files instead of moving arms; no Ray."""

from dataclasses import replace
from datetime import datetime

import pytest

from rejoint.logs.history import SUMMARY, HistoryRow, utc_now, write_rows
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.runs.fleet.campaign import FleetRules, Work, WorkOutcome, run_fleet
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.repair import STAGES, stages_of
from rejoint.session.inputs import arm_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import write_json
from rejoint.system.stopping import Interrupted

MONDAY = datetime(2026, 11, 23, 9)
DONE = WorkOutcome(seconds=1.0)


class PlayedExecutor:
    """Does work at once, one piece at a time; ``plays`` says otherwise for a piece, by its arm and step."""

    def __init__(self, plays=None):
        self.plays = plays or {}
        self.begun: list[tuple[str, str]] = []
        self.together: list[set[str]] = []
        self.held: list[str] = []
        self.running: list[Work] = []

    def close(self): ...

    def begin(self, work):
        self.running.append(work)
        self.begun.append((work.arm.name, work.step))

    def hold(self, work):
        self.held.append(work.arm.name)

    def wait(self, _):
        self.together.append({work.arm.name for work in self.running if work.moves})
        work = self.running[0]
        play = self.plays.get((work.arm.name, work.step), [])
        turn = play.pop(0) if play else DONE
        if isinstance(turn, BaseException):
            raise turn
        if callable(turn):
            turn = turn()
        if turn is None:
            return []
        self.running.pop(0)
        if turn is DONE:
            leave_files(work)
        return [(work, turn)]


def leave_files(work, state="steady", error=1.0):
    """Leave what a step leaves."""
    if work.step == "check":
        place = work.folder / "checks" / work.arm.name / f"{utc_now():%Y%m%dT%H%M%S%f}" / SUMMARY
        place.parent.mkdir(parents=True)
        row = HistoryRow(time=utc_now(), kind="check", arm=work.arm.name, state=state, error_mm=error)
        write_rows(place, [replace(row, tolerance_mm=work.arm.tolerance_mm, line="No change. Do: nothing.")])
        return
    files = RunFolder(work.folder)
    file = stages_of(work.arm.address, arm_of(work.arm.address, None), files)[work.step]
    file.parent.mkdir(parents=True, exist_ok=True)
    assert not file.exists(), f"{work.step} of {work.arm.name} is done twice"
    file.write_text("done")
    if work.step == "report":
        files.finished.write_text("done")
        info = RunInfo(robot=work.arm.address, arm="mycobot280", seed=0, version="0", created="2026-11-23T09:00:00")
        write_json(files.info, info)
        row = HistoryRow(time=utc_now(), kind="repair", arm=work.arm.name, controller="policy", error_mm=20.0)
        write_rows(work.folder / SUMMARY, [replace(row, settled_mm=0.5)])


def arm(name, address="", **given):
    allowed = {"may_move": True, "may_repair": True, "needs_somebody": False}
    return FleetArm(name=name, address=address or f"tcp://10.0.0.{ord(name[0])}:9000", **{**allowed, **given})


def emulated(name):
    return arm(name, f"emulated:worn?seed={ord(name[0])}")


def call(
    tmp_path,
    arms,
    executor,
    verb="check",
    rules=None,
    **given,
):
    fleet = Fleet(path=tmp_path / "FLEET.toml", folder=tmp_path / "lab", arms=tuple(arms))
    return run_fleet(fleet, verb, lambda _: executor, rules or FleetRules(now=lambda: MONDAY), **given)


@pytest.mark.parametrize(
    ("given", "verb", "somebody", "why"),
    [
        ({"may_move": False}, "check", True, "may_move"),
        ({"may_repair": False}, "repair", True, "may_repair"),
        ({"needs_somebody": True}, "check", False, "somebody has to be there"),
        ({"hours": ["Tue 08:00-18:00"]}, "check", True, "its hours begin Tue 2026-11-24 08:00"),
        ({"hours": ["Mon 08:00-09:04", "Wed 10:00-11:00"]}, "check", True, "begin Wed 2026-11-25 10:00"),
        ({"may_repair": False}, "check", False, ""),
        ({"needs_somebody": True}, "check", True, ""),
        ({"hours": ["Mon 08:00-09:05"]}, "check", False, ""),
    ],
)
def test_nothing_moves_without_permission_and_outside_its_hours(tmp_path, given, verb, somebody, why):
    executor = PlayedExecutor()
    rules = FleetRules(somebody=somebody, now=lambda: MONDAY)
    found = call(tmp_path, [arm("a", **given)], executor, verb, rules)
    (row,) = found.rows
    assert executor.begun == ([] if why else [("a", "check")])
    assert (row.end, row.code) == (("left", 5) if why else ("done", 0))
    assert why in row.found
    assert found.code == row.code


def test_a_real_arm_does_not_move_again_by_itself(tmp_path):
    lost = WorkOutcome(problem="WorkerCrashedError", code=4)
    executor = PlayedExecutor({("a", "diagnose"): [lost], ("b", "train"): [lost]})
    found = call(tmp_path, [arm("a"), emulated("b")], executor, "repair")
    assert executor.begun.count(("a", "diagnose")) == 1
    worst, other = found.rows
    assert (worst.name, worst.end, worst.code) == ("a", "failed", 4)
    assert "WorkerCrashedError" in worst.found
    assert (other.end, other.code) == ("failed", 4)
    assert not found.finished
    executor = PlayedExecutor()
    call(tmp_path, [arm("a"), emulated("b")], executor, "repair")  # somebody has looked
    assert executor.begun[0] == ("a", "diagnose")
    assert ("b", "diagnose") not in executor.begun
    assert ("b", "train") in executor.begun


class KilledError(BaseException):
    """The process that leads is gone."""


def test_a_killed_lead_costs_one_step_of_each_arm(tmp_path):
    """Killed at each point in turn; then nothing is missing, and nothing was done twice."""
    arms = [emulated(name) for name in "abc"]
    done: list[tuple[str, str]] = []
    for name, step in [("a", "diagnose"), ("b", "identify"), ("c", "train"), ("a", "report")]:
        executor = PlayedExecutor({(name, step): [KilledError()]})
        with pytest.raises(KilledError):
            call(tmp_path, arms, executor, "repair")
        done += [one for one in executor.begun if one not in [(work.arm.name, work.step) for work in executor.running]]
    executor = PlayedExecutor()
    found = call(tmp_path, arms, executor, "repair")
    done += executor.begun
    stages = [step for step in STAGES if step != "gains"]
    assert sorted(done) == sorted((one.name, step) for one in arms for step in stages)
    assert found.finished
    assert not list(tmp_path.glob("lab/repairs/*/002"))
    call(tmp_path, arms, executor := PlayedExecutor(), "repair")  # all is done: the next one begins anew
    assert len(executor.begun) == len(arms) * len(stages)


def test_a_quick_try_says_so_and_counts_for_nothing_in_a_repair(tmp_path):
    arms, quick = [emulated("a"), emulated("b")], FleetRules(now=lambda: MONDAY, quick=True)
    (row,) = call(tmp_path, arms[:1], PlayedExecutor(), "repair", quick).rows
    assert (row.state, row.code) == ("quick try", 0)
    with pytest.raises(KilledError):
        call(tmp_path, arms, PlayedExecutor({("b", "report"): [KilledError()]}), "repair", quick)
    call(tmp_path, arms, executor := PlayedExecutor(), "repair")
    assert ("a", "diagnose") in executor.begun


def test_an_interruption_brings_arms_to_a_hold_first(tmp_path):
    held = WorkOutcome(seconds=1.0, problem="held, as it was asked to stop", code=130)
    executor, events = PlayedExecutor({("a", "check"): [Interrupted(2), held], ("e", "check"): [None] * 100}), []
    with pytest.raises(Interrupted):
        call(tmp_path, [arm("a"), emulated("e")], executor, tell=events.append)
    assert events[-1] == "a: check failed: held during check"  # and no hours, which are now
    assert executor.held == ["a"]
    assert [work.arm.name for work in executor.running] == ["e"]


def test_what_fails_is_told_and_others_go_on(tmp_path):
    problems = {
        ("a", "check"): [WorkOutcome(seconds=1.0, problem="no robot answers", code=2)],
        ("b", "check"): [WorkOutcome(seconds=1.0, problem="a bug: KeyError", code=1)],
        ("c", "check"): [WorkOutcome(seconds=1.0)],  # says that it is done, but nothing is there
    }
    events: list[str] = []
    found = call(tmp_path, [arm(name) for name in "abcd"], PlayedExecutor(problems), tell=events.append)
    assert [(row.name, row.end, row.code) for row in found.rows] == [
        ("b", "failed", 1),
        ("c", "failed", 4),
        ("a", "failed", 2),
        ("d", "done", 0),
    ]
    assert "left no file" in found.rows[1].found
    assert found.code == 1
    assert "no robot answers" in found.page.read_text()
    ends = {line.split(":")[0]: line.split()[2] for line in events[1:] if not line.endswith("begun")}
    assert ends == {"a": "failed:", "b": "failed:", "c": "failed:", "d": "done"}
    call(tmp_path, [arm(name) for name in "abcd"], executor := PlayedExecutor())
    assert {name for name, _ in executor.begun} == {"a", "b", "c"}


def test_only_those_are_repaired_that_need_it(tmp_path):
    """One in alarm, one over its tolerance, one that is steady, one in alarm that may not be repaired."""
    arms = [emulated("a"), arm("b", tolerance_mm=2.0), emulated("c"), arm("d", may_repair=False)]
    seen = {"a": ("alarm", 1.0), "b": ("learning", 2.5), "c": ("drifting", 1.0), "d": ("alarm", 1.0)}

    class Checked(PlayedExecutor):
        def wait(self, timeout):
            work = self.running[0]
            if work.step != "check":
                return super().wait(timeout)
            self.running.pop(0)
            leave_files(work, *seen[work.arm.name])
            return [(work, DONE)]

    executor = Checked()
    found = call(tmp_path, arms, executor, "repair", FleetRules(needed=True, now=lambda: MONDAY))
    assert [name for name, step in executor.begun if step == "check"] == ["a", "b", "c", "d"]
    assert {name for name, step in executor.begun if step == "report"} == {"a", "b"}
    rows = {row.name: row for row in found.rows}
    assert (rows["a"].state, rows["a"].error_mm) == ("repaired", 0.5)
    assert "Use policy." in rows["a"].found
    assert (rows["c"].end, rows["c"].state, rows["c"].code) == ("done", "drifting", 6)
    assert (rows["d"].end, rows["d"].code) == ("left", 5)
    assert found.finished


def test_two_calls_do_not_lead_at_once_and_arms_are_named_right(tmp_path):
    def second():
        with pytest.raises(FileError, match="this program is working"):
            call(tmp_path, [arm("a")], PlayedExecutor())
        return DONE

    executor = PlayedExecutor({("a", "check"): [second]})
    assert call(tmp_path, [arm("a")], executor).rows[0].end == "done"
    with pytest.raises(InputError, match="has no arm x; it has: a"):
        call(tmp_path, [arm("a")], PlayedExecutor(), only=("x",))


def test_a_dry_run_of_a_fleet_moves_nothing_and_writes_nothing(tmp_path, cli):
    file = tmp_path / "fleet.toml"
    file.write_text('[[arm]]\nname = "a"\naddress = "emulated:worn"\n')
    assert "Dry run, nothing moved" in " ".join(cli("fleet", "check", file, "--dry-run").err.split())
    assert list(tmp_path.iterdir()) == [file]
