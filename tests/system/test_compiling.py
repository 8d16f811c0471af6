"""Compiled loops that cannot be compiled, or kept anywhere, are told in a line; they are no bug of ours."""

import numba
import pytest
from numba.core import caching

from commandline import run_cli
from rejoint.system.compiling import explain


def test_a_compiler_that_is_switched_off_is_told_before_anything_begins(capsys, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code, _, told = run_cli("repair", "emulated:worn", capsys=capsys, monkeypatch=monkeypatch)
    assert (code, told.count("\n")) == (2, 1)
    assert "NUMBA_DISABLE_JIT is set" in told


def test_compiled_loops_without_a_place_are_told_with_what_to_do(monkeypatch) -> None:
    for locator in caching.CacheImpl._locator_classes:
        monkeypatch.setattr(locator, "ensure_cache_path", lambda _: (_ for _ in ()).throw(OSError("read-only")))
    with pytest.raises(RuntimeError) as failed:
        numba.njit("f8(f8)", cache=True)(lambda x: 2.0 * x)
    line = explain(failed.value)
    assert line is not None
    assert "set NUMBA_CACHE_DIR to a folder that can" in line
    assert explain(RuntimeError("something else")) is None
