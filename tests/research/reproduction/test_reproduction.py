"""The reproduction runs, resumes and says what it found: every experiment, run quickly, and its page."""

import re

import numpy as np
import pytest
from PIL import Image

from rejoint.arms import mycobot280
from rejoint.control.policy import load_policy
from rejoint.research.reproduction.campaign import EXPERIMENTS, choose, finished_file, run_experiments, write_page
from rejoint.research.reproduction.experiment import QUICK, Bench
from rejoint.research.reproduction.trainings import WORN, play, worn_ranges

ARM = mycobot280()


def nothing(*event):
    pass


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Every experiment, run quickly, in a folder of its own."""
    made = Bench(folder=tmp_path_factory.mktemp("reproduction"), arm=ARM, seed=0, scale=QUICK, threads=2)
    run_experiments(made, EXPERIMENTS, on_experiment=nothing)
    return made


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
    assert len(pictures) == 5
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


def test_exploration_noise_is_noise(bench):
    untrained = load_policy(bench.training(WORN[0]).outputs.snapshot(0), ARM)
    quiet = play(untrained, worn_ranges(ARM), 8, seed=0)
    again = play(untrained, worn_ranges(ARM), 8, seed=0)
    noisy = play(untrained, worn_ranges(ARM), 8, seed=0, noise=0.5)
    np.testing.assert_array_equal(quiet.reward, again.reward)
    np.testing.assert_array_equal(quiet.target, noisy.target)  # the same episodes
    assert (quiet.tcp[5] != noisy.tcp[5]).any()
