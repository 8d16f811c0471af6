"""A run folder with every file, from made-up but complete results."""

import dataclasses

import numpy as np
import pytest
from report_samples import (
    TARGETS,
    estimate,
    joint_metrics,
    keep_calibration,
    make_comparison,
    shown,
    trial_log,
    write_curves,
)

from madetwin import made_twin
from rejoint.arms import load_arm
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.healthy import healthy_reference
from rejoint.diagnosis.measurement import Measurement
from rejoint.diagnosis.segments import OpenLoop, TargetError
from rejoint.diagnosis.verdict import Finding
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.system.files import write_json
from rejoint.system.statistics import Estimate
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.twin import HeldOut, PredictionError


@pytest.fixture(scope="session")
def arm():
    return load_arm("mycobot280")


@pytest.fixture(scope="session")
def diagnosis(arm):
    rng = np.random.default_rng(0)
    healthy = healthy_reference(arm)
    worn = tuple(joint_metrics(sample, 7.0 + i, 0.1) for i, sample in enumerate(healthy.joints))
    good = tuple(joint_metrics(sample, 38.0, 0.04) for sample in healthy.joints)
    errors = rng.uniform(12, 35, TARGETS)
    targets = tuple(
        TargetError(target_mm=(150.0, 0.0, 200.0), error_mm=float(e), true_error_mm=float(e) + 5) for e in errors
    )
    return Diagnosis(
        arm=arm.name,
        robot="emulated:worn",
        condition="bad",
        verdict="This arm misses its targets by 22.4 mm.",
        findings=(
            Finding(
                joint="joint3",
                kind="weak_gain",
                severity="bad",
                quantity="stiffness_nm_per_rad",
                measured=estimate(7.0),
                healthy=estimate(38.0),
                tcp_mm=14.2,
                sentence="joint3 is soft and sags under the arm's own weight, 14.2 mm at the tool.",
            ),
        ),
        unseen=("Play and flex behind the encoders cannot be seen.",),
        open_loop=OpenLoop(
            targets=targets,
            error_mm=estimate(float(errors.mean())),
            spread_mm=float(errors.std(ddof=1)),
            true_error_mm=estimate(27.0),
        ),
        measurement=Measurement(joints=worn, period_s=0.025),
        healthy=dataclasses.replace(healthy, source="12 emulated arms", joints=good, error_mm=Estimate(3.2, 2.1, 4.3)),
    )


@pytest.fixture(scope="session")
def twin(arm):
    belief, n = prior(arm), arm.joints
    k = len(belief.mean)
    identified = np.arange(k) % 3 != 2
    sigma = np.where(identified, 0.15, 1.0) * belief.sigma
    parameters = dataclasses.replace(nominal_parameters(arm), stiffness=np.linspace(5, 9, n))
    covariance = np.diag(sigma**2)
    covariance[0, 6 * n] = covariance[6 * n, 0] = 0.95 * sigma[0] * sigma[6 * n]  # stiffness of joint 1, delay

    def error(scale):
        return PredictionError(joint=scale * 0.01, tcp=scale * 2.5e-3)

    return made_twin(
        arm,
        parameters,
        covariance=covariance,
        narrowing=np.where(identified, 0.15, 1.0),
        identified=identified,
        held_out=HeldOut(seconds=30.0, no_twin=error(10), healthy_twin=error(8), twin=error(1)),
        fit_seconds=90.0,
        notes=("replayed where it was, as it never answers: joint3",),
    )


@pytest.fixture(scope="session")
def comparison(arm):
    return make_comparison(arm)


@pytest.fixture
def run_folder(tmp_path, arm, diagnosis, twin, comparison):
    """A run folder with everything but a policy file."""
    return fill(RunFolder(tmp_path / "run"), arm, diagnosis, twin, comparison)


@pytest.fixture(scope="session")
def whole(tmp_path_factory, arm, diagnosis, twin, comparison):
    """The page of such a folder, and its figures by key."""
    return shown(fill(RunFolder(tmp_path_factory.mktemp("run")), arm, diagnosis, twin, comparison).path)


def fill(folder, arm, diagnosis, twin, comparison):
    write_json(
        folder.info,
        RunInfo(robot="emulated:worn", arm=arm.name, seed=7, version="0.1.0", created="2026-11-20T06:00:00"),
    )
    write_json(folder.diagnosis, diagnosis)
    twin.save(folder.twin)
    write_json(folder.comparison, comparison)
    keep_calibration(folder, arm)
    write_curves(folder.curves)
    targets = np.array(comparison.targets[0])
    for name in comparison.controllers:
        for kind in ("crossing", "hold"):
            trial_log(arm, name, kind, targets).save(folder.log(f"{kind}/{name}/0/0"))
    return folder
