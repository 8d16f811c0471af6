"""Text with columns: units are read from names or options, never guessed."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, sample, write_table

from rejoint.logs.importing import import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError, InputError


def test_a_unit_may_stand_in_each_name_and_other_columns_are_told(tmp_path: Path):
    titles = "time_ms,time_s,command.b_deg,position.a_rad,command.a_rad,position.b_deg,true_tcp.x_mm,true_tcp.y_m"
    rest = {"shoulder_lift": "c", "elbow_flex": "d", "wrist_flex": "e"}
    lines = [titles + ",true_tcp.z_m" + "".join(f",position.{n}_rad,command.{n}_rad" for n in rest.values())]
    lines += [f"{20 * k},7,{9 * k},{0.1 * k},{0.2 * k},{18 * k},{100 * k},{k},{-k}" + ",0,0" * 3 for k in range(4)]
    (tmp_path / "mixed.csv").write_text("\n".join(lines) + "\n")
    options = ImportOptions(columns={"time": "time_ms", "shoulder_pan": "a", "wrist_roll": "b"} | rest)
    imported = import_logs(tmp_path / "mixed.csv", ARM, out=tmp_path / "logs", options=options)
    (log,), k = imported.logs, np.arange(4)
    np.testing.assert_allclose(log.time, 0.02 * k)
    np.testing.assert_allclose(log.position, np.outer(k, [0.1, 0, 0, 0, np.pi / 10]))
    np.testing.assert_allclose(log.command, np.outer(k, [0.2, 0, 0, 0, np.pi / 20]))
    np.testing.assert_allclose(log.true_tcp, np.outer(k, [0.1, 1.0, -1.0]))
    assert any("time_s" in note for note in imported.notes)


@pytest.mark.parametrize(("unit", "ticks"), {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}.items())
def test_a_declared_time_unit_is_taken(tmp_path: Path, unit: str, ticks: float):
    found = sample()
    scaled = type(found)(time=found.time * ticks, position=found.position, command=found.command)
    source = write_table(tmp_path / "wave.csv", scaled, {"time_s": "time"})
    with pytest.raises(FileError, match="column time does not say its unit"):
        import_logs(source, ARM, out=tmp_path / "logs")
    (log,) = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(time_unit=unit)).logs
    np.testing.assert_allclose(log.time, found.time, rtol=1e-15)
    with pytest.raises(InputError, match="exists already"):
        import_logs(source, ARM, out=tmp_path / "logs")


@pytest.mark.parametrize(
    ("unit", "scale", "said"), [("rad", 180 / np.pi, "beyond two turns; .* degrees"), ("deg", 1.0, "surely radians")]
)
def test_degrees_called_radians_and_the_reverse_are_refused(tmp_path: Path, unit: str, scale: float, said: str):
    names = {f"{g}.{j}_rad": f"{g}.{j}_{unit}" for g in ("position", "command") for j in ARM.joint_names}
    with pytest.raises(FileError, match=said):
        import_logs(write_table(tmp_path / "wave.csv", worn_sample(), names, scale=scale), ARM, out=tmp_path / "logs")


def test_a_list_of_json_records_is_a_table(tmp_path: Path):
    table = write_table(tmp_path / "wave.csv", sample())
    with table.open(newline="") as stream:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(stream)]
    (tmp_path / "records.json").write_text(json.dumps(rows))
    both = [import_logs(tmp_path / name, ARM, out=tmp_path / name[:3]).logs[0] for name in ("wave.csv", "records.json")]
    for name in ("time", "position", "command"):
        np.testing.assert_array_equal(*(getattr(log, name) for log in both))
