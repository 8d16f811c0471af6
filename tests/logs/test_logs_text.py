"""CSV as spreadsheets, Arduino sketches, NumPy and old programs write it; and the layout that the pages show."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, worn_sample, write_table

from rejoint.logs import ImportOptions, import_logs
from rejoint.system.errors import FileError, InputError

FOUND = worn_sample(seconds=5)
NAMES = ["time_s", *(f"{group}.{name}_rad" for group in ("position", "command") for name in ARM.joint_names)]
TABLE = np.column_stack([FOUND.time, FOUND.position, FOUND.command])


def lines(separator: str = ",", point: str = ".", header: bool = True) -> list[str]:
    rows = [separator.join(repr(float(value)).replace(".", point) for value in row) for row in TABLE]
    return [separator.join(NAMES)] * header + rows


def text(*rows: str, end: str = "\n") -> str:
    return end.join(rows) + end


WAYS: dict[str, tuple[bytes, str]] = {
    "plain": (text(*lines()).encode(), ""),
    "windows": (text(*lines(), end="\r\n").encode("utf-8-sig"), ""),
    "utf-16": (text(*lines()).encode("utf-16"), "UTF-16, columns parted by commas"),
    "utf-16 without its mark": (text(*lines()).encode("utf-16-be"), "UTF-16"),
    "utf-32": (text(*lines()).encode("utf-32"), "UTF-32"),
    "latin-1": (text("# Prüfstand 3, Temperatur 21 °C", *lines()).encode("latin-1"), "Latin-1"),
    "semicolons": (text(*lines(";")).encode(), "parted by semicolons"),
    "german": (text(*lines(";", ",")).encode("latin-1"), "parted by semicolons, decimal commas"),
    "tabs": (text(*lines("\t", ",")).encode("utf-16"), "UTF-16, columns parted by tabs, decimal commas"),
    "spaces": (text(*lines("  ")).encode(), "parted by spaces"),
    "bars": (text(*lines(" | ")).encode(), "parted by bars"),
    "declared separator": (text("sep=;", *lines(";")).encode(), "semicolons"),
    "comments": (text("# robot 7", "", "% second", *lines()[:40], "# paused", *lines()[40:]).encode(), ""),
    "numpy": (text("# " + lines()[0], *lines()[1:]).encode(), ""),
    "trailing separators": (text(*(line + "," for line in lines())).encode(), ""),
    "wider rows": (text(lines()[0], *(f"{line}," for line in lines()[1:])).encode(), ""),
    "quoted commas": (
        text(lines()[0], *('"' + row.replace("x", '","') + '"' for row in lines("x", ",")[1:])).encode(),
        "decimal commas",
    ),
    "prints of a sketch": (text("Servo test v1.2", "Ready.", *lines("\t")).encode(), "parted by tabs, after 2 other"),
    "heading of a spreadsheet": (text("Bench 3;;;;", ";;;;", *lines(";", ",")).encode("utf-16"), "after 1 other line"),
    "empty rows of a spreadsheet": (text(*lines(";"), ";" * 10, ";" * 10).encode(), "semicolons"),
    "no end of the last line": ("\n".join(lines()).encode(), ""),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_writing_a_table_gives_the_same_numbers(tmp_path: Path, way: str):
    data, said = WAYS[way]
    (tmp_path / "log.csv").write_bytes(data)
    imported = import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    kept = len(log)
    assert kept >= len(TABLE) - (way == "no end of the last line")
    assert log.time.tolist() == TABLE[:kept, 0].tolist()
    assert log.position.tolist() == TABLE[:kept, 1:6].tolist()
    assert log.command.tolist() == TABLE[:kept, 6:].tolist()
    read = [note for note in imported.notes if "read as" in note]
    assert bool(read) == bool(said)
    assert all(said in note for note in read)


def broken(change: Callable[[list[str]], list[str]]) -> bytes:
    return text(*change(lines())).encode()


WRONG: dict[str, tuple[bytes, str]] = {
    "mixed decimals": (text(*lines(";", ",")[:9], *lines(";")[9:]).encode(), "a comma, .* in line 10 a point"),
    "decimal commas between commas": (text(*lines(",", ",")).encode(), "22 columns, .* has 11 .decimal"),
    "thousands": (broken(lambda t: [*t[:5], t[5].replace("0.", '"1,000.', 1).replace(",", '",', 2)]), "line 6"),
    "underscores": (broken(lambda t: [*t[:4], t[4].replace("0.0", "1_0.0", 1), *t[5:]]), "line 5.*'1_0"),
    "arabic digits": (broken(lambda t: [*t[:4], t[4].replace("0.", "٠.", 1), *t[5:]]), "line 5, .*no number"),
    "no titles but words": (text("0,1,base,elbow", "1,1,base,elbow").encode(), "line 1 has no titles, but val"),
    "dates": (broken(lambda t: [*t[:4], "2025-06-15 15:06:40" + t[4][4:], *t[5:]]), "'2025-06-15 .* is a date"),
    "binary": (bytes(range(256)) * 4, "no text: read as Latin-1, line 1 holds the control character"),
    "empty": (b"\n\n", "is empty"),
    "only comments": (b"# a\n# b,c\n", "text in UTF-8 without a table"),
    "damaged utf-16": (text(*lines()).encode("utf-16")[:-1], "text in UTF-16 that is damaged at byte"),
    "no titles": (text(*lines(header=False)).encode(), "none of the columns 1, 2, .* without a line of titles"),
    "other titles": (
        text("t;a;b", "0;1;2").encode(), "none of the columns t, a, b says the time, .*semicolons; .*--map",
    ),
    "time alone": (text("time_s,volt", "0,1", "0.02,2").encode(), "no column with joint positions; found .*volt"),
    "only titles": (text(lines()[0]).encode(), r"state: 0 sample\(s\), a log needs at least 2"),
}  # fmt: skip


@pytest.mark.parametrize("way", WRONG)
def test_an_error_names_what_was_found(tmp_path: Path, way: str):
    data, said = WRONG[way]
    (tmp_path / "log.csv").write_bytes(data)
    with pytest.raises(FileError, match=said) as caught:
        import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs", format="csv")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


def test_a_line_that_was_cut_is_left_out(tmp_path: Path):
    whole = text(*lines())
    (tmp_path / "log.csv").write_text(whole[:-12])
    imported = import_logs(tmp_path / "log.csv", ARM, out=tmp_path / "logs")
    assert len(imported.logs[0]) == len(TABLE) - 1
    assert any("the last, does not end and may be cut: left out" in note for note in imported.notes)


TITLES = ["t [ms]", *(f"joint_{letter}" for letter in "abcde"), *(f"cmd {number}" for number in range(1, 6))]
MAP = {"time": "t [ms]"} | {
    name: f"joint_{letter}" for name, letter in zip(ARM.joint_names, "abcde", strict=True)
} | {f"command.{name}": f"cmd {number}" for number, name in enumerate(ARM.joint_names, start=1)}  # fmt: skip


def other_titles(path: Path) -> Path:
    rows = [",".join(repr(float(v)) for v in [1e3 * row[0], *np.rad2deg(row[1:])]) for row in TABLE]
    path.write_text(text(",".join(TITLES), *rows))
    return path


@pytest.mark.parametrize("sign", ["[°]", "(°)", "[deg]"])
def test_a_title_may_have_the_sign_of_degrees(tmp_path: Path, sign: str):
    titled = [f"{title} {sign}" for title in TITLES[1:]]
    rows = [",".join(repr(float(v)) for v in [row[0], *np.rad2deg(row[1:])]) for row in TABLE]
    (tmp_path / "a.csv").write_text(text(",".join(["time_s", *titled]), *rows), encoding="utf-8")
    mapped = {ours: f"{theirs} {sign}" for ours, theirs in MAP.items() if ours != "time"}
    log = import_logs(tmp_path / "a.csv", ARM, out=tmp_path / "logs", options=ImportOptions(columns=mapped)).logs[0]
    np.testing.assert_allclose(log.position, FOUND.position, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(log.command, FOUND.command, rtol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_other_titles_are_mapped_from_either_side(tmp_path: Path, turned: bool):
    pairs = {theirs: ours for ours, theirs in MAP.items()} if turned else MAP
    options = ImportOptions(angle_unit="deg", columns=pairs)
    log = import_logs(other_titles(tmp_path / "a.csv"), ARM, out=tmp_path / "logs", options=options).logs[0]
    np.testing.assert_allclose(log.time, FOUND.time, rtol=1e-12)
    np.testing.assert_allclose(log.position, FOUND.position, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(log.command, FOUND.command, rtol=1e-12)


def test_columns_without_titles_are_numbered(tmp_path: Path):
    (tmp_path / "serial.txt").write_text(text("starting ...", *lines(header=False)).replace("starting", "# starting"))
    numbered = dict(zip(["time_s", *ARM.joint_names], map(str, range(1, 7)), strict=True))
    numbered |= {f"command.{name}": str(column) for column, name in enumerate(ARM.joint_names, start=7)}
    options = ImportOptions(angle_unit="rad", columns=numbered)
    log = import_logs(tmp_path / "serial.txt", ARM, out=tmp_path / "logs", options=options).logs[0]
    assert log.command.tolist() == FOUND.command.tolist()


def test_a_wrong_map_is_named(tmp_path: Path):
    source = other_titles(tmp_path / "a.csv")
    for pairs, kind, said in (
        ({"elbow": "joint_a"}, InputError, "neither side is something that a log has: .* elbow_flex"),
        ({"elbow_flex": "q9"}, FileError, r"no column q9; found UTF-8, columns parted by commas: t \[ms\], joint_a"),
        ({"elbow_flex": "joint_a", "wrist_flex": "joint_a"}, InputError, "takes column joint_a twice"),
        ({"elbow_flex_deg": "joint_a", "wrist_flex_rad": "joint_b"}, FileError, "joint_a is in deg by its name, but"),
    ):
        options = ImportOptions(angle_unit="rad", columns=pairs)
        with pytest.raises(kind, match=said):
            import_logs(source, ARM, out=tmp_path / "logs", options=options)


def test_files_of_a_folder_that_are_left_out_are_named(tmp_path: Path):
    (tmp_path / "in").mkdir()
    write_table(tmp_path / "in/a.csv", Sample(time=FOUND.time, position=FOUND.position, command=FOUND.command))
    (tmp_path / "in/calibration.csv").write_text("posture,x_mm\n1,2\n")
    imported = import_logs(tmp_path / "in", ARM, out=tmp_path / "logs")
    assert imported.notes == ("a: files without columns of a log left out: calibration.csv",)


PAGE = (Path(__file__).parents[2] / "docs/files.md").read_text()


def test_the_example_of_the_documentation_is_imported(tmp_path: Path):
    tables = re.findall(r"```csv\n(.*?)```", PAGE, re.DOTALL)
    assert len(tables) == 2
    (tmp_path / "one.csv").write_text(tables[0])
    log = import_logs(tmp_path / "one.csv", ARM, out=tmp_path / "1").logs[0]
    np.testing.assert_allclose(log.time, [0.0, 0.02, 0.04])
    np.testing.assert_allclose(np.rad2deg(log.position[:, 2]), [10.1, 10.4, 11.0])
    np.testing.assert_allclose(np.rad2deg(log.command[:, 2]), [11.0, 12.0, 13.0])
    command = re.search(r"--map (\S+)", PAGE)[1]
    (tmp_path / "two.csv").write_text(tables[1])
    pairs = dict(pair.split("=") for pair in command.split(","))
    options = ImportOptions(time_unit="ms", angle_unit="deg", columns=pairs)
    other = import_logs(tmp_path / "two.csv", ARM, out=tmp_path / "2", options=options).logs[0]
    np.testing.assert_allclose(other.position, log.position)
    np.testing.assert_allclose(other.command, log.command)
