"""The reproduction runs, resumes and says what it found: every experiment, run quickly, and its page."""

import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from rejoint.arms import mycobot280
from rejoint.control.controllers.policy import load_policy
from rejoint.system.errors import InputError
from rejoint_lab.research.reproduction import measures
from rejoint_lab.research.reproduction.campaign import (
    EXPERIMENTS,
    PAPER,
    WORN,
    Bench,
    ranges_of,
    run_experiments,
    write_page,
)

ARM = mycobot280()


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Every experiment, run quickly with short episodes, in a folder of its own."""
    made = Bench(folder=tmp_path_factory.mktemp("reproduction"), arm=ARM, seed=0).quickly()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measures, "PAPER", replace(PAPER, task=replace(PAPER.task, hold_steps=20)))
        run_experiments(made, EXPERIMENTS, str)
        yield made


def test_every_experiment_finds_something_and_the_page_shows_it(bench):
    page = write_page(bench)
    text = page.read_text()
    for experiment in EXPERIMENTS.values():
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
    pictures = re.findall(r"!\[[^\]]+\]\((figures/[^)]+)\)", text)
    assert len(pictures) == 5
    for picture in pictures:
        assert (page.parent / picture).stat().st_size < 150_000
        with Image.open(page.parent / picture) as image:
            assert min(image.size) > 250
    anchors = re.findall(r"\]\(#([^)]+)\)", text)
    assert anchors[0] == "table-1-kinematics"
    assert len(anchors) == len(EXPERIMENTS)


def test_trainings_and_trials_are_kept(bench):
    kept = [*bench.folder.rglob("*.onnx"), *bench.folder.rglob("*.parquet")]
    kept += (bench.folder / "trials").iterdir()
    before = {path: path.stat().st_mtime_ns for path in kept}
    chosen = {name: EXPERIMENTS[name] for name in ("fig-9", "table-3")}
    results = [(bench.folder / "results" / f"{name}.json").read_text() for name in chosen]
    run_experiments(bench, chosen, str)
    assert {path: path.stat().st_mtime_ns for path in kept} == before
    assert [(bench.folder / "results" / f"{name}.json").read_text() for name in chosen] == results
    with pytest.raises(InputError, match="give another --run"):
        run_experiments(replace(bench, seed=1), chosen, str)


def test_exploration_noise_is_noise(bench):
    untrained = load_policy(bench.training(WORN[0]).snapshot(0), ARM)
    arms = ranges_of(bench.arm, "worn")
    quiet, again, noisy = (measures.play(untrained, arms, 8, seed=0, noise=noise) for noise in (0.0, 0.0, 0.5))
    np.testing.assert_array_equal(quiet["reward"], again["reward"])
    np.testing.assert_array_equal(quiet["target"], noisy["target"])  # the same episodes
    assert (quiet["tcp"][5] != noisy["tcp"][5]).any()
