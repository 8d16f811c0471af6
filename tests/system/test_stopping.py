"""Signals end the program also where the exception of their handler is swallowed."""

import signal
import subprocess
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest

from rejoint.logs.runlog import RunLog
from rejoint.runs.fleet import rayexecutor

PRELUDE = """
import ctypes, os, signal, sys, time
from rejoint.system import stopping

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup, under which a suite may run, has it ignored

@ctypes.CFUNCTYPE(None)
def callback():
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000):  # the handler runs between two instructions, in here
        pass
"""


def run(code):
    return subprocess.run(
        [sys.executable, "-c", PRELUDE + code], capture_output=True, text=True, check=False, timeout=60
    )


def printed(code):
    """The lines of a program; pytest shows beside a failure what went wrong in it."""
    ended = run(code)
    sys.stderr.write(ended.stderr)
    return ended.stdout.splitlines()


def test_a_signal_in_a_callback_of_compiled_code_is_sent_again():
    told = printed(
        "stopping.install()\n"
        "try:\n    callback()\n    print('swallowed', flush=True)\n    time.sleep(30)\n"
        "except stopping.Interrupted as error: print(error, flush=True)\n"
    )
    assert told == ["swallowed", "interrupted by SIGTERM"]


@pytest.mark.parametrize(
    "after",
    ["raise RuntimeError('no compiled object yet')", "raise ImportError('initialization failed')", "time.sleep(30)"],
)
def test_the_command_line_ends_as_interrupted_whatever_the_compiled_code_makes_of_it(after):
    ended = run(
        f"def app(**_):\n    callback()\n    {after}\n"
        "import rejoint.cli as cli\ncli.app = app\nsys.argv = ['rejoint']\ncli.main()\n"
    )
    assert ended.returncode == 143
    assert ended.stderr.startswith("error: interrupted by SIGTERM"), ended.stderr


SWALLOWED = """
class Late:
    def find_spec(self, name, path=None, target=None):
        if name == 'pandas.core':
            os.kill(os.getpid(), signal.SIGTERM)

stopping.install()
sys.meta_path.insert(0, Late())
"""


def test_a_signal_while_arrow_imports_pandas_is_heard(tmp_path):
    """Arrow took it for a missing pandas, and whatever read the first log of its process went on to the end."""
    log = RunLog.of(np.arange(3.0), np.zeros((3, 6)), np.zeros((3, 6)), arm="mycobot280")
    log.save(tmp_path / "one.parquet")
    told = printed(
        f"{SWALLOWED}from rejoint.logs.runlog import RunLog\nfrom pathlib import Path\n"
        f"try:\n    RunLog.load(Path({str(tmp_path / 'one.parquet')!r}))\n    print('read')\n"
        "except stopping.Interrupted as error: print(error)\n"
    )
    assert told == ["interrupted by SIGTERM"]


def test_work_that_goes_on_though_its_interruption_was_swallowed_hears_it_as_it_tells_how_far_it_is():
    ended = run(
        "import rejoint.cli as cli\nfrom rejoint.cli.console import Terminal\n"
        "def app(**_):\n    with Terminal().bar('fitting') as update:\n        update(0.0, 'begun')\n"
        "        try:\n            os.kill(os.getpid(), signal.SIGTERM)\n            time.sleep(30)\n"
        "        except BaseException:\n            update(0.5, 'what puts right is not cut short')\n"
        "        update(0.6, '')\n        time.sleep(30)\n"
        "cli.app = app\nsys.argv = ['rejoint']\ncli.main()\n"
    )
    assert (ended.returncode, ended.stderr) == (143, "error: interrupted by SIGTERM\n")


def test_a_second_signal_does_not_cut_the_last_line_short():
    ended = run(
        "import io\nimport rejoint.cli as cli\n"
        "class Again(io.TextIOWrapper):\n"
        "    def write(self, text):\n        os.kill(os.getpid(), signal.SIGTERM)\n        return super().write(text)\n"
        "def app(**_):\n    os.kill(os.getpid(), signal.SIGTERM)\n    time.sleep(30)\n"
        "sys.stderr = Again(sys.stderr.buffer, line_buffering=True)\n"
        "cli.app = app\nsys.argv = ['rejoint']\ncli.main()\n"
    )
    assert ended.returncode == 143
    assert ended.stderr == "error: interrupted by SIGTERM\n"


