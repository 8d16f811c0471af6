"""Whatever happens to a file: it is imported, or a FileError says why, and never is half a folder left."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import ARM, sample, write_sage, write_table
from test_logs_lerobot import DATA, DATASET
from test_logs_mcap import write_foxglove, write_json

from rejoint.logs.exporting import export_log
from rejoint.logs.importing import import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError

EXAMPLES = int(os.environ.get("REJOINT_EXAMPLES", "100"))

mutations = st.tuples(st.floats(0, 1), st.sampled_from((0, 1, 7, 30, 10**9)), st.binary(max_size=30))
"""Place, bytes that are lost there, and bytes that come instead."""


def mutated(data: bytes, changes: list[tuple[float, int, bytes]]) -> bytes:
    for where, lost, instead in changes:
        at = int(where * len(data))
        data = data[:at] + instead + data[at + lost :]
    return data


def write_ros2(path: Path) -> Path:
    found = sample()
    export_log(RunLog.of(found.time, found.command, found.position, arm=ARM), path)
    return path


MAKERS: dict[str, tuple[Callable[[Path], Path], str, ImportOptions]] = {
    "sage-state": (lambda f: write_sage(f / "m", sample()), "state_motor.csv", ImportOptions()),
    "sage-control": (lambda f: write_sage(f / "m", sample()), "control.csv", ImportOptions()),
    "sage-joints": (lambda f: write_sage(f / "m", sample()), "joint_list.txt", ImportOptions()),
    "table": (lambda f: write_table(f / "m.csv", sample()), "", ImportOptions()),
    "mcap-cdr": (lambda f: write_ros2(f / "m.mcap"), "", ImportOptions()),
    "mcap-json": (lambda f: write_json(f / "m.mcap", sample()), "", ImportOptions()),
    "mcap-protobuf": (lambda f: write_foxglove(f / "m.mcap", sample()), "", ImportOptions()),
    "lerobot-info": (lambda f: shutil.copytree(DATASET, f / "m"), "meta/info.json", ImportOptions(angle_unit="deg")),
    "lerobot-data": (lambda f: shutil.copytree(DATASET, f / "m"), str(DATA), ImportOptions(angle_unit="deg")),
}


@pytest.mark.parametrize("kind", MAKERS)
def test_damage_never_crashes_and_never_leaves_half(tmp_path: Path, kind: str):
    make, part, options = MAKERS[kind]
    source = make(tmp_path)
    file = source / part if part else source
    whole = file.read_bytes()
    fates = {"imported": 0, "refused": 0}
    name = kind.partition("-")[0]

    @settings(max_examples=EXAMPLES, database=None)
    @given(st.lists(mutations, min_size=1, max_size=3))
    def attempt(changes: list[tuple[float, int, bytes]]) -> None:
        file.write_bytes(mutated(whole, changes))
        out = tmp_path / "logs"
        try:
            imported = import_logs(source, ARM, out=out, format=name, options=options)
        except FileError as error:
            fates["refused"] += 1
            kept = f"{error.path}: {error.problem}; {error.remedy}"
            assert str(error) == kept  # noqa: PT017 - either outcome is allowed
            assert sorted(path.name for path in tmp_path.iterdir()) == [source.name]
        else:
            fates["imported"] += 1
            assert len(imported.logs) == len(list(out.iterdir())) > 0
            for path in out.iterdir():
                RunLog.load(path)
            shutil.rmtree(out)

    attempt()
    assert fates["refused"] > 0


def test_a_failing_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, rows in (("a", 60), ("b", 61)):
        write_sage(tmp_path / "in" / name, sample(rows))
    written = []

    def full_disk(log: RunLog, path: Path) -> None:
        written.append(path)
        if len(written) == 2:
            raise OSError("No space left on device")
        path.write_bytes(b"log")

    monkeypatch.setattr(RunLog, "save", full_disk)
    with pytest.raises(OSError, match="No space"):
        import_logs(tmp_path / "in", ARM, out=tmp_path / "logs")
    assert len(written) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
