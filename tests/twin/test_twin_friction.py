"""A friction law is added in one file: what docs/architecture.md says of it is done to a copy of the package."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import rejoint
from commandline import python
from rejoint.twin.parameters import STRIBECK_SPEED, dry_friction

SOURCE = Path(rejoint.__file__).parent
PAGE = SOURCE.parent.parent / "docs" / "architecture.md"

USE = """
import dataclasses, sys, tempfile
from pathlib import Path
import numpy as np
from rejoint.arms import mycobot280
from rejoint.training.ranges import IdentifiedRanges, BroadRanges
from rejoint.logs.runlog import RunLog
from rejoint.twin.twin import read_twin
from rejoint.twin.fit import Problem, fit
from rejoint.twin.parameters import PARAMETERS, nominal_parameters, pack, prior, vector_names
from rejoint.twin.twin import PredictionError
from rejoint.twin.replay import Replay, cut
from rejoint.twin.simulation import Draw, Simulation
from rejoint.twin.twin import HeldOut, Twin

arm, rng, step = mycobot280(), np.random.default_rng(0), 0.005
truth = dataclasses.replace(
    nominal_parameters(arm),
    coulomb=np.full(6, 0.15),
    stiction=np.ones(6),
    asymmetry=np.array([0.4, -0.3, 0.2, 0.0, -0.4, 0.3]),
)
time = np.arange(0.0, 8.0, 0.025)
command = arm.rest + 0.3 * np.sin(np.outer(time, rng.uniform(2.0, 5.0, 6)) + rng.uniform(0, 6, 6)) * np.minimum(
    time, 1.0
)[:, None]
still = np.full((len(time), 3), np.nan)


def log(position):
    return RunLog(arm=arm.name, joint_names=arm.joint_names, robot="twin", label="sines", time=time,
                  position=position, command=command, target=still, true_tcp=still)


def predicted(twin):
    logs = [log(np.tile(command[:1], (len(time), 1)))]
    return Replay(arm, cut(logs, 100.0)).predict(twin.repeat(1))[0]


logs, belief = [log(predicted(truth))], prior(arm)
others = [p.name for p in PARAMETERS if p.name != "asymmetry"]
problem = Problem(Replay(arm, cut(logs, 2.0)), belief, frozen=others)
start = np.where(np.array([n.startswith("asym") for n in vector_names(arm.joint_names)]), 0.0, pack(truth))
found = fit(problem, start, 4)
names = np.array(vector_names(arm.joint_names))
place = problem.layout.at("asymmetry")
print(*names[place], sep=",")
print(*found.vector[place], sep=",")
error, sigma = PredictionError(joint=0.0, tcp=0.0), 0.1 * belief.sigma
twin = Twin(arm=arm.name, joint_names=arm.joint_names, parameters=truth, covariance=np.diag(sigma**2),
            lower=belief.lower, upper=belief.upper, narrowing=sigma / belief.sigma, identified=sigma > 0.0,
            held_out=HeldOut(seconds=1.0, no_twin=error, healthy_twin=error, twin=error), fit_seconds=1.0)
path = Path(tempfile.mkdtemp()) / "twin.toml"
twin.save(path)
print(*read_twin(path, arm).parameters.asymmetry, sep=",")
draw = IdentifiedRanges(broad=BroadRanges(arm=arm), twin=twin).draw(rng, 2000)
print(*draw.twin.asymmetry.mean(axis=0), sep=",")
speeds = []
for sign in (1.0, -1.0):
    driven = Simulation(arm, 2000)
    at = np.tile(arm.rest, (2000, 1))
    driven.place(dataclasses.replace(draw, gravity_scale=np.zeros(2000)), at, at + sign * 0.2)
    driven.advance(np.full(2000, 0.03))
    speeds.append(np.abs(driven.twins.qvel).mean(axis=0))
print(*(speeds[1] - speeds[0]), sep=",")
"""


def documented_edits():
    """Edits that the page shows: file, the text that stands there, and that which takes its place."""
    section = PAGE.read_text().split("### A friction law", 1)[1].split("\n## ", 1)[0]
    edits = []
    for block in section.split("```diff\n")[1:]:
        head, *lines = block.split("```", 1)[0].rstrip("\n").split("\n")
        for hunk in "\n".join(lines).split("\n...\n"):
            rows = hunk.split("\n")
            old = "\n".join(row[1:] for row in rows if row[:1] != "+")
            new = "\n".join(row[1:] for row in rows if row[:1] != "-")
            edits.append((head.removeprefix("# "), old, new))
    return edits


def test_the_law_of_the_page_is_fitted_kept_drawn_and_simulated(tmp_path):
    shutil.copytree(SOURCE, tmp_path / "rejoint")
    edits = documented_edits()
    assert {file for file, _, _ in edits} == {"twin/parameters.py"}
    for file, old, new in edits:
        path = tmp_path / "rejoint" / file
        text = path.read_text()
        assert text.count(old) == 1, (file, old)
        path.write_text(text.replace(old, new))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    names, *numbers = python("-c", USE, env=environment).out.split()
    assert names.split(",")[0] == "asymmetry.joint1"
    fitted, kept, drawn, faster_back = (np.array(row.split(","), dtype=float) for row in numbers)
    truth = [0.4, -0.3, 0.2, 0.0, -0.4, 0.3]
    np.testing.assert_allclose(fitted, truth, atol=0.05)
    np.testing.assert_array_equal(kept, truth)
    np.testing.assert_allclose(drawn, truth, atol=0.02)
    assert (np.sign(faster_back) == np.sign(truth))[[0, 1, 2, 4, 5]].all()


def test_dry_friction_falls_from_static_to_kinetic_and_grows_with_load():
    law = np.array([0.1, 0.4, 1.5])
    assert dry_friction(law, np.array(STRIBECK_SPEED), 0.0) == pytest.approx(0.1 + 0.05 / np.e)
    np.testing.assert_allclose(dry_friction(law, 3.0, np.array([0.0, 0.5, 1.0])), [0.1, 0.3, 0.5])
    plain = np.array([0.1, 0.0, 1.0])[:, None]
    np.testing.assert_array_equal(dry_friction(plain, np.linspace(-1.0, 1.0, 41), 7.0), 0.1)
