"""The reproduction runs, resumes and says what it found: every experiment, run quickly, and its page."""

import dataclasses
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from sketchbook import Sketchbook

from readpage import put, rounds
from rejoint.arms import mycobot280, tcp_position
from rejoint.arms.mycobot280 import DH_TABLE, PAPER_DH_TABLE
from rejoint.control.comparison.result import Comparison
from rejoint.control.policy import load_policy
from rejoint.research.reproduction import paths
from rejoint.research.reproduction.campaign import finished_file, run_experiments
from rejoint.research.reproduction.control import CLASSICAL, POLICIES, TABLE_4
from rejoint.research.reproduction.episodes import Episodes, healthy_ranges, play, worn_ranges
from rejoint.research.reproduction.experiment import QUICK, Bench, Finished
from rejoint.research.reproduction.kinematics import TABLE_1
from rejoint.research.reproduction.page import write_page
from rejoint.research.reproduction.paths import FIG_11
from rejoint.research.reproduction.recipe import TABLE_3, WORDS
from rejoint.research.reproduction.registry import EXPERIMENTS, choose
from rejoint.research.reproduction.trainings import LITERALLY, WORN
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, write_json
from rejoint.training.presets import PAPER

ARM = mycobot280()


def nothing(*event):
    pass


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Every experiment, run quickly, in a folder of its own."""
    made = Bench(folder=tmp_path_factory.mktemp("reproduction"), arm=ARM, seed=0, scale=QUICK, threads=2)
    run_experiments(made, EXPERIMENTS, on_experiment=nothing)
    return made


def by_name(findings):
    return {number.what: number for number in findings.numbers}


@pytest.fixture
def copied(bench, tmp_path):
    """The results of all experiments, in a folder that a test may change."""
    for part in ("results", "figures", "logs", "comparison.json"):
        source = bench.folder / part
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, tmp_path / part)
    (tmp_path / "trainings").symlink_to(bench.folder / "trainings")
    return Sketchbook(folder=tmp_path, arm=ARM, seed=0, scale=QUICK, threads=1)


def finished(bench, experiment):
    return read_json(finished_file(bench, experiment), Finished).findings


def lines(bench, tmp_path):
    return write_page(bench, tmp_path / "page.md").read_text(encoding="utf-8").splitlines()


def test_every_experiment_finds_something_and_the_page_shows_it(bench, tmp_path):
    page = write_page(bench, tmp_path / "docs" / "page.md")
    text = page.read_text(encoding="utf-8")
    for experiment in EXPERIMENTS:
        assert f"## {experiment.title}" in text
    assert "Not run yet" not in text
    for paper in (
        "3.09 mm",
        "22.7 mm",
        "7.34",
        "8.21 ± 1.11 mm",
        "13.4 ± 12.2 mm",
        "197 s",
        "96.3 s",
        "14.2 s",
        "75.0 %",
    ):
        assert f"| {paper} |" in text
    assert "nan" not in text
    pictures = re.findall(r"!\[[^\]]+\]\((page/[^)]+)\)", text)
    assert len(pictures) == 6
    for picture in pictures:
        assert (page.parent / picture).stat().st_size < 150_000
        with Image.open(page.parent / picture) as image:
            assert min(image.size) > 250
    anchors = re.findall(r"\]\(#([^)]+)\)", text)
    assert anchors[0] == "table-1-kinematics"
    assert len(anchors) == len(EXPERIMENTS)


def test_what_is_finished_is_kept_and_can_be_written_anew(bench):
    calls = []
    files = [*bench.folder.rglob("*")]
    before = {path: path.stat().st_mtime_ns for path in files}
    run_experiments(bench, EXPERIMENTS, on_experiment=lambda *event: calls.append(event[1]))
    assert calls == [True] * len(EXPERIMENTS)
    assert {path: path.stat().st_mtime_ns for path in files} == before
    one = choose(["fig-12"])
    found = run_experiments(bench, one, again=True, on_experiment=nothing)
    changed = {path for path in files if path.stat().st_mtime_ns != before[path] and path.is_file()}
    assert changed == {finished_file(bench, one[0]), bench.folder / "figures" / "fig-12.png"}
    assert found[0].quick


def test_episodes_of_an_untrained_policy(bench):
    """The base law with the paper's noise reaches targets on a normal arm and hardly any on worn ones."""
    untrained = load_policy(bench.training(WORN[0]).outputs.snapshot(0), ARM)
    worn = play(untrained, worn_ranges(ARM), 24, seed=0)
    healthy = play(untrained, healthy_ranges(ARM), 24, seed=0)
    assert worn.reached.mean() < healthy.reached.mean()
    for episodes in (worn, healthy):
        ended = episodes.reached + episodes.collided
        assert (ended <= 1).all()
        assert (episodes.steps[ended == 0] == PAPER.task.hold_steps).all()
        assert ARM.targets.contains(np.round(episodes.target, 6)).all()
        rows = np.isfinite(episodes.tcp).all(axis=-1).sum(axis=0)
        np.testing.assert_array_equal(rows, episodes.steps + 1)
        np.testing.assert_allclose(episodes.tcp[0], tcp_position(ARM, ARM.rest)[None].repeat(24, axis=0), atol=1e-3)
        # Every step costs a centimetre's tenth at least until 5 mm are reached, and success brings ten.
        last = episodes.tcp[episodes.steps.astype(int), np.arange(24)]
        close = np.linalg.norm(last - episodes.target, axis=-1)
        assert (close[episodes.reached == 1] < 0.0065).all()  # encoders are as coarse
        assert (episodes.reward < 10.0).all()
        assert (episodes.reward[episodes.reached == 0] < -0.05 * PAPER.task.hold_steps).all()


