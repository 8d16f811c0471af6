"""What the estimators say about real arms from public repositories, beside what is true of them.

    python -m benchmarks.strangers --data FOLDER --arms bam,iris,g1

FOLDER (or the environment variable REJOINT_REAL) holds one folder per arm, with files as their authors published them:
`bam_xl330` (Rhoban/bam), `iris` (thejerrycheng/MEng_project), `ur5` (swiatecki/ProjectMoose), `kinova`
(wissem01chiha/dynamic-identification), `openarm` (YIZHIXIAOCANGSHU/Friction-Identification-for-Manipulators), `g1`
(YifanTian07/G1-policy-train), `ur10e` (shamilmamedov/dynamic_calibration). Most state no licence, so that this project
does not contain them.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import typer

import rejoint
from rejoint.arms import Arm, load_arm
from rejoint.logs import ImportOptions, import_logs
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import RejointError
from rejoint.twin.twin import Twin

VARIABLE = "REJOINT_REAL"
"""Environment variable that names the folder of real arms' recordings"""

PENDULUM = """<robot name="pendulum"><link name="base"/><link name="rod"><inertial><origin xyz="0 0 -0.1"/>
<mass value="0.49"/><inertia ixx="0.0001" iyy="0.0001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"/><joint name="servo" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 -1 0"/>
<origin xyz="0.2 0 0.5"/>
<limit lower="-3.1" upper="3.1" velocity="20" effort="1"/></joint><joint name="end" type="fixed"><parent link="rod"/>
<child link="tool"/><origin xyz="0 0 -0.1"/></joint></robot>"""
"""A lone servo: 0.49 kg at 0.1 m, hanging at zero"""


def models(name: str) -> Path:
    """URDF of the package ManipulaPy (development extra)."""
    return Path(str(files("ManipulaPy"))) / "ManipulaPy_data" / name


def openarm() -> str:
    """URDF of seven joints about as long and heavy as an OpenArm: its own is not published with the recordings."""
    axes = ("0 0 1", "1 0 0", "0 0 1", "0 1 0", "0 0 1", "1 0 0", "0 1 0")
    lengths, masses = (0.06, 0.06, 0.16, 0.06, 0.15, 0.07, 0.05), (1.1, 0.9, 0.9, 0.5, 0.6, 0.4, 0.5)
    parts = ['<robot name="openarm"><link name="base"/>']
    for i, (axis, length, mass) in enumerate(zip(axes, lengths, masses, strict=True)):
        before = f"link{i}" if i else "base"
        parts.append(
            f'<link name="link{i + 1}"><inertial><origin xyz="0 0 {-length / 2}"/><mass value="{mass}"/>'
            f'<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint{i + 1}" type="revolute"><parent link="{before}"/><child link="link{i + 1}"/>'
            f'<origin xyz="{0 if i else 0.3} 0 {-lengths[i - 1] if i else 1}"/><axis xyz="{axis}"/>'
            '<limit lower="-3.1" upper="3.1" velocity="10" effort="40"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def read(
    arm: Arm,
    paths: Sequence[Path],
    out: Path,
    options: dict[str, Any],
    format: str | None = None,  # noqa: A002
) -> list[RunLog]:
    """Import files; say which are refused."""
    logs: list[RunLog] = []
    for path in paths:
        try:
            logs += import_logs(path, arm, out=out / path.stem, format=format, options=ImportOptions(**options)).logs
        except RejointError as error:
            print(f"  refused: {error}")
    return logs


def say(arm: Arm, logs: Sequence[RunLog], plan: rejoint.LogPlan | None = None) -> Twin | None:
    """Print what diagnosis and identification say; return the twin, if there is one."""
    begin = time.perf_counter()
    try:
        found = rejoint.diagnose(list(logs), arm=arm).diagnosis
        print(f"  diagnosis ({time.perf_counter() - begin:.0f} s), {found.condition}: {found.verdict}")
        for row in found.measurement.joints:
            k, effort = row.stiffness_nm_per_rad, row.coulomb_effort
            known = "" if k is None else f"k {k.value:.4g} ({k.low:.4g} to {k.high:.4g}) {row.stiffness_source}"
            felt = "" if effort is None else f" Coulomb {effort.value:.3g} ({effort.low:.3g} to {effort.high:.3g})"
            moved = "" if row.viscous_effort is None else f" viscous {row.viscous_effort.value:.3g}"
            if known or felt:
                print(f"    {row.joint}: {known}{felt}{moved}")
        for finding in found.findings:
            print(f"    {finding.kind}: {finding.sentence}")
        for line in found.unseen:
            print(f"    unseen: {line}")
    except RejointError as error:
        print(f"  diagnosis refuses: {error}")
    begin = time.perf_counter()
    try:
        twin = rejoint.identify(list(logs), arm=arm, plan=plan)
    except RejointError as error:
        print(f"  identification refuses: {error}")
        return None
    print(f"  twin ({time.perf_counter() - begin:.0f} s)")
    low, high = twin.interval
    names = dict(zip(twin.names, twin.identified, strict=True))
    for joint, name in enumerate(arm.joint_names):
        told = " ".join(
            f"{kind} {getattr(twin.parameters, kind)[joint]:.3g} ({getattr(low, kind)[joint]:.3g} to "
            f"{getattr(high, kind)[joint]:.3g}{'' if names[f'{kind}.{name}'] else ', NOT identified'})"
            for kind in ("stiffness", "damping", "coulomb")
        )
        print(f"    {name}: {told}")
    assert twin.judgement is not None
    for name, errors in twin.judgement.mean.items():
        if errors.free is not None:
            print(f"    held out, {name}: {1e3 * errors.free.tcp:.2f} mm {np.degrees(errors.free.joint):.3f} deg")
    for line in (*twin.judgement.doubts, *twin.notes):
        print(f"    says: {line}")
    return twin


