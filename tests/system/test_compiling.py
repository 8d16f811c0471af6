"""Compiled loops that cannot be compiled, or kept anywhere, are told in a line; they are no bug of ours."""

import errno
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core import caching

from rejoint.system.extras import explain


def test_a_compiler_that_is_switched_off_is_told_before_anything_begins(cli, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    told = cli("repair", "emulated:worn", code=2).err
    assert told.count("\n") == 1
    assert "NUMBA_DISABLE_JIT is set" in told


def test_compiled_loops_without_a_place_are_told_with_what_to_do(monkeypatch):
    for locator in caching.CacheImpl._locator_classes:
        monkeypatch.setattr(locator, "ensure_cache_path", lambda _: (_ for _ in ()).throw(OSError("read-only")))
    with pytest.raises(RuntimeError) as failed:
        numba.njit("f8(f8)", cache=True)(lambda x: 2.0 * x)
    line = explain(failed.value)
    assert "set NUMBA_CACHE_DIR to a folder that can" in line
    assert explain(RuntimeError("something else")) is None


@pytest.fixture
def kept(tmp_path):
    """A module with a compiled loop, and the folder that keeps it."""
    source = tmp_path / "doubling.py"
    source.write_text("import numba\n\n@numba.njit('f8(f8)', cache=True)\ndef double(x):\n    return 2.0 * x\n")

    def load():
        found = {"__name__": "doubling"}
        exec(compile(source.read_text(), source, "exec"), found)
        return found["double"]

    return load, Path(load().stats.cache_path)


@pytest.mark.parametrize("ending", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize("left", [b"", b"\x00\xff nothing that was ever kept"])
def test_damaged_compiled_loops_are_removed_and_told(kept, ending, left):
    load, folder = kept
    for file in folder.glob(ending):
        file.write_bytes(left)
    with pytest.raises(Exception) as failed:  # noqa: PT011 - whatever Numba makes of it
        load()
    line = explain(failed.value)
    assert str(folder) in line
    assert "compiles them again" in line
    assert load()(2.0) == 4.0


def test_a_full_disk_for_compiled_loops_is_told_with_its_place(kept, monkeypatch):
    load, folder = kept
    for file in folder.glob("*.nb*"):
        file.unlink()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.os, "replace", full)
    with pytest.raises(OSError, match="No space") as failed:
        load()
    line = explain(failed.value)
    assert line.startswith(f"{folder}: compiled loops are damaged or cannot be kept there")
    assert "No space left on device" in line
    assert "NUMBA_CACHE_DIR" in line


def test_the_first_frame_of_an_arm_compiles_what_it_needs_and_a_guarded_loop_all():
    program = (
        "from rejoint.arms import load_arm, tcp_position\n"
        "from rejoint.control.guard import GuardLimits, warm_up\n"
        "import rejoint.arms.compiled as loops\n"
        "arm = load_arm('mycobot280')\n"
        "tcp_position(arm, arm.rest)\n"
        "print(bool(loops.solve_all.signatures))\n"
        "warm_up(GuardLimits.of(arm))\n"
        "print(bool(loops.solve_all.signatures))\n"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True)
    assert found.stdout.split() == ["False", "True"]
