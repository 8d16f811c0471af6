"""The whole repair of an arm whose family comes from a package outside this one: `examples/robot_family`.

The short form, with a twin and a training that are hardly any, is `tests/robots/test_family_outside.py`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

EXAMPLE = Path(__file__).parents[1] / "examples" / "robot_family"


def install(folder: Path) -> None:
    """Write into ``folder`` what an installer leaves of the example's metadata, for whoever has both on their path."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8"
    )
    lines = [f"[{group}]\n" + "".join(f"{name} = {what}\n" for name, what in points.items())
             for group, points in project["entry-points"].items()]  # fmt: skip
    (info / "entry_points.txt").write_text("".join(lines), encoding="utf-8")


def main() -> None:
    """Repair it with the default recipe: about ten minutes on two cores."""
    with TemporaryDirectory() as place:
        install(Path(place))
        words = ["repair", "swing://one", "--run", str(Path(place) / "run"), "--json"]
        code = f"import sys; sys.path[:0] = {[place, str(EXAMPLE)]!r}; from rejoint.cli import main; main()"
        done = subprocess.run([sys.executable, "-c", code, *words], stdout=subprocess.PIPE, text=True, check=True)
    print("\n".join(done.stdout.splitlines()[:-1]))
    print("recommended:", json.loads(done.stdout.splitlines()[-1])["recommended"]["controller"])
