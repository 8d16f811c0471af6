"""The wheel in an environment of its own without extras, a complete run folder, and an emulated arm to drive.

Everything but that environment runs from the one that `make` has set up. Package index, cache and pins are pip's own.
"""

import os
import re
import subprocess
import sys
import venv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import Arm, mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.loop import Schedule
from rejoint.control.loop import run as drive
from rejoint.logs.runfolder import RunFolder
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.twin import HeldOut, PredictionError, Twin

ROOT = Path(__file__).parent.parent
CONSTRAINTS = ROOT / "constraints.txt"


def pip(*words: str) -> None:
    """Run pip; CalledProcessError where it fails."""
    command = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *words)
    subprocess.run(command, env=_environment(), check=True)


def _environment() -> dict[str, str]:
    """Return this process's variables without those that lead Python to other packages than its environment's."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """Lines that begin with "error:"."""
        return [line for line in self.err.splitlines() if line.startswith("error: ")]


@dataclass(frozen=True, kw_only=True)
class Base:
    """The environment that holds the wheel and nothing of the extras."""

    bin: Path
    home: Path
    """folder that its commands run in"""

    def rejoint(self, *words: str) -> Ended:
        """Run a command to its end."""
        return self._run(str(self.bin / "rejoint"), *words)

    def python(self, code: str) -> Ended:
        """Run Python code to its end."""
        return self._run(str(self.bin / "python"), "-I", "-c", code)

    def _run(self, *command: str) -> Ended:
        done = subprocess.run(
            command, cwd=self.home, env=_environment(), capture_output=True, text=True, timeout=300, check=False
        )
        return Ended(code=done.returncode, out=done.stdout, err=done.stderr)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy of what git knows: no file that only this checkout has can slip in."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip("wheel", "--no-deps", "--wheel-dir", str(out), str(source))
    return next(out.glob("*.whl"))


@pytest.fixture(scope="session")
def base(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Base:
    home = tmp_path_factory.mktemp("base")
    venv.create(home / "env", with_pip=False)
    python = home / "env" / "bin" / "python"
    pip("--python", str(python), "install", "--constraint", str(CONSTRAINTS), str(wheel))
    return Base(bin=python.parent, home=home)


@pytest.fixture(scope="session")
def complete(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Make a run folder with logs, a twin (of the prior's medians) and a policy that has hardly been trained."""
    run = Run.create(tmp_path_factory.mktemp("runs") / "one", "emulated:worn", mycobot280(), 0)
    twin = _twin(run.arm)
    twin.save(run.folder.twin)
    train(run.arm, twin, out=run.folder.path, options=TrainingOptions(iterations=2, agents=16))
    robot = open_robot("emulated:worn", arm=run.arm)
    targets = run.arm.targets.sample(np.random.default_rng(0), (1, 4))
    recording = drive(robot, make_controller("integrator", run.arm), targets, Schedule(dwell=3.0))
    recording.log(0, "excitation").save(run.folder.log("excitation"))
    return run.folder


@pytest.fixture(scope="session")
def arm_at() -> Iterator[str]:
    """Address of an emulated arm that another process serves in real time."""
    command = [sys.executable, "-m", "rejoint", "emulate", "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        assert server.stderr is not None
        told = server.stderr.readline()
        address = re.search(r"tcp://\S+", told)
        assert address is not None, told
        yield address[0]
        server.terminate()


def _twin(arm: Arm) -> Twin:
    belief, nothing = prior(arm), PredictionError(joint=0.0, tcp=0.0)
    return Twin(
        arm=arm.name,
        joint_names=arm.joint_names,
        parameters=nominal_parameters(arm),
        covariance=np.diag((0.1 * belief.sigma) ** 2),
        lower=belief.lower,
        upper=belief.upper,
        narrowing=np.full(len(belief.mean), 0.1),
        identified=np.ones(len(belief.mean), dtype=bool),
        held_out=HeldOut(seconds=0.0, no_twin=nothing, healthy_twin=nothing, twin=nothing),
        fit_seconds=0.0,
    )
