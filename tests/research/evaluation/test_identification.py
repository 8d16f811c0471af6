import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.guard import Reason
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation import identification
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.identification import COPIES, VARIANT, KnownArm, evaluate_identification, know_arm
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.trials import TrialSettings
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.file import write_twin
from rejoint.twin.parameters import nominal_parameters, pack, vector_names
from rejoint.twin.prediction import PredictionError
from rejoint.twin.twin import HeldOut, Twin

ARM = mycobot280()


def make_twin() -> Twin:
    parameters = nominal_parameters(ARM)
    vector, error = pack(parameters), PredictionError(joints=np.zeros(6), joint=0.01, tcp=0.002)
    k = len(vector_names(ARM.joint_names))
    return Twin(
        arm=ARM.name, joint_names=ARM.joint_names, parameters=parameters, covariance=1e-4 * np.eye(k),
        lower=vector - 2.0, upper=vector + 2.0, narrowing=np.full(k, 0.5), identified=np.ones(k, dtype=bool),
        held_out=HeldOut(seconds=10.0, no_twin=error, healthy_twin=error, twin=error), fit_seconds=30.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> RunFolder:
    """A folder with twin and policy, as the chain leaves it."""
    folder = RunFolder(tmp_path_factory.mktemp("arm"))
    twin = make_twin()
    write_twin(folder.twin, twin)
    train(ARM, twin, out=folder.path, options=TrainingOptions(agents=8, iterations=1, threads=1))
    return folder


def test_what_an_arm_has_been_through_is_taken_over(known, monkeypatch):
    monkeypatch.setattr("rejoint.diagnosis.diagnosis.diagnose", lambda *_, **__: pytest.fail("identified again"))
    before = known.policy.stat().st_mtime_ns
    found = know_arm(ARM, 5, known, None, lambda *_: None)
    assert found.wear_seed == 5
    assert known.policy.stat().st_mtime_ns == before
    np.testing.assert_allclose(found.twin.parameters.stiffness, nominal_parameters(ARM).stiffness, rtol=1e-4)


def test_knowing_an_arm_is_compared_with_not_knowing_it(known, tmp_path, monkeypatch):
    seen = []

    def know(arm, wear_seed, folder, iterations, on_progress):
        seen.append((wear_seed, folder.path.name))
        return KnownArm(wear_seed=wear_seed, twin=make_twin(), policy=known.policy)

    monkeypatch.setattr(identification, "know_arm", know)
    monkeypatch.setattr(identification, "COPIES", 2)
    settings = TrialSettings(
        family=ArmFamily(arms=2, targets=1, crossings=1), protocol=Protocol(hold=1.2), crossing=False, threads=1
    )
    result = evaluate_identification(ARM, [], settings, tmp_path, None, lambda *_: None)
    assert seen == [(10_000, "10000"), (10_001, "10001")]
    assert result.controllers == (
        "feedforward", "tuned-feedforward", "feedforward on its twin", "predictive on its twin", "policy on its twin",
    )  # fmt: skip
    assert {pair.rival for pair in result.pairs} == set(result.controllers[:-1])
    row = result.row(VARIANT, "feedforward")
    assert row.settled.value > 0.0
    assert (row.settled.low, row.settled.high) == (None, None), "two arms tell little of a third"
    assert (tmp_path / "evaluation.html").exists()
    assert COPIES > 2


def test_the_trips_of_all_copies_of_an_arm_are_kept():
    blank = {f.name: np.zeros((2, 1)) for f in dataclasses.fields(Outcome)}
    tripped = np.array([float(Reason.STALE), float(Reason.OUT_OF_RANGE)])
    merged = identification.one_arm(Outcome(**blank | {"wear_seed": np.array([7.0, 7.0]), "tripped": tripped}))
    assert merged.tripped.tolist() == [float(Reason.STALE | Reason.OUT_OF_RANGE)]
    assert merged.wear_seed.tolist() == [7.0]
    assert merged.settled.shape == (1, 2)
