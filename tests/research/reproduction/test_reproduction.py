"""The reproduction runs, resumes, and says what it found; its measures are judged on what is known."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from rejoint.arms import mycobot280, tcp_position
from rejoint.cli import main
from rejoint.control.policy import load_policy
from rejoint.research.reproduction import gains, kinematics
from rejoint.research.reproduction.campaign import finished_file, run_experiments
from rejoint.research.reproduction.episodes import healthy_ranges, play, worn_ranges
from rejoint.research.reproduction.experiment import QUICK, Bench
from rejoint.research.reproduction.page import table, write_page
from rejoint.research.reproduction.registry import EXPERIMENTS, choose
from rejoint.research.reproduction.trainings import HEALTHY, LIMITED, LITERAL, NOISY, WORN, finish_trainings, recipe
from rejoint.system.errors import InputError, RejointError
from rejoint.training.presets import PAPER
from rejoint.training.ranges import PaperRanges

ARM = mycobot280()


def nothing(*event):
    pass


def cli(*words, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["rejoint", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    captured = capsys.readouterr()
    return int(stopped.value.code or 0), captured.out, captured.err


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


def test_a_page_says_what_was_not_run(tmp_path):
    bench = Bench(folder=tmp_path, arm=ARM, seed=0, scale=QUICK)
    run_experiments(bench, choose(["table-1"]), on_experiment=nothing)
    text = write_page(bench, tmp_path / "page.md").read_text(encoding="utf-8")
    assert "Not run yet: `rejoint reproduce table-4`" in text
    assert "A quick run" in text


def test_the_command_line_lists_runs_and_refuses(tmp_path, capsys, monkeypatch):
    tools = {"capsys": capsys, "monkeypatch": monkeypatch}
    code, out, _ = cli("reproduce", "--list", "--json", **tools)
    assert code == 0
    assert [one["name"] for one in json.loads(out.splitlines()[-1])] == [one.name for one in EXPERIMENTS]
    words = ("--run", str(tmp_path / "run"), "--out", str(tmp_path / "page.md"))
    code, out, _ = cli("reproduce", "table-1", *words, "--quick", "--json", **tools)
    assert code == 0
    found = json.loads(out.splitlines()[-1])["experiments"][0]
    assert found["findings"]["numbers"][0]["value"] == pytest.approx(0.97, abs=0.02)
    assert (tmp_path / "page.md").exists()
    code, _, err = cli("reproduce", "table-9", **tools)
    assert code == 2
    assert "table-4" in err


def test_experiments_are_chosen_by_any_of_their_names_in_the_paper_s_order():
    assert [one.name for one in choose(["fig-13", "fig-8"])] == ["fig-9", "table-4"]
    assert choose([]) == EXPERIMENTS
    with pytest.raises(InputError, match="known: algorithm-1"):
        choose(["fig-99"])


def test_trainings_differ_in_what_their_names_say():
    assert [recipe(name) for name in WORN] == [(PAPER, 0), (PAPER, 1), (PAPER, 2)]
    assert {recipe(name)[0].ranges for name in HEALTHY} == {"paper-healthy"}
    limited, noisy, literal = (recipe(name)[0] for name in (LIMITED, NOISY, LITERAL))
    assert np.degrees([noisy.joint_noise, literal.joint_noise]) == pytest.approx(5.0)
    assert np.degrees(literal.task.law.authority_limit) == pytest.approx(5.0)
    assert limited.task == noisy.task
    assert limited.joint_noise == PAPER.joint_noise
    assert [one.task.layout for one in (limited, noisy, literal)] == ["equation-16"] * 2 + ["equation-16-action"]


def test_both_tables_are_one_mechanism():
    paper = kinematics.paper_arm(kinematics.PAPER_DH_TABLE)
    q = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (50, 6))
    apart = np.linalg.norm(tcp_position(paper, q + kinematics.PAPER_ANGLE_SHIFT) - tcp_position(ARM, q), axis=-1)
    assert 0.9e-3 < apart.max() < 1.0e-3  # d5 is 0.95 mm shorter


def test_overshoot_and_error_of_a_known_path():
    steps = round(gains.DWELL / gains.STEP)
    time = np.arange(steps) * gains.STEP
    ringing = 1.0 - np.exp(-8.0 * time) * np.cos(2 * np.pi * 2.0 * time)
    path = np.zeros((2 * steps, 3))
    path[:steps, 0], path[steps:, 0] = 0.2 * ringing, 0.2
    path[steps:, 1] = 0.1 * ringing
    targets = np.array([[0.203, 0.0, 0.0], [0.2, 0.103, 0.0]])
    error, overshoot = gains.judge(path, targets)
    assert error == pytest.approx(3.0, abs=0.01)
    assert overshoot == pytest.approx(100 * (ringing.max() - 1.0), abs=0.1)


def test_soft_twins_ring_and_stiff_ones_do_not(tmp_path):
    bench = Bench(folder=tmp_path, arm=ARM, seed=0, scale=QUICK)
    targets = ARM.targets.sample(np.random.default_rng(1), (3,))
    found = [gains.judge(path, targets) for path in gains.trace(bench, PaperRanges(arm=ARM), targets)]
    (stiff, stiff_over), (middle, middle_over), (soft, soft_over) = found
    assert stiff < 1.0 < middle < 5.0 < soft
    assert stiff_over < 1.0 < 15.0 < middle_over < soft_over


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


def test_tables_keep_their_columns():
    lines = table(("a", "b"), [("x|y", "1")])
    assert lines == ["| a | b |", "| --- | --- |", "| x\\|y | 1 |"]


def test_a_folder_holds_one_seed(bench):
    with pytest.raises(InputError, match="quick reproduction of seed 0, expected a quick one of seed 1"):
        run_experiments(replace(bench, seed=1), choose(["table-1"]), on_experiment=nothing)


def test_a_training_that_cannot_go_on_says_why_and_stops_the_others(tmp_path):
    bench = Bench(folder=tmp_path, arm=ARM, seed=0, scale=QUICK, threads=1)
    taken = bench.training(WORN[0]).outputs.folder
    taken.parent.mkdir(parents=True)
    taken.write_bytes(b"a file where a folder should be")
    with pytest.raises(RejointError, match="training: cannot be written"):
        finish_trainings(bench, (WORN[0], LITERAL))
    assert not bench.training(LITERAL).policy.exists()
