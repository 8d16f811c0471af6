"""What the pages say is so: their code runs, their commands are known, their links lead somewhere."""

import ast
import importlib
import inspect
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer.main

from rejoint.arms import load_arm
from rejoint.cli import app
from rejoint.cli.console import with_place
from rejoint.control.controllers.policy import DIGEST_KEY, METADATA_KEY
from rejoint.logs.runfolder import RunFolder
from rejoint.twin.parameters import PARAMETERS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")), *sorted(DOCS.glob("*.md")))
}
GROUP = typer.main.get_command(app)
COMMANDS = {name: command.loaded() for name, command in GROUP.commands.items()}
RESEARCH = COMMANDS.pop("research")
COMMANDS |= {f"research {name}": command.loaded() for name, command in RESEARCH.commands.items()}
NOT_RUN = "Not run"
"""Begins the title, which readers see, of a block of Python that needs an arm or more time than a test has"""

FENCE = re.compile(r"^(```+)([^\n]*)\n(.*?)^\1$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(?<!`)`([^`]+)`(?!`)")

each_page = pytest.mark.parametrize("page", PAGES)


def blocks(page, language):
    """Title line and text of every fenced block of a language."""
    return [(head, text) for _, head, text in FENCE.findall(PAGES[page]) if head.split(" ")[0] == language]


def inline(page):
    """Every piece of code in the text of a page, on one line each."""
    paragraphs = FENCE.sub("", PAGES[page]).split("\n\n")
    return [" ".join(code.split()) for paragraph in paragraphs for code in CODE.findall(paragraph)]


def shell(page):
    """Words of every command in the blocks of a page, variables of the page put in."""
    known: dict[str, str] = {}
    for _, text in blocks(page, "sh"):
        for line in text.replace("\\\n", " ").splitlines():
            for name, value in known.items():
                line = line.replace(f"${name}", value)
            words = shlex.split(line, comments=True)
            if len(words) == 1 and (given := re.fullmatch(r"([A-Z]+)=(.*)", words[0])):
                known[given[1]] = given[2]
            elif words:
                yield words


def check_command(words, *, whole):
    """Raise unless `rejoint WORDS` names a command and options that it has; ``whole``: also all it needs."""
    if not words or words[0].startswith("-"):
        return
    if words[0] == "research":
        words = [" ".join(words[:2]), *words[2:]]
    assert words[0] in COMMANDS, f"there is no command rejoint {words[0]}"
    command = COMMANDS[words[0]]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    used = {word.partition("=")[0] for word in words[1:] if word.startswith("--")} - {"--help"}
    assert used <= options, f"rejoint {words[0]} has no {', '.join(sorted(used - options))}"
    if whole and "--help" not in words:
        command.make_context(words[0], with_place(words[1:]))


def check_program(words):
    """Raise unless the module or script of a `python` command is there and reads the options."""
    name = words[2] if words[1:2] == ["-m"] else words[1]
    if name.partition(".")[0] not in ("benchmarks", "rejoint", "rejoint_lab") and not name.endswith(".py"):
        return  # a module of Python itself, or of another package
    if name == "benchmarks":
        if words[3:4] in ([], ["NAME"]):
            return
        name = f"benchmarks.{words[3]}"
    place = name.removesuffix(".py").replace(".", "/")
    files = [ROOT / f"{place}.py", ROOT / f"src/{place}.py", ROOT / f"src/{place}/__main__.py"]
    text = "".join(file.read_text() for file in files if file.exists())
    assert any(sign in text for sign in ('__name__ == "__main__"', "argparse", "def main(")), (
        f"{words}: there is no such program"
    )
    for option in (word for word in words if word.startswith("--")):
        name = option.removeprefix("--").replace("-", "_")
        assert f'"{option}"' in text or f"{name}: " in text, f"{words}: it has no {option}"


