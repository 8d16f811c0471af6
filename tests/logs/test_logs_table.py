"""CSV files with named columns: units are read from names or options, never guessed."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.csv
import pytest
from log_samples import ARM, Sample, sample, write_table

from rejoint.logs import ImportOptions, detect, import_logs
from rejoint.system.errors import FileError, InputError


def test_every_number_arrives(tmp_path: Path):
    found = sample()
    source = write_table(tmp_path / "wave.csv", found)
    assert detect(source) == "table"
    imported = import_logs(source, ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    assert imported.notes == ()
    assert log.time.tolist() == found.time.tolist()
    assert log.position.tolist() == found.position.tolist()
    assert log.command.tolist() == found.command.tolist()
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["wave.parquet"]


def columns(found: Sample) -> dict[str, np.ndarray]:
    """The columns of a table, and one that is no part of a log."""
    table = {"time_s": found.time, "voltage": np.full(len(found.time), 7.4)}
    for group in ("position", "command"):
        table |= {f"{group}.{name}_rad": getattr(found, group)[:, i] for i, name in enumerate(ARM.joint_names)}
    return table


def write_pyarrow(path: Path, found: Sample) -> None:
    pyarrow.csv.write_csv(pa.table(columns(found)), path)  # quotes its header


def write_numpy(path: Path, found: Sample) -> None:
    table = columns(found)
    np.savetxt(path, np.stack(list(table.values()), axis=1), "%.17g", ",", header=",".join(table), comments="")


def write_pandas(path: Path, found: Sample) -> None:
    pandas.DataFrame(columns(found)).to_csv(path)  # with its unnamed index column


def write_excel(path: Path, found: Sample) -> None:
    """As spreadsheets do on Windows: a byte order mark, and lines that end in two characters."""
    with path.open("w", newline="", encoding="utf-8-sig") as stream:
        writer = csv.DictWriter(stream, columns(found), dialect="excel")
        writer.writeheader()
        writer.writerows(
            dict(zip(columns(found), row, strict=True)) for row in zip(*columns(found).values(), strict=True)
        )


@pytest.mark.parametrize("write", [write_pyarrow, write_numpy, write_pandas, write_excel])
def test_files_of_other_programs_arrive_bit_for_bit(tmp_path: Path, write: Callable[[Path, Sample], None]):
    found = sample()
    write(tmp_path / "wave.csv", found)
    assert detect(tmp_path / "wave.csv") == "table"
    imported = import_logs(tmp_path / "wave.csv", ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    assert log.time.tolist() == found.time.tolist()
    assert log.position.tolist() == found.position.tolist()
    assert log.command.tolist() == found.command.tolist()
    assert any("columns ignored" in note and "voltage" in note for note in imported.notes)


def test_a_unit_may_stand_in_each_name(tmp_path: Path):
    lines = [
        "time_ms,command.b_deg,position.a_rad,command.a_rad,position.b_deg,true_tcp.x_mm,true_tcp.y_m,true_tcp.z_m"
    ]
    lines += [f"{20 * k},{9 * k},{0.1 * k},{0.2 * k},{18 * k},{100 * k},{k},{-k}" for k in range(4)]
    names = {"a": "shoulder_pan", "b": "wrist_roll"}
    two = {"shoulder_lift": "c", "elbow_flex": "d", "wrist_flex": "e"}
    wide = [lines[0] + "".join(f",position.{n}_rad,command.{n}_rad" for n in two.values())]
    wide += [line + ",0,0" * 3 for line in lines[1:]]
    (tmp_path / "mixed.csv").write_text("\n".join(wide) + "\n")
    options = ImportOptions(columns={joint: name for name, joint in names.items()} | two)
    log = import_logs(tmp_path / "mixed.csv", ARM, out=tmp_path / "logs", options=options).logs[0]
    k = np.arange(4)
    np.testing.assert_allclose(log.time, 0.02 * k)
    np.testing.assert_allclose(log.position, np.outer(k, [0.1, 0, 0, 0, np.pi / 10]))
    np.testing.assert_allclose(log.command, np.outer(k, [0.2, 0, 0, 0, np.pi / 20]))
    np.testing.assert_allclose(log.true_tcp, np.outer(k, [0.1, 1.0, -1.0]))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_a_declared_time_unit_is_taken(tmp_path: Path, unit: str):
    ticks = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    found = sample()
    scaled = type(found)(time=found.time * ticks, position=found.position, command=found.command)
    source = write_table(tmp_path / "wave.csv", scaled, {"time_s": "time"})
    with pytest.raises(
        FileError, match=r"column time does not say its unit; rename it time_s or .* or set --time-unit"
    ):
        import_logs(source, ARM, out=tmp_path / "logs")
    log = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(time_unit=unit)).logs[0]
    np.testing.assert_allclose(log.time, found.time, rtol=1e-15)


def test_degrees_called_radians_are_refused(tmp_path: Path):
    source = write_table(tmp_path / "wave.csv", sample(), scale=180 / np.pi)
    with pytest.raises(
        FileError,
        match=r"position.*_rad is .* rad, beyond two turns; .* are degrees, or angles of .* before .*column's name",
    ):
        import_logs(source, ARM, out=tmp_path / "logs")


def test_radians_called_degrees_are_refused(tmp_path: Path):
    names = {f"{g}.{j}_rad": f"{g}.{j}_deg" for g in ("position", "command") for j in ARM.joint_names}
    with pytest.raises(
        FileError, match=r"no angle is beyond 0.7.* deg; the values are surely radians; .*column's name"
    ):
        import_logs(write_table(tmp_path / "wave.csv", sample(), names), ARM, out=tmp_path / "logs")


def test_a_full_folder_is_never_written_into(tmp_path: Path):
    source = write_table(tmp_path / "wave.csv", sample())
    (tmp_path / "logs").mkdir()
    import_logs(source, ARM, out=tmp_path / "logs")
    with pytest.raises(InputError, match="exists already"):
        import_logs(source, ARM, out=tmp_path / "logs")