def test_what_ended_once_in_a_process_hears_signals_again():
    ended = run(
        "stopping.install()\nstopping.close()\nos.kill(os.getpid(), signal.SIGTERM)\n"
        "import subprocess\nchild = [sys.executable, '-c', 'import signal; print(signal.getsignal(signal.SIGTERM))']\n"
        "print(subprocess.run(child, capture_output=True, text=True).stdout.strip(), flush=True)\n"
        "stopping.install()\nos.kill(os.getpid(), signal.SIGTERM)\n"
    )
    assert ended.stdout.splitlines() == ["0"], ended.stdout  # SIG_DFL
    assert "Interrupted: interrupted by SIGTERM" in ended.stderr


def test_other_exceptions_that_nobody_sees_are_shown_as_before():
    ended = run("stopping.install()\n@ctypes.CFUNCTYPE(None)\ndef broken():\n    raise ValueError('seen')\nbroken()\n")
    assert ended.returncode == 0
    assert "ValueError: seen" in ended.stderr


def test_what_asks_from_another_thread_ends_a_drive_where_it_looks_and_says_who_it_was():
    told = printed(
        "import threading\nstopping.install()\n"
        "with stopping.noted():\n"
        "    asking = threading.Thread(target=stopping.ask, args=('a button',))\n"
        "    asking.start()\n    asking.join()\n    time.sleep(0.1)\n    print('still here', flush=True)\n"
        "    try:\n        stopping.check()\n"
        "    except stopping.Interrupted as error: print(error, error.exit_code, flush=True)\n"
        "try:\n    stopping.check()\n    os.kill(os.getpid(), signal.SIGTERM)\n    time.sleep(30)\n"
        "except stopping.Interrupted as error: print(error, flush=True)\n"
    )
    assert told == ["still here", "interrupted by a button 130", "interrupted by SIGTERM"]


@pytest.mark.parametrize("background", [False, True])
def test_what_asks_ends_other_work_as_well_also_where_ctrl_c_is_ignored(background):
    ignored = "signal.signal(signal.SIGINT, signal.SIG_IGN)\n" if background else ""
    told = printed(
        f"import threading\n{ignored}stopping.install()\n"
        "threading.Timer(0.2, stopping.ask, args=('a button',)).start()\n"
        "try:\n    time.sleep(30)\n"
        "except stopping.Interrupted as error: print(error, error.exit_code, flush=True)\n"
    )
    assert told == ["interrupted by a button 130"]


DRIVES = """
import threading
ended = []
def drive(name):
    try:
        with stopping.noted():
            begun.wait()
            stopping.pause(30)
    except stopping.Interrupted as error: ended.append(f"{name} {error}")
def threads(*names):
    global begun
    begun = threading.Barrier(len(names) + 1)
    made = [threading.Thread(target=drive, args=(name,)) for name in names]
    for one in made: one.start()
    return made
"""


def test_a_signal_ends_what_every_thread_drives_and_only_that():
    told = printed(
        f"{DRIVES}\nmade = threads('one', 'two')\n"
        "with stopping.noted():\n    begun.wait()\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "    for one in made: one.join()\n"
        "    print(*sorted(ended), sep='\\n')\n"
        "    try: stopping.pause(30)\n"
        "    except stopping.Interrupted as error: print('main', error)\n"
        "    stopping.pause(0.01)\n"
        "with stopping.noted(): stopping.pause(0.01)\n"
        "print('goes on', flush=True)\n"
    )
    assert told == [
        "one interrupted by SIGINT",
        "two interrupted by SIGINT",
        "main interrupted by SIGINT",
        "goes on",
    ]