@each_page
def test_python_runs(page, tmp_path, monkeypatch, few_targets):
    """The blocks of a page build on one another; they run in an empty folder, beside the modules of the examples."""
    monkeypatch.chdir(tmp_path)
    for folder in {path.parent for path in (ROOT / "examples").rglob("*.py")}:
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {"__name__": "page"}
    for head, text in blocks(page, "python"):
        code = compile(text, page, "exec")
        if f'title="{NOT_RUN}' not in head:
            exec(code, names)


@each_page
def test_calls_take_what_they_are_given(page):
    """Names and parameters of `rejoint` are right in blocks that are not run as well."""
    for _, text in blocks(page, "python"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and re.match(r"rejoint\.", name := ast.unparse(node.func)):
                parameters = inspect.signature(resolve(name)).parameters
                assert {word.arg for word in node.keywords} <= set(parameters), ast.unparse(node)
                assert len(node.args) <= len(parameters), ast.unparse(node)


@each_page
def test_commands_are_known(page):
    makefile = (ROOT / "Makefile").read_text()
    for _, text in blocks(page, ""):
        assert not re.search(r"^(pip|rejoint|python) ", text, re.MULTILINE), f"{page}: commands stand in blocks of sh"
    found = [shlex.split(code) for code in inline(page) if re.match(r"(rejoint|make|python) ", code)]
    for words, whole in [(words, True) for words in shell(page)] + [(words, False) for words in found]:
        program = words[0].rpartition("/")[2]
        if program == "rejoint":
            check_command(words[1:], whole=whole)
        elif program == "make":
            assert all(f"\n{target}:" in makefile or "=" in target for target in words[1:]), words
        elif program == "python":
            check_program(words)
        else:
            assert program in ("pip", "source"), f"{page}: what is {program}?"


@each_page
def test_places_in_the_code_exist(page):
    for name in re.findall(r"^::: (\S+)", PAGES[page], re.MULTILINE):
        resolve(name)
    tests = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    for code in inline(page):
        if re.fullmatch(r"[\w/]+\.py", code):
            at = (ROOT, ROOT / "src" / "rejoint", ROOT / "src" / "rejoint_lab")
            assert any((root / code).exists() for root in at) or "/" not in code, f"there is no {code}"
        elif re.fullmatch(r"test_\w+", code):
            assert f"def {code}(" in tests, f"there is no test {code}"
        elif re.fullmatch(r"rejoint(_lab)?(\.\w+)+", code) and code not in (METADATA_KEY, DIGEST_KEY):
            resolve(code)


def resolve(name):
    """Return the module, or what is in one, that a dotted name means."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        owner, _, attribute = name.rpartition(".")
        assert owner, f"there is no {name}"
        found = resolve(owner)
        assert hasattr(found, attribute), f"there is no {name}"
        return getattr(found, attribute)


def slugs(text):
    """Anchors of a page's headings, as GitHub and MkDocs make them."""
    titles = re.findall(r"^#+ (.+)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


PRIVATE = ("told", "nobody", "goes? with", "crews?", "newcomers?", "seat", "burden", "patience", "calm", "lump(s|ed)?",
           "weightless", "situation", "truth", "plays?")  # fmt: skip
"""Words that the field does not use, or not so, in pages and help"""

OLD = ("afresh", "ailments?", "aim(s|ed|ing)?", "anew", "as it goes", "believe[sd]?", "believing", "doubt(s|ed)?",
       "films?", "filmed", "gauges?", "geared", "known ahead", "leads", "led", "norms?", "parted", "parting", "race",
       "rigs?", "shelf", "sightings?", "somebody", "stances?", "stands?", "standing", "stood", "tells?", "whoever",
       "whom")  # fmt: skip
"""Words that pages do not use, for each of which the field has a plainer one"""

LONGEST = 30
"""Words in a sentence of a page (chosen: it is read once)"""


def prose(text):
    """Return a page without its code, and its links without their addresses."""
    return re.sub(r"\]\([^)]*\)", "]", CODE.sub("", FENCE.sub("", text)))


def sentences(text):
    """Return the sentences of paragraphs and list items; a piece of code is one word, and tables are no sentences."""
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", CODE.sub("code", FENCE.sub("\n\n", text)))
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^ *(\||#|:::|!!!|\?\?\?|<).*$", "", text, flags=re.MULTILINE)  # tables, headings, titles
    text = re.sub(r"^ *([*-]|\d+\.) ", "\n", text, flags=re.MULTILINE)
    return [one for part in re.split(r"\n\s*\n", text) for one in re.split(r"(?<=[.!?])[\"*)]*\s+", part)]


def check_words(text, where, words=PRIVATE):
    """Raise where prose holds a private word; code and names are no prose."""
    found = [match[0] for match in re.finditer(rf"\b(?:{'|'.join(words)})\b", prose(text), re.IGNORECASE)]
    assert not found, f"{where}: {', '.join(found)}"


@each_page
def test_pages_use_the_words_of_the_field(page):
    check_words(PAGES[page], page, PRIVATE + OLD)


@each_page
def test_sentences_are_short(page):
    long = [one for one in sentences(PAGES[page]) if len(re.findall(r"\S*\w\S*", one)) > LONGEST]
    assert not long, f"{page}: {long}"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_uses_the_words_of_the_field(name):
    texts = [COMMANDS[name].help, *(getattr(parameter, "help", None) for parameter in COMMANDS[name].params)]
    check_words("\n\n".join(filter(None, texts)), name)


def test_every_option_says_what_it_is():
    for name, command in COMMANDS.items():
        assert "Example" in command.help, name
        for parameter in command.params:
            text = getattr(parameter, "help", None)
            assert text, f"rejoint {name}: {parameter.opts} says nothing"
            assert text.endswith("."), f"rejoint {name}: {text}"


def test_the_glossary_gives_a_word_one_meaning():
    words = re.findall(r"^\| ([^|]+?) \| [^|]+ \|", PAGES["docs/glossary.md"], re.MULTILINE)
    words = [word for word in words if word not in ("word", "---")]
    assert len(words) >= 30
    assert len(words) == len(set(words)), sorted(word for word in words if words.count(word) > 1)


@each_page
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", PAGES[page])):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        goal = (ROOT / page).parent / path if path else ROOT / page
        assert goal.is_file(), f"{page}: there is no {link}"
        if anchor:
            assert anchor in slugs(goal.read_text()), f"{page}: there is no heading for {link}"


def test_every_command_is_listed():
    lines = [
        words.removeprefix("rejoint ").split() for words in inline("docs/commands.md") if words.startswith("rejoint ")
    ]
    listed = {" ".join(words[: 1 + (words[0] == "research")]) for words in lines}
    assert listed == set(COMMANDS)


def test_every_option_is_on_a_page():
    pages = "".join(text for page, text in PAGES.items() if page.startswith("docs/"))
    options = {name for command in COMMANDS.values() for option in command.params for name in option.opts}
    assert {name for name in options if name.startswith("--")} - set(re.findall(r"--[a-z-]+", pages)) == set()


def test_arms_in_the_pages_can_be_loaded(tmp_path):
    found = [text for page in PAGES for _, text in blocks(page, "toml") if "[[joint]]" in text]
    assert found
    for text in found:
        (tmp_path / "arm.toml").write_text(text)
        assert load_arm(str(tmp_path / "arm.toml")).joints == len(tomllib.loads(text)["joint"])


def test_every_file_of_a_run_folder_is_described():
    page = PAGES["docs/files.md"]
    folder = RunFolder(Path())
    files = [value for name in dir(RunFolder) if isinstance(value := getattr(folder, name, None), Path)]
    files += [folder.curves]
    for path in set(files) - {folder.path}:
        assert f"`{path}" in page, path


def test_every_parameter_of_a_twin_is_described():
    rows = {(p.name, "yes" if p.per_joint else "no") for p in PARAMETERS}
    found = re.findall(r"^\| `(\w+)` \| [^|]+ \| (yes|no) \|", PAGES["docs/files.md"], re.MULTILINE)
    assert set(found) == rows