def test_exploration_noise_is_noise(bench):
    untrained = load_policy(bench.training(WORN[0]).outputs.snapshot(0), ARM)
    quiet = play(untrained, worn_ranges(ARM), 8, seed=0)
    again = play(untrained, worn_ranges(ARM), 8, seed=0)
    noisy = play(untrained, worn_ranges(ARM), 8, seed=0, noise=0.5)
    np.testing.assert_array_equal(quiet.reward, again.reward)
    np.testing.assert_array_equal(quiet.target, noisy.target)  # the same episodes
    assert (quiet.tcp[5] != noisy.tcp[5]).any()


def test_a_folder_holds_one_seed(bench):
    with pytest.raises(InputError, match="quick reproduction of seed 0, expected a quick one of seed 1"):
        run_experiments(replace(bench, seed=1), choose(["table-1"]), on_experiment=nothing)


def test_every_number_stands_once_in_the_section_of_its_experiment(bench, tmp_path):
    text = "\n".join(lines(bench, tmp_path))
    for experiment in EXPERIMENTS:
        section = text.split(f"## {experiment.title}\n")[1].split("\n## ")[0].splitlines()
        found = finished(bench, experiment)
        assert found.numbers
        for number in found.numbers:
            assert section.count(f"| {number.what} | {number.ours} | {number.paper or '-'} |") == 1
        for grid in found.grids:
            begin = section.index(f"**{grid.title}**") + 2
            rows = [line[2:-2].split(" | ") for line in section[begin : begin + 2 + len(grid.rows)]]
            assert [rows[0], *rows[2:]] == [list(grid.headers), *map(list, grid.rows)]


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=lambda one: one.name)
def test_what_changes_in_a_finding_changes_in_its_line_alone(copied, tmp_path, experiment):
    file = finished_file(copied, experiment)
    kept, before = read_json(file, Finished), lines(copied, tmp_path)
    places = ["numbers.0.ours", "numbers.1.paper", "text.0", "readings.0"]
    places += ["grids.0.rows.1.1", "grids.0.headers.1"] * bool(kept.findings.grids)
    places += ["drawings.0.caption", "drawings.0.alt"] * bool(kept.findings.drawings)
    for place in places:
        write_json(file, put(kept, f"findings.{place}", "7.77 mm"))
        after = lines(copied, tmp_path)
        changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
        assert len(changed) == 1, place
        assert "7.77 mm" in changed[0][1]
    write_json(file, put(kept, "findings.numbers.0.value", 7.77))
    assert lines(copied, tmp_path) == before, "the bare value is for programs, the words for the page"