def test_whoever_drives_hears_signals_also_where_another_thread_drives_already():
    told = printed(
        f"{DRIVES}\n(other,) = threads('other')\nbegun.wait()\n"
        "try:\n    with stopping.noted():\n        os.kill(os.getpid(), signal.SIGTERM)\n        stopping.pause(30)\n"
        "except stopping.Interrupted as error: print(error)\n"
        "other.join()\nprint(*ended, signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, flush=True)\n"
    )
    assert told == ["interrupted by SIGTERM", "other interrupted by SIGTERM True"]


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_wish_to_end_while_ray_starts_is_met_when_it_has_started(signum):
    """Raised in between it ended in a segmentation fault, by Ray's own handler with the exit code 15 and no line."""
    ended = run(
        "import rejoint.cli as cli\nfrom rejoint.runs.fleet import rayexecutor\n"
        "class Ray:\n    def shutdown(self): print('shut down', flush=True)\n"
        "def started(*_):\n    signal.signal(signal.SIGTERM, lambda signum, _: sys.exit(signum))\n"
        f"    os.kill(os.getpid(), {int(signum)})\n    time.sleep(0.01)\n    print('started', flush=True)\n"
        "    return Ray()\n"
        "rayexecutor._started = started\n"
        "def app(**_):\n    rayexecutor.RayExecutor([])\n"
        "cli.app = app\nsys.argv = ['rejoint']\ncli.main()\n"
    )
    assert (ended.returncode, ended.stderr) == (128 + signum, f"error: interrupted by {signum.name}\n")
    assert ended.stdout.split("\n") == ["started", "shut down", ""]


def test_ray_sets_no_handler_of_signals_while_it_starts(monkeypatch):
    told = signal.SIGTERM, signal.SIG_IGN
    monkeypatch.setattr(rayexecutor, "_started", lambda *_: MagicMock(old=signal.signal(*told)))
    before = signal.getsignal(signal.SIGTERM), signal.signal
    rayexecutor.RayExecutor([])
    assert (signal.getsignal(signal.SIGTERM), signal.signal) == before


def test_a_thread_that_drives_is_interrupted_from_another_one_and_nothing_else():
    told = printed(
        f"{DRIVES}\nprint(stopping.interrupt())\n(other,) = threads('thread')\nbegun.wait()\n"
        "print(stopping.interrupt('a button'))\nother.join()\nprint(*ended, stopping.interrupt())\n"
        "with stopping.noted(): stopping.pause(0.01)\nprint('goes on', flush=True)\n"
    )
    assert told == [
        "False",
        "True",
        "thread interrupted by a button False",
        "goes on",
    ]


SWALLOWING = """
def driven(error=BaseException):
    with stopping.noted():
        try:  # as in the vendor's client
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
        except BaseException: print('swallowed', flush=True)
        try: stopping.pause(30)
        except error as met: print(repr(met), flush=True)
"""


@pytest.mark.parametrize("raised", ["SystemExit(3)", "ValueError('mine')", "KeyboardInterrupt()"])
def test_what_the_programs_own_handler_raises_waits_for_where_it_is_safe(raised):
    """The vendor's client swallowed five of eight, and the arm was driven on."""
    told = printed(
        f"{SWALLOWING}\ndef mine(signum, frame):\n    print('called', flush=True)\n    raise {raised}\n"
        "signal.signal(signal.SIGINT, mine)\ndriven()\nprint(signal.getsignal(signal.SIGINT) is mine)\n"
    )
    assert told == ["called", raised, "True"]


def test_what_the_programs_own_handler_does_not_end_goes_on():
    told = printed(
        "heard = []\nsignal.signal(signal.SIGINT, lambda signum, frame: heard.append(signum))\n"
        "with stopping.noted(), stopping.noted():\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n    stopping.pause(0.05)\nprint(len(heard))\n"
    )
    assert told == ["1"]


def test_ctrl_c_ends_a_drive_within_a_task_of_asyncio():
    """asyncio's handler only cancels the task at its next await: the arm was driven to its end."""
    told = printed(
        f"{SWALLOWING}\nimport asyncio\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "async def task():\n    driven(stopping.Interrupted)\n    await asyncio.sleep(0)\n    print('goes on')\n"
        "asyncio.run(task())\n"
    )
    assert told == ["Interrupted('interrupted by SIGINT')", "goes on"]


def test_the_stop_button_of_a_notebook_ends_a_drive_in_a_cell_that_awaits():
    told = printed(
        f"{SWALLOWING}\nkernel = {{'__name__': 'ipykernel.ipkernel'}}\n"
        "exec('def handle_sigint(*args): pass', kernel)\nsignal.signal(signal.SIGINT, kernel['handle_sigint'])\n"
        "driven(stopping.Interrupted)\n"
    )
    assert told == ["Interrupted('interrupted by SIGINT')"]