def bam(folder: Path, out: Path) -> None:
    """Judge a weak servo: P = 100 and 400 must predict 200 and 800."""
    urdf = out / "pendulum.urdf"
    urdf.write_text(PENDULUM)
    arm = load_arm(urdf)
    logs = read(arm, sorted(folder.glob("*.json")), out, {"angle_unit": "rad", "time_unit": "s"})
    print(f"  {len(logs)} of {len(sorted(folder.glob('*.json')))} recordings imported")
    say(arm, logs)


def iris(folder: Path, out: Path) -> None:
    """Judge an arm of 320.5 N m/rad at joints 1-3, 240.4 at 4-6; damping at least 8 and 4 N m s/rad."""
    arm = load_arm(folder / "iris_servo.toml")
    read(arm, [folder / "motor_session_A.csv"], out, {})
    say(arm, read(arm, [folder / "joint_session_A.csv"], out, {}))


def ur5(folder: Path, out: Path) -> None:
    """Judge a good industrial arm: lag 2 ms, error at rest about 0."""
    arm = load_arm(models("universal_robots/ur5/ur5.urdf"), base="base_link", tip="tool0")
    columns = {"time_s": "1", "position": "3..8", "command": "27..32"}
    say(arm, read(arm, sorted(folder.glob("*.txt")), out, {"columns": columns, "angle_unit": "rad"}, "table"))


def kinova(folder: Path, out: Path) -> None:
    """Judge an arm that rests within 0.5 mm."""
    arm = load_arm(models("kinova/gen3/gen3.urdf"), base="base_link", tip="EndEffector_Link")
    say(arm, read(arm, sorted(folder.glob("*.csv")), out, {"angle_unit": "rad", "time_unit": "ms"}))


def open_arm(folder: Path, out: Path) -> None:
    """Judge an arm with one joint powered in each file of the kind collect."""
    urdf = out / "openarm.urdf"
    urdf.write_text(openarm())
    arm = load_arm(urdf)
    for path in sorted(folder.glob("*collect*.npz")):
        print(f"  {path.name}")
        data = np.load(path)
        table = np.column_stack([data["time"], data["q"], data["q_cmd"], data["tau_measured"]])
        kinds = (("position", "rad"), ("command", "rad"), ("torque", "nm"))
        titles = ["time_s", *(f"{kind}.{joint}_{unit}" for kind, unit in kinds for joint in arm.joint_names)]
        text = out / f"{path.stem}.csv"
        np.savetxt(text, table, delimiter=",", header=",".join(titles), comments="")
        say(arm, read(arm, [text], out, {}))


def g1(folder: Path, out: Path) -> None:
    """Judge an arm of probably 80 N m/rad at shoulder and elbow, 40 at the wrist, and gravity fed forward."""
    arm = load_arm(folder / "g1.urdf", base="torso_link", tip="right_wrist_yaw_link")
    say(arm, read(arm, sorted(folder.glob("*.csv")), out, {}))


def ur10e(folder: Path, out: Path) -> None:
    """Judge currents; a regression of joint 1's gives Coulomb friction 1.44 A and viscous friction 1.72 A s/rad."""
    arm = load_arm(models("universal_robots/ur10e/ur10e.urdf"), base="base_link", tip="tool0")
    columns = {"time_s": "1", "position": "2..7", "current": "14..19"}
    say(arm, read(arm, sorted(folder.glob("*.csv")), out, {"columns": columns, "angle_unit": "rad"}, "table"))


ARMS = {
    "bam": (bam, "bam_xl330"),
    "iris": (iris, "iris"),
    "ur5": (ur5, "ur5"),
    "kinova": (kinova, "kinova"),
    "openarm": (open_arm, "openarm"),
    "g1": (g1, "g1"),
    "ur10e": (ur10e, "ur10e"),
}


def run(data: Path | None = None, arms: str = ",".join(ARMS)) -> None:
    """Print what is said about each of the ``arms`` (comma-separated)."""
    folder = data or Path(os.environ.get(VARIABLE, ""))
    if not folder.is_dir() or folder == Path():
        sys.exit(f"{VARIABLE} or --data must name the folder of recordings (see the head of this file)")
    for name in arms.split(","):
        tell, where = ARMS[name]
        print(f"\n{name}: {tell.__doc__}")
        with tempfile.TemporaryDirectory() as out:
            tell(folder / where, Path(out))


if __name__ == "__main__":
    typer.run(run)
