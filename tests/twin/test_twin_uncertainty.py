"""Intervals from clusters that differ, against fits that are really made without each of them."""

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from rejoint.twin.fit import jackknife
from rejoint.twin.parameters import Prior


def linear():
    rng, one = np.random.default_rng(0), np.ones(3)
    slopes = [rng.normal(0.0, 1.0, (size, 3)) for size in rng.integers(8, 40, 7)]
    answers = [x @ [1.0, 2.0, 3.0] + rng.normal(0.0, 1.0) + rng.normal(0.0, 0.3, len(x)) for x in slopes]
    return Prior(mean=0.0 * one, sigma=1e4 * one, lower=-one, upper=one, correlation=np.eye(3)), slopes, answers


def solve(slopes, answers):
    return np.linalg.lstsq(np.concatenate(slopes), np.concatenate(answers), rcond=None)[0]


def test_one_newton_step_leaves_a_cluster_out_of_a_linear_fit_exactly():
    prior, slopes, answers = linear()
    x, count = solve(slopes, answers), len(slopes)
    without = [solve(slopes[:g] + slopes[g + 1 :], answers[:g] + answers[g + 1 :]) - x for g in range(count)]
    curvatures = np.array([s.T @ s for s in slopes])
    scores = np.array([s.T @ (s @ x - y) for s, y in zip(slopes, answers, strict=True)])
    spread = (count - 1) / count * np.array(without).T @ np.array(without)
    expected = (spread + np.linalg.inv(curvatures.sum(axis=0))) * (student.ppf(0.975, count - 1) / norm.ppf(0.975)) ** 2
    np.testing.assert_allclose(jackknife(prior, curvatures, scores), expected, rtol=1e-5)


def test_what_no_cluster_tells_keeps_its_prior():
    one, sigma = np.ones(3), np.array([0.5, 2.0, 1.0])
    prior = Prior(mean=0.0 * one, sigma=sigma, lower=-one, upper=one, correlation=np.eye(3))
    covariance = jackknife(prior, np.zeros((5, 3, 3)), np.zeros((5, 3)))
    np.testing.assert_allclose(covariance, np.diag(prior.sigma**2), atol=1e-12)
