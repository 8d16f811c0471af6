"""The live view without a browser: nothing is lost, torn or changed, and what is drawn and said is so."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rejoint.arms import frames, load_arm, mycobot280, tcp_position
from rejoint.arms.collision import collides
from rejoint.arms.rotations import rotation_of
from rejoint.cli.live import HERE, host_and_port, with_place
from rejoint.control.default import DefaultController
from rejoint.control.guard import GuardLimits, Reason, guard
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState
from rejoint.pages.live import animation, panel
from rejoint.pages.live.ghost import Ghost
from rejoint.pages.live.ring import Ring
from rejoint.pages.live.skeleton import Skeleton, capsule
from rejoint.pages.live.trails import Trails
from rejoint.pages.live.view import LiveView
from rejoint.pages.live.words import guard_words
from rejoint.robots import open_robot, wallclock
from rejoint.system.errors import InputError
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import Draw, Simulation

ARM = mycobot280()
N = ARM.joints


def write(ring, number, *, time=None, reasons=0, position=None, wanted=None, command=None, **given):
    """Write a record every number of which is ``number``, unless given."""
    each, point = np.full((1, N), float(number)), np.full((1, 3), float(number))
    position, wanted, command = (each if one is None else one[None] for one in (position, wanted, command))
    cycle = Cycle(
        time=np.array([number if time is None else time], dtype=float), position=position, command=command,
        target=given.get("target", point), aim=point, target_index=np.array([number]),
        since_target=np.zeros(1), true_tcp=given.get("true_tcp", point), active=np.array([True]),
        reasons=np.array([reasons], dtype=np.uint16), load=each, turned=np.full(1, np.nan),
    )  # fmt: skip
    state = JointState(
        time=cycle.time, position=position, age=np.zeros(1), temperature=given.get("temperature"), load=each
    )
    ring.write(0, cycle, state, wanted)


@given(slots=st.integers(1, 9), writes=st.lists(st.integers(0, 12), max_size=12))
def test_a_reader_gets_the_newest_records_once_and_in_order(slots, writes):
    ring, read, written, seen = Ring(N, slots), 0, 0, []
    for burst in writes:
        for number in range(written, written + burst):
            write(ring, number)
        written += burst
        records, read = ring.since(read)
        assert len(records) == min(burst, slots)  # what did not fit is lost, the oldest first
        assert records.index.tolist() == list(range(written - len(records), written))
        seen += records.index.tolist()
    assert seen == sorted(set(seen))


def test_records_that_are_read_while_others_are_written_are_whole():
    ring, last = Ring(N, 7), 30_000

    def writer():
        for number in range(last):
            write(ring, number)

    thread, read, seen = threading.Thread(target=writer), 0, []
    thread.start()
    alive = True
    while alive:  # once more after its end
        alive = thread.is_alive()
        records, read = ring.since(read)
        numbers = records.index
        assert (records.position == numbers[:, None]).all()
        assert (records.true_tcp == numbers[:, None]).all()
        seen += numbers.tolist()
    thread.join()
    assert seen == sorted(set(seen))
    assert seen[-1] == last - 1


def test_a_slot_that_is_filled_anew_while_it_is_read_is_left_out():
    ring = Ring(N, 6)

    class Overtaken(list):
        """Slots of which the writer fills four more while a reader is at its second."""

        def __getitem__(self, place):
            if place == 1 and ring.count == 6:
                for number in range(6, 10):
                    write(ring, number)
            return super().__getitem__(place)

    ring._slots = Overtaken(ring._slots)
    for number in range(6):
        write(ring, number)
    records, read = ring.since(0)
    assert records.index.tolist() == [0, 4, 5]
    assert ring.since(read)[0].index.tolist() == [6, 7, 8, 9]


def test_looking_on_changes_nothing_and_sees_what_is_recorded():
    targets = ARM.targets.sample(np.random.default_rng(0), (1, 2))

    def drive(robot):
        return run(robot, DefaultController(ARM), targets, Schedule(dwell=0.4))

    view = LiveView()
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    alone, watched = drive(open_robot("emulated:worn", seed=4)), drive(robot)
    records, count = view._subject.ring.since(0)
    assert count == len(alone.time) == len(records)
    for name in ("time", "position", "command", "target", "aim", "true_tcp", "load", "reasons"):
        expected = getattr(alone, name)
        assert np.array_equal(getattr(watched, name), expected, equal_nan=True)
        assert np.array_equal(getattr(records, name), expected[:, 0], equal_nan=True)
    assert np.isfinite(records.temperature).all()
    limited = records.reasons > 0
    assert limited.any()
    assert np.array_equal(records.wanted[~limited][:-1], records.command[~limited][:-1])  # the last is not sent
    assert (records.wanted[limited] != records.command[limited]).any(axis=1).all()


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_frames_that_are_nested_as_drawn_are_those_of_the_kinematics(name):
    arm = load_arm(name)
    drawing = Skeleton.of(arm)
    for q in np.random.default_rng(1).uniform(arm.lower, arm.upper, (20, arm.joints)):
        expected, turn, origin = frames(arm, q), np.eye(3), np.zeros(3)
        assert np.allclose(drawing.end[0], expected.position[0], atol=1e-12)
        for j, quaternion in enumerate(drawing.turns(q)):
            origin = origin + turn @ drawing.place[j]
            turn = turn @ rotation_of(quaternion)
            assert np.allclose(origin, expected.position[j], atol=1e-12)
            assert np.allclose(turn, expected.rotation[j], atol=1e-12)
            after = expected.tcp_position if j == arm.joints - 1 else expected.position[j + 1]
            assert np.allclose(origin + turn @ drawing.end[j + 1], after, atol=1e-12)


@pytest.mark.parametrize("end", [[0.0, 0.0, 0.2], [0.1, -0.05, 0.02], [-0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
def test_a_capsule_is_closed_seen_from_outside_and_as_thick_as_it_says(end):
    end, radius = np.array(end), 0.03
    vertices, faces = capsule(end, radius, sides=60, rings=30)
    length = float(np.linalg.norm(end))
    along = np.clip(vertices @ end / max(length, 1e-12) ** 2, 0.0, 1.0) if length else np.zeros(len(vertices))
    assert np.allclose(np.linalg.norm(vertices - along[:, None] * end, axis=1), radius, atol=1e-12)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0
    assert volume == pytest.approx(np.pi * radius**2 * length + 4.0 / 3.0 * np.pi * radius**3, rel=0.01)


def test_the_ghost_is_the_twin_under_the_commands_that_the_arm_got():
    twin = SimpleNamespace(parameters=nominal_parameters(ARM), stiction=1.2, acceleration=np.inf)
    commands = ARM.rest + np.cumsum(np.random.default_rng(2).normal(0.0, 0.01, (40, N)), axis=0)
    times = np.cumsum(np.random.default_rng(3).uniform(0.02, 0.03, 40))
    ring, own = Ring(N), Simulation(ARM, 1)
    own.place(Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration), ARM.rest[None], commands[:1])
    expected = []
    for k, (time, command) in enumerate(zip(times, commands, strict=True)):
        if k:
            own.advance(np.array([time - times[k - 1]]))
        expected.append(own.measured[0].copy())
        own.send(command[None])
        write(ring, k, time=time, position=ARM.rest, command=command)
    records, _ = ring.since(0)
    ghost = Ghost(ARM, twin)
    first, second = (type(records)(rows, N) for rows in (records.rows[:17], records.rows[17:]))
    predicted = np.vstack([ghost.follow(first), ghost.follow(second)])  # as frames come
    assert np.abs(predicted[-1] - ARM.rest).max() > 0.01
    assert np.allclose(predicted, expected, atol=1e-12)


def guarded(wanted, *, sent=ARM.rest, position=ARM.rest, temperature=None, collisions=True):
    """Words for a command that the guard itself has judged."""
    limits = GuardLimits.of(ARM)
    heat = None if temperature is None else temperature[None]
    state = JointState(time=np.zeros(1), position=position[None], age=np.zeros(1), temperature=heat)
    judged = guard(limits, wanted[None], sent[None], np.zeros((1, N)), state, 0.025)
    ring = Ring(N)
    write(ring, 0, time=0.0, position=position, wanted=sent, command=sent)
    write(ring, 1, time=0.025, position=position, wanted=wanted, command=judged.command[0], temperature=heat,
          reasons=int(judged.reasons[0]))  # fmt: skip
    return Reason(int(judged.reasons[0])), guard_words(ring.since(0)[0], limits)


def moved(joint, degrees, start=ARM.rest):
    return start + np.radians(degrees) * np.eye(N)[joint]


def test_each_limit_is_told_with_its_joint():
    assert guarded(ARM.rest) == (Reason.NONE, ())
    reasons, words = guarded(moved(2, 15.0))
    assert reasons & Reason.STEP
    assert f"speed: joint3 is held to {np.degrees(ARM.max_speed[2]):.0f} deg/s" in words
    reasons, words = guarded(moved(1, -35.0))
    assert reasons & Reason.LEAD
    assert "lead: joint2 was asked to be 35.0 deg ahead of where it is, 20 deg are allowed" in words
    edge = ARM.rest.copy()
    edge[4] = ARM.upper[4] - np.radians(1.0)
    reasons, words = guarded(moved(4, 3.0, edge), sent=edge, position=edge)
    assert reasons & Reason.POSITION
    asked, limit = np.degrees(ARM.upper[4]) + 2.0, np.degrees(GuardLimits.of(ARM).upper[4])
    assert f"joint limit: joint5 was asked for {asked:.1f} deg and is kept at {limit:.1f} deg" in words


def test_a_hot_servo_is_told_before_all_limits():
    heat = np.full(N, 30.0)
    heat[3] = 71.0
    reasons, words = guarded(moved(2, 15.0), temperature=heat)
    assert reasons & Reason.TEMPERATURE
    assert words[0] == "joint4 is at 71 deg C, limit 65; let it cool"


def test_contacts_and_the_floor_name_what_would_touch():
    rng, limits, seen = np.random.default_rng(5), GuardLimits.of(ARM), set()
    ring = Ring(N)
    for number in range(400):
        q = rng.uniform(limits.lower, limits.upper)
        touches = bool(collides(ARM, frames(ARM, q[None]))[0])
        low = tcp_position(ARM, q)[2] < limits.tcp_floor
        for reason, met in ((Reason.COLLISION, touches), (Reason.FLOOR, low)):
            if met:
                write(ring, number, time=number, wanted=q, position=q, command=q, reasons=reason.value)
                (word,) = guard_words(ring.since(ring.count - 1)[0], limits)
                seen.add(word)
    lowest = 1e3 * limits.tcp_floor
    assert f"floor: the tool was asked to go lower than {lowest:.0f} mm" in seen
    assert "contact: the tool would touch the ground" in seen
    assert "contact: the link after joint1 would touch the link after joint6" in seen


def test_every_reason_of_the_guard_has_words():
    ring = Ring(N)
    write(ring, 0, reasons=sum(one.value for one in Reason), position=ARM.rest, temperature=np.full((1, N), 70.0))
    words = guard_words(ring.since(0)[0], GuardLimits.of(ARM))
    assert len(words) == len(set(words)) == len([one for one in Reason if one.value])


def test_the_trace_keeps_ways_and_errors_over_runs_with_clocks_of_their_own():
    ring, trace = Ring(N), Trails(ARM)
    for number in range(3):
        for k in range(40):
            q = ARM.rest + 0.01 * k
            place = tcp_position(ARM, q)
            cycle = Cycle(
                time=np.array([100.0 * number + 0.025 * k]), position=q[None], command=q[None],
                target=place[None] + [0.0, 0.0, 0.003], aim=place[None] + [0.0, 0.004, 0.003],
                target_index=np.zeros(1, int), since_target=np.zeros(1), true_tcp=place[None], active=np.array([True]),
                reasons=np.zeros(1, np.uint16), load=q[None], turned=np.full(1, np.nan),
            )  # fmt: skip
            ring.write(number, cycle, JointState(time=cycle.time, position=q[None], age=np.zeros(1)), q[None])
    trace.follow(ring.since(0)[0])
    t, error, true = trace.curve
    assert (np.diff(t) > 0.0).all()
    assert 2.5 < t[-1] < 3.2
    assert error == pytest.approx(0.005)
    assert true == pytest.approx(0.003)
    assert trace.errors == (pytest.approx(0.005), pytest.approx(0.003))
    assert np.linalg.norm(np.diff(trace.tool, axis=0), axis=1).max() < 0.05


def test_the_panel_speaks_in_millimetres_degrees_and_minutes():
    assert "5.00 mm" in panel.error((0.005, np.nan), 0.010)
    assert panel.GREEN in panel.error((0.005, np.nan), 0.010)
    assert "12.0 mm" in panel.error((0.012, 0.02), 0.010)
    assert panel.AMBER in panel.error((0.012, 0.02), 0.010)
    assert "no target" in panel.error((np.nan, np.nan), 0.010)
    doing = panel.Doing(title="2/6 Twin", what="<fitting>", share=0.25, since=60.0)
    assert "about 3 min left" in panel.head("tcp://arm", "policy", doing)
    assert "&lt;fitting&gt;" in panel.head("", "", doing)
    assert [panel.duration(s) for s in (3.0, 89.0, 200.0, 4000.0)] == ["5 s", "90 s", "3 min", "1 h 07 min"]
    assert "every command passes" in panel.guard((), "")
    assert "Stopped" in panel.guard(("lead",), "tripped")


@pytest.mark.parametrize(("target", "true"), [(np.nan, 0.1), (0.1, 0.1), (0.1, np.nan)])
def test_the_legend_names_what_is_drawn_and_nothing_else(target, true):
    """A check has no targets, but an emulated arm's tool is drawn in it; a real one's never is."""
    ring = Ring(N)
    write(ring, 0, position=ARM.rest, target=np.full((1, 3), target), true_tcp=np.full((1, 3), true))
    subject = SimpleNamespace(arm=ARM, ghost=None)
    names = [name for _, name in animation._legend(subject, ring.since(0)[0])]
    assert ("target, and what is accepted" in names) == np.isfinite(target)
    assert ("the tool itself" in names) == np.isfinite(true)
    assert "check ·" not in panel.head("emulated:worn", "", panel.Doing(title="check", what="check"))


class Passing:
    """A robot of virtual time, a second a step, that takes no time of the wall."""

    def step(self, command, active=None):  # noqa: ARG002 - as robots are
        self.now = getattr(self, "now", 100.0) + 1.0
        return JointState(time=np.array([self.now, 0.0]), position=command, age=np.zeros(2))


def test_virtual_time_is_slowed_down_to_the_pace_which_may_change(monkeypatch):
    wall = [0.0]
    monkeypatch.setattr(wallclock.time, "monotonic", lambda: wall[0])
    monkeypatch.setattr(wallclock, "pause", lambda duration: wall.__setitem__(0, wall[0] + max(duration, 0.0)))
    pace = [1.0]
    robot = wallclock.WallClock(Passing(), lambda: pace[0])
    robot.step(np.zeros((2, N)))
    for _ in range(4):
        robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.0)
    pace[0] = 10.0
    for _ in range(5):
        robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.5)
    pace[0] = np.inf
    robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.5)


def test_a_bare_live_has_its_place_and_takes_no_argument_for_one():
    assert with_place(["repair", "--live", "emulated:worn"]) == ["repair", f"--live={HERE}", "emulated:worn"]
    assert with_place(["deploy", "emulated:worn", "--live"]) == ["deploy", "emulated:worn", f"--live={HERE}"]
    assert with_place(["deploy", "--live", "0.0.0.0:80", "x"]) == ["deploy", "--live", "0.0.0.0:80", "x"]
    assert host_and_port("0.0.0.0:80") == ("0.0.0.0", 80)
    for wrong in ("emulated:worn", "8080", "host:99999", ":80", ""):
        with pytest.raises(InputError, match="expected HOST:PORT, such as 127"):
            host_and_port(wrong)


def test_a_view_that_fails_or_was_never_opened_does_not_end_what_is_driven(monkeypatch):
    view = LiveView()
    view._page = SimpleNamespace(watched=True, show=lambda *_, **__: 1 / 0)
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    view._thread.start()
    done = run(
        robot, IntegratorController(ARM), ARM.targets.sample(np.random.default_rng(0), (1, 1)), Schedule(dwell=0.3)
    )
    view._thread.join()
    assert len(done.time) > 10
    assert view.failure == "ZeroDivisionError: division by zero"
