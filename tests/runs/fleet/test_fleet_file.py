"""FLEET.toml: what is read from it, and what is said of a file that cannot be used."""

import re
from dataclasses import replace
from datetime import date, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import load_arm, write_arm_toml
from rejoint.runs.fleet.file import FleetArm, read_fleet
from rejoint.runs.fleet.hours import DAYS, Hours, read_hours
from rejoint.system.errors import FileError

OWN = replace(load_arm("mycobot280"), name="own")
TEXT = """
folder = "lab"
hours = ["Mon-Fri 08:00-18:00"]
tolerance_mm = 3.0
may_move = true

[[arm]]
name = "bench-3"
address = "tcp://192.168.1.20:9000"
description = "so101"
bench = "table 1"

[[arm]]
name = "desk"
address = "emulated:worn?seed=2"
description = "own.toml"
hours = ["Fri 22:00-06:00"]
closed = ["2026-12-24 to 2027-01-06"]
tolerance_mm = 5
needs_somebody = false
may_repair = true
"""


def write_fleet(folder: Path, text: str = TEXT) -> Path:
    """Write the file, and the description of its second arm."""
    folder.mkdir(exist_ok=True)
    write_arm_toml(folder / "own.toml", OWN)
    (folder / "FLEET.toml").write_text(text)
    return folder / "FLEET.toml"


def test_arms_take_what_they_do_not_say_from_the_top(tmp_path: Path) -> None:
    fleet = read_fleet(write_fleet(tmp_path))
    first, second = fleet.arms
    assert fleet.folder == tmp_path / "lab"
    assert (first.name, first.description, first.bench, first.resource) == (
        "bench-3",
        "so101",
        "table 1",
        "arm-bench-3",
    )
    assert (first.tolerance_mm, first.may_move, first.needs_somebody, first.may_repair) == (3.0, True, True, False)
    assert (second.tolerance_mm, second.may_move, second.needs_somebody, second.may_repair) == (5.0, True, False, True)
    assert second.description == str(tmp_path / "own.toml")
    assert [arm.virtual for arm in fleet.arms] == [False, True]
    assert first.hours == read_hours(["Mon-Fri 08:00-18:00"])
    assert second.hours == read_hours(["Fri 22:00-06:00"], ["2026-12-24 to 2027-01-06"])
    assert fleet.only(("desk",)) == (second,)


