"""A run folder with every file, from made-up but complete results."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rejoint.arms import load_arm, solve_position
from rejoint.comparison.result import (
    Comparison,
    ControllerRow,
    CrossingRow,
    GuardCount,
    HoldRow,
    Outcomes,
    Protocol,
    Stay,
)
from rejoint.comparison.statistics import cluster, clustered_share, spread
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.healthy import HealthyReference
from rejoint.diagnosis.measurement import JointMetrics, Measurement
from rejoint.diagnosis.open_loop import OpenLoop, TargetError
from rejoint.diagnosis.regression import Estimate
from rejoint.diagnosis.verdict import Finding
from rejoint.runs import RunFolder, RunInfo, RunLog, write_json, write_log
from rejoint.twin.file import write_twin
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.replay import PredictionError
from rejoint.twin.twin import HeldOut, Twin

SETS, REPETITIONS, TARGETS = 2, 3, 10
SETTLED = {
    "default": 22e-3, "pid-sum": 9e-3, "pid-literal": 21e-3, "integrator": 2.1e-3, "feedforward": 1.5e-3,
    "policy": 0.33e-3,
}  # fmt: skip
SPEED = {
    "default": 2.5, "pid-sum": 0.8, "pid-literal": 2.2, "integrator": 1.1, "feedforward": 1.8, "policy": 4.0,
}  # fmt: skip
"""[1/s] at which the made-up error falls"""


@pytest.fixture(scope="session")
def arm():
    return load_arm("mycobot280")


def estimate(value, share=0.1):
    return Estimate(value, value * (1 - share), value * (1 + share))


def joint_metrics(joint, stiffness, friction):
    return JointMetrics(
        joint=joint, stiffness_nm_per_rad=estimate(stiffness), stiffness_source="gravity",
        motor_inertia_kg_m2=0.02,
        hysteresis_rad=estimate(2 * friction / stiffness), coulomb_nm=estimate(friction), lag_s=estimate(0.04),
        damping_ratio=estimate(0.7), overshoot=estimate(0.03), hunting_rad=estimate(0.0004),
        noise_rad=Estimate(0.0006, None, None), torque_limit_nm=None, torque_seen_nm=0.6, saturated_share=0.0,
        stuck_rad=0.01,
    )  # fmt: skip


@pytest.fixture
def diagnosis(arm):
    rng = np.random.default_rng(0)
    worn = tuple(joint_metrics(name, 7.0 + i, 0.1) for i, name in enumerate(arm.joint_names))
    good = tuple(joint_metrics(name, 38.0, 0.04) for name in arm.joint_names)
    errors = rng.uniform(12, 35, TARGETS)
    targets = tuple(
        TargetError(target_mm=(150.0, 0.0, 200.0), error_mm=float(e), sag_mm=float(e) * 0.9, true_error_mm=float(e) + 5)
        for e in errors
    )
    return Diagnosis(
        arm=arm.name, robot="emulated:worn", condition="bad", verdict="This arm misses its targets by 22.4 mm.",
        findings=(
            Finding(
                joint="joint3", kind="weak_gain", severity="bad", quantity="stiffness_nm_per_rad",
                measured=estimate(7.0), healthy=estimate(38.0), tcp_mm=14.2,
                sentence="joint3 is soft and sags under the arm's own weight, 14.2 mm at the tool.",
            ),
        ),
        unseen=("The encoders sit before the gears.",),
        open_loop=OpenLoop(
            targets=targets, error_mm=estimate(float(errors.mean())), spread_mm=float(errors.std(ddof=1)),
            true_error_mm=estimate(27.0), hidden_mm=7.5,
        ),
        measurement=Measurement(joints=worn, delay_s=0.02, period_s=0.025),
        healthy=HealthyReference(
            arm=arm.name, source="12 emulated arms", joints=good, error_mm=Estimate(3.2, 2.1, 4.3), hidden_mm=None,
            motors_kg_m2=(0.02,) * arm.joints,
        ),
    )  # fmt: skip


@pytest.fixture
def twin(arm):
    belief, n = prior(arm), arm.joints
    k = len(belief.mean)
    identified = np.arange(k) % 3 != 2
    sigma = np.where(identified, 0.15, 1.0) * belief.sigma
    parameters = dataclasses.replace(nominal_parameters(arm), stiffness=np.linspace(5, 9, n))
    covariance = np.diag(sigma**2)
    covariance[0, 6 * n] = covariance[6 * n, 0] = 0.95 * sigma[0] * sigma[6 * n]  # stiffness of joint 1, delay

    def error(scale):
        return PredictionError(joints=np.full(n, scale * 0.01), joint=scale * 0.01, tcp=scale * 2.5e-3)

    return Twin(
        arm=arm.name, joint_names=arm.joint_names, parameters=parameters, covariance=covariance, lower=belief.lower,
        upper=belief.upper, narrowing=np.where(identified, 0.15, 1.0), identified=identified,
        held_out=HeldOut(seconds=30.0, no_twin=error(10), healthy_twin=error(8), twin=error(1)), fit_seconds=90.0,
        notes=("torque limit close to the gravity torque held in the log: joint3",),
    )  # fmt: skip


def controller_row(name, seed, true_known):
    rng, shape = np.random.default_rng(seed), (SETS, REPETITIONS, TARGETS)
    labels, mean = cluster(shape)[1], SETTLED[name]
    settled = mean * rng.uniform(0.7, 1.3, shape)
    true = settled + 7e-3 if true_known else np.full(shape, np.nan)
    crossed = (rng.random(shape) < (1.0 if mean < 5e-3 else 0.75 if mean < 10e-3 else 0.07)).astype(float)
    times = np.where(crossed == 1, np.log(10) / SPEED[name], 20.0)
    stays = []
    for within in Protocol().within:
        there = settled < within
        median = float(np.median(np.where(there, np.log(0.1 / within) / SPEED[name], np.inf)))
        stays.append(
            Stay(
                within=within, share=clustered_share(there.ravel().astype(float), labels),
                median=median if np.isfinite(median) else None,
            )
        )  # fmt: skip
    values = {
        "crossed": crossed, "crossing_error": np.where(crossed == 1, 8.2e-3, mean), "crossing_true": true,
        "crossing_time": times, "settled": settled, "settled_true": true, "oscillation": 0.1 * settled,
    }  # fmt: skip
    flat = {key: tuple(float(v) if np.isfinite(v) else None for v in value.ravel()) for key, value in values.items()}
    stay = tuple(tuple(np.full(settled.size, 1.0 if s.median is None else s.median).tolist()) for s in stays)
    return ControllerRow(
        controller=name,
        crossing=CrossingRow(
            success=clustered_share(crossed.ravel(), labels), error=spread(values["crossing_error"].ravel(), labels),
            true_error=spread(true.ravel(), labels), cycle_time=spread(times.sum(axis=-1).ravel(), np.arange(6)),
        ),
        hold=HoldRow(
            settled=spread(settled.ravel(), labels), settled_true=spread(true.ravel(), labels), stays=tuple(stays),
            oscillation=spread(0.1 * settled.ravel(), labels),
        ),
        guard=(GuardCount(reason="step", cycles=120, share=0.031), GuardCount(reason="lead", cycles=5, share=0.0013))
        if name == "policy" else (),
        failures=1 if name == "pid-literal" else 0,
        outcomes=Outcomes(
            shape=shape, within=Protocol().within, stay=stay, stayed=tuple(tuple(1.0 for _ in s) for s in stay), **flat
        ),
    )  # fmt: skip


def make_comparison(arm, names=tuple(SETTLED), *, true_known=True):
    targets = arm.targets.sample(np.random.default_rng(3), (SETS, TARGETS))
    return Comparison(
        robot="emulated:worn", arm=arm.name, seed=0, batched=True, true_known=true_known, repetitions=REPETITIONS,
        targets=tuple(tuple(map(tuple, points)) for points in targets.tolist()), protocol=Protocol(), clusters="trials",
        rows=tuple(controller_row(name, i, true_known) for i, name in enumerate(names)),
    )  # fmt: skip


@pytest.fixture
def comparison(arm):
    return make_comparison(arm)


def trial_log(arm, name, kind, targets):
    """A made-up trial: every joint goes to its goal exponentially and stops short by about the settled error."""
    dwell, period = (2.0, 8.0)[kind == "hold"], 0.04
    goals = solve_position(arm, targets, np.tile(arm.rest, (len(targets), 1))).q
    steps = int(dwell / period)
    fade = np.exp(-SPEED[name] * period * np.arange(1, steps + 1))[:, None]
    position, here = [], arm.rest
    for goal in goals:
        stop = goal + SETTLED[name] / 0.25 * np.array([0.2, 0.6, 0.4, 0.1, 0, 0])
        position.append(stop + (here - stop) * fade)
        here = position[-1][-1]
    q = np.concatenate(position)
    return RunLog(
        arm=arm.name, joint_names=arm.joint_names, robot="emulated:worn", label=f"{kind}/{name}/0/0",
        time=period * np.arange(1, len(q) + 1), position=q, command=q, target=np.repeat(targets, steps, axis=0),
        true_tcp=np.full((len(q), 3), np.nan), extra={"controller": name},
    )  # fmt: skip


def write_curves(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    k = np.arange(1, 81)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        pa.table({
            "step": 16384 * k, "reward": 1 - 3 * np.exp(-k / 15), "success_rate": 1 - np.exp(-k / 20),
            "error_mm": 50 * np.exp(-k / 12) + 0.8, "wall_s": 0.6 * k,
        }),
        path,
    )  # fmt: skip


@pytest.fixture
def run_folder(tmp_path, arm, diagnosis, twin, comparison):
    """A run folder with everything but a policy file."""
    folder = RunFolder(tmp_path / "run")
    write_json(
        folder.info,
        RunInfo(robot="emulated:worn", arm=arm.name, seed=7, version="0.1.0", created="2026-11-20T06:00:00"),
    )
    write_json(folder.diagnosis, diagnosis)
    write_twin(folder.twin, twin)
    write_json(folder.comparison, comparison)
    write_curves(folder.training / "curves.parquet")
    targets = np.array(comparison.targets[0])
    for name in comparison.controllers:
        for kind in ("crossing", "hold"):
            write_log(folder.log(f"{kind}/{name}/0/0"), trial_log(arm, name, kind, targets))
    return folder
