"""What the estimators say about real arms from public repositories, beside what is true of them.

    python -m benchmarks strangers --data FOLDER --arms bam,iris,g1

FOLDER (or the environment variable REJOINT_REAL) holds one folder per arm, with files as their authors published them:
`bam_xl330` (Rhoban/bam), `iris` (thejerrycheng/MEng_project), `ur5` (swiatecki/ProjectMoose), `kinova`
(wissem01chiha/dynamic-identification), `openarm` (YIZHIXIAOCANGSHU/Friction-Identification-for-Manipulators), `g1`
(YifanTian07/G1-policy-train), `ur10e` (shamilmamedov/dynamic_calibration). Most state no licence, so that this project
does not contain them.
"""

import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder import RunFolder
from rejoint.system.files import read_json


def chain(masses: Sequence[float], lengths: Sequence[float], axes: Sequence[str], at: float) -> str:
    """URDF of links that hang one below the other, each with its mass [kg] ``at`` a share of its length [m]."""
    parts = ['<robot name="chain"><link name="link0"/>']
    for i, (mass, length, axis) in enumerate(zip(masses, lengths, axes, strict=True), start=1):
        above = f"0 0 {-lengths[i - 2]}" if i > 1 else "0.3 0 1"
        parts.append(
            f'<link name="link{i}"><inertial><origin xyz="0 0 {-at * length}"/><mass value="{mass}"/>'
            '<inertia ixx="0.0001" iyy="0.0001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint{i}" type="revolute"><parent link="link{i - 1}"/><child link="link{i}"/>'
            f'<origin xyz="{above}"/><axis xyz="{axis}"/>'
            '<limit lower="-3.1" upper="3.1" velocity="20" effort="40"/></joint>'
        )
    end = f'<link name="tool"/><joint name="end" type="fixed"><parent link="link{len(masses)}"/><child link="tool"/>'
    return "".join([*parts, end, f'<origin xyz="0 0 {-lengths[-1]}"/></joint></robot>'])


@dataclass(frozen=True, kw_only=True)
class Stranger:
    """A real arm, its recordings, and what is true of it."""

    files: str
    model: str
    """a file beside the recordings or of the package ManipulaPy (development extra), or a URDF's text"""
    truth: str
    ends: str = ""
    """options for the arm"""
    read: str = ""
    """options for the import"""


MADE = chain(
    (1.1, 0.9, 0.9, 0.5, 0.6, 0.4, 0.5),
    (0.06, 0.06, 0.16, 0.06, 0.15, 0.07, 0.05),
    ("0 0 1", "1 0 0", "0 0 1", "0 1 0", "0 0 1", "1 0 0", "0 1 0"),
    0.5,
)
"""About as long and heavy as an OpenArm: its own model is not published with the recordings"""
TOOL = "--base base_link --tip tool0"
UNITS = "--angle-unit rad --time-unit s"
WITHOUT_TITLES = "--format table --angle-unit rad --map time_s=1,position="

ARMS = {
    "bam": Stranger(
        files="bam_xl330/*.json",
        model=chain((0.49,), (0.1,), ("0 -1 0",), 1.0),
        truth="a weak servo, right where it stands 50 degrees from its goal",
        read=UNITS,
    ),
    "iris": Stranger(
        files="iris/*_session_A.csv",
        model="iris_servo.toml",
        truth="320.5 N m/rad at joints 1-3, 240.4 at 4-6; damping at least 8 and 4 N m s/rad; motors geared by 6.33",
        read=UNITS,
    ),
    "ur5": Stranger(
        files="ur5/*.txt",
        model="universal_robots/ur5/ur5.urdf",
        truth="a good industrial arm: lag 2 ms, error at rest about 0",
        ends=TOOL,
        read=f"{WITHOUT_TITLES}3..8,command=27..32",
    ),
    "kinova": Stranger(
        files="kinova/*.csv",
        model="kinova/gen3/gen3.urdf",
        truth="rests within 0.5 mm; one file has corrupt cells",
        ends="--base base_link --tip EndEffector_Link",
    ),
    "openarm": Stranger(
        files="openarm/*collect_joint_[13].npz",
        model=MADE,
        truth="one joint is powered in each file; Coulomb friction .34 .84 .12 .17 .11 N m at joints 3-7",
        read=UNITS,
    ),
    "g1": Stranger(
        files="g1/*.csv",
        model="g1.urdf",
        truth="probably 80 N m/rad at shoulder and elbow, 40 at the wrist, and gravity fed forward",
        ends="--base torso_link --tip right_wrist_yaw_link",
    ),
    "ur10e": Stranger(
        files="ur10e/*.csv",
        model="universal_robots/ur10e/ur10e.urdf",
        truth="joint 1 by regressions: 1.44 A and 1.72 A s/rad on accelerations (R2 0.988), 1.45 A and 1.86 A s/rad "
        "with the links' inertia in every posture (R2 0.9995)",
        ends=TOOL,
        read=f"{WITHOUT_TITLES}2..7,current=14..19",
    ),
}


def model_of(stranger: Stranger, folder: Path, out: Path) -> Path:
    """Return the file that describes the arm."""
    place, made = folder / stranger.model[:60], out / "arm.urdf"
    if stranger.model.startswith("<"):
        made.write_text(stranger.model)
        return made
    return place if place.exists() else Path(str(files("ManipulaPy"))) / "ManipulaPy_data" / stranger.model


def ask(*words: object) -> None:
    """Run a command and print what it says."""
    begin = time.perf_counter()
    said = subprocess.run([sys.executable, "-m", "rejoint", *map(str, words)], capture_output=True, text=True)
    print(f"  {words[0]}, {time.perf_counter() - begin:.0f} s:")
    print(*(f"    {line}" for line in (said.stderr + said.stdout).splitlines() if line), sep="\n", flush=True)


def numbers(run: RunFolder) -> None:
    """Print what was measured at each joint, with intervals."""
    if run.diagnosis.exists():
        for row in read_json(run.diagnosis, Diagnosis).measurement.joints:
            told = {"k": row.stiffness_nm_per_rad, "Coulomb": row.coulomb_effort, "viscous": row.viscous_effort}
            known = [f"{k} {v.value:.4g} ({v.low or 0:.4g} to {v.high or np.inf:.4g})" for k, v in told.items() if v]
            print(f"    {row.joint}: {', '.join(known) or 'nothing'}")
    if run.twin.exists():
        for name in ("stiffness", "damping"):
            table = tomllib.loads(run.twin.read_text())[name]
            rows = zip(table["low95"], table["high95"], table["identified"], strict=True)
            print(f"    twin, {name}:", *(f"{low:.3g} to {high:.3g}{'' if told else '?'}" for low, high, told in rows))


def main(data: Annotated[Path, typer.Option(envvar="REJOINT_REAL", exists=True)], arms: str = ",".join(ARMS)) -> None:
    """Print what is said about each of the ``arms`` (comma-separated)."""
    for name in arms.split(","):
        stranger = ARMS[name]
        print(f"\n{name}: {stranger.truth}")
        with tempfile.TemporaryDirectory() as place:
            out, ends = Path(place), stranger.ends.split()
            paths = sorted(data.glob(stranger.files))
            model = model_of(stranger, paths[0].parent, out)
            (out / "files").mkdir()
            for path in paths:
                shutil.copy(path, out / "files")
            ask("import", out / "files", out / "logs", "--arm", model, *ends, *stranger.read.split())
            for command in ("diagnose", "identify"):
                ask(command, "--logs", out / "logs", "--arm", model, *ends, "--run", out / "run")
            numbers(RunFolder(out / "run"))