def test_the_file_in_the_docs_says_what_holds_where_nothing_is_said(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "fleet.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "FLEET.toml").write_text(text)
    first, second, virtual = read_fleet(tmp_path / "FLEET.toml").arms
    assert (first.may_move, first.needs_somebody, first.may_repair) == (True, True, True)
    assert (second.may_repair, virtual.needs_somebody) == (False, False)
    (tmp_path / "FLEET.toml").write_text('[[arm]]\nname = "a"\naddress = "tcp://10.0.0.1"\n')
    fleet = read_fleet(tmp_path / "FLEET.toml")
    assert fleet.folder == tmp_path / "runs"
    assert fleet.arms == (FleetArm(name="a", address="tcp://10.0.0.1"),)
    assert not fleet.arms[0].may_move


@pytest.mark.parametrize(
    ("found", "instead", "told"),
    [
        ('name = "desk"', 'name = "bench-3"', r"line 14: arm 2: name: two arms have the name 'bench-3'"),
        ('name = "desk"', 'name = "a desk"', r"line 14: arm 2: name: expected letters, digits"),
        ("emulated:worn?seed=2", "tcp://192.168.1.20:9000", r"line 15: arm 2: address: two arms have the address"),
        (
            "emulated:worn?seed=2",
            "tcp://192.168.1.20",
            r"two arms have the address 'tcp://192.168.1.20', which is that of",
        ),
        ("emulated:worn?seed=2", "feetech://192.168.1.20:9000?p=16", r"two arms have the address"),
        ("emulated:worn?seed=2", "emulated worn", r"line 15: arm 2: address: unknown robot address"),
        ("own.toml", "gone.toml", r"line 16: arm 2: description: .*gone.toml.*no such file"),
        (
            'emulated:worn?seed=2"\ndescription = "own.toml',
            "emulated:wron",
            r"line 15: arm 2: address: no wear profile",
        ),
        ("= 3.0", f"= {'9' * 5000}", r"it is not TOML: Exceeds the limit"),
        ('"so101"', '"so102"', r"line 10: arm 1: description: .*so102"),
        ("Fri 22", "Fre 22", r"line 17: arm 2: hours: expected hours such as Mon-Fri 08:00-18:00"),
        ("08:00-18:00", "08:00-24:30", r"line 3: hours: expected two different times from 00:00 to 24:00"),
        ("2027-01-06", "2026-01-06", r"line 18: arm 2: closed: expected a day such as"),
        ("tolerance_mm = 5", "tolerance_mm = 0", r"line 19: arm 2: tolerance_mm: expected a finite number above 0"),
        ("may_repair = true", 'may_repair = "yes"', r"line 21: arm 2: may_repair: expected true or false, found 'yes'"),
        ("may_move = true", "may_mvoe = true", r"line 5: may_mvoe: there is no such key; did you mean may_move"),
        ("[[arm]]", "[[robot]]", r"robot: there is no such key"),
        ('hours = ["Fri 22:00-06:00"]', "hours = []", r"line 17: arm 2: hours: expected a list of one text or more"),
        ('folder = "lab"', "folder = 3", r"line 2: folder: expected a text, found 3"),
    ],
)
def test_what_cannot_be_used_is_named_in_one_line(tmp_path: Path, found: str, instead: str, told: str) -> None:
    assert found in TEXT
    path = write_fleet(tmp_path, TEXT.replace(found, instead))
    with pytest.raises(FileError, match=told) as error:
        read_fleet(path)
    assert "\n" not in str(error.value)


def test_a_file_of_notepad_is_read_and_a_tilde_is_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    text = TEXT.replace('"lab"', '"~/lab"').replace('"own.toml"', '"~/own.toml"').replace("\n", "\r\n")
    write_fleet(tmp_path / "home", "")
    (tmp_path / "FLEET.toml").write_text(text, encoding="utf-8-sig", newline="")
    fleet = read_fleet(tmp_path / "FLEET.toml")
    assert fleet.folder == tmp_path / "home" / "lab"
    assert fleet.arms[1].description == str(tmp_path / "home" / "own.toml")


@pytest.mark.parametrize("one", ["tcp://localhost:9311", "tcp://0.0.0.0:9311", "feetech://LOCALHOST:9311"])
def test_one_place_has_one_arm_however_it_is_written(tmp_path: Path, one: str) -> None:
    link = tmp_path / "by-id"
    link.symlink_to("/dev/ttyACM0")
    for first, second in (("tcp://127.0.0.1:9311", one), (f"feetech://{link}?p=16", "feetech:///dev/ttyACM0")):
        text = "".join(f'[[arm]]\nname = "a{n}"\naddress = "{arm}"\n' for n, arm in enumerate((first, second)))
        (tmp_path / "FLEET.toml").write_text(text)
        with pytest.raises(FileError, match=r"line 6: arm 2: address: two arms have the address .* of a0"):
            read_fleet(tmp_path / "FLEET.toml")


@settings(max_examples=300)
@given(data=st.data())
def test_a_file_is_read_or_refused_whatever_is_in_it(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Values of every kind, in every place."""
    values = [
        "0",
        "-1",
        "1e400",
        "nan",
        f"1{'0' * 400}",
        "true",
        '""',
        '"x"',
        "[]",
        "[1]",
        '["Mon 00:00-24:00"]',
        "{}",
        "{a = 1}",
        "2026-01-01",
        '"emulated:worn"',
        '"::"',
        '["2026-02-30"]',
        '["９９:00"]',
        '["Mon ٠٨:00-18:00"]',
    ]
    lines = TEXT.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(lines) - 1))
        key = lines[place].partition("=")[0]
        lines[place] = f"{key}= {data.draw(st.sampled_from(values))}" if "=" in lines[place] else data.draw(
            st.sampled_from(["", "[arm]", "[[arm]]", "[tip]", "=", "\x00", lines[place]])
        )  # fmt: skip
    path = write_fleet(tmp_path_factory.getbasetemp(), "\n".join(lines))
    try:
        fleet = read_fleet(path)
    except FileError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert len({arm.name for arm in fleet.arms}) == len(fleet.arms) > 0
        assert all(arm.tolerance_mm is None or arm.tolerance_mm > 0.0 for arm in fleet.arms)


def test_hours_by_hand() -> None:
    hours = read_hours(["Mon-Fri 08:00-18:00", "fri 22:00-06:00"], ["2026-11-25", "2026-12-24 to 2027-01-06"])
    monday = datetime(2026, 11, 23)
    assert not hours.is_open(monday.replace(hour=7, minute=59))
    assert hours.is_open(monday.replace(hour=8))
    assert not hours.is_open(monday.replace(hour=18))
    assert hours.closes(monday.replace(hour=9)) == monday.replace(hour=18)
    assert not hours.is_open(datetime(2026, 11, 25, 12))  # closed
    assert hours.opens(datetime(2026, 11, 24, 20)) == datetime(2026, 11, 26, 8)
    assert hours.is_open(datetime(2026, 11, 28, 5, 59))  # Saturday, since Friday night
    assert not hours.is_open(datetime(2026, 11, 28, 6))
    assert hours.opens(datetime(2026, 12, 23, 19)) == datetime(2027, 1, 7, 8)
    assert read_hours(["Sat-Mon 10:00-11:00"]).spans == ((5, 600, 660), (6, 600, 660), (0, 600, 660))
    assert Hours().is_open(monday)
    assert Hours().closes(monday) is None
    assert Hours(closed=((date(2026, 11, 24), date(2026, 11, 24)),)).closes(monday) == datetime(2026, 11, 24)


clock = "{:02}:{:02}".format
spans = st.builds(
    lambda first, last, begin, end: f"{DAYS[first]}-{DAYS[last]} {clock(*divmod(begin, 60))}-{clock(*divmod(end, 60))}",
    st.integers(0, 6), st.integers(0, 6), st.integers(0, 1439), st.integers(0, 1440),
).filter(lambda text: text[8:13] != text[14:])  # fmt: skip


@settings(max_examples=60)
@given(
    texts=st.lists(spans, min_size=1, max_size=3), day=st.integers(0, 13),
    now=st.datetimes(datetime(2026, 11, 23), datetime(2026, 12, 7)),
)  # fmt: skip
def test_hours_open_and_close_when_they_say(texts: list[str], day: int, now: datetime) -> None:
    """Between now and the next change nothing changes, minute by minute; then it does."""
    hours = read_hours(texts, [f"{datetime(2026, 11, 23) + timedelta(days=day):%Y-%m-%d}"])
    now = now.replace(second=0, microsecond=0)
    open_now = hours.is_open(now)
    change = hours.closes(now) if open_now else hours.opens(now)
    if change is None:
        assert open_now
        return
    assert change > now
    assert hours.is_open(change) != open_now
    minutes = min(int((change - now).total_seconds() // 60), 3000)
    assert all(hours.is_open(now + timedelta(minutes=i)) == open_now for i in range(minutes))
