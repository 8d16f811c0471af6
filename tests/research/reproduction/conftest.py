import pytest

from rejoint.arms import mycobot280
from rejoint.research.reproduction.campaign import run_experiments
from rejoint.research.reproduction.experiment import QUICK, Bench
from rejoint.research.reproduction.registry import EXPERIMENTS


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """Every experiment, run quickly, in a folder of its own."""
    made = Bench(folder=tmp_path_factory.mktemp("reproduction"), arm=mycobot280(), seed=0, scale=QUICK, threads=2)
    run_experiments(made, EXPERIMENTS, on_experiment=lambda *_: None)
    return made
