"""Figs. 11 and 12: policies at the paper's task, on randomised twins that no training has seen."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq

from rejoint.arms import Array
from rejoint.control.comparison.result import Columns
from rejoint.control.controllers.observation import POINT_SCALE, Observation, layout_slots
from rejoint.control.controllers.policy import PolicyController, load_policy
from rejoint.pages.html import BLUE, ORANGE, RED, Look
from rejoint.pages.report.figures import WIDE, Series, curves
from rejoint.training.ranges import Ranges
from rejoint_lab.research.evaluation.family import keep
from rejoint_lab.research.reproduction.campaign import HEALTHY, WORN, Bench, Found, ranges_of
from rejoint_lab.research.reproduction.models import strokes_of, ways
from rejoint_lab.research.reproduction.paper import PAPER, PaperTask

DRAWN = 12
"""paths on Fig. 11; chosen"""
ARMS = 256
"""episodes of Fig. 11"""
CONVERGED = -5.0
"""Reward reached in Fig. 12 of Park et al. 2024"""
LAST = 3
"""Averaged last policies; chosen"""
CONDITIONS = {
    "with Real2Sim ranges": (WORN, "worn", BLUE),
    "without, on the worn arms": (HEALTHY, "worn", RED),
    "without, on its own normal arm": (HEALTHY, "healthy", ORANGE),
}
"""Trainings, arms on which they are judged, look"""
_SEED = 1_000_003
"""Seed increment of the evaluated arms"""


def play(
    controller: PolicyController, ranges: Ranges, arms: int, *, seed: int, noise: float = 0.0, threads: int = 1
) -> Columns:
    """Run one episode on each of N ``arms``; ``noise``: exploration in units of the action.

    Returns accumulated ``reward``, ``steps``, ``reached`` and ``collided`` (N,), the ``tcp`` (T, N, 3) [m] from the
    start, NaN after the end, and the ``target`` (N, 3) [m].
    """
    task = PaperTask(controller.arm, ranges, arms, PAPER.task, seed=_SEED + seed, threads=threads)
    rng = np.random.default_rng(seed)
    observation, _ = task.reset(staggered=False)
    target, paths = _point(observation, "target"), [_point(observation, "tcp")]
    going, found = np.ones(arms, dtype=bool), dict(zip(MEASURES, np.zeros((4, arms)), strict=True))
    while going.any():
        action = controller.act(observation) + rng.normal(0.0, noise, (arms, controller.arm.joints))
        result = task.step(action)
        events = (result.reward, going, result.terminated, result.collided)
        for total, event in zip(found.values(), events, strict=True):
            total += np.where(going, event, 0.0)
        paths.append(np.where(going[:, None], _point(result.final_observation, "tcp"), np.nan))
        going = going & ~(result.terminated | result.truncated)
        observation = result.observation
    return found | {"tcp": np.stack(paths), "target": target}


MEASURES = ("reward", "steps", "reached", "collided")


def _point(observation: Observation, name: str) -> Array:
    """Point (N, 3) [m] in observations of equation 16."""
    slots = layout_slots("equation-16", (observation.shape[1] - 10) // 3)
    at = [slot.name for slot in slots].index(name)
    begin = sum(slot.size for slot in slots[:at])
    return observation[:, begin : begin + 3].astype(float) / POINT_SCALE


def measure_paths(bench: Bench) -> Found:
    """Play the same episodes before and after training."""
    folder, ranges = bench.training(WORN[0]), ranges_of(bench.arm, "worn")
    noises = pq.read_table(folder.curves, columns=["noise"])["noise"].to_numpy()
    arms, found, played = min(ARMS, 4 * bench.scale.judged), Found(), {}
    for key, file, noise in (
        ("first", folder.snapshot(0), noises[0]),
        ("quiet", folder.snapshot(0), 0.0),
        ("last", folder.policy, 0.0),
        ("busy", folder.policy, noises[-1]),
    ):
        controller = load_policy(file, bench.arm)
        played[key] = one = play(controller, ranges, arms, seed=bench.seed, noise=noise, threads=bench.threads)
        way = np.nansum(np.linalg.norm(np.diff(one["tcp"], axis=0), axis=-1), axis=0)
        found[f"{key}_way"] = np.median(way / np.linalg.norm(one["target"] - one["tcp"][0], axis=-1))
        found |= {f"{key}_{name}": 100 * one[name].mean() for name in ("reached", "collided")}
    panels = {
        title: strokes_of(list(np.moveaxis(played[key]["tcp"][:, :DRAWN], 1, 0)), played[key]["target"][:DRAWN], look)
        for title, look, key in (("first episode, exploring", RED, "first"), ("trained", BLUE, "last"))
    }
    bench.draw(ways(panels), "fig-11")
    return found | {"arms": arms}


def measure_course(bench: Bench) -> Found:
    """Judge the policies of all trainings on the same arms."""
    jobs = [(label, name, arms) for label, (names, arms, _) in CONDITIONS.items() for name in names]
    courses: dict[str, list[Columns]] = {label: [] for label in CONDITIONS}
    for done, (label, name, arms) in enumerate(jobs):
        bench.on_progress(done / len(jobs), f"policies of {name} on {arms} arms")
        courses[label].append(course(bench, name, arms))
    cycles = PAPER.ppo.rollout * courses[label][0]["updates"]
    found = {(label, key): np.array([one[key] for one in some]) for label, some in courses.items() for key in MEASURES}
    ends = {at: values[:, -LAST:].mean(axis=1) for at, values in found.items()}
    own, other, home = CONDITIONS
    rewards = found[other, "reward"].mean(axis=0)
    below = np.flatnonzero(found[own, "reward"].mean(axis=0) <= CONVERGED)
    first = int(below[-1]) + 1 if len(below) else 0
    better = ends[own, "reward"].min() > ends[other, "reward"].max()
    told = {
        f"{label}_{key}": _range(factor * ends[name, key])
        for label, name in (("own", own), ("other", other), ("home", home))
        for key, factor in zip(MEASURES, (1.0, 1.0, 100.0, 100.0), strict=True)
    }
    panels = {
        f"{name} per episode": [_over(one, look, found[one, key]) for one, (_, _, look) in CONDITIONS.items()]
        for key, name in (("reward", "reward"), ("steps", "time steps"))
    }
    bench.draw(curves(panels, cycles, "time steps of each agent", (WIDE, 3.5)), "fig-12")
    return told | {
        "converged": f"{cycles[first]:.0f}" if first < len(cycles) else "never",
        "highest": cycles[np.argmax(rewards)],
        "apart": "yes" if better and ends[own, "steps"].max() < ends[other, "steps"].min() else "no",
        "every": bench.scale.snapshot_every * PAPER.ppo.rollout,
        "judged": bench.scale.judged,
    }


def _range(values: Array) -> str:
    return f"{values.mean():.3g} ({values.min():.3g} to {values.max():.3g})"


def course(bench: Bench, name: str, arms: str) -> Columns:
    """Judge the policies of a training: means (K,) over the episodes, with the ``updates`` (K,) of the policies."""
    folder = bench.training(name)
    files = {int(file.stem.rpartition("-")[2]): file for file in sorted(folder.training.glob("policy-*.onnx"))}
    files[max(files) + bench.scale.snapshot_every] = folder.policy

    def judge() -> Columns:
        played = [
            play(
                load_policy(file, bench.arm), ranges_of(bench.arm, arms), count, seed=bench.seed, threads=bench.threads
            )
            for file in files.values()
        ]
        means = {key: np.array([one[key].mean() for one in played]) for key in MEASURES}
        return means | {"updates": np.array(list(files), dtype=float)}

    count = bench.scale.judged
    identity = repr((name, arms, count, bench.seed))
    return keep(folder.path / f"course-{arms}.parquet", identity, judge)


def _over(label: str, look: Look, values: Array) -> Series:
    """Means of ``values`` (R, K), with the smallest and the largest."""
    known = np.isfinite(values).any(axis=0)
    mean, low, high = found = np.full((3, values.shape[1]), np.nan)
    found[:, known] = [over(values[:, known], axis=0) for over in (np.nanmean, np.nanmin, np.nanmax)]
    return Series(label=label, look=look, value=mean, low=low, high=high)
