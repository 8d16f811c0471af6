"""Whoever asks a driven arm to stop is heard: signals at random moments, through the vendor's unmodified client."""

import os
import re
import signal
import threading
import time

import numpy as np
import pytest
from test_faults import ARM, TARGETS

from emulatedservers import deploy, serve_pty, serve_tcp
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import recording_of
from rejoint.robots import open_robot
from rejoint.system import stopping
from rejoint.system.stopping import Interrupted
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.plant.wear import load_wear

pytestmark = pytest.mark.realtime

PERIOD = 0.02


@pytest.fixture(autouse=True)
def heard():
    """SIGTERM ends a process that does not handle it."""
    stopping.install()


@pytest.fixture
def stops(monkeypatch):
    """When the firmware was ordered to stop."""
    times, stop = [], Firmware.stop

    def noticed(firmware):
        times.append(time.monotonic())
        stop(firmware)

    monkeypatch.setattr(Firmware, "stop", noticed)
    return times


@pytest.mark.parametrize(("transport", "signals"), [("tcp", 60), ("pty", 40)])
def test_every_signal_stops_the_arm_within_one_control_period(transport, signals, stops):
    rng = np.random.default_rng(5)
    timing = {"state": 0.004, "acknowledgement": 0.003}
    firmware = Firmware.build(ARM, "worn")
    late = []
    with (serve_tcp if transport == "tcp" else serve_pty)(firmware, timing=timing) as server:
        robot = open_robot(server.address, period=(PERIOD, PERIOD))
        for _ in range(signals):
            stops.clear()
            asked = signal.SIGINT if rng.random() < 0.5 else signal.SIGTERM
            sent = []

            def send(asked=asked, sent=sent):
                sent.append(time.monotonic())
                os.kill(os.getpid(), asked)

            timer = threading.Timer(rng.uniform(0.0, 0.1), send)

            def begin(_cycle, timer=timer):
                if timer.ident is None:
                    timer.start()

            with pytest.raises(Interrupted) as caught:
                run(robot, IntegratorController(ARM), TARGETS, Schedule(dwell=10.0), on_cycle=begin)
            timer.join()
            assert caught.value.signum == asked
            assert stops, "the arm was never told to stop"
            assert "was stopped" in caught.value.__notes__[-1]
            if stops[0] - sent[0] > PERIOD + 2 * sum(timing.values()):
                late.append(stops[0] - sent[0])
        robot.close()
    # The wish is looked at after every question; what delays it further is a busy machine.
    assert len(late) <= 0.1 * signals, late
    assert max(late, default=0.0) < 1.0


def test_a_signal_between_runs_is_heard_by_the_next_one(stops):
    with serve_tcp(Firmware.build(ARM, "worn")) as server, stopping.noted():
        robot = open_robot(server.address, period=(PERIOD, PERIOD))
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Interrupted) as caught:
            run(robot, IntegratorController(ARM), TARGETS, Schedule(dwell=10.0))
        robot.close()
    assert recording_of(caught.value) is None, "nothing was driven"
    assert stops


def test_what_nobody_looked_at_is_raised_at_the_end_and_kept():
    with pytest.raises(Interrupted) as caught, stopping.noted():
        os.kill(os.getpid(), signal.SIGTERM)
    assert caught.value.exit_code == 143
    stopping.check()  # and is over then
    assert stopping.interruption() is caught.value
    stopping.install()
    assert stopping.interruption() is None, "what was raised before is over"


def test_what_brings_an_arm_to_rest_is_not_interrupted():
    with stopping.noted():
        with stopping.shielded():
            os.kill(os.getpid(), signal.SIGINT)
            stopping.pause(0.01)
        with pytest.raises(Interrupted):
            stopping.pause(10.0)


def test_handlers_are_given_back():
    before = [signal.getsignal(signum) for signum in stopping.SIGNALS]
    with stopping.noted(), stopping.noted():
        pass
    assert [signal.getsignal(signum) for signum in stopping.SIGNALS] == before


def test_a_deployment_ends_with_the_exit_code_of_its_signal(tmp_path):
    firmware = Firmware.build(ARM, "worn")
    with serve_tcp(firmware) as server:
        process = deploy(server.address, firmware, tmp_path / "run", 0.02)
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 130, said
    assert "interrupted by SIGINT" in said
    assert "was stopped" in said
    assert re.search(r"What was recorded until then: .*\.parquet", said)
    assert list((tmp_path / "run" / "logs").glob("deploy-*.parquet"))


@pytest.mark.parametrize("seed", range(4, 8))
def test_a_joint_that_stuck_does_not_go_on_after_its_arm_was_stopped(seed):
    robot = EmulatedRobot(ARM, [load_wear("worn", ARM)], seed=seed)

    def end(cycle):
        if cycle.time[0] > 0.3 + 0.05 * seed:
            stopping.interrupt("the test")

    with pytest.raises(Interrupted) as caught:
        run(robot, DefaultController(ARM), np.array([[[0.2, 0.09, 0.24]]]), Schedule(dwell=4.0), on_cycle=end)
    ahead = recording_of(caught.value).command[-1] - robot.plant.encoder()
    assert np.abs(ahead).max() < np.radians(15.0), "a motion begins from the command that brakes"
    robot.plant.advance(0.3)
    there = robot.plant.encoder()
    robot.plant.advance(1.5)
    assert np.abs(robot.plant.encoder() - there).max() < np.radians(1.0)