def test_table_4_says_what_the_comparison_holds(copied):
    result, numbers = read_json(copied.folder / "comparison.json", Comparison), by_name(TABLE_4.run(copied))
    groups = {"default": ["default"], "PID, plain sum": ["pid-sum"], "PID, as printed": ["pid-literal"]}
    for label, names in {**groups, "DT-DRL": list(POLICIES)}.items():
        rows = [result.row(name).outcomes for name in names]
        reached = [value for row in rows for value in row.crossed]
        error = [1e3 * value for row in rows for value in row.crossing_error if value is not None]
        cycles = [sum(row.crossing_time[i : i + 3]) for row in rows for i in range(0, 6, 3)]  # trials of 3 targets
        success = numbers[f"{label}: success rate"]
        assert success.value == pytest.approx(100 * sum(reached) / len(reached))
        assert rounds(success.ours.split(" %")[0], success.value)
        low, high = success.ours.split("(")[1].rstrip(")").split(" to ")
        assert 0 <= float(low) <= round(success.value) <= float(high) <= 100
        printed = numbers[f"{label}: error at the crossing"]
        assert printed.value == pytest.approx(np.mean(error))
        mean, std = printed.ours.removesuffix(" mm").split(" ± ")
        assert rounds(mean, np.mean(error))
        assert rounds(std, np.std(error))
        printed = numbers[f"{label}: time for ten targets"]
        assert printed.value == pytest.approx(np.mean(cycles))
        assert rounds(printed.ours.removesuffix(" s"), np.mean(cycles))


def test_swapping_two_controllers_swaps_their_numbers(copied):
    path = copied.folder / "comparison.json"
    result, before = read_json(path, Comparison), TABLE_4.run(copied)
    swap = {"default": "pid-sum", "pid-sum": "default"}
    rows = {swap.get(row.controller, row.controller): row for row in result.rows}
    swapped = [dataclasses.replace(rows[name], controller=name) for name in result.controllers]
    write_json(path, dataclasses.replace(result, rows=tuple(swapped)))
    after = TABLE_4.run(copied)
    one, other = by_name(before), by_name(after)
    for what in ("success rate", "error at the crossing", "time for ten targets"):
        assert other[f"default: {what}"].ours == one[f"PID, plain sum: {what}"].ours
        assert other[f"PID, plain sum: {what}"].ours == one[f"default: {what}"].ours
        assert other[f"DT-DRL: {what}"] == one[f"DT-DRL: {what}"]
        assert other[f"default: {what}"].paper == one[f"default: {what}"].paper, "the paper's stay where they are"
    (held,), (again,) = before.grids, after.grids
    cells = {row[0]: row[1:] for row in held.rows}
    assert {row[0]: row[1:] for row in again.rows} == cells | {
        "default": cells["PID, plain sum"], "PID, plain sum": cells["default"]
    }  # fmt: skip


def test_one_error_changes_the_numbers_that_it_enters_and_no_other(copied):
    path = copied.folder / "comparison.json"
    result, before = read_json(path, Comparison), by_name(TABLE_4.run(copied))
    place = list(result.controllers).index("default")
    old = result.rows[place].outcomes.crossing_error[2]
    write_json(path, put(result, f"rows.{place}.outcomes.crossing_error.2", old + 6e-3))
    after = by_name(TABLE_4.run(copied))
    (changed,) = [what for what in before if before[what] != after[what]]
    assert changed == "default: error at the crossing"
    assert after[changed].value == pytest.approx(before[changed].value + 1.0)  # 6 mm on one of six targets


def test_fig_13_draws_the_ways_of_the_logs(copied):
    from rejoint.logs.runlog import read_log

    TABLE_4.run(copied)
    axes = np.array(copied.figures["fig-13"].axes).reshape(2, 4)
    for column, name in enumerate((*CLASSICAL, POLICIES[0])):
        tcp = 1e3 * tcp_position(ARM, read_log(copied.folder / "logs" / f"crossing-{name}.parquet").position)
        np.testing.assert_allclose(np.transpose(axes[0, column].lines[0].get_data()), tcp[:, [1, 0]])
        np.testing.assert_allclose(np.transpose(axes[1, column].lines[0].get_data()), tcp[:, [0, 2]])


