"""Text with columns: units are read from names or options, never guessed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from log_samples import ARM, sample, worn_sample, write_table
from test_logs_mcap import messages, state

from rejoint.logs.importing import import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError, InputError


def test_a_unit_may_stand_in_each_name_and_other_columns_are_told(tmp_path):
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
def test_a_declared_time_unit_is_taken_and_rows_are_sorted(tmp_path, unit: str, ticks: float):
    found, rows = sample(), np.arange(60) ^ 1
    scaled = type(found)(time=found.time[rows] * ticks, position=found.position[rows], command=found.command[rows])
    source = write_table(tmp_path / "wave.csv", scaled, {"time_s": "time"})
    with pytest.raises(FileError, match="column time does not say its unit"):
        import_logs(source, ARM, out=tmp_path / "logs")
    (log,) = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(time_unit=unit)).logs
    np.testing.assert_allclose(log.time, found.time, rtol=1e-15)
    assert log.position.tolist() == found.position.tolist()
    dated = replace(scaled, time=scaled.time + 1.7e9 * ticks)
    (log,) = import_logs(write_table(tmp_path / "dated.csv", dated, {"time_s": "time"}), ARM, out=tmp_path / "3").logs
    np.testing.assert_allclose(log.time - log.time[0], found.time - found.time[0], atol=1e-6)
    with pytest.raises(InputError, match="exists already"):
        import_logs(source, ARM, out=tmp_path / "logs")
    with pytest.raises(InputError, match="--order, --stamp: nothing"):
        import_logs(source, ARM, out=tmp_path / "2", options=ImportOptions(time_unit=unit, stamp="log", names=("a",)))


@pytest.mark.parametrize(
    ("unit", "scale", "said"), [("rad", 180 / np.pi, "beyond two turns; .* degrees"), ("deg", 1.0, "may be radians")]
)
def test_degrees_called_radians_and_the_reverse_are_refused(tmp_path, unit: str, scale: float, said: str):
    names = {f"{g}.{j}_rad": f"{g}.{j}_{unit}" for g in ("position", "command") for j in ARM.joint_names}
    with pytest.raises(FileError, match=said):
        import_logs(write_table(tmp_path / "wave.csv", worn_sample(), names, scale=scale), ARM, out=tmp_path / "logs")


def test_small_degrees_are_doubted_only_where_radians_are_possible(tmp_path):
    names = {f"{g}.{j}_rad": f"{g}.{j}_deg" for g in ("position", "command") for j in ARM.joint_names}
    moved = worn_sample(seconds=8)
    wide = write_table(tmp_path / "wide.csv", moved, names, scale=4.1)
    (log,) = import_logs(wide, ARM, out=tmp_path / "logs").logs
    np.testing.assert_allclose(log.position, np.deg2rad(4.1 * moved.position))
    zero = np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0])
    other = replace(moved, position=moved.position + zero, command=moved.command + zero)
    with pytest.raises(FileError, match="may be radians"):
        import_logs(write_table(tmp_path / "other.csv", other, names), ARM, out=tmp_path / "no")


@pytest.mark.parametrize("way", ["cells", "records", "bag"])
def test_each_command_holds_until_the_next_of_its_joint(tmp_path, way: str):
    """The last one for a second: what follows it, and what precedes the first, is left out."""
    found = worn_sample(seconds=8)
    row, turns = np.arange(len(found.time))[:, None], np.arange(3, 8)
    held = found.command[np.minimum(row, 200) // turns * turns, np.arange(5)]
    sent = np.where((row % turns == 0) & (row >= 20) & (row <= 200), held, np.nan)
    source = write_table(tmp_path / "log.csv", replace(found, command=sent))
    if way == "records":  # of states, and of commands
        groups = {"command_rad": sent.tolist(), "position_rad": found.position.tolist()}
        rows = [{"time_s": time, group: groups[group][k]} for k, time in enumerate(found.time) for group in groups]
        source = tmp_path / "log.jsonl"
        source.write_text("\n".join(map(json.dumps, rows)))
    if way == "bag":
        states = [state(k, k) | {"position": q.tolist()} for k, q in enumerate(found.position)]
        commands = [
            state(k, k) | {"name": [ARM.joint_names[joint]], "position": [sent[k, joint]]}
            for k, joint in np.argwhere(np.isfinite(sent)).tolist()
        ]
        source = messages(tmp_path / "log.mcap", {"/joint_states": states, "/joint_commands": commands})
    log = import_logs(source, ARM, out=tmp_path / "logs").logs[0]
    kept = slice(24, 251)
    np.testing.assert_allclose(log.time, found.time[kept])
    np.testing.assert_array_equal(log.position, found.position[kept])
    np.testing.assert_array_equal(log.command, held[kept])


@pytest.mark.parametrize(("kind", "sent"), [("records", "command"), ("columns", "q_des"), ("arrays", "q_target")])
def test_parts_of_what_json_and_archives_hold_are_joints(tmp_path, kind: str, sent: str):
    found, source = worn_sample(seconds=8), tmp_path / "log.json"
    names, position, command = ARM.joint_names[::-1], np.rad2deg(found.position), found.command
    held = {"time_s": found.time, "position_deg": position[:, ::-1], f"{sent}_rad": command[:, ::-1]}
    lists = {name: one.tolist() for name, one in held.items()} | {"names": names}
    if kind == "records":
        parts = [dict(zip(names, row, strict=True)) for row in lists["position_deg"]]
        rows = zip(found.time, parts, lists[f"{sent}_rad"], strict=True)
        lists = {"about": {"names": names, "rows": [dict(zip(held, row, strict=True)) for row in rows]}}
    source.write_text(json.dumps(lists))
    if kind == "arrays":
        source = tmp_path / "log.npz"
        np.savez(source, **held, names=names)
    (log,) = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(names=names)).logs
    np.testing.assert_allclose(log.position, found.position[: len(log)])
    np.testing.assert_array_equal(log.command, command[: len(log)])


@pytest.mark.parametrize(
    ("clock", "state", "sent"),
    [
        ("header.stamp.sec,header.stamp.nanosec", "feedback.positions[{}]", "reference.positions[{}]"),
        ("__time,/joint_states/header/stamp/sec", "/joint_states/{}/position", "/joint_commands/{}/position"),
        ("%time_ns,field.header.stamp", "field.actual.positions{}", "field.desired.positions{}"),
        ("__time", "/arm/state/feedback/positions[{}]", "/arm/state/desired/positions[{}]"),
        ("Time (ns)", "joint_angle_{}", "TargetPos{}"),
        ("nsecs", "current_pos_{}", "action[{}] (rad)"),
        ("%time_ns,sec,system_time", "{}", "goal of {}"),
    ],
)
def test_titles_as_other_programs_write_them_are_read(tmp_path, clock: str, state: str, sent: str):
    found, source = sample(), tmp_path / "log.csv"
    second = np.floor(found.time)
    clocks = {"__time": found.time, "header.stamp.nanosec": 1e9 * (found.time - second)}
    clocks |= dict.fromkeys(("%time_ns", "Time (ns)", "nsecs"), 1e9 * found.time)
    joints = ARM.joint_names if "/{}/" in f"/{state}/" else range(5)
    columns = [clocks.get(one, second) for one in clock.split(",")] + [*found.position.T, *found.command.T]
    titles = ["name", clock, *map(state.format, joints), *map(sent.format, joints)]
    rows = [",".join(["arm", *map(repr, row)]) for row in np.transpose(columns).tolist()]
    source.write_text("\n".join([",".join(titles), *rows, ""]).replace("name,%", "%name,"))
    (log,) = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="rad")).logs
    np.testing.assert_allclose(log.time, found.time, atol=1e-12)
    np.testing.assert_array_equal([log.position, log.command], [found.position, found.command])


def test_clocks_of_two_messages_are_no_parts_of_one_time(tmp_path):
    source = write_table(tmp_path / "log.csv", sample(), {"time_s": "/a/header/stamp/sec"})
    head, *rows = source.read_text().splitlines()
    stamps = "/a/header/stamp/nanosec,/b/header/stamp/sec,/b/header/stamp/nanosec"
    source.write_text("\n".join([f"{stamps},{head}", *(f"0,7,0,{row}" for row in rows), ""]))
    with pytest.raises(FileError, match="says the time, expected one"):
        import_logs(source, ARM, out=tmp_path / "logs")


@pytest.mark.parametrize("others", ["q_star_,target_vel_,tau_des_,motor_position_,", "q_current_,state,enc,q_ref_"])
def test_columns_that_only_resemble_commands_or_positions_are_left_alone(tmp_path, others: str):
    found, stems = sample(), others.split(",")
    source = write_table(tmp_path / "log.csv", found)
    head, *rows = source.read_text().splitlines()
    for k, joint in enumerate(ARM.joint_names):
        head = head.replace(f"position.{joint}", f"q{k}").replace(f"command.{joint}", f"q_cmd_{k}")
    titles = [f"{stem}{k}" for stem in stems for k in range(5)] + ["state", "Rotation_raw", "target_pitch"]
    source.write_text("\n".join([",".join([head, *titles]), *(f"{row}{',7' * len(titles)}" for row in rows), ""]))
    (log,) = import_logs(source, ARM, out=tmp_path / "logs").logs
    np.testing.assert_array_equal([log.position, log.command], [found.position, found.command])
