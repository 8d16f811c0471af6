"""Made-up but complete results of every stage."""

import dataclasses

import numpy as np
from markupsafe import Markup, escape

from comparisons import made_comparison
from madetwin import made_calibration
from readpage import Page
from rejoint.arms import Displacement, solve_position
from rejoint.control.comparison.result import Protocol
from rejoint.diagnosis.calibration.calibration import DisplacementLayout, write_calibration
from rejoint.diagnosis.calibration.measurements import Measurements, write_measurements
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.figures import Gallery, Picture
from rejoint.pages.report.page import read_contents, report_html
from rejoint.system.files import write_json
from rejoint.system.statistics import Estimate

SETS, REPETITIONS, TARGETS = 2, 3, 10


SETTLED = {
    "default": 22e-3,
    "pid-sum": 9e-3,
    "pid-literal": 21e-3,
    "integrator": 2.1e-3,
    "feedforward": 1.5e-3,
    "policy": 0.33e-3,
}


SPEED = {
    "default": 2.5,
    "pid-sum": 0.8,
    "pid-literal": 2.2,
    "integrator": 1.1,
    "feedforward": 1.8,
    "policy": 4.0,
}


"""[1/s] at which the made-up error falls"""


def estimate(value):
    return Estimate(value, 0.9 * value, 1.1 * value)


def joint_metrics(sample, stiffness, friction):
    """A joint like ``sample`` with round numbers."""
    return dataclasses.replace(
        sample,
        stiffness_nm_per_rad=estimate(stiffness),
        hysteresis_rad=estimate(2 * friction / stiffness),
        coulomb_nm=estimate(friction),
        lag_s=estimate(0.04),
        damping_ratio=estimate(0.7),
        overshoot=estimate(0.03),
        hunting_rad=estimate(0.0004),
        offset_rad=Estimate(0.002, -0.001, 0.005),
        noise_rad=Estimate(0.0006, None, None),
    )


def controller_columns(name, seed):
    rng, shape, mean = np.random.default_rng(seed), (SETS, REPETITIONS, TARGETS), SETTLED[name]
    settled = mean * rng.uniform(0.7, 1.3, shape)
    true = settled + 7e-3
    crossed = (rng.random(shape) < (1.0 if mean < 5e-3 else 0.75 if mean < 10e-3 else 0.07)).astype(float)
    stays = {
        name_: np.where(settled < within, np.log(0.1 / within) / SPEED[name], Protocol().hold)
        for name_, within in zip(Protocol().stay_names, Protocol().within, strict=True)
    }
    return stays | {
        "crossed": crossed,
        "crossing_error": np.where(crossed == 1, 8.2e-3, mean),
        "crossing_true": true,
        "crossing_time": np.where(crossed == 1, np.log(10) / SPEED[name], 20.0),
        "settled": settled,
        "settled_true": true,
        "oscillation": 0.1 * settled,
    }


def make_calibration(arm):
    """A calibration of an arm with play, and the measurements, from both sides of four postures, behind it."""
    rng, n = np.random.default_rng(5), arm.joints
    found = dataclasses.replace(
        Displacement.none(arm), offset=np.full(n, 0.004), compliance=np.full(n, 0.01), play=np.full(n, 0.02)
    )
    position = np.repeat(arm.rest + rng.uniform(-0.6, 0.6, (4, n)), 2, axis=0)
    point = found.tool(arm, position) + rng.normal(0.0, 1e-3, (8, 3))
    measured = Measurements(position=position, point=point, sigma=np.full(8, 0.5e-3), posture=np.arange(8) // 2)
    left_out = np.stack([rng.uniform(6e-3, 9e-3, 8), rng.uniform(0.5e-3, 2e-3, 8)], axis=-1)
    before, after = left_out.mean(axis=0)
    noise = {"covariance": 1e-6 * np.eye(DisplacementLayout(arm).body), "floor": 1e-3}
    told = {"date": "2026-11-20T07:30:00", "points": 8, "suspects": (5,)}
    return made_calibration(arm, found, before=before, after=after, left_out=left_out, **noise, **told), measured


def keep_calibration(folder, arm, points=None):
    """Write a calibration and the first ``points`` of its measurements (default: all), and return both."""
    calibration, measured = make_calibration(arm)
    write_calibration(folder.calibration, calibration)
    write_measurements(folder.measurements, arm, measured.rows(np.arange(points or len(measured))))
    return calibration, measured


def make_comparison(arm, names=tuple(SETTLED)):
    columns = {name: controller_columns(name, i) for i, name in enumerate(names)}
    found = made_comparison(arm, columns, arm.targets.sample(np.random.default_rng(3), (SETS, TARGETS)))
    guard = {"policy": {"step": 0.031, "lead": 0.0013}}
    ended = {"pid-literal": ("temperature",)}
    rows = (
        dataclasses.replace(row, guard=guard.get(row.controller, {}), ended=ended.get(row.controller, ()))
        for row in found.rows
    )
    return dataclasses.replace(found, rows=tuple(rows))


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
    time, target = period * np.arange(1, len(q) + 1), np.repeat(targets, steps, axis=0)
    log = RunLog.of(time, q, q, arm=arm, label=f"{kind}/{name}/0/0", target=target)
    return dataclasses.replace(log, robot="emulated:worn", extra={"controller": name})


def write_curves(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    k = np.arange(1, 81)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        pa.table(
            {
                "step": 16384 * k,
                "reward": 1 - 3 * np.exp(-k / 15),
                "success_rate": 1 - np.exp(-k / 20),
                "error_mm": 50 * np.exp(-k / 12) + 0.8,
                "wall_s": 0.6 * k,
            }
        ),
        path,
    )


class Sketches(Gallery):
    """Keeps the figures to look into, and saves the time of drawing them: of a picture there is what is read out."""

    def __init__(self):
        super().__init__()
        self.figures = {}

    def show(self, key, figure, *, alt, caption=""):
        assert key not in self.figures
        self.figures[key] = figure
        return Picture(svg=Markup(f'<svg aria-label="{escape(alt)}"></svg>'), caption=caption)


def begin(path, arm):
    """Write the description of a run."""
    info = RunInfo(robot="emulated:worn", arm=arm.name, seed=0, version="0", created="now")
    write_json(RunFolder(path).info, info)


def shown(path):
    """The page of a run folder and its figures by key."""
    gallery = Sketches()
    return Page(report_html(read_contents(path), gallery)), gallery.figures
