"""The import graph is the one that docs/architecture.md draws, and no file that is read can run code."""

import ast
import configparser
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

from commandline import python

ROOT = Path(__file__).parent.parent


def test_imports_point_one_way():
    command = [str(Path(sys.executable).with_name("lint-imports")), "--config", str(ROOT / ".importlinter")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_nothing_is_unpickled():
    """A file that is read can then run no code."""
    suspects = {"load", "loads", "Unpickler", "eval", "exec", "read_pickle"}
    ours = {"Policy.load", "RunLog.load", "rejoint.Twin.load"}  # readers of our own formats
    allowed = {"json.loads", "tomllib.loads", "json.load", "msgspec.json.decode"} | ours
    calls = []
    for path in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name.rsplit(".", 1)[-1] in suspects and name not in allowed:
                    calls.append((path.name, name, {word.arg: ast.unparse(word.value) for word in node.keywords}))
    kept = [call for call in calls if call[1] != "point.load"]  # what an installed package brings is imported
    assert {(name, words.get("weights_only"), words.get("allow_pickle")) for _, name, words in kept} == {
        ("np.load", None, "False"),
    }


def test_the_page_draws_the_graph_that_is_kept():
    config = configparser.ConfigParser()
    config.read(ROOT / ".importlinter")
    layers = config["importlinter:contract:layers"]["layers"].replace("rejoint.", "").split("\n")
    drawn = " -> ".join(", ".join(re.split(" [|:] ", layer)) for layer in layers if layer)
    page = (ROOT / "docs" / "architecture.md").read_text()
    assert f"\n{drawn}\n" in page
    for room in drawn.replace(" -> ", ", ").split(", "):
        assert f"`{room}/`" in page or f"`{room}.py`" in page, room


def test_a_policy_runs_without_a_simulator():
    blocked = ["torch", "skrl", "mujoco", "matplotlib", "jinja2", "onnx"]
    code = (
        f"import sys\nfor name in {blocked!r}: sys.modules[name] = None\n"
        "import rejoint.cli, rejoint.control.controllers.policy, rejoint.control.loop, rejoint.robots.mycobot.bus\n"
    )
    python("-c", code)


def test_the_product_works_without_the_room_of_the_camera():
    code = (
        "import sys\nfor name in ('cv2', 'rejoint.camera'): sys.modules[name] = None\n"
        "import rejoint, rejoint.cli.upkeep, rejoint.cli.show, rejoint.runs.repair, rejoint.session.motions\n"
        "assert len(rejoint.calibrate('emulated:worn', count=2, visits=1).measurements) == 2\n"
    )
    python("-c", code)


def test_help_does_not_wait_for_what_is_slow_to_import():
    code = (
        "import sys, rejoint.cli\n"
        "slow = {'torch', 'mujoco', 'numba', 'matplotlib', 'viser', 'scipy', 'pandas', 'pyarrow'}\n"
        "print(sorted(slow & set(sys.modules)))"
    )
    assert python("-c", code).out.strip() == "[]"


def named(kind):
    """Names of all functions or classes of both packages, each with its file."""
    files = sorted((ROOT / "src").rglob("*.py"))
    return [
        (node.name, str(file))
        for file in files
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, kind)
    ]


def test_no_two_classes_have_one_name():
    found = Counter(name.lstrip("_") for name, _ in named(ast.ClassDef))
    public = {"Observer", "Settings"}  # of a session; the law of a policy and a comparison have some of their own
    assert {name for name, count in found.items() if count > 1} <= public


def test_functions_and_classes_are_named_by_the_fields_words():
    private = re.compile(r"(?i)(^|_)(told|nobody|crew|seat|burden|patience|calm|lump|weightless|situation|forget)(_|$)")
    names = [*named(ast.ClassDef), *named(ast.FunctionDef)]
    assert [name for name in names if private.search(name[0])] == []


def tokens(file):
    """Count a file's tokens without comments, docstrings, line ends and indentation: packed lines count as much."""
    text = file.read_text()
    bare = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    alone = {
        (node.value.lineno, node.value.col_offset)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    }
    found = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(one.type not in bare and one.start not in alone for one in found)


def test_every_room_keeps_its_budget():
    """A change that adds also deletes. A larger budget is a decision, with its reason in the commit."""
    budgets = tomllib.loads((ROOT / "tests" / "budgets.toml").read_text())
    used = Counter()
    for file in (ROOT / "src").rglob("*.py"):
        package, *rest = file.relative_to(ROOT / "src").parts
        used[f"{package}/{rest[0]}" if len(rest) > 1 else package] += tokens(file)
    over = {room: count for room, count in used.items() if count > budgets["tokens"].get(room, 0)}
    assert over == {}, "more tokens than tests/budgets.toml allows"
    assert set(budgets["tokens"]) == set(used)
    assert len(list((ROOT / "src").rglob("*.py"))) <= budgets["files"]
