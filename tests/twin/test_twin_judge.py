"""Judgement of twins on logs of known truth, and what repeats."""

from pathlib import Path

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, pressing, record, wandering

import rejoint
from rejoint.arms import tcp_position
from rejoint.system.errors import InputError
from rejoint.twin.judge import Candidate, judge, predict_logs, read_published
from rejoint.twin.parameters import healthy_parameters
from rejoint.twin.twin import NO_TWIN, TablePlane, smaller

TABLE = TablePlane(height=-0.02, slope_x=0.0, slope_y=0.0, stiffness=3000.0, friction=0.2)


@pytest.fixture(scope="module")
def logs():
    return [
        record("free", *wandering(1, 14.0)),
        record("long", *wandering(2, 21.0)),
        record("press", *pressing(16.0), table=TABLE),
    ]


@pytest.fixture(scope="module")
def judgement(logs):
    truth = Candidate(name="truth", parameters=TRUTH)
    tabled = Candidate(name="truth on its table", parameters=TRUTH, table=TABLE)
    healthy = Candidate(name="healthy", parameters=healthy_parameters(ARM))
    return judge(ARM, predict_logs(ARM, [truth, tabled, healthy], logs), logs)


def test_the_truth_predicts_to_the_encoder_step(judgement):
    for motion in judgement.motions[:2]:
        error = motion.errors["truth"].free
        assert error.joint < 1.5 * ARM.encoder_step
        assert motion.errors["truth"].contact is None
        assert motion.errors["truth"].all == error


def test_no_twin_is_the_command(judgement, logs):
    for motion, log in zip(judgement.motions[:2], logs, strict=False):
        sent = log.command[np.maximum(np.arange(len(log)) - 1, 0)]
        gap = np.linalg.norm(tcp_position(ARM, sent) - tcp_position(ARM, log.position), axis=1)
        assert motion.errors[NO_TWIN].free.tcp == pytest.approx(np.sqrt(np.mean(gap**2)))
        assert motion.errors["truth"].free.tcp < motion.errors["healthy"].free.tcp < motion.errors[NO_TWIN].free.tcp


def test_contact_counts_apart_and_needs_the_table(judgement):
    press = judgement.motions[2]
    assert press.motion == "press"
    assert 5.0 < press.contact_seconds < press.seconds
    assert press.errors["truth"].contact.tcp > 0.010
    assert press.errors["truth on its table"].contact.tcp < 0.002
    assert press.errors["truth on its table"].all.tcp < 0.2 * press.errors["truth"].all.tcp


@pytest.mark.parametrize(
    ("ours", "theirs", "sure"),
    [
        ([1, 1], [2, 2], True),
        ([1, 2.1], [2, 2], False),
        ([1, 1, 1], [2, 2.2, 1.8], True),
        ([1, 3, 1], [2, 2, 2], False),
    ],
)
def test_few_motions_are_trusted_where_each_is_better(ours, theirs, sure):
    assert smaller(np.array(ours, float), np.array(theirs, float)) == sure


@pytest.mark.parametrize("names", [("truth", "truth"), (NO_TWIN,)])
def test_every_prediction_has_a_name_of_its_own(logs, names):
    with pytest.raises(InputError, match="a name of its own"):
        predict_logs(ARM, beside := [Candidate(name=name, parameters=TRUTH) for name in names], logs[:1])
    with pytest.raises(InputError, match="a name of its own"):
        rejoint.identify(logs, arm=ARM, plan=rejoint.LogPlan(beside=beside))  # at once, not after the fit


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "docs" / "published").glob("*.toml")), ids=str)
def test_the_published_sets_of_the_documentation_are_usable(path, logs):
    found = read_published(path, ARM)
    judgement = judge(ARM, predict_logs(ARM, [found], logs[:1]), logs[:1])
    assert 1e-3 < judgement.mean[found.name].all.tcp < 0.2  # another arm's numbers: neither right nor absurd
