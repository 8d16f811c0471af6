"""Known truth, several times: parameters lie inside their intervals as often as claimed; a plant is predicted."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion_logs import ARM, PERIOD, TRUTH, centre_of, record, wandering

from rejoint.twin.fit import uncertainty
from rejoint.twin.identify import FITTED, HEALTHY, IDENTIFIED, LogSettings, Motions, identify_logs, independent
from rejoint.twin.parameters import pack, vector_names
from rejoint.twin.twin import NO_TWIN
from rejoint_lab.plant.wear import load_wear

sys.path.append(str(Path(__file__).parents[1] / "diagnosis"))
from plant_logs import record_motions

SEEDS = 2
WRONG = 0.15
"""Of the logarithm of each link's mass: the fit assumes those of the data sheet"""
SETTINGS = LogSettings(coarse_seconds=48.0, fit_seconds=200.0)

DISTURBANCE, MEMORY = np.radians(0.2), 0.4
"""[rad] and [s] of what no twin explains: a real low-cost arm's residuals are of this size"""


def drawn_truth(rng):
    """An arm around `TRUTH`: a quarter more or less in everything, another zero, another delay."""
    changed = {
        name: getattr(TRUTH, name) * np.exp(0.25 * rng.standard_normal(ARM.joints))
        for name in ("stiffness", "damping", "coulomb", "armature")
    }
    offset = TRUTH.offset + np.radians(0.5) * rng.standard_normal(ARM.joints)
    return replace(TRUTH, **changed, offset=offset, delay=rng.uniform(0.003, 0.020))


def disturbed(log, rng):
    """The log with an autoregressive error on its readings, rounded to encoder steps again."""
    keep = np.exp(-PERIOD / MEMORY)
    error = DISTURBANCE * rng.standard_normal(log.position.shape)
    for k in range(1, len(log)):
        error[k] = keep * error[k - 1] + np.sqrt(1 - keep**2) * error[k]
    return replace(log, position=np.round((log.position + error) / ARM.encoder_step) * ARM.encoder_step)


@pytest.fixture(scope="module")
def distances():
    """For each seed: names, distances in standard deviations, and standard deviations of what was identified."""
    found = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        truth, logs = drawn_truth(rng), []
        factor = np.exp(WRONG * rng.standard_normal(ARM.joints))
        links = replace(ARM, mass=ARM.mass * factor, inertia=ARM.inertia * factor[:, None, None])
        for k in range(8):
            log = record(f"motion{k}", *wandering(1000 * seed + k, 12.0, centre_of(k)), truth=truth, own=links)
            logs.append(disturbed(log, rng))
        motions = Motions(ARM, logs, SETTINGS)
        problem, fit = motions.settle(*motions.find_structure())
        sigma = np.sqrt(np.diag(uncertainty(problem, fit, independent(problem))))
        known = (sigma < IDENTIFIED * problem.prior.sigma) & ~fit.at_bound & ~problem.frozen
        names = np.array(vector_names(ARM.joint_names))[known]
        found.append((names, ((fit.vector - pack(truth)) / sigma)[known], sigma[known]))
    return found


def test_every_kind_of_parameter_is_recovered_inside_its_interval_as_often_as_claimed(distances):
    """The parameters of a joint share one scale, so only joints and seeds count as independent tests.

    Of 10 at 95 %, fewer than 8 within is a chance of about one in a hundred.
    """
    inside = np.concatenate([np.abs(z) < 1.96 for _, z, _ in distances])
    assert len(inside) >= 15 * SEEDS
    assert inside.mean() >= 0.8, [dict(zip(n, z.round(1), strict=True)) for n, z, _ in distances]
    kinds = np.concatenate([[name.partition(".")[0] for name in names] for names, _, _ in distances])
    for kind in ("stiffness", "damping", "coulomb", "offset"):
        assert (kinds == kind).sum() >= 2 * SEEDS
        assert inside[kinds == kind].mean() >= 0.7, kind


def test_the_intervals_are_not_merely_wide(distances):
    z = np.concatenate([z for _, z, _ in distances])
    assert np.sqrt(np.mean(z**2)) > 0.3
    for names, _, sigma in distances:
        assert sigma[names == "stiffness.shoulder_lift"] < 0.3  # 0.1 to 0.15 of it for masses that are not known
        assert sigma[names == "coulomb.shoulder_lift"] < 0.4  # 0.2 of it for friction at rest


def test_a_plant_with_play_and_flex_is_predicted_on_motion_the_fit_has_not_seen():
    """The plant is richer than any twin, so its parameters have no truth here: prediction decides."""
    logs = record_motions([load_wear("so101", ARM)], 5, 12.0, seed=3)[0]
    settings = LogSettings(coarse_seconds=24.0, fit_seconds=40.0, hold_out=("motion1", "motion4"))
    found = identify_logs(ARM, logs, settings)
    mean = found.judgement.mean
    assert mean[FITTED].free.tcp < 0.25 * min(mean[HEALTHY].free.tcp, mean[NO_TWIN].free.tcp)
    assert mean[FITTED].free.tcp < 4e-3
