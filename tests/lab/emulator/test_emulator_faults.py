"""Fault switches: how they are asked for, and what each of them does to answers and servos, in virtual time."""

import numpy as np
import pytest
from benchmarks.virtual import START, VirtualClient

from rejoint.arms import mycobot280
from rejoint.robots.mycobot.wire import Frame, encode, pack_angles
from rejoint.robots.wireserver import DeathError, LinkGoneError
from rejoint_lab.emulator.faults import Fault, WireFaults, parse_faults

ARM = mycobot280()
PROMPT = {"state": 0.01, "acknowledgement": 0.01, "jitter": 0.0}
GET_ANGLES = encode(Frame(0x20))
ANGLES = bytes.fromhex("FE FE 0E 20 07D0 0000 DECC FE0C 0000 0000 FA")
POSTURE = ARM.rest + np.radians([10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
SEND_ANGLES = encode(Frame(0x22, pack_angles(POSTURE) + bytes((100,))))


def faults(text):
    return parse_faults(text, ARM.joints)


def at(joint, after):
    return (Fault(joints=(joint,), after=after),)


def chance(share):
    return (Fault(size=share),)


# --- how they are asked for ---------------------------------------------------------------------


def test_the_words_of_the_command_line_become_what_they_say():
    text = "drop=0.05, garbage=0.05,stall=1.5/4,freeze=3@5,blind=2@5,overheat@10,die@20,slow=0.5,stale=0.1,split=0.1"
    assert faults(text) == {
        "drop": chance(0.05),
        "garbage": chance(0.05),
        "stall": (Fault(duration=1.5, every=4.0),),
        "freeze": at(2, 5.0),
        "blind": at(1, 5.0),
        "overheat": at(1, 10.0),
        "die": (Fault(after=20.0),),
        "slow": chance(0.5),
        "stale": chance(0.1),
        "split": chance(0.1),
    }
    text = (
        "echo=1,double=.2,half=0.3,gone=2/3,gone=9/1,silent@4,jump=1@0,limit=6@1e1,current=2@3,overload=2@3,voltage@7"
    )
    assert faults(text) == {
        "echo": chance(1.0),
        "double": chance(0.2),
        "half": chance(0.3),
        "gone": (Fault(after=2.0, duration=3.0), Fault(after=9.0, duration=1.0)),
        "silent": (Fault(after=4.0),),
        "jump": at(0, 0.0),
        "limit": at(5, 10.0),
        "current": at(1, 3.0),
        "overload": at(1, 3.0),
        "voltage": (Fault(joints=(0, 1, 2, 3, 4, 5), after=7.0),),
    }
    assert faults("freeze=3@5,freeze=1@2,overheat=4@1")["freeze"] == (*at(2, 5.0), *at(0, 2.0))
    assert faults("") == {}


# --- what becomes of answers --------------------------------------------------------------------


def client_of(firmware, text):
    """A client in virtual time, and (seconds after the first request, bytes) of all that is sent to it."""
    client, sent = VirtualClient(firmware, timing=PROMPT, faults=faults(text)), []
    client.sent = lambda now, data: sent.append((now - START, data))
    return client, sent


@pytest.fixture
def talk(firmware):
    """Ask things; returns what was sent."""

    def converse(text, requests, **options):
        client, sent = client_of(firmware, text)
        client.ask(requests, **options)
        return [(round(at, 4), data) for at, data in sent]

    return converse


def test_without_faults_nothing_is_touched(talk):
    assert talk("", [GET_ANGLES] * 3) == [(0.01, ANGLES), (0.02, ANGLES), (0.03, ANGLES)]
    assert WireFaults({}).pieces(GET_ANGLES, ANGLES) == [ANGLES]


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


@pytest.mark.parametrize("begin", [b"\xff\xff\xfd\x00", b"\xff\xff"])
def test_a_stale_answer_is_an_earlier_one_of_the_same_servo(begin):
    line, question = WireFaults(faults("stale=1")), begin + b"\xfe\x04 read all"
    first, later = ([begin + bytes([servo, 4]) + word for servo in (1, 2, 3)] for word in (b"here", b"gone"))
    assert [line.pieces(question, answer) for answer in first] == [[answer] for answer in first]
    assert [line.pieces(question, answer) for answer in later] == [[answer] for answer in first]


def test_garbage_comes_before_an_answer_or_inside(talk):
    answers = [data for _, data in talk("garbage=1", [GET_ANGLES] * 60)]
    before = [data for data in answers if data.endswith(ANGLES)]
    inside = [data for data in answers if not data.endswith(ANGLES)]
    assert min(len(before), len(inside)) > 10
    for data in answers:
        assert any(data.startswith(ANGLES[:n]) and data.endswith(ANGLES[n:]) for n in range(len(ANGLES)))
        assert len(ANGLES) < len(data) <= len(ANGLES) + 12


def test_a_link_that_stands_still_lets_everything_out_late(talk):
    times = [time for time, _ in talk("stall=0.5/2", [GET_ANGLES] * 90, pause=0.04)]
    assert min(times[40:]) > 2.0  # 20 a second
    assert not [time for time in times if 2.0 <= time < 2.5 or 4.0 <= time < 4.5]
    gaps = np.diff(times)
    assert sorted(gaps)[-2:] == pytest.approx([0.5, 0.5], abs=0.06)
    assert sorted(gaps)[-3] < 0.06


def test_a_silent_link_says_nothing_more_and_takes_no_orders(firmware):
    client, sent = client_of(firmware, "silent@1")
    client.end = START + 30.0
    client.ask([GET_ANGLES] * 10 + [SEND_ANGLES] * 90, pause=0.1)
    assert 0.8 < sent[-1][0] < 1.0
    np.testing.assert_allclose(firmware.planned_angles, ARM.rest)
    assert firmware.plant.time[0] == pytest.approx(30.0, abs=0.1)


@pytest.mark.parametrize(("text", "error"), [("die@0.5", DeathError), ("gone=0.5/2", LinkGoneError)])
def test_an_end_comes_at_its_time_even_while_an_answer_is_under_way(firmware, text, error):
    client, _ = client_of(firmware, f"slow=10,{text}")
    with pytest.raises(error):
        client.ask([GET_ANGLES])
    assert client.now - START == pytest.approx(0.5, abs=0.02)
    if error is LinkGoneError:
        client.session.outlast_absence()
        assert client.now - START == pytest.approx(2.5, abs=0.02)


def test_faults_count_from_the_first_byte_of_a_client(firmware):
    client, sent = client_of(firmware, "gone=1/1")
    client.wait(5.0)
    with pytest.raises(LinkGoneError):
        client.ask([GET_ANGLES] * 99, pause=0.1)
    assert len(sent) == 10
    assert client.now - START == pytest.approx(6.0, abs=0.02)


# --- what becomes of servos ---------------------------------------------------------------------
