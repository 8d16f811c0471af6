"""Who does what next, with a executor that writes files instead of moving arms; no Ray."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from rejoint.arms import load_arm, write_arm_toml
from rejoint.cli import main
from rejoint.logs.history.rows import SUMMARY, HistoryRow, utc_now, write_rows
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.runs.chain import STAGES, stages_of
from rejoint.runs.fleet import campaign as campaigns
from rejoint.runs.fleet.call import run_fleet
from rejoint.runs.fleet.campaign import Campaign, state_file
from rejoint.runs.fleet.drive import TRIES, Event, Rules, drive
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.fleet.hours import read_hours
from rejoint.runs.fleet.result import FleetResult
from rejoint.runs.fleet.work import Lost, RepairOptions, Work, WorkOutcome
from rejoint.runs.given import arm_of
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError, UnsavedError
from rejoint.system.stopping import Interrupted

MONDAY = datetime(2026, 11, 23, 9)
DONE = WorkOutcome(seconds=1.0)


class PlayedExecutor:
    """Does work at once, one piece at a time; ``plays`` says otherwise for a piece, by its arm and step."""

    def __init__(self, plays: dict[tuple[str, str], list[object]] | None = None) -> None:
        self.plays = plays or {}
        self.begun: list[tuple[str, str]] = []
        self.together: list[set[str]] = []
        self.held: list[str] = []
        self.running: list[Work] = []

    def __enter__(self) -> "PlayedExecutor":
        return self

    def __exit__(self, *_: object) -> None: ...

    def begin(self, work: Work) -> None:
        self.running.append(work)
        self.begun.append((work.arm.name, work.step))

    def hold(self, work: Work) -> None:
        self.held.append(work.arm.name)

    def wait(self, _: float) -> Sequence[tuple[Work, WorkOutcome | Lost]]:
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


def leave_files(work: Work, state: str = "steady", error: float = 1.0) -> None:
    """Leave what a step leaves."""
    if work.step == "check":
        place = work.folder / "checks" / work.arm.name / f"{utc_now():%Y%m%dT%H%M%S%f}" / SUMMARY
        place.parent.mkdir(parents=True)
        write_rows(place, [HistoryRow(time=utc_now(), kind="check", arm=work.arm.name, state=state, error_mm=error,
                                      tolerance_mm=work.arm.tolerance_mm,
                                      line="No change. Do: nothing; check again in a month.")])  # fmt: skip
        return
    files = RunFolder(work.folder)
    file = stages_of(work.arm.address, arm_of(work.arm.address, None), files)[work.step]
    file.parent.mkdir(parents=True, exist_ok=True)
    assert not file.exists(), f"{work.step} of {work.arm.name} is done twice"
    file.write_text("done")
    if work.step == "report":
        files.finished.write_text("done")


def arm(name: str, address: str = "", **given: object) -> FleetArm:
    allowed = {"may_move": True, "may_repair": True, "needs_somebody": False}
    return FleetArm(name=name, address=address or f"tcp://10.0.0.{ord(name[0])}:9000", **{**allowed, **given})


def emulated(name: str) -> FleetArm:
    return arm(name, f"emulated:worn?seed={ord(name[0])}")


def call(
    tmp_path: Path,
    arms: Sequence[FleetArm],
    executor: PlayedExecutor,
    verb: str = "check",
    rules: Rules | None = None,
    **given: object,
) -> FleetResult:
    fleet = Fleet(path=tmp_path / "FLEET.toml", folder=tmp_path / "lab", arms=tuple(arms))
    return run_fleet(fleet, verb, lambda _: executor, rules or Rules(now=lambda: MONDAY), **given)


def test_steps_are_those_of_a_repair_in_their_order(tmp_path: Path) -> None:
    executor = PlayedExecutor()
    found = call(tmp_path, [emulated("a"), arm("b")], executor, "repair")
    for name, left_out in (("a", {"gains"}), ("b", {"gains", "calibrate"})):
        assert [step for one, step in executor.begun if one == name] == [s for s in STAGES if s not in left_out]
    assert found.finished
    assert {row.end for row in found.rows} == {"done"}


@pytest.mark.parametrize(
    ("given", "verb", "somebody", "why"),
    [
        ({"may_move": False}, "check", True, "may_move"),
        ({"may_repair": False}, "repair", True, "may_repair"),
        ({"needs_somebody": True}, "check", False, "somebody has to be there"),
        ({"hours": read_hours(["Tue 08:00-18:00"])}, "check", True, "its hours begin Tue 2026-11-24 08:00"),
        ({"hours": read_hours(["Mon 08:00-09:04", "Wed 10:00-11:00"])}, "check", True, "begin Wed 2026-11-25 10:00"),
    ],
)
def test_nothing_moves_without_permission_and_outside_its_hours(
    tmp_path: Path, given: dict[str, object], verb: str, somebody: bool, why: str
) -> None:
    executor = PlayedExecutor()
    rules = Rules(somebody=somebody, now=lambda: MONDAY)
    found = call(tmp_path, [arm("a", **given)], executor, verb, rules)
    assert executor.begun == []
    (row,) = found.rows
    assert (row.end, row.code) == ("left", 5)
    assert why in row.found
    assert found.code == 5


@pytest.mark.parametrize(
    ("given", "verb", "somebody"),
    [
        ({"may_repair": False}, "check", False),
        ({"needs_somebody": True}, "check", True),
        ({"hours": read_hours(["Mon 08:00-09:05"])}, "check", False),
    ],
)
def test_what_is_allowed_moves(tmp_path: Path, given: dict[str, object], verb: str, somebody: bool) -> None:
    executor = PlayedExecutor()
    found = call(tmp_path, [arm("a", **given)], executor, verb, Rules(somebody=somebody, now=lambda: MONDAY))
    assert executor.begun == [("a", "check")]
    assert found.code == 0


def test_stages_in_which_nothing_moves_know_no_hours(tmp_path: Path) -> None:
    """Diagnosed on Monday, identified and trained in the night, compared when the arm may move again."""
    times = iter([MONDAY] * 2 + [MONDAY.replace(hour=20)] * 100)
    here = arm("a", hours=read_hours(["Mon-Fri 08:00-18:00"]))
    rules = Rules(now=lambda: next(times))
    executor = PlayedExecutor()
    found = call(tmp_path, [here], executor, "repair", rules)
    assert [step for _, step in executor.begun] == ["diagnose", "identify", "train"]
    assert "begin Tue 2026-11-24 08:00" in found.rows[0].found
    executor = PlayedExecutor()
    found = call(tmp_path, [here], executor, "repair", Rules(now=lambda: MONDAY + timedelta(days=1)))
    assert [step for _, step in executor.begun] == ["compare", "report"]
    assert found.finished


def test_an_arm_is_held_when_its_hours_end(tmp_path: Path) -> None:
    clock = {"now": MONDAY}

    def later() -> None:
        clock["now"] = MONDAY.replace(hour=18)

    held = WorkOutcome(seconds=1.0, problem="held, as it was asked to stop", code=143)
    executor = PlayedExecutor({("a", "check"): [later, None, held]})
    here = arm("a", hours=read_hours(["Mon-Fri 08:00-18:00"]))
    found = call(tmp_path, [here], executor, rules=Rules(now=lambda: clock["now"]))
    assert executor.held == ["a"]
    assert (found.rows[0].end, found.rows[0].code) == ("left", 5)
    assert "held during check; its hours begin Tue" in found.rows[0].found


def test_whose_hours_end_first_comes_first(tmp_path: Path) -> None:
    arms = [arm("a"), arm("b", hours=read_hours(["Mon 08:00-18:00"])), arm("c", hours=read_hours(["Mon 08:00-12:00"]))]
    executor = PlayedExecutor()
    call(tmp_path, arms, executor)
    assert [name for name, _ in executor.begun] == ["c", "b", "a"]


def test_one_arm_of_a_bench_moves_at_a_time_and_so_many_in_all(tmp_path: Path) -> None:
    arms = [arm("a", bench="one"), arm("b", bench="one"), arm("c", bench="two"), arm("d"), emulated("e")]
    executor = PlayedExecutor()
    call(tmp_path, arms, executor)
    assert max(len(names & {"a", "b"}) for names in executor.together) == 1
    assert {"a", "c", "d", "e"} in executor.together
    executor = PlayedExecutor()
    call(tmp_path, arms, executor, rules=Rules(at_once=2, now=lambda: MONDAY), anew=True)
    assert max(len(names - {"e"}) for names in executor.together) == 2  # emulated ones move nothing
    assert len(executor.begun) == 5


def test_a_real_arm_does_not_move_again_by_itself(tmp_path: Path) -> None:
    lost = Lost(why="WorkerCrashedError")
    executor = PlayedExecutor({("a", "diagnose"): [lost], ("b", "diagnose"): [lost], ("b", "train"): [lost]})
    found = call(tmp_path, [arm("a"), emulated("b")], executor, "repair")
    assert executor.begun.count(("a", "diagnose")) == 1
    assert executor.begun.count(("b", "diagnose")) == 2
    assert executor.begun.count(("b", "train")) == 2
    worst, other = found.rows
    assert (worst.name, worst.end, worst.code) == ("a", "failed", 4)
    assert "look at the arm" in worst.found
    assert (other.end, other.lost) == ("done", 2)
    assert not found.finished
    executor = PlayedExecutor()
    call(tmp_path, [arm("a"), emulated("b")], executor, "repair")  # somebody has looked
    assert executor.begun[0] == ("a", "diagnose")
    assert "b" not in {name for name, _ in executor.begun}


def test_training_of_a_real_arm_is_done_again_and_ends_somewhere(tmp_path: Path) -> None:
    executor = PlayedExecutor({("a", "train"): [Lost(why="OutOfMemoryError")] * 10})
    found = call(tmp_path, [arm("a")], executor, "repair")
    assert executor.begun.count(("a", "train")) == TRIES
    assert executor.begun.count(("a", "diagnose")) == 1
    assert "lost 4 times" in found.rows[0].found


class KilledError(BaseException):
    """The process that leads is gone."""


def test_a_killed_lead_costs_one_step_of_each_arm(tmp_path: Path) -> None:
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
    assert len({(tmp_path / "lab" / "repairs" / one.name / "002").exists() for one in arms} | {False}) == 1
    call(tmp_path, arms, executor := PlayedExecutor(), "repair")  # all is done: the next one begins anew
    assert len(executor.begun) == len(arms) * len(stages)


def test_an_arm_that_is_described_otherwise_begins_another_run(tmp_path: Path) -> None:
    """Of three arms two were interrupted; one of them is described otherwise then, and so is one that was through."""
    own = tmp_path / "own.toml"
    write_arm_toml(own, replace(load_arm("mycobot280"), name="own"))
    arms = [replace(emulated(name), description=str(own)) for name in "ab"] + [emulated("c")]
    fleet = Fleet(path=tmp_path / "FLEET.toml", folder=tmp_path / "lab", arms=tuple(arms))
    first = Campaign.open(fleet, "repair")
    for one in arms:
        Run.create(first.run(one), one.address, arm_of(one.address, one.description))
    RunFolder(first.run(arms[1])).finished.write_text("done")
    assert Campaign.open(fleet, "repair").info == first.info
    write_arm_toml(own, replace(load_arm("mycobot280"), name="own", mass=1.2 * load_arm("mycobot280").mass))
    runs = Campaign.open(fleet, "repair").info.runs
    assert runs == {"a": "repairs/a/002", "b": "repairs/b/001", "c": "repairs/c/001"}
    RunFolder(first.run(arms[2])).info.write_text("damaged")
    assert Campaign.open(fleet, "repair").info.runs == runs, "who works there says so, and only that arm fails"


def test_checks_go_on_and_begin_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arms = [emulated("a"), emulated("b")]
    with pytest.raises(KilledError):
        call(tmp_path, arms, PlayedExecutor({("b", "check"): [KilledError()]}))
    found = call(tmp_path, arms, executor := PlayedExecutor())
    assert executor.begun == [("b", "check")]
    assert [(row.state, row.end) for row in found.rows] == [("steady", "done")] * 2
    assert f"ended {found.ended:%Y-%m-%d %H:%M} UTC" in found.page.read_text()  # of a call cut short it is an older one
    call(tmp_path, arms, executor := PlayedExecutor())
    assert len(executor.begun) == 2
    with pytest.raises(KilledError):
        call(tmp_path, arms, PlayedExecutor({("b", "check"): [KilledError()]}))
    monkeypatch.setitem(campaigns.STALE, "check", timedelta(0))  # the next week
    call(tmp_path, arms, executor := PlayedExecutor())
    assert len(executor.begun) == 2


def test_what_a_wrong_clock_began_in_the_future_is_begun_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arms = [emulated("a"), emulated("b")]
    with monkeypatch.context() as wrong:
        wrong.setattr(campaigns, "utc_now", lambda: utc_now() + timedelta(days=1))
        with pytest.raises(KilledError):
            call(tmp_path, arms, PlayedExecutor({("b", "check"): [KilledError()]}))
    found = call(tmp_path, arms, executor := PlayedExecutor())
    assert len(executor.begun) == 2
    assert found.finished


def test_some_arms_alone_are_a_call_of_their_own(tmp_path: Path) -> None:
    arms = [emulated("a"), emulated("b")]
    for _ in range(2):  # a norm is made of checks that follow one another
        found = call(tmp_path, arms, executor := PlayedExecutor(), only=("a",))
        assert executor.begun == [("a", "check")]
        assert found.finished
    with pytest.raises(KilledError):
        call(tmp_path, arms, PlayedExecutor({("b", "check"): [KilledError()]}))
    assert not call(tmp_path, arms, executor := PlayedExecutor(), only=("a",)).finished  # b is still to be checked
    assert executor.begun == []
    assert call(tmp_path, arms, executor := PlayedExecutor(), only=("b",)).finished
    assert executor.begun == [("b", "check")]


def test_an_interruption_brings_arms_to_a_hold_first(tmp_path: Path) -> None:
    held = WorkOutcome(seconds=1.0, problem="held, as it was asked to stop", code=130)
    executor = PlayedExecutor({("a", "check"): [Interrupted(2), held], ("e", "check"): [None] * 100})
    with pytest.raises(Interrupted):
        call(tmp_path, [arm("a"), emulated("e")], executor)
    assert executor.held == ["a"]
    assert [work.arm.name for work in executor.running] == ["e"]


def test_what_fails_is_told_and_others_go_on(tmp_path: Path) -> None:
    problems = {
        ("a", "check"): [WorkOutcome(seconds=1.0, problem="no robot answers", kind="AddressError", code=2)],
        ("b", "check"): [WorkOutcome(seconds=1.0, problem="a bug: KeyError", kind="KeyError", code=1, trace="Trace")],
        ("c", "check"): [WorkOutcome(seconds=1.0)],  # says that it is done, but nothing is there
    }
    events: list[Event] = []
    found = call(tmp_path, [arm(name) for name in "abcd"], PlayedExecutor(problems), tell=events.append)
    assert [(row.name, row.end, row.code) for row in found.rows] == [
        ("b", "failed", 1), ("c", "failed", 4), ("a", "failed", 2), ("d", "done", 0),
    ]  # fmt: skip
    assert "left no file" in found.rows[1].found
    assert found.code == 1
    assert (tmp_path / "lab" / "fleet" / "bug-b.txt").read_text() == "Trace"
    assert "no robot answers" in found.page.read_text()
    assert {(event.arm.name, event.kind) for event in events if event.kind != "begun"} == {
        ("a", "failed"), ("b", "failed"), ("c", "failed"), ("d", "done"),
    }  # fmt: skip
    call(tmp_path, [arm(name) for name in "abcd"], executor := PlayedExecutor())
    assert {name for name, _ in executor.begun} == {"a", "b", "c"}


def test_only_those_are_repaired_that_need_it(tmp_path: Path) -> None:
    """One in alarm, one over its tolerance, one that is steady, one in alarm that may not be repaired."""
    arms = [emulated("a"), arm("b", tolerance_mm=2.0), emulated("c"), arm("d", may_repair=False)]
    seen = {"a": ("alarm", 1.0), "b": ("learning", 2.5), "c": ("drifting", 1.0), "d": ("alarm", 1.0)}

    class Checked(PlayedExecutor):
        def wait(self, timeout: float) -> Sequence[tuple[Work, WorkOutcome | Lost]]:
            work = self.running[0]
            if work.step != "check":
                return super().wait(timeout)
            self.running.pop(0)
            leave_files(work, *seen[work.arm.name])
            return [(work, DONE)]

    executor = Checked()
    found = call(tmp_path, arms, executor, "repair", options=RepairOptions(needed=True))
    assert [name for name, step in executor.begun if step == "check"] == ["a", "b", "c", "d"]
    assert {name for name, step in executor.begun if step == "report"} == {"a", "b"}
    rows = {row.name: row for row in found.rows}
    assert (rows["c"].end, rows["c"].state, rows["c"].code) == ("done", "drifting", 6)
    assert (rows["d"].end, rows["d"].code) == ("left", 5)
    assert found.finished


def test_two_calls_do_not_lead_at_once_and_arms_are_named_right(tmp_path: Path) -> None:
    fleet = Fleet(path=tmp_path / "FLEET.toml", folder=tmp_path / "lab", arms=(arm("a"),))

    def second() -> WorkOutcome:
        with pytest.raises(FileError, match="this program is working"):
            call(tmp_path, fleet.arms, PlayedExecutor())
        return DONE

    executor = PlayedExecutor({("a", "check"): [second]})
    assert call(tmp_path, fleet.arms, executor).rows[0].end == "done"
    with pytest.raises(InputError, match="has no arm x; it has: a"):
        call(tmp_path, fleet.arms, PlayedExecutor(), only=("x",))


def test_waits_for_hours_that_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": MONDAY}

    def sleep(seconds: float) -> None:
        clock["now"] += timedelta(hours=1)

    monkeypatch.setattr("rejoint.runs.fleet.drive.pause", sleep)
    here = arm("a", hours=read_hours(["Tue 08:00-18:00"]))
    executor = PlayedExecutor()
    found = call(tmp_path, [here], executor, rules=Rules(stay=True, now=lambda: clock["now"]))
    assert found.rows[0].end == "done"
    assert clock["now"] == datetime(2026, 11, 24, 8)


def test_the_command_ends_with_the_worst_and_in_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, object]] = []

    class Stub(PlayedExecutor):
        def __init__(self, _: Sequence[FleetArm], **options: object) -> None:
            given.append(options)
            super().__init__({("real", "check"): [WorkOutcome(seconds=1.0, problem="no robot answers", code=2)]})

        def watch(self, show: object) -> None: ...

        def close(self) -> None:
            given.append({"closed": True})

    monkeypatch.setattr("rejoint.runs.fleet.rayexecutor.RayExecutor", Stub)
    text = 'may_move = true\nneeds_somebody = false\n[[arm]]\nname = "virtual"\naddress = "emulated:worn"\n'
    text += '[[arm]]\nname = "real"\naddress = "tcp://10.0.0.1"\n[[arm]]\nname = "left"\naddress = "tcp://10.0.0.2"\n'
    (tmp_path / "FLEET.toml").write_text(f"{text}needs_somebody = true\n")
    monkeypatch.setattr(
        "sys.argv", ["rejoint", "fleet", "check", str(tmp_path / "FLEET.toml"), "--json", "--cpus", "2"]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    shown, said = capsys.readouterr()
    rows = json.loads(shown.splitlines()[-1])["rows"]
    assert [(row["name"], row["end"], row["code"]) for row in rows] == [
        ("real", "failed", 2), ("left", "left", 5), ("virtual", "done", 0),
    ]  # fmt: skip
    assert "real: check failed: check: no robot answers" in said
    assert given == [{"address": None, "cpus": 2, "training_cpus": 1.0}, {"closed": True}]


def test_what_became_of_the_arms_is_told_where_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *_: object) -> None:
        raise FileError(path, "cannot be written (No space left on device)", "free some space")

    arms = [emulated("a"), arm("b")]
    monkeypatch.setattr("rejoint.runs.fleet.page.write_page", full)
    failed = WorkOutcome(seconds=1.0, problem="a bug", kind="KeyError", code=1, trace="where it is")
    with pytest.raises(UnsavedError, match="No space left") as error:
        call(tmp_path, arms, PlayedExecutor({("b", "check"): [failed]}))
    assert [(row.name, row.end) for row in error.value.result.rows] == [("b", "failed"), ("a", "done")]
    assert (tmp_path / "lab" / "fleet" / "bug-b.txt").read_text() == "where it is"
    monkeypatch.setattr(campaigns, "write_json", full)
    with pytest.raises(FileError, match="No space left"):
        call(tmp_path, arms, PlayedExecutor())


def test_the_state_is_a_plain_file(tmp_path: Path) -> None:
    fleet = Fleet(path=tmp_path / "FLEET.toml", folder=tmp_path / "lab", arms=(arm("a"),))
    campaign = Campaign.open(fleet, "repair")
    told = json.loads(state_file(fleet, "repair").read_text())
    assert told["runs"] == {"a": "repairs/a/001"}
    assert not told["finished"]
    standing = drive(fleet.arms, campaign.left, campaign.work, PlayedExecutor(), Rules())
    assert [step for step, _ in standing[0].steps] == [s for s in STAGES if s not in ("gains", "calibrate")]


def test_who_only_takes_reports_loads_nothing_of_the_work() -> None:
    code = (
        "import sys, rejoint.runs.fleet.rayworker as _; print(sorted({'numpy', 'pyarrow', 'numba'} & {*sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
