"""The base installation on a Raspberry Pi: every pinned package it needs exists there, ready built.

Nothing is installed. pip resolves the wheel's requirements for that platform with `--only-binary`, so that a package
that would have to be compiled there fails; a package of Python alone has a wheel for any platform. pip reads
conditions on the processor (``platform_machine``) for the machine it runs on: none of the packages has such a one.
"""

import json
import re
from pathlib import Path

import pytest

from conftest import CONSTRAINTS, pip

PYTHONS = ("3.11", "3.13")
"""of Raspberry Pi OS: Bookworm (2023) and Trixie (2025)"""

PLATFORMS = ("manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64")
"""that run with Bookworm's C library, 2.36, as far as packages are published for them"""


@pytest.mark.parametrize("version", PYTHONS)
def test_every_base_package_is_built_for_a_raspberry_pi(version: str, wheel: Path, tmp_path: Path) -> None:
    options = [word for platform in PLATFORMS for word in ("--platform", platform)]
    for abi in (f"cp{version.replace('.', '')}", "abi3", "none"):
        options += ["--abi", abi]
    pip(
        "install", "--dry-run", "--ignore-installed", "--report", str(tmp_path / "report.json"),
        "--only-binary", ":all:", "--implementation", "cp", "--python-version", version, *options,
        "--target", str(tmp_path / "nowhere"), "--constraint", str(CONSTRAINTS), str(wheel),
    )  # fmt: skip
    found = json.loads((tmp_path / "report.json").read_text())["install"]
    chosen = {_normal(one["metadata"]["name"]): one for one in found}
    pins = dict(line.split("==") for line in CONSTRAINTS.read_text().split())
    pinned = {_normal(name): number for name, number in pins.items()}
    assert {"numba", "numpy", "onnxruntime", "pyarrow", "pymycobot"} <= chosen.keys()
    for name, one in chosen.items():
        if name != "rejoint":
            assert one["metadata"]["version"] == pinned[name]  # a package that no pin names would be another tomorrow
            assert one["download_info"]["url"].endswith(("aarch64.whl", "none-any.whl"))
    assert not (tmp_path / "nowhere").exists()


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
