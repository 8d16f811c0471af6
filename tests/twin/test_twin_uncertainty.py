"""Intervals from clusters that differ, against fits that are really made without each of them."""

from types import SimpleNamespace

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from rejoint.twin.fit import Weights
from rejoint.twin.parameters import Prior
from rejoint.twin.uncertainty import _steadied, jackknife


def linear(seed=0, clusters=7, parameters=3):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(8, 40, clusters)
    slopes = [rng.normal(0.0, 1.0, (size, parameters)) for size in sizes]
    answers = [
        x @ np.arange(1.0, 1.0 + parameters) + rng.normal(0.0, 1.0) + rng.normal(0.0, 0.3, len(x)) for x in slopes
    ]
    prior = Prior(mean=np.zeros(parameters), sigma=np.full(parameters, 1e4), lower=-np.ones(3), upper=np.ones(3))
    return prior, slopes, answers


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
    prior = Prior(mean=np.zeros(3), sigma=np.array([0.5, 2.0, 1.0]), lower=-np.ones(3), upper=np.ones(3))
    covariance = jackknife(prior, np.zeros((5, 3, 3)), np.zeros((5, 3)))
    np.testing.assert_allclose(covariance, np.diag(prior.sigma**2), atol=1e-12)


class Stub:
    """A problem of one joint whose residuals are ``slopes`` times the parameters, 1 mrad each."""

    joints = 1

    def __init__(self, slopes):
        k = slopes.shape[1]
        self.slopes, self.owner, self.frozen = slopes, np.zeros(k, dtype=int), np.zeros(k, dtype=bool)
        self.prior = Prior(mean=np.zeros(k), sigma=np.ones(k), lower=np.full(k, -9.0), upper=np.full(k, 9.0))

    def columns(self, joint):
        return np.flatnonzero(self.owner == joint)

    def residuals(self, vectors):
        return 1e-3 * (vectors @ self.slopes.T)[..., None]


def steadied(slopes, noise):
    problem = Stub(slopes)
    weights = Weights(precision=np.full((len(slopes), 1), 1e6), share=np.ones((len(slopes), 1)))
    found = SimpleNamespace(vector=np.zeros(3), weights=weights)
    jacobian = 1e-3 * (slopes + noise)[:, None]
    covariance = np.linalg.inv((slopes + noise).T @ (slopes + noise))
    return _steadied(problem, found, jacobian, covariance)[:, 0] / 1e-3


def test_exact_sensitivities_are_left_as_they_are():
    slopes = np.random.default_rng(1).normal(0.0, 1.0, (400, 3))
    np.testing.assert_allclose(steadied(slopes, 0.0 * slopes), slopes, rtol=1e-4, atol=1e-4)


def test_noise_of_simulations_does_not_pass_for_knowledge():
    rng = np.random.default_rng(2)
    slopes = rng.normal(0.0, 1.0, (4000, 3)) @ np.diag([1.0, 1.0, 0.05])  # the last is hardly seen
    steady = steadied(slopes, rng.normal(0.0, 0.2, slopes.shape))
    assert (steady[:, 2] ** 2).sum() < 1.3 * (slopes[:, 2] ** 2).sum()  # with noise it is 17 times as much
    np.testing.assert_allclose((steady[:, :2] ** 2).sum(axis=0), (slopes[:, :2] ** 2).sum(axis=0), rtol=0.1)
