"""What the base installation lacks is known, and asked for in one line."""

import ast
import sys
import tomllib
from pathlib import Path

from rejoint.system import extras

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

BASE = {
    "google",
    "msgspec",
    "numba",
    "numpy",
    "onnxruntime",
    "pyarrow",
    "pymycobot",
    "serial",
    "rich",
    "scipy",
    "tomlkit",
    "typer",
}
NAMED_OTHERWISE = {
    "google": "protobuf",
    "serial": "pyserial",
    "dynamixel_sdk": "dynamixel-sdk",
    "PIL": "pillow",
    "mcap_protobuf": "mcap-protobuf-support",
    "mcap_ros2": "mcap-ros2-support",
    "cv2": "opencv-python-headless",
    "scservo_sdk": "ftservo-python-sdk",
}
USED_BY_OTHERS = {"serial"}  # by the vendor's client
ONLY_WITH_OTHERS = {"markupsafe"}  # comes with jinja2, whose absence is told


def imported():
    """Return the modules of others that the packages import anywhere."""
    found = set()
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {name.name.partition(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
            elif isinstance(node, ast.Call) and ast.unparse(node.func) == "Late":
                found.add(ast.literal_eval(node.args[0]).partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"rejoint", "rejoint_lab"}


def declared(requirements):
    """Return the names of the packages in a list of requirements."""
    return {requirement.replace("[", "<").split("<")[0].split(">")[0].split("=")[0] for requirement in requirements}


def test_every_module_is_of_the_base_or_of_an_extra():
    known = {module for modules in extras.EXTRAS.values() for module in modules}
    assert imported() | USED_BY_OTHERS == BASE | known | ONLY_WITH_OTHERS
    package = lambda module: NAMED_OTHERWISE.get(module, module)  # noqa: E731
    assert {package(module) for module in BASE} == declared(PROJECT["dependencies"])
    for extra, modules in extras.EXTRAS.items():
        assert {package(module) for module in modules} == declared(PROJECT["optional-dependencies"][extra])
