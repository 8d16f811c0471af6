"""Fault switches: how they are asked for, and what each of them does to answers and servos, in virtual time."""

import dataclasses

import numpy as np
import pytest
from benchmarks.virtual import START, VirtualClient

from rejoint.arms import mycobot280
from rejoint.arms.wire.commands import answer
from rejoint.arms.wire.frames import Decoder, Frame, encode
from rejoint.arms.wire.values import pack_angles, unpack_angles
from rejoint.cli.serving import emulate
from rejoint.robots.lab.emulator import Faults, Firmware, Timing, build_firmware, parse_faults
from rejoint.robots.lab.emulator.armfaults import BEYOND_LIMIT, HEATING, HOT, JUMP
from rejoint.robots.lab.emulator.faults import KNOWN, Absence, Onset, Stall, form
from rejoint.robots.lab.emulator.wirefaults import DeathError, LinkGoneError, WireFaults
from rejoint.system.errors import InputError

ARM = mycobot280()
PROMPT = Timing(state=0.01, acknowledgement=0.01, jitter=0.0)
GET_ANGLES = encode(Frame(0x20))
ANGLES = bytes.fromhex("FE FE 0E 20 07D0 0000 DECC FE0C 0000 0000 FA")
POSTURE = ARM.rest + np.radians([10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
SEND_ANGLES = encode(Frame(0x22, pack_angles(POSTURE) + bytes((100,))))


def faults(text):
    return parse_faults(text, ARM.joints)


def at(joint, after):
    return (Onset(joints=(joint,), after=after),)


# --- how they are asked for ---------------------------------------------------------------------


def test_the_words_of_the_command_line_become_what_they_say():
    text = "drop=0.05, garbage=0.05,stall=1.5/4,freeze=3@5,blind=2@5,overheat@10,die@20,slow=0.5,stale=0.1,split=0.1"
    assert faults(text) == Faults(
        drop=0.05, garbage=0.05, stall=Stall(duration=1.5, every=4.0), freeze=at(2, 5.0), blind=at(1, 5.0),
        overheat=at(1, 10.0), die=20.0, slow=0.5, stale=0.1, split=0.1,
    )  # fmt: skip
    text = (
        "echo=1,double=.2,half=0.3,gone=2/3,gone=9/1,silent@4,jump=1@0,limit=6@1e1,current=2@3,overload=2@3,voltage@7"
    )
    assert faults(text) == Faults(
        echo=1.0, double=0.2, half=0.3, gone=(Absence(after=2.0, duration=3.0), Absence(after=9.0, duration=1.0)),
        silent=4.0, jump=at(0, 0.0), limit=at(5, 10.0), current=at(1, 3.0), overload=at(1, 3.0),
        voltage=(Onset(joints=(0, 1, 2, 3, 4, 5), after=7.0),),
    )  # fmt: skip
    assert faults("freeze=3@5,freeze=1@2,overheat=4@1").freeze == (*at(2, 5.0), *at(0, 2.0))
    assert faults("") == Faults()


def test_every_fault_that_is_known_can_be_asked_for_and_is_in_the_help():
    assert set(KNOWN) == {field.name for field in dataclasses.fields(Faults)}
    for name in KNOWN:
        assert any(words in emulate.__doc__ for words in form(name).split(" or "))


@pytest.mark.parametrize(
    "text",
    [
        "drop", "drop=", "drop=1.5", "drop=-0.1", "drop=nan", "drop=0.1@3", "drop=0.1,drop=0.2", "slow=-1", "slow=inf",
        "stall=2", "stall=4/4", "stall=1/0", "stall=a/b", "freeze=3", "freeze=0@1", "freeze=7@1", "freeze=1.5@1",
        "freeze@1", "freeze=3@-1", "freeze=3@5@6", "die", "die=5", "die@", "gone=5", "gone@5", "overheat",
        "voltage=7@1",
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_with_what_was_expected(text):
    with pytest.raises(InputError, match=rf"{text.split('=')[0].split('@')[0]}.*got '"):
        faults(text)


def test_an_unknown_fault_is_answered_with_those_that_are_known():
    with pytest.raises(InputError, match=r"'drip=0.1' is no known fault") as refused:
        faults("drip=0.1")
    assert all(form(name) in str(refused.value) for name in KNOWN)
    assert "joint J from 1 to 6" in str(refused.value)


# --- what becomes of answers --------------------------------------------------------------------


@pytest.fixture
def talk(firmware):
    """Ask things in virtual time; returns (seconds after the first request, bytes) of all that was sent."""

    def converse(text, requests, **options):
        client, sent = VirtualClient(firmware, timing=PROMPT, faults=faults(text)), []
        client.sent = lambda now, data: sent.append((round(now - START, 4), data))
        client.ask(requests, **options)
        return sent

    return converse


def test_without_faults_nothing_is_touched(talk):
    assert talk("", [GET_ANGLES] * 3) == [(0.01, ANGLES), (0.02, ANGLES), (0.03, ANGLES)]
    assert WireFaults(Faults()).pieces(GET_ANGLES, ANGLES) == [ANGLES]


def test_a_lost_answer_is_lost_on_its_way_back(talk, firmware):
    firmware.fresh = True
    assert talk("drop=1", [GET_ANGLES, SEND_ANGLES]) == []
    np.testing.assert_allclose(firmware.destination, POSTURE, atol=1e-4)


def test_an_answer_is_doubled_echoed_cut_or_split(talk):
    assert talk("double=1", [GET_ANGLES]) == [(0.01, ANGLES * 2)]
    assert talk("echo=1", [GET_ANGLES]) == [(0.01, GET_ANGLES + ANGLES)]
    halves = [data for _, data in talk("half=1", [GET_ANGLES] * 20)]
    assert len(halves) == 20
    assert all(0 < len(half) < len(ANGLES) and ANGLES.startswith(half) for half in halves)
    assert len({len(half) for half in halves}) > 5
    (first, head), (second, tail) = talk("split=1", [GET_ANGLES])
    assert (head + tail, first) == (ANGLES, 0.01)
    assert 0.03 < second - first < 0.3


def test_garbage_comes_before_an_answer_or_inside(talk):
    answers = [data for _, data in talk("garbage=1", [GET_ANGLES] * 60)]
    before = [data for data in answers if data.endswith(ANGLES)]
    inside = [data for data in answers if not data.endswith(ANGLES)]
    assert min(len(before), len(inside)) > 10
    for data in answers:
        assert any(data.startswith(ANGLES[:n]) and data.endswith(ANGLES[n:]) for n in range(len(ANGLES)))
        assert len(ANGLES) < len(data) <= len(ANGLES) + 12


def test_a_stale_answer_is_that_to_the_same_question_before(talk, firmware):
    firmware.fresh = True
    first, _, second = talk("stale=1", [GET_ANGLES, SEND_ANGLES, GET_ANGLES], pause=0.5)
    assert first[1] == second[1] == ANGLES
    wire = WireFaults(faults("stale=1"))
    assert wire.pieces(encode(Frame(0x4A, b"\x01")), b"one") == [b"one"]
    assert wire.pieces(encode(Frame(0x4A, b"\x02")), b"two") == [b"two"]  # another question
    assert wire.pieces(encode(Frame(0x4A, b"\x02")), b"new") == [b"two"]


def test_shares_are_kept_and_drawn_with_the_seed():
    def lost(text, seed):
        wire = WireFaults(faults(text), seed)
        return [not wire.pieces(GET_ANGLES, ANGLES) for _ in range(2000)]

    hit = lost("drop=0.05", 3)
    assert 60 < sum(hit) < 140  # 100 expected, four standard deviations are 39
    assert lost("drop=0.05", 3) == hit != lost("drop=0.05", 4)
    assert lost("drop=0.05,garbage=0.3,split=0.5,stale=0.1", 3) == hit  # one switch does not move the others


def test_a_slow_robot_answers_late_and_in_turn(talk):
    assert talk("slow=0.5", [GET_ANGLES] * 3) == [(0.51, ANGLES), (1.02, ANGLES), (1.53, ANGLES)]


def test_a_link_that_stands_still_lets_everything_out_late(talk):
    times = [time for time, _ in talk("stall=0.5/2", [GET_ANGLES] * 90, pause=0.04)]
    assert min(times[40:]) > 2.0  # 20 a second
    assert not [time for time in times if 2.0 <= time < 2.5 or 4.0 <= time < 4.5]
    gaps = np.diff(times)
    assert sorted(gaps)[-2:] == pytest.approx([0.5, 0.5], abs=0.06)
    assert sorted(gaps)[-3] < 0.06


def test_what_was_asked_during_a_stall_is_answered_after_it(talk):
    sent = talk("stall=0.5/1", [GET_ANGLES] * 5, pause=0.99, patience=0.3)
    assert [data for _, data in sent] == [ANGLES] * 5
    assert sent[1][0] == pytest.approx(1.5, abs=0.02)


def test_a_silent_link_says_nothing_more_and_takes_no_orders(firmware):
    client, sent = VirtualClient(firmware, timing=PROMPT, faults=faults("silent@1")), []
    client.sent = lambda now, _data: sent.append(now - START)
    client.end = START + 30.0
    client.ask([GET_ANGLES] * 10 + [SEND_ANGLES] * 90, pause=0.1)
    assert 0.8 < sent[-1] < 1.0
    np.testing.assert_allclose(firmware.planned_angles, ARM.rest)
    assert firmware.time == pytest.approx(30.0, abs=0.1)


@pytest.mark.parametrize(("text", "error"), [("die@0.5", DeathError), ("gone=0.5/2", LinkGoneError)])
def test_an_end_comes_at_its_time_even_while_an_answer_is_under_way(firmware, text, error):
    client = VirtualClient(firmware, timing=PROMPT, faults=faults(f"slow=10,{text}"))
    with pytest.raises(error):
        client.ask([GET_ANGLES])
    assert client.now - START == pytest.approx(0.5, abs=0.02)
    if error is LinkGoneError:
        client.session.outlast_absence()
        assert client.now - START == pytest.approx(2.5, abs=0.02)


def test_faults_count_from_the_first_byte_of_a_client(firmware):
    client, sent = VirtualClient(firmware, timing=PROMPT, faults=faults("gone=1/1")), []
    client.sent = lambda now, _data: sent.append(now - START)
    client.wait(5.0)
    with pytest.raises(LinkGoneError):
        client.ask([GET_ANGLES] * 99, pause=0.1)
    assert len(sent) == 10
    assert client.now - START == pytest.approx(6.0, abs=0.02)


# --- what becomes of servos ---------------------------------------------------------------------


def angles_of(data):
    return unpack_angles(Decoder().feed(data)[0].payload)


def test_a_frozen_encoder_tells_what_it_told_while_its_servo_goes_on(talk, firmware, plant):
    firmware.fresh = True
    sent = talk("freeze=1@0.05,freeze=3@0", [SEND_ANGLES] + [GET_ANGLES] * 20, pause=0.1)
    told = np.degrees([angles_of(data) for _, data in sent[1:]])
    assert np.ptp(told[1:, 0]) == 0.0
    assert 20.0 <= told[-1, 0] < 30.0
    assert plant.position[0, 0] == pytest.approx(POSTURE[0], abs=1e-3)


def test_a_blind_servo_runs_away_where_nobody_sees_it(worn):
    worn.fresh = True
    client, sent = VirtualClient(worn, faults=faults("blind=2@0")), []
    before = worn.true_tcp
    client.sent = lambda _now, data: sent.append(data)
    moved = encode(Frame(0x22, pack_angles(ARM.rest + np.radians([0.0, 10.0, 0, 0, 0, 0])) + bytes((100,))))
    client.ask([moved] + [GET_ANGLES] * 20, pause=0.1)
    told = np.array([angles_of(data)[1] for data in sent[1:]])
    assert np.ptp(told) == 0.0
    moved_by = np.linalg.norm(worn.true_tcp - before)
    whole = build_firmware(ARM, "worn")
    whole.fresh = True
    start = whole.true_tcp
    whole.move_joints(ARM.rest + np.radians([0.0, 10.0, 0, 0, 0, 0]), 1.0)
    whole.advance(2.0)
    assert moved_by > 2.0 * np.linalg.norm(whole.true_tcp - start)


def test_a_jump_is_one_of_a_single_reading(talk, firmware):
    sent = talk("jump=2@0.5", [GET_ANGLES] * 20, pause=0.05)
    told = np.array([angles_of(data) for _, data in sent])
    off = np.abs(told - ARM.rest).max(axis=1) > 1e-3
    assert off.sum() == 1
    jumped = told[off][0] - ARM.rest
    assert abs(jumped[1]) == pytest.approx(JUMP, abs=1e-3)
    assert np.abs(np.delete(jumped, 1)).max() < 1e-3
    assert ((told >= ARM.lower) & (told <= ARM.upper)).all()
    np.testing.assert_allclose(firmware.angles, ARM.rest)


def test_a_reading_beyond_its_limit_runs_there_and_stays(talk):
    sent = talk("limit=3@0.5", [GET_ANGLES] * 40, pause=0.04)
    times, told = np.array([time for time, _ in sent]), np.array([angles_of(data)[2] for _, data in sent])
    assert np.all(told[times < 0.5] == told[0])
    assert told[-1] == pytest.approx(ARM.lower[2] - BEYOND_LIMIT, abs=1e-3)
    assert np.abs(np.diff(told) / np.diff(times)).max() < ARM.max_speed.max()
    at_once = talk("limit=3@0", [GET_ANGLES])
    assert angles_of(at_once[0][1])[2] <= ARM.lower[2] - 0.9 * BEYOND_LIMIT


def test_a_servo_gets_hot_beyond_its_own_threshold(firmware):
    client, temperatures, states = VirtualClient(firmware, timing=PROMPT, faults=faults("overheat@1")), [], []

    def read(now, data):
        frame = Decoder().feed(data)[0]
        (temperatures if frame.command == 0xE5 else states).append((now - START, *frame.payload))

    client.sent = read
    client.ask([encode(Frame(0xE5)), encode(Frame(0xE4))] * 50, pause=0.08)
    heat, status = np.array(temperatures), np.array(states)
    assert (heat[:, [1, 3, 4, 5, 6]] == 30).all()
    assert (heat[heat[:, 0] < 1.0, 2] == 30).all()
    assert heat[-1, 2] == HOT
    assert np.diff(heat[:, 2]).max() <= HEATING * 0.2 + 1.0
    reported = status[:, 2] == 4
    assert reported[-1]
    assert not reported[np.interp(status[:, 0], heat[:, 0], heat[:, 2]) < 68.0].any()


@pytest.mark.parametrize(
    ("text", "status", "asked", "answered"),
    [
        ("current=4@0", [0, 0, 0, 8, 0, 0], 0xE2, [0, 0, 0, 3250, 0, 0]),
        ("overload=5@0", [0, 0, 0, 0, 32, 0], 0xE2, [0] * 6),
        ("voltage@0", [1] * 6, 0xE3, [70] * 6),
        ("voltage=6@0,overload=6@0,overheat=6@0", [0, 0, 0, 0, 0, 37], 0xE3, [120] * 5 + [70]),
    ],
)
def test_a_servo_reports_what_it_suffers_from(talk, text, status, asked, answered):
    health, reading = talk(text, [encode(Frame(0xE4)), encode(Frame(asked))])
    assert list(Decoder().feed(health[1])[0].payload) == status
    payload = Decoder().feed(reading[1])[0].payload
    assert list(np.frombuffer(payload, ">i2" if asked == 0xE2 else np.uint8)) == answered


def test_alarms_come_at_their_time_and_a_healthy_arm_has_none(talk, firmware):
    assert answer(firmware, Frame(0xE4)).frame.payload == bytes(6)
    assert answer(firmware, Frame(0xE3)).frame.payload == bytes([120] * 6)
    sent = talk("overload=1@0.5", [encode(Frame(0xE4))] * 20, pause=0.05)
    for time, data in sent:
        assert (data[4] == 32) == (time > 0.51)
    assert isinstance(firmware, Firmware)
