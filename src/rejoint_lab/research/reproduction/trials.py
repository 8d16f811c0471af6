"""Fig. 9, Table 3 and Table 4: controllers on a healthy and on a worn arm, by the trials of all evaluations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.comparison.protocols import schedule
from rejoint.control.comparison.result import Columns, Protocol
from rejoint.control.controllers.observation import layout_size
from rejoint.control.controllers.policy import load_policy
from rejoint.control.loop import run
from rejoint.control.robot import Controller, Robot
from rejoint.pages.html import BLUE, RED, look_of
from rejoint.pages.report.figures import WIDE, Series, Stroke, curves
from rejoint.pages.report.page import read_curves
from rejoint.pages.report.tables import plain_table, result_columns
from rejoint.pages.words import measured
from rejoint.robots import open_robot
from rejoint.system.statistics import FEWEST_CLUSTERS, Spread
from rejoint_lab.research.evaluation.evaluate import VariantRow, classical, make_row, together
from rejoint_lab.research.evaluation.family import ArmFamily, keep, try_on
from rejoint_lab.research.reproduction.campaign import LITERALLY, WORN, Bench, Found, Grid, ranges_of, recipe
from rejoint_lab.research.reproduction.models import strokes_of, ways
from rejoint_lab.research.reproduction.paper import PAPER

DWELL = 5.0
"""[s] per target of Fig. 9; chosen"""
LAST = 5
"""last updates that are averaged; chosen"""
NAMES = {
    "default": "default",
    "pid-sum": "PID, plain sum",
    "pid-literal": "PID, as printed",
    "policy": "DT-DRL",
}


def try_arm(bench: Bench, name: str, protocol: Protocol, profile: str = "worn", *, only: str = "") -> Columns:
    """Try a controller, or the policy of a training, on all targets; ``only`` by one of the protocols.

    Results (S R, K); targets of a set are those of one "arm", or each repetition is one where sets are few.
    """
    scale = bench.scale
    crossings, holds = (scale.targets * (only in ("", kind)) for kind in ("crossing", "hold"))
    repetitions = 1 if only == "hold" else scale.repetitions
    targets = np.repeat(bench.targets, repetitions, axis=0)
    opened = partial(_open, bench, profile, len(targets))
    family = ArmFamily(arms=len(targets), targets=holds, crossings=crossings, protocol=protocol, threads=bench.threads)
    identity = repr((bench.seed, family, profile))
    path = bench.folder / "outcomes" / f"{profile}--{name}{only and f'--{only}'}.parquet"
    found = keep(path, identity, lambda: try_on(bench.arm, opened, _maker(bench, name), family, (targets, None)))
    # repetitions of a target set are no other arms, where there are sets enough
    labels = np.arange(len(targets)) // (repetitions if scale.sets >= FEWEST_CLUSTERS else 1)
    return found | {"arm": np.repeat(labels[:, None].astype(float), targets.shape[1], axis=1)}


def _maker(bench: Bench, name: str) -> Callable[[Arm], Controller]:
    if name in NAMES:
        return lambda arm: classical(name).make(arm, ())
    return partial(load_policy, bench.training(name).policy)


def _open(bench: Bench, profile: str, count: int) -> Robot:
    return open_robot(f"emulated:{profile}", arm=bench.arm, seed=bench.seed, count=count, threads=bench.threads)


def _row(name: str, outcomes: list[Columns], protocol: Protocol) -> VariantRow:
    return make_row("", name, together(outcomes), protocol)


def _mm(one: Spread | None, places: int = 2) -> str:
    if one is None:
        return "-"
    std = "" if one.std is None else f" ± {1e3 * one.std:.{places}f}"
    return f"{1e3 * one.mean.value:.2f}{std} mm"


def _ten(row: VariantRow) -> str:
    """Time [s] for all targets of a set."""
    return "-" if row.cycle_time is None else f"{row.cycle_time.mean.value:.1f}"


def measure_wear(bench: Bench) -> Found:
    """Send the default controller of a healthy and of a worn arm to the same targets."""
    protocol, found, series, means = Protocol(hold=DWELL), Found(), list[Series](), list[Array]()
    for profile, look, paper in (("healthy", BLUE, 3.09), ("worn", RED, 22.7)):
        bench.on_progress(0.5 * len(series), f"{profile} arm")
        outcome = try_arm(bench, "default", protocol, profile, only="hold")
        row, sets = _row("default", [outcome], protocol), 1e3 * outcome["settled"]
        found |= {profile: _mm(row.settled, 1), f"{profile}_true": _mm(row.settled_true, 1)}
        means.append(sets.mean(axis=1))
        label = f"{profile}, mean {sets[0].mean():.1f} mm (paper {paper:g} mm)"
        series.append(Series(label=label, look=look, value=sets[0]))
    numbers = np.arange(1.0, bench.scale.targets + 1)
    bench.draw(curves({"error by the encoders [mm]": series}, numbers, "target", (WIDE, 3.2)), "fig-9")
    healthy, worn = means
    return found | {
        "ratio": worn.mean() / healthy.mean(),
        "low": worn.min(),
        "high": worn.max(),
        "sets": bench.scale.sets,
        "targets": bench.scale.targets,
        "dwell": DWELL,
    }


def measure_trainings(bench: Bench) -> Found:
    """Compare trainings over the paper's open points, and their policies on the worn arm."""
    names, rows, success = (*WORN, *LITERALLY), [], dict[str, float]()
    for done, name in enumerate(names):
        bench.on_progress(done / len(names), f"policy of {name} on the worn arm")
        outcome, (preset, offset) = try_arm(bench, name, bench.scale.protocol, only="crossing"), recipe(name)
        trained, row = read_curves(bench.training(name).curves), _row(name, [outcome], bench.scale.protocol)
        success[name] = 100 * row.reached
        rows.append(
            (
                f"{np.degrees(preset.task.law.authority_limit):.0f}°",
                f"{np.degrees(ranges_of(bench.arm, name).joint_noise):.0f}°",
                "command - position" if preset.task.layout == "equation-16" else "last action",
                str(offset),
                f"{100 * trained.success_rate[-LAST:].mean():.0f}",
                f"{success[name]:.1f}",
                _mm(row.crossing_error).removesuffix(" mm"),
                _ten(row),
            )
        )
    headers = (
        "largest action",
        "joint noise",
        "Δθ",
        "seed",
        "success in training %, 5 mm",
        "on the worn arm %, 10 mm",
        "error at the crossing mm",
        "ten targets s",
    )
    worn = [success[name] for name in WORN]
    row = _row(
        "policy", [try_arm(bench, name, bench.scale.protocol, only="crossing") for name in WORN], bench.scale.protocol
    )
    return {
        "size": layout_size(PAPER.task.layout, bench.arm.joints),
        "transitions": trained.step[-1] / 1e6,
        "seconds": _seconds(bench),
        "success": f"{100 * row.reached:.1f} % ({min(worn):.1f} to {max(worn):.1f} over seeds)",
        "error": _mm(row.crossing_error),
        **{name.partition("-")[0]: success[name] for name in LITERALLY},
        "grids": [Grid("What the policies do on the worn arm", headers, tuple(rows))],
    }


