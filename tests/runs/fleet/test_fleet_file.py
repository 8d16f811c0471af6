"""FLEET.toml: what is read from it, and what is said of a file that cannot be used."""

from dataclasses import replace
from datetime import datetime, timedelta

from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import load_arm, write_arm_toml
from rejoint.runs.fleet.file import DAYS, ROOM, FleetArm, read_fleet
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


def write_fleet(folder, text=TEXT):
    """Write the file, and the description of its second arm."""
    folder.mkdir(exist_ok=True)
    write_arm_toml(folder / "own.toml", OWN)
    (folder / "FLEET.toml").write_text(text)
    return folder / "FLEET.toml"


def test_arms_take_what_they_do_not_say_from_the_top(tmp_path):
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
    assert (first.hours, first.closed) == (["Mon-Fri 08:00-18:00"], None)
    assert (second.hours, second.closed) == (["Fri 22:00-06:00"], ["2026-12-24 to 2027-01-06"])
    assert fleet.only(("desk",)) == (second,)


@settings(max_examples=300)
@given(data=st.data())
def test_a_file_is_read_or_refused_whatever_is_in_it(tmp_path_factory, data):
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
        lines[place] = (
            f"{key}= {data.draw(st.sampled_from(values))}"
            if "=" in lines[place]
            else data.draw(st.sampled_from(["", "[arm]", "[[arm]]", "[tip]", "=", "\x00", lines[place]]))
        )
    path = write_fleet(tmp_path_factory.getbasetemp(), "\n".join(lines))
    try:
        fleet = read_fleet(path)
    except FileError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert len({arm.name for arm in fleet.arms}) == len(fleet.arms) > 0
        assert all(arm.tolerance_mm is None or arm.tolerance_mm > 0.0 for arm in fleet.arms)


clock = "{:02}:{:02}".format
spans = st.builds(
    lambda first, last, begin, end: f"{DAYS[first]}-{DAYS[last]} {clock(*divmod(begin, 60))}-{clock(*divmod(end, 60))}",
    st.integers(0, 6),
    st.integers(0, 6),
    st.integers(0, 1439),
    st.integers(0, 1440),
).filter(lambda text: text[8:13] != text[14:])


@settings(max_examples=60)
@given(
    texts=st.lists(spans, min_size=1, max_size=3),
    day=st.integers(0, 13),
    now=st.datetimes(datetime(2026, 11, 23), datetime(2026, 12, 7)),
)
def test_motions_begin_at_the_first_minute_that_leaves_them_room(texts, day, now):
    closed = [f"{datetime(2026, 11, 23) + timedelta(days=day):%Y-%m-%d}"]
    hours = FleetArm(name="a", address="a", hours=texts, closed=closed).opening
    now = now.replace(second=0, microsecond=0)

    def leaves_room(at):
        return all(hours.is_open(at + timedelta(minutes=k)) for k in range(ROOM))

    begins = hours.begins(now)
    end = now + timedelta(minutes=3000) if begins is None else begins
    assert begins is None or (begins >= now and leaves_room(begins))
    minutes = min(int((end - now).total_seconds() // 60), 3000)
    assert not any(leaves_room(now + timedelta(minutes=k)) for k in range(0, minutes, 7))
