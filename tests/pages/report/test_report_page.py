"""The page: self-contained, honest about what is missing, and safe against hostile text."""

import dataclasses
import re
from importlib.resources import files

import pytest
from report_samples import begin, make_comparison

from readpage import Page
from rejoint.control.comparison.recommend import recommend
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.pages.report.page import write_report
from rejoint.pages.report.tables import columns, plain_table
from rejoint.system.errors import FileError
from rejoint.system.files import write_json

TEMPLATE = (files("rejoint.pages") / "templates" / "report.html").read_text()


def test_full_report(run_folder, comparison):
    path = write_report(run_folder.path)
    assert path == run_folder.report
    source, page = path.read_text(), Page(path)

    # Self-contained: nothing is fetched, and no script runs but the one, without anything of the run, that copies.
    assert not re.search(r"(?:https?:)?//[a-z]", source, re.IGNORECASE)
    assert "@import" not in source
    assert "url(" not in source.replace("url(#", "")
    for tag, attributes in page.tags:
        assert tag not in ("script", "link", "iframe", "img", "object"), tag
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith("#"), (tag, attributes)
        acts = {name: value for name, value in attributes.items() if name.startswith("on")}
        assert not acts or (tag == "button" and list(acts) == ["onclick"] and acts["onclick"] in TEMPLATE)
    assert "nan" not in re.findall(r"[a-z]+", page.words.lower())
    assert "None" not in page.words

    # Accessible: language, unique identifiers, alternative texts, headers and captions.
    assert ("html", {"lang": "en"}) in page.tags
    assert len(page.ids) == len(set(page.ids))
    pictures = [attributes for tag, attributes in page.tags if tag == "svg"]
    assert len(pictures) == 3
    assert all(picture["role"] == "img" and len(picture["aria-label"]) > 30 for picture in pictures)
    tables = sum(tag == "table" for tag, _ in page.tags)
    assert sum(tag == "caption" for tag, _ in page.tags) == tables
    assert all("scope" in attributes for tag, attributes in page.tags if tag == "th")
    for tag, attributes in page.tags:
        if tag == "a":
            assert attributes["href"][1:] in page.ids, "a link leads nowhere"

    # The table holds the numbers of the comparison, as the terminal prints them.
    headers, rows = plain_table(columns(comparison), comparison.rows)
    told = {row[0].split(" | ")[0].split(" recommended")[0].strip(): row for row in page.rows if row}
    for plain in rows:
        cells = [cell.split(" | ")[0].strip() for cell in told[plain[0]][1:]]
        assert cells == plain[1:]
        assert len(cells) == len(headers) - 1
    best = recommend(comparison).controller
    assert f"Use the controller “{best}”" in page.words
    assert [name for name, row in told.items() if "recommended" in row[0]] == [best]
    assert not any(attributes.get("class") == "missing" for _, attributes in page.tags)
    assert "Stiffness of joint3 and joint6." in page.words, "named as not identified"

    # PNG files beside the page, and curves under the promised name.
    names = {file.name for file in run_folder.figures.glob("*.png")}
    assert {"training.png", "tool-places.png", "error-over-time.png"} == names
    assert len(names) == len(pictures)


def test_the_same_files_give_the_same_page(tmp_path, arm):
    begin(tmp_path, arm)
    write_json(RunFolder(tmp_path).comparison, make_comparison(arm, ("default",)))
    first = write_report(tmp_path).read_bytes()
    assert write_report(tmp_path).read_bytes() == first


HOSTILE = '<script>alert("x")</script><img src=http://evil.example/a.png onerror=x>'


def test_hostile_text_stays_text(tmp_path, arm, diagnosis):
    folder = RunFolder(tmp_path / "a & b <i>")
    write_json(folder.info, RunInfo(robot=HOSTILE, arm=arm.name, seed=1, version=HOSTILE, created=HOSTILE))
    finding = dataclasses.replace(diagnosis.findings[0], sentence=HOSTILE, kind=HOSTILE)
    write_json(
        folder.diagnosis, dataclasses.replace(diagnosis, verdict=HOSTILE, findings=(finding,), unseen=(HOSTILE,))
    )
    row = dataclasses.replace(make_comparison(arm, ("default",)).rows[0], controller="../" + HOSTILE)
    write_json(folder.comparison, dataclasses.replace(make_comparison(arm, ("default",)), robot=HOSTILE, rows=(row,)))
    page = Page(write_report(folder.path))
    assert {"script", "img", "i"} & {tag for tag, _ in page.tags} == set()
    assert page.words.count('<script>alert("x")</script>') >= 5
    assert {file.parent for file in tmp_path.rglob("*.png")} <= {folder.figures}


@pytest.mark.parametrize(
    "name", ["run.json", "diagnosis.json", "twin.toml", "comparison.json", "training/curves.parquet", "policy.onnx"]
)
def test_damaged_files_are_named(tmp_path, name, arm, diagnosis):
    begin(tmp_path, arm)
    write_json(RunFolder(tmp_path).diagnosis, diagnosis)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b'{"arm": "mycob')
    with pytest.raises(FileError) as error:
        write_report(tmp_path)
    assert error.value.path == path
    assert not (tmp_path / "report.html").exists()
