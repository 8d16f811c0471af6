"""CSV as spreadsheets, Arduino sketches, NumPy and old programs write it; and the layout that the pages show."""

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, worn_sample

from rejoint.logs.importing import import_logs
from rejoint.logs.joints import ImportOptions

FOUND = worn_sample(seconds=5)
NAMES = ["time_s", *(f"{group}.{name}_rad" for group in ("position", "command") for name in ARM.joint_names)]
TABLE = np.column_stack([FOUND.time, FOUND.position, FOUND.command])


def lines(separator: str = ",", point: str = ".", header: bool = True) -> list[str]:
    rows = [separator.join(repr(float(value)).replace(".", point) for value in row) for row in TABLE]
    return [separator.join(NAMES)] * header + rows


def text(*rows: str, end: str = "\n") -> str:
    return end.join(rows) + end


def dated(line: str) -> str:
    time, _, rest = line.partition(",")
    return f"{datetime.fromtimestamp(float(time), UTC).isoformat()},{rest}"


WAYS: dict[str, tuple[bytes, str]] = {
    "plain": (text(*lines()).encode(), ""),
    "windows": (text(*lines(), end="\r\n").encode("utf-8-sig"), ""),
    "utf-16": (text(*lines()).encode("utf-16"), "UTF-16, columns parted by commas"),
    "utf-16 without its mark": (text(*lines()).encode("utf-16-be"), "UTF-16"),
    "latin-1": (text("# Prüfstand 3, Temperatur 21 °C", *lines()).encode("latin-1"), "Latin-1"),
    "german": (text(*lines(";", ",")).encode("latin-1"), "parted by semicolons"),
    "tabs": (text(*lines("\t", ",")).encode("utf-16"), "UTF-16, columns parted by tabs"),
    "spaces": (text(*lines("  ")).encode(), "parted by spaces"),
    "bars": (text(*lines(" | ")).encode(), "parted by bars"),
    "declared separator": (text("sep=;", *lines(";")).encode(), "semicolons"),
    "comments": (text("# robot 7", "", "% second", *lines()[:40], "# paused", *lines()[40:]).encode(), ""),
    "numpy": (text("# " + lines()[0], *lines()[1:]).encode(), ""),
    "trailing separators": (text(*(line + "," for line in lines())).encode(), ""),
    "quoted commas": (
        text(lines()[0], *('"' + row.replace("x", '","') + '"' for row in lines("x", ",")[1:])).encode(),
        "",
    ),
    "prints of a sketch": (text("Servo test v1.2", "Ready.", *lines("\t")).encode(), "parted by tabs, after 2 other"),
    "heading of a spreadsheet": (text("Bench 3;;;;", ";;;;", *lines(";", ",")).encode("utf-16"), "after 1 other line"),
    "a vendor's recorder": (text("Graph,3", "-1,XL430,Present Position,,,", *lines()).encode(), "after 2 other line"),
    "empty rows of a spreadsheet": (text(*lines(";"), ";" * 10, ";" * 10).encode(), "semicolons"),
    "no end of the last line": ("\n".join(lines()).encode(), ""),
    "dates": (text("time," + lines()[0].partition(",")[2], *map(dated, lines()[1:])).encode(), ""),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_writing_a_table_gives_the_same_numbers(tmp_path, way: str):
    data, said = WAYS[way]
    (tmp_path / "log.csv").write_bytes(data)
    imported = import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    kept = len(log)
    assert kept >= len(TABLE) - (way == "no end of the last line")
    assert np.abs(log.time - TABLE[:kept, 0]).max() <= 1e-6 * (way == "dates")
    assert log.position.tolist() == TABLE[:kept, 1:6].tolist()
    assert log.command.tolist() == TABLE[:kept, 6:].tolist()
    read = [note for note in imported.notes if "read as" in note]
    assert bool(read) == bool(said)
    assert all(said in note for note in read)


def test_a_line_that_was_cut_is_left_out(tmp_path):
    whole = text(*lines())
    (tmp_path / "log.csv").write_text(whole[:-12])
    imported = import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs")
    assert len(imported.logs[0]) == len(TABLE) - 1
    assert any("the last line does not end and may be cut: left out" in note for note in imported.notes)


def test_columns_without_titles_are_numbered(tmp_path):
    rows = lines(header=False)
    (tmp_path / "serial.txt").write_text(text("# starting ...", *rows[:12], "lost, retry", *rows[12:]))
    options = ImportOptions(angle_unit="rad", columns={"time_s": "1", "position": "2..6", "command": "7..11"})
    log = import_logs(tmp_path / "serial.txt", ARM, out=tmp_path / "logs", options=options).logs[0]
    assert log.command.tolist() == FOUND.command.tolist()


def test_one_pattern_maps_the_columns_of_every_joint_and_those_named_as_joints_are_positions(tmp_path):
    titles = ["time_s", *(f"{name}_{kind}" for kind in ("rad", "target") for name in ARM.joint_names)]
    (tmp_path / "log.csv").write_text(text(",".join(titles), *lines(header=False)).replace("\n", ",\n"))
    options = ImportOptions(columns={"command.JOINT_rad": "-JOINT_target"}, force=True)
    log = import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs", options=options).logs[0]
    assert log.position.tolist() == FOUND.position.tolist()
    assert log.command.tolist() == (-FOUND.command).tolist()


PAGE = (Path(__file__).parents[2] / "docs/logs.md").read_text()


def test_the_example_of_the_documentation_is_imported(tmp_path):
    tables = re.findall(r"```csv\n(.*?)```", PAGE, re.DOTALL)
    assert len(tables) == 2
    (tmp_path / "one.csv").write_text(tables[0])
    log = import_logs(tmp_path / "one.csv", ARM, out=tmp_path / "1").logs[0]
    np.testing.assert_allclose(log.time, [0.0, 0.02, 0.04])
    np.testing.assert_allclose(np.rad2deg(log.position[:, 2]), [10.1, 10.4, 11.0])
    np.testing.assert_allclose(np.rad2deg(log.command[:, 2]), [11.0, 12.0, 13.0])
    command = re.search(r"^    --map (\S+)", PAGE, re.MULTILINE)[1]
    (tmp_path / "two.csv").write_text(tables[1])
    pairs = dict(pair.split("=") for pair in command.split(","))
    options = ImportOptions(time_unit="ms", angle_unit="deg", columns=pairs)
    other = import_logs(tmp_path / "two.csv", ARM, out=tmp_path / "2", options=options).logs[0]
    np.testing.assert_allclose(other.position, log.position)
    np.testing.assert_allclose(other.command, log.command)
