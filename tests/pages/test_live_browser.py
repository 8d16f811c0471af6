"""The live view in a real browser: the arm is drawn and moves, the guard speaks, the button holds it."""

import io
import re
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from browser import CHROMIUM, RENDERER, chromium
from PIL import Image

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: install it to see the live view in a browser"),
]
BUTTON = "[...document.querySelectorAll('button')].find(b => !b.disabled && b.innerText.includes('Hold the arm'))"
SCENE = (0, 200, 780, 650)  # px: what is neither panel nor notice


@contextmanager
def driving(*words):
    """Yield a command with a live view and the address of its page; it is ended at the end."""
    command = [sys.executable, "-m", "rejoint", *words, "--live", "127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stderr.readline()
            assert line.startswith("Live view: http://127.0.0.1:"), line
            yield process, line.split()[-1]
        finally:
            process.kill()


def scene(tab):
    """Colours (h, w, 3) of the middle of the picture."""
    return np.asarray(Image.open(io.BytesIO(tab.picture())).convert("RGB").crop(SCENE), dtype=int)


def test_the_arm_is_seen_to_move_the_guard_speaks_and_the_button_holds_it():
    with (
        driving("deploy", "emulated:worn", "--controller", "default", "--dwell", "3") as (process, page),
        chromium(1200, 900) as tab,
    ):
        if tab.ask(RENDERER) is None:
            pytest.skip("no WebGL in this browser, not even in software")
        tab.call("Page.navigate", url=page)
        tab.wait_for("document.querySelector('canvas') && document.body.innerText.includes('off by its encoders')")
        assert "emulated:worn · default" in tab.text()
        assert re.search(r"target \d+ of 10", tab.text())
        tab.wait_for("document.body.innerText.includes('Guard: every command passes')")
        first = scene(tab)
        time.sleep(3.5)  # another target
        second = scene(tab)
        for picture in (first, second):
            assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100  # an empty scene has a colour or two
            assert (np.ptp(picture, axis=2) < 40).any()
            assert picture.std() > 10.0
        assert (np.abs(first - second).max(axis=2) > 30).mean() > 0.01
        tab.ask(f"{BUTTON}.click()")
        tab.wait_for(f"document.body.innerText.includes('Stopped.') && !!{BUTTON}", 10.0)  # and holds what comes next
        out, err = process.communicate(timeout=30)
        assert process.returncode == 130  # as for Ctrl-C
        assert "error: interrupted by the button of the live view" in err
        assert "The arm was stopped and holds its position; nothing was powered off." in err
        assert "ended early" in out
        assert "viser" not in out


def test_a_port_that_is_taken_is_told_in_one_line_before_anything_moves():
    with driving("deploy", "emulated:worn") as (_, page):
        place = page.removeprefix("http://")
        other = subprocess.run(
            [sys.executable, "-m", "rejoint", "deploy", "emulated:worn", "--live", place],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
    assert other.returncode == 2
    assert not other.stdout
    assert other.stderr.startswith(f"error: cannot listen on {place} (Address already in use); choose another")
    assert len(other.stderr.splitlines()) == 1