def test_fig_11_counts_episodes_and_measures_their_paths(copied, monkeypatch):
    def made(reached, collided, detour):
        """Four episodes of three steps: out to one side, to the other, and to the target."""
        start, target = np.zeros((4, 3)), np.tile([0.1, 0.0, 0.0], (4, 1))
        half = np.tile([0.05, detour, 0.0], (4, 1))
        return Episodes(
            reward=np.zeros(4), steps=np.full(4, 2.0), reached=np.array(reached, dtype=float),
            collided=np.array(collided, dtype=float), tcp=np.stack([start, half, target, np.full((4, 3), np.nan)]),
            target=target,
        )  # fmt: skip

    # in the order in which they are played: untrained exploring and quiet, trained quiet and exploring
    plays = iter([made((1, 0, 0, 0), (0, 1, 1, 0), 0.12), made((1, 1, 0, 0), (0, 0, 0, 0), 0.0),
                  made((1, 1, 1, 0), (0, 0, 0, 1), 0.0375), made((1, 1, 1, 1), (0, 0, 0, 0), 0.0)])  # fmt: skip
    monkeypatch.setattr(paths, "play", lambda *_, **__: next(plays))
    findings = FIG_11.run(copied)
    assert [number.ours for number in findings.numbers] == [
        "25.0 %", "50.0 %", "75.0 %", "100.0 %", "2.6", "1.2", "50.0 %", "25.0 %"
    ]  # fmt: skip
    assert [number.value for number in findings.numbers] == pytest.approx([25, 50, 75, 100, 2.6, 1.25, 50, 25])
    assert any("more often while it still explores" in text for text in findings.text)
    first = copied.figures["fig-11"].axes[0].lines[0]
    np.testing.assert_allclose(np.transpose(first.get_data()), [[0, 0], [120, 50], [0, 100]], atol=1e-9)


def test_table_1_shows_both_tables_and_how_far_they_are_apart(bench):
    findings = finished(bench, TABLE_1)
    (grid,), numbers = findings.grids, by_name(findings)
    for row, paper, vendor in zip(grid.rows, PAPER_DH_TABLE, DH_TABLE, strict=True):
        expected = [
            value
            for one in (paper, vendor)
            for value in (np.degrees(one.offset), 1e3 * one.d, 1e3 * one.a, np.degrees(one.alpha))
        ]
        assert [float(cell) for cell in row[1:]] == pytest.approx(expected, rel=1e-4)
    # The tables differ in d1 by 0.02 mm and in d5 by 0.95 mm, along two axes that turn against one another.
    apart = numbers["largest flange distance, Table 1 against the vendor's"].value
    assert np.hypot(0.02, 0.95) - 0.01 < apart <= 0.97 + 1e-6
    assert numbers["the same with the vendor's d1 and d5"].value < 1e-9
    assert numbers["encoder step"].value == pytest.approx(360 / 4096)
    assert numbers["target box that inverse kinematics reaches"].value == 100.0


def test_table_3_says_the_same_in_its_numbers_and_in_its_table(bench):
    findings = finished(bench, TABLE_3)
    numbers, rows = by_name(findings), findings.grids[1].rows
    worn, departures = rows[:3], rows[3:]
    assert numbers["success of --preset paper on the worn arm"].value == pytest.approx(
        np.mean([float(row[5]) for row in worn]), abs=0.05
    )
    for name, row in zip(LITERALLY, departures, strict=True):
        assert rounds(row[5], numbers[f"success, {WORDS[name]}"].value)
    assert [row[0] for row in rows] == ["10°"] * 3 + ["5°"] * 3
    assert [row[1] for row in rows] == ["1°"] * 4 + ["5°"] * 2
    assert [row[2] for row in rows] == ["command - position"] * 5 + ["last action"]
    assert [row[3] for row in rows] == ["0", "1", "2", "0", "0", "0"]
