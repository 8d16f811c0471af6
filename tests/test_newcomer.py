"""What newcomers met: each mistake ends in one clear line, and harms nothing."""

import os
import pty
import socket
import subprocess
import sys
import termios
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

import rejoint
from commandline import python
from rejoint.cli.console import HERE, with_place
from rejoint.robots import place_of, ports
from rejoint.robots.family import Wire
from rejoint.system.shell import host_and_port, listen_tcp

POLICY = Path(rejoint.__file__).parent / "control" / "controllers" / "policies" / "mycobot280.onnx"
SERVO, COBOT = b"\xff\xff\x01\x02\x00\xfc", b"\xfe\xfe\x03\x12\x01\xfa"


@contextmanager
def answering(answer, begins):
    """A TCP port at which ``answer`` follows on each question that begins so."""
    listener = listen_tcp("127.0.0.1", 0, 8)
    listener.setblocking(True)

    def serve():
        while True:
            try:
                connection, _ = listener.accept()
                with connection:
                    while data := connection.recv(64):
                        if data.startswith(begins):
                            connection.send(answer)
            except OSError:
                return

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


@contextmanager
def serial_line(answer, begins, rate):
    """A serial port behind which something answers at a baud rate alone."""
    ours, theirs = pty.openpty()

    def serve():
        while True:
            try:
                data = os.read(ours, 64)
            except OSError:
                return
            if data.startswith(begins) and termios.tcgetattr(theirs)[4] == rate:
                os.write(ours, answer)

    threading.Thread(target=serve, daemon=True).start()
    yield os.ttyname(theirs)
    os.close(theirs)
    os.close(ours)


@pytest.mark.parametrize(
    ("scheme", "answer", "hello", "right"),
    [("tcp", SERVO, b"\xff\xff", "feetech"), ("feetech", COBOT, b"\xfe\xfe", "tcp")],
)
def test_an_arm_of_another_kind_is_named_with_its_address(scheme, answer, hello, right):
    with answering(answer, hello) as place:
        assert ports.other_arm(place_of(f"{scheme}://{place}")).endswith(f"give {right}://{place}")
        host, port = place.split(":")
        assert ports.answering(Wire(text="", host=host, port=int(port)))[0].begins == hello.hex()


def test_the_baud_rate_at_which_an_arm_answers_is_named():
    with serial_line(COBOT, b"\xfe\xfe", termios.B115200) as device:
        assert ports.answering(Wire(text="", device=device, baud=1_000_000))[1] == 115_200
        assert f"serial://{device}?baud=115200" in ports.other_arm(place_of(f"serial://{device}"))


def test_a_missing_port_is_not_asked_for_its_server(monkeypatch):
    monkeypatch.setattr(ports, "ports", lambda: {"/dev/ttyACM0": "a servo board"})
    with pytest.raises(rejoint.AddressError, match=r"no port /dev/ttyACM77; .*/dev/ttyACM0") as caught:
        rejoint.open_robot("feetech:///dev/ttyACM77")
    assert "server" not in str(caught.value)


def test_a_log_survives_an_emulator_that_cannot_listen(tmp_path, cli):
    log = tmp_path / "log.csv"
    log.write_text("precious")
    with listen_tcp("127.0.0.1", 0) as taken:
        cli("emulate", "--port", str(taken.getsockname()[1]), "--log", str(log), code=2)
    assert log.read_text() == "precious"


def test_a_function_that_makes_no_controller_is_refused():
    with pytest.raises(rejoint.InputError, match="controller"):
        rejoint.compare("emulated:worn", [repr], plan=rejoint.TrialPlan(sets=1, repetitions=1))


def test_a_path_of_windows_is_no_address():
    with pytest.raises(rejoint.RejointError, match="no folder with run logs"):
        rejoint.diagnose(r"C:\logs")


def test_every_public_result_is_short_at_a_prompt(tmp_path):
    run = rejoint.Run.create(tmp_path, "emulated:worn", rejoint.load_arm("mycobot280"))
    found = rejoint.compare(
        "emulated:worn",
        ["default"],
        run=run,
        plan=rejoint.TrialPlan(sets=1, repetitions=1),
        observer=rejoint.Observer(),
    )
    assert list(found.logs) == [name for name in run.logs if name in found.logs]  # one name for one log
    assert set(run.to_pandas()["controller"]) == {"default"}
    done = rejoint.deploy("emulated:worn", [[0.2, 0.0, 0.2], [0.19, 0.03, 0.21]])
    assert done.to_pandas()["error"].iloc[1] == done.visits[1].error
    results = [run, run.arm, found, done, rejoint.read_arm("so101"), rejoint.Policy.load(POLICY)]
    for one in results:
        assert len(repr(one)) < 500
        assert "<" in one._repr_html_()
        assert len(one.to_pandas()) >= 1


def test_an_old_python_is_named_before_anything_is_installed(tmp_path):
    root = Path(__file__).parent.parent
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text((root / name).read_text())
    old = tmp_path / "python"
    old.write_text(
        f"#!/bin/sh\nexec {sys.executable} -c 'import sys; sys.version_info = (3, 9); exec(sys.argv[2])' \"$@\"\n"
    )
    old.chmod(0o755)
    done = subprocess.run(
        ["make", "repair", f"PYTHON={old}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode
    assert "Python 3.11 or newer" in done.stderr
    assert "is 3.9" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_a_shell_completes_names_of_commands():
    words = {"_REJOINT_COMPLETE": "complete_bash", "COMP_WORDS": "rejoint do", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['rejoint']; from rejoint.__main__ import main; main()"
    assert python("-c", code, env=os.environ | words).out.split() == ["doctor"]


@pytest.mark.parametrize("words", [[], ["repair"], ["research"], ["arms", "add"]], ids=" ".join)
def test_help_shows_that_flags_take_no_value(cli, words):
    assert "bool" not in cli(*words, "--help").out


@pytest.mark.parametrize("listen", ["x", "99999", ":80", ""])
def test_a_place_to_listen_at_is_a_port_with_or_without_a_host(listen):
    assert host_and_port("--listen", "9601") == host_and_port("--listen", "127.0.0.1:9601") == ("127.0.0.1", 9601)
    assert with_place(["--live", "9601", "--live", "run"]) == ["--live", "9601", f"--live={HERE}", "run"]
    with pytest.raises(rejoint.InputError, match="expected HOST:PORT"):
        host_and_port("--listen", listen)
