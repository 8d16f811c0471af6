"""Whether a repair calibrates: what is asked for at the command line, and what is done because of it."""

import io
import os
import signal
import sys

import numpy as np
import pytest

import rejoint
from hearing import Hears
from rejoint.arms import mycobot280
from rejoint.cli.console import Terminal
from rejoint.cli.upkeep import gauge_by_word
from rejoint.diagnosis.calibration.procedure import Stop, TouchGauge, TrackerGauge
from rejoint.logs.runfolder import RunFolder
from rejoint.runs import repair as chain
from rejoint.system.errors import InputError
from rejoint.system.stopping import Interrupted, noted


def test_words_stand_for_what_measures(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    file = tmp_path / "track.csv"
    file.write_text("time,x,y,z\n" + 4 * "1,1,2,3\n")
    words = None, "none", "touch", f"tracker={file}"
    found = [gauge_by_word(Terminal(), "emulated:worn", word, 0) for word in words]
    assert found[:2] == [None, "none"]
    assert isinstance(found[2], TouchGauge)
    assert isinstance(found[3], TrackerGauge)
    assert found[3].path == file


def test_a_signal_ends_the_wait_for_a_line(monkeypatch):
    out, into = os.pipe()
    monkeypatch.setattr(sys, "stdin", os.fdopen(out, closefd=False))  # open as long as its reader
    os.write(into, b"1 2 3\n4 ")
    gauge, stop = gauge_by_word(Terminal(), "emulated:worn", "touch", 0), Stop(1, 1, np.zeros(3))
    with noted():
        assert gauge.ask(stop) == "1 2 3\n"
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Interrupted):
            gauge.ask(stop)
    os.close(into)


def test_nobody_types_where_standard_input_is_closed(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(InputError, match="asks at the terminal, and there is none"):
        gauge_by_word(Terminal(), "emulated:worn", "touch", 0)


@pytest.mark.parametrize(
    ("robot", "gauge", "calibrated", "corrected"),
    [
        ("emulated:worn", None, True, None),
        ("emulated:worn", "none", False, "none"),
        ("tcp://10.0.0.1:9000", None, False, None),
        ("tcp://10.0.0.1:9000", TouchGauge(ask=str), True, None),
    ],
)
def test_a_repair_calibrates_where_something_measures(tmp_path, monkeypatch, robot, gauge, calibrated, corrected):
    done, stages = {}, []
    for name in ("diagnose", "calibrate", "identify", "train", "compare", "report"):
        monkeypatch.setattr(chain, name, lambda *_, name=name, **options: done.update({name: options}))
    rejoint.repair(
        robot,
        run=tmp_path / "run",
        plan=rejoint.RepairPlan(gauge=gauge),
        observer=Hears(stage=lambda stage: stages.append(stage.name)),
    )
    assert ("calibrate" in done) is calibrated
    assert ("calibrate" in stages) is calibrated
    assert done["compare"]["settings"].calibration == corrected
    if calibrated:
        assert done["calibrate"]["gauge"] is gauge


@pytest.mark.parametrize(("controllers", "trained"), [((), True), (["policy"], True), ("integrator", False)])
def test_a_repair_trains_a_policy_where_one_is_compared(tmp_path, controllers, trained):
    plan = rejoint.RepairPlan(controllers=controllers)
    stages = chain.stages_of("emulated:worn", mycobot280(), RunFolder(tmp_path), plan)
    assert ("train" in stages) is trained
