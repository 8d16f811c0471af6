"""Files of the shape that strangers publish: motors before gears, no titles, JSON, archives, weak and dead servos."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest
from log_samples import ARM, worn_sample
from typer.testing import CliRunner

from rejoint.arms import Arm, load_arm
from rejoint.cli import app
from rejoint.logs.importing import import_logs
from rejoint.logs.joints import ImportOptions, read_map
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError, InputError

FOUND = worn_sample(seconds=8)
GEAR = 6.33
SIX = """name = "{name}"
[tip]
position_m = [0.1, 0.0, 0.1]
"""
UNITS = ImportOptions(angle_unit="rad", time_unit="s")


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    """Five joints with numbers and wide limits."""
    return numbered(tmp_path, 5)


def numbered(folder: Path, joints: int) -> Arm:
    text = SIX.format(name="bench")
    for k in range(1, joints + 1):
        text += f'[[joint]]\nname = "joint{k}"\nposition_m = [0.0, 0.0, 0.1]\naxis = [{k % 2}, {1 - k % 2}, 0]\n'
        text += "lower_deg = -170\nupper_deg = 170\nmax_speed_deg_s = 400\n"
    (folder / "arm.toml").write_text(text)
    return load_arm(folder / "arm.toml")


def columns(path: Path, table: dict[str, np.ndarray]) -> Path:
    pyarrow.csv.write_csv(pa.table(table), path)
    return path


def titled(prefix: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{prefix}{k}": column for k, column in enumerate(values.T)}


def motor_log(folder: Path) -> Path:
    """Radians of the motors, in steps of 2 pi / 32768."""
    step = 2 * np.pi / 32768
    angles = [GEAR * 4 * q + 3.0 for q in (FOUND.position, FOUND.command)]
    table = (
        {"timestamp": FOUND.time + 1.7e9}
        | titled("tgt_m", angles[1])
        | titled("act_m", np.round(angles[0] / step) * step)
    )
    return columns(folder / "motors.csv", table)


def test_angles_of_motors_are_refused_with_the_gear_and_mapped(tmp_path, arm: Arm):
    source = motor_log(tmp_path)
    for unit in ("rad", "deg"):
        with pytest.raises(FileError, match=r"motors, before .*gear.*--map JOINT=THEIRS/RATIO"):
            import_logs(source, arm, out=tmp_path / "no", options=replace(UNITS, angle_unit=unit))
    pairs = {f"joint{k + 1}": f"m{k}/{4 * GEAR}-{3.0 / (4 * GEAR):.12f}" for k in range(5)}
    (tmp_path / "map.toml").write_text("\n".join(f'{ours} = "{theirs}"' for ours, theirs in pairs.items()))
    for said in ([f"{ours}={theirs}" for ours, theirs in pairs.items()], [str(tmp_path / "map.toml")]):
        options = replace(UNITS, columns=read_map(said))
        log = import_logs(source, arm, out=tmp_path / f"logs{len(said)}", options=options).logs[0]
        np.testing.assert_allclose(log.position, FOUND.position, atol=1e-5)
        np.testing.assert_allclose(log.command, FOUND.command, atol=1e-9)
    for wrong in ("joint1", "joint1=", "joint1=0*m0"):
        with pytest.raises(InputError, match="--map"):
            import_logs(source, arm, out=tmp_path / "no", options=replace(UNITS, columns=read_map([wrong])))


def test_corrupt_numbers_cut_a_log_and_a_doubted_one_is_skipped(tmp_path):
    (tmp_path / "in").mkdir()
    names = {"time_s": FOUND.time}
    for group, values in (("position", FOUND.position), ("command", FOUND.command)):
        names |= {f"{group}.{joint}_rad": values[:, k] for k, joint in enumerate(ARM.joint_names)}
    bad = FOUND.position[:, 2].copy()
    bad[200] = -9.48e297
    cut = columns(tmp_path / "in/a.csv", names | {"position.elbow_flex_rad": bad})
    lines = cut.read_text().splitlines()
    lines[301] = f"{lines[301].rpartition(',')[0]},#REF!"
    lines[351] = lines[351][:30]
    cut.write_text("\n".join(lines))
    columns(
        tmp_path / "in/b.csv",
        names | {f"position.{joint}_rad": names[f"command.{joint}_rad"] for joint in ARM.joint_names},
    )
    (tmp_path / "in/c.csv").write_text("rubbish")
    done = CliRunner().invoke(app, ["import", str(tmp_path / "in"), str(tmp_path / "logs"), "--arm", "so101", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout.splitlines()[-1])
    assert (told["logs"], len(told["skipped"])) == (3, 2)
    assert [len(RunLog.load(tmp_path / f"logs/a-{k}of3.parquet")) for k in (1, 2, 3)] == [200, 99, 97]