def _seconds(bench: Bench) -> float:
    return float(np.mean([read_curves(bench.training(name).curves).wall_s[-1] for name in WORN]))


def measure_control(bench: Bench) -> Found:
    """Compare by the paper's protocol, and by holds."""
    protocol, found, rows, panels = bench.scale.protocol, Found(), list[VariantRow](), dict[str, list[Stroke]]()
    targets = bench.targets[0]
    for name, label in NAMES.items():
        policies = WORN if name == "policy" else (name,)
        bench.on_progress(len(rows) / 6, label)
        outcomes = [try_arm(bench, one, protocol) for one in policies]
        row = _row(label, outcomes, protocol)
        found |= {
            f"{name}_success": f"{measured(row.success, 100)} %",
            f"{name}_error": _mm(row.crossing_error),
            f"{name}_time": _ten(row),
        }
        rows += [_row(one, [outcome], protocol) for one, outcome in zip(policies, outcomes, strict=True)]
        panels[label] = strokes_of([_path(bench, policies[0], targets)], targets, look_of(name))
    bench.draw(ways(panels), "fig-13")
    headers, cells = plain_table(result_columns(protocol, bench.scale.targets), rows, notes=True)
    title = f"The table of the comparison: every target held for {protocol.hold:g} s as well (95 % intervals)"
    return found | {
        "seconds": _seconds(bench),
        "targets": bench.scale.targets,
        "sets": bench.scale.sets,
        "repetitions": bench.scale.repetitions,
        "grids": [Grid(title, tuple(headers), tuple(map(tuple, cells)))],
    }


def _path(bench: Bench, name: str, targets: Array) -> Array:
    """Path (T, 3) [m] by the encoders through ``targets`` (K, 3) [m]."""
    plan = schedule("crossing", bench.scale.protocol, keep_going=True)
    recording = run(_open(bench, "worn", 1), _maker(bench, name)(bench.arm), targets[None], plan)
    return tcp_position(bench.arm, recording.position[:, 0])
