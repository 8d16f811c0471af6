"""The page: self-contained, honest about what is missing, and safe against hostile text."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from report_samples import SETTLED, make_comparison, write_curves

from readpage import Page
from rejoint.control.comparison.recommend import recommend
from rejoint.logs.runfolder.folder import RunFolder, RunInfo
from rejoint.pages.report.contents import read_contents
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.page import make_page, write_report
from rejoint.pages.report.sections.verdict import QUICK
from rejoint.pages.report.tables import comparison_table, comparison_view
from rejoint.system.errors import FileError
from rejoint.system.files import write_json


def test_full_report(run_folder, comparison):
    path = write_report(run_folder.path)
    assert path == run_folder.report
    source, page = path.read_text(encoding="utf-8"), Page(path)

    # Self-contained: nothing is fetched, no script runs.
    assert not re.search(r"(?:https?:)?//[a-z]", source, re.IGNORECASE)
    assert "@import" not in source
    assert "url(" not in source.replace("url(#", "")
    for tag, attributes in page.tags:
        assert tag not in ("script", "link", "iframe", "img", "object"), tag
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith("#"), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes)
    assert "nan" not in re.findall(r"[a-z]+", page.words.lower())
    assert "None" not in page.words

    # Accessible: language, unique identifiers, alternative texts, headers and captions.
    assert ("html", {"lang": "en"}) in page.tags
    assert len(page.ids) == len(set(page.ids))
    pictures = [attributes for tag, attributes in page.tags if tag == "svg"]
    assert len(pictures) > 20
    assert all(picture["role"] == "img" and len(picture["aria-label"]) > 30 for picture in pictures)
    tables = sum(tag == "table" for tag, _ in page.tags)
    assert sum(tag == "caption" for tag, _ in page.tags) == tables
    assert all("scope" in attributes for tag, attributes in page.tags if tag == "th")
    for tag, attributes in page.tags:
        if tag == "a":
            assert attributes["href"][1:] in page.ids, "a link leads nowhere"

    # The table holds the numbers of the comparison, as the terminal prints them.
    headers, rows = comparison_table(comparison)
    shown = {row[0].split(" | ")[0].split(" recommended")[0].strip(): row for row in page.rows if row}
    for plain in rows:
        cells = [cell.split(" | ")[0].strip() for cell in shown[plain[0]][1:]]
        assert cells == plain[1:]
        assert len(cells) == len(headers) - 1
    best = recommend(comparison).controller
    assert f"Use the controller “{best}”" in page.words
    assert [name for name, row in shown.items() if "recommended" in row[0]] == [best]
    assert not any(attributes.get("class") == "missing" for _, attributes in page.tags)
    assert "Stiffness of joint1 and delay cannot be told apart (correlation +0.95)." in page.words
    assert "Stiffness of joint3 and joint6." in page.words, "named as not identified"

    # PNG files beside the page, and curves under the promised name.
    names = {file.name for file in run_folder.figures.glob("*.png")}
    assert {"training.png", "error-per-target.png", "error-over-time.png", "held-out.png"} <= names
    assert {f"path-{name}.png" for name in comparison.controllers} <= names
    assert len(names) == len(pictures)


def test_the_paper_s_numbers_stand_beside_those_of_its_own_arm_alone(arm):
    comparison = make_comparison(arm, ("default", "policy"))

    def small_print(table):
        return " ".join([*table.notes, *(cell.note for row in table.rows for cell in row.cells)])

    assert "paper: 22.0 ± 14.6" in small_print(comparison_view(comparison, "policy"))
    other = comparison_view(dataclasses.replace(comparison, arm="ur5e"), "policy")
    assert "paper" not in small_print(other).replace("protocol of Park et al. 2024", "")


def test_a_baseline_that_wins_is_recommended(tmp_path, arm):
    comparison = make_comparison(arm, ("default", "integrator"))
    worse = dataclasses.replace(make_comparison(arm, ("pid-sum",)).rows[0], controller="policy")
    comparison = dataclasses.replace(comparison, rows=(*comparison.rows, worse))
    write_json(RunFolder(tmp_path).comparison, comparison)
    words = Page(write_report(tmp_path)).words
    assert "Use the controller “integrator”" in words
    assert "The learned policy was tried and is not the best here" in words


def test_an_arm_that_nothing_helps_is_left_alone(tmp_path, arm):
    write_json(RunFolder(tmp_path).comparison, make_comparison(arm, ("default",)))
    assert "Leave this arm as it is" in Page(write_report(tmp_path)).words


def test_the_same_files_give_the_same_page(tmp_path, arm):
    write_json(RunFolder(tmp_path).comparison, make_comparison(arm, ("default",)))
    first = write_report(tmp_path).read_bytes()
    assert write_report(tmp_path).read_bytes() == first


def test_missing_stages_are_named(tmp_path, diagnosis):
    write_json(RunFolder(tmp_path).diagnosis, diagnosis)
    words = Page(write_report(tmp_path)).words
    for missing in (
        "The controllers have not been compared yet", "No run log of a trial is here yet",
        "No twin has been identified yet", "No policy has been trained yet", "Nobody has measured where the tool is",
    ):  # fmt: skip
        assert words.count(missing) == 2, "once on top and once in its section"
    assert "The arm has not been diagnosed yet" not in words
    assert "No controller has been tried on this arm yet, so none is recommended." in words
    assert diagnosis.verdict in words


def test_what_is_to_be_done_stands_in_the_order_of_doing(tmp_path, diagnosis):
    folder = RunFolder(tmp_path)
    write_json(folder.info, RunInfo(robot="emulated:worn", arm="mycobot280", seed=0, version="0", created="now"))
    write_json(folder.diagnosis, diagnosis)
    text = write_report(tmp_path).read_text(encoding="utf-8")
    told = text[text.index("What is still to be done") :]
    places = [told.index(f"rejoint {stage}") for stage in ("calibrate", "identify", "train", "compare")]
    assert places == sorted(places)


def test_true_error_that_nobody_knows(tmp_path, arm):
    write_json(RunFolder(tmp_path).comparison, make_comparison(arm, ("default", "policy"), true_known=False))
    page = Page(write_report(tmp_path))
    assert "The true error of the tool is not known on this arm" in page.words
    headers = next(row for row in page.rows if row and row[0].startswith("controller"))
    column = headers.index("settled error, true [mm]")
    rows = [row for row in page.rows if row and row[0].split(" ")[0] in SETTLED]
    assert len(rows) == 2
    assert {row[column] for row in rows} == {"not known"}


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
    assert {file.parent for file in tmp_path.rglob("*.png")} == {folder.figures}


@pytest.mark.parametrize(
    "name", ["run.json", "diagnosis.json", "twin.toml", "comparison.json", "training/curves.parquet", "policy.onnx"]
)
def test_damaged_files_are_named(tmp_path, name, diagnosis):
    write_json(RunFolder(tmp_path).diagnosis, diagnosis)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b'{"arm": "mycob')
    with pytest.raises(FileError) as error:
        write_report(tmp_path)
    assert error.value.path == path
    assert not (tmp_path / "report.html").exists()


def test_a_damaged_log_is_named(run_folder):
    path = run_folder.log("hold/policy/0/0")
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(FileError) as error:
        write_report(run_folder.path)
    assert error.value.path == path


def test_curves_of_something_else_are_named(tmp_path):
    path = tmp_path / "training" / "curves.parquet"
    write_curves(path)
    import pyarrow.parquet as pq

    pq.write_table(pq.read_table(path).drop_columns(["reward"]), path)
    with pytest.raises(FileError) as error:
        write_report(tmp_path)
    assert error.value.path == path


def test_nothing_to_report(tmp_path, arm):
    with pytest.raises(FileError, match="no such run folder"):
        write_report(tmp_path / "nowhere")
    write_json(
        RunFolder(tmp_path).info, RunInfo(robot="emulated:worn", arm=arm.name, seed=0, version="0", created="now")
    )
    with pytest.raises(FileError, match="no stage has been run"):
        write_report(tmp_path)


def test_files_of_different_arms_are_refused(tmp_path, arm, diagnosis):
    folder = RunFolder(tmp_path)
    write_json(folder.diagnosis, diagnosis)
    write_json(folder.comparison, dataclasses.replace(make_comparison(arm, ("default",)), arm="so101"))
    with pytest.raises(FileError, match="different arms"):
        write_report(tmp_path)
    write_json(folder.comparison, dataclasses.replace(make_comparison(arm, ("default",)), arm="no-such-arm"))
    with pytest.raises(FileError, match="no-such-arm"):
        write_report(tmp_path)


def test_results_that_are_missing_are_not_known(tmp_path, arm):
    """Every trial tripped the guard: nothing but failures."""
    row = make_comparison(arm, ("policy",)).rows[0]
    none = tuple([None] * len(row.outcomes.settled))
    outcomes = dataclasses.replace(
        row.outcomes, settled=none, settled_true=none, oscillation=none, crossing_error=none, crossing_time=none,
        crossed=tuple([0.0] * len(none)), stay=(none,) * 3,
    )  # fmt: skip
    row = dataclasses.replace(
        row, failures=6, outcomes=outcomes, guard=(),
        crossing=dataclasses.replace(row.crossing, error=None, true_error=None, cycle_time=None),
        hold=dataclasses.replace(row.hold, settled=None, settled_true=None, oscillation=None),
    )  # fmt: skip
    default = make_comparison(arm, ("default",)).rows[0]
    comparison = dataclasses.replace(make_comparison(arm, ("default",)), rows=(default, row))
    write_json(RunFolder(tmp_path).comparison, comparison)
    page = Page(write_report(tmp_path))
    cells = next(found for found in page.rows if found and found[0].startswith("policy"))
    assert [cell.split(" | ")[0] for cell in cells].count("not known") == 5
    assert cells[-1] == "6 trials stopped"
    assert np.isfinite(default.hold.settled.mean.value)


def test_the_page_of_a_quick_try_says_first_that_it_is_no_result(run_folder):
    assert QUICK not in make_page(read_contents(run_folder.path), Gallery()).verdict
    write_json(run_folder.quick, {"quick": "2026-11-21T00:00:00"})
    assert make_page(read_contents(run_folder.path), Gallery()).verdict[0] == QUICK
