"""What the experiments measure.

Figs. 11 and 12: policies at the paper's task, on randomised twins that no training has seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pyarrow.parquet as pq
from matplotlib.figure import Figure

from rejoint.arms import Arm, Array, mycobot280, solve_position, tcp_position
from rejoint.arms.arm import dh_chain
from rejoint.control.comparison.compare import Ledger, Settings, TrialRunner
from rejoint.control.comparison.result import (
    METRICS,
    Columns,
    Comparison,
    ControllerRow,
    Key,
    row_of,
)
from rejoint.control.controllers.observation import Observation, layout_factors, layout_slots
from rejoint.control.controllers.policy import PolicyController, load_policy
from rejoint.control.correction import tool_error
from rejoint.pages.html import INK, LOOKS, Look, look_of
from rejoint.pages.report.figures import WIDE, Series, Stroke, canvas, curves, plane
from rejoint.pages.report.page import read_curves
from rejoint.pages.report.tables import plain_table, result_columns
from rejoint.pages.words import measured
from rejoint.robots import open_robot
from rejoint.system.files import read_shipped
from rejoint.system.shell import __version__
from rejoint.system.statistics import Spread
from rejoint.training.ranges import Ranges
from rejoint.twin.simulation import ChainBatch, Draw
from rejoint_lab.research.evaluation.evaluate import classical
from rejoint_lab.research.reproduction.campaign import (
    HEALTHY,
    LITERALLY,
    PAPER,
    WORN,
    Bench,
    Found,
    Grid,
    PaperRanges,
    PaperTask,
    ranges_of,
    recipe,
)

POSTURES = 1000

_TABLES = read_shipped(__file__, "dh.toml", dict[str, list[list[float]]])
PAPER_DH_TABLE, DH_TABLE = (
    np.array(_TABLES[whose]) * [1.0, 1.0, np.pi / 180, np.pi / 180] for whose in ("paper", "vendor")
)
"""d [m], a [m], alpha [rad], offset [rad] of `dh_chain`: Table 1 of Park et al. 2024, and the vendor's"""

PAPER_ANGLE_SHIFT = np.radians([180.0, -90.0, 0.0, 90.0, 90.0, 0.0])
"""Angles of the paper minus the vendor's"""


def measure_kinematics(bench: Bench) -> Found:
    """Compare both tables."""
    vendor, paper = mycobot280(), paper_arm(PAPER_DH_TABLE)
    rows = PAPER_DH_TABLE.copy()
    rows[[0, 4], 0] = DH_TABLE[[0, 4], 0]
    postures = vendor.drawn(POSTURES, bench.seed)
    places = tcp_position(vendor, postures)
    apart, equal = (
        1e3 * tool_error(other, postures + PAPER_ANGLE_SHIFT, places).max() for other in (paper, paper_arm(rows))
    )
    names = ("offset °", "d mm", "a mm", "α °")
    headers = ("joint", *(f"{whose}: {name}" for whose in ("paper", "vendor") for name in names))
    tables = zip(PAPER_DH_TABLE, DH_TABLE, strict=True)
    cells = [(str(i), *_cells(paper), *_cells(vendor)) for i, (paper, vendor) in enumerate(tables, start=1)]
    return {
        "apart": apart,
        "equal": equal,
        "postures": POSTURES,
        "shift": ", ".join(f"{angle:.0f}" for angle in np.degrees(PAPER_ANGLE_SHIFT)),
        "encoder": np.degrees(vendor.encoder_step),
        "grids": [Grid("Both tables", headers, cells)],
    }


def paper_arm(rows: Array) -> Arm:
    """Build the myCobot 280 from a table of the paper."""
    vendor, (offset, axis, tip) = mycobot280(), dh_chain(rows)
    shifted = {name: getattr(vendor, name) + PAPER_ANGLE_SHIFT for name in ("lower", "upper", "rest")}
    return replace(vendor, offset=offset, axis=axis, tip=tip, **shifted)


def _cells(row: Array) -> tuple[str, ...]:
    d, a, alpha, offset = row
    return f"{np.degrees(offset):g}", f"{1e3 * d:.5g}", f"{1e3 * a:.5g}", f"{np.degrees(alpha):g}"


PAIRS = ((1e4, 1e3), (1e3, 50.0), (200.0, 10.0))
"""Park et al. 2024, section IV-C"""
STEP = 1.0 / 240.0
"""[s] time step"""
FIG_10_DWELL = 2.0
"""[s] per target; chosen"""
WINDOW = 0.25
"""[s] at the end of a target; chosen"""
BOUNDLESS = 1e6
"""[N m] no torque limit, as in equation 12"""
VISITS = 6
"""targets on the figure; chosen"""


def measure_gains(bench: Bench) -> Found:
    """Move twins to the same targets, in both units."""
    targets = bench.targets[0, :VISITS]
    ours, literal = PaperRanges(arm=bench.arm), PaperRanges(arm=bench.arm, stiffness_unit=1.0, damping_unit=1.0)
    paths, printed = (trace(bench, ranges, targets) for ranges in (ours, literal))
    panels = {
        f"P = {p:g}, D = {d:g}": strokes_of([path], targets, look)
        for (p, d), look, path in zip(PAIRS, (LOOKS["blue"], LOOKS["orange"], LOOKS["red"]), paths, strict=True)
    }
    bench.draw(ways(panels, views=("from above",)), "fig-10")
    shown = [
        [f"{e:.2g} mm, {o:.0f} %" for e, o in (judge(path, targets) for path in some)] for some in (paths, printed)
    ]
    rows = [(f"{p:g}", f"{d:g}", *cells) for (p, d), *cells in zip(PAIRS, *shown, strict=True)]
    headers = ("P", "D", "rescaled: error, overshoot", "P in N m/rad: error, overshoot")
    return {
        **dict(zip(("stiff", "soft", "softest"), shown[0], strict=True)),
        "count": len(targets),
        "dwell": FIG_10_DWELL,
        "window": WINDOW,
        "literal": judge(printed[2], targets)[0],
        "p": ours.stiffness_unit,
        "d": ours.damping_unit,
        "grids": [Grid("Both readings of the units", headers, rows)],
    }


def trace(bench: Bench, ranges: PaperRanges, targets: Array) -> Array:
    """Move twins to ``targets`` (K, 3) [m]; returns paths (3, T, 3) [m]."""
    arm = bench.arm
    twins, free = ChainBatch(arm, len(PAIRS), timestep=STEP), ranges.twins(*np.array(PAIRS).T[..., None])
    twins.write(Draw.of(replace(free, torque_limit=np.array(BOUNDLESS))))
    twins.restart(arm.rest)
    steps, goal, paths = round(FIG_10_DWELL / STEP), arm.rest, []
    for target in targets:
        goal = solve_position(arm, target, goal).q
        paths.append(tcp_position(arm, twins.rollout(np.broadcast_to(goal, (len(PAIRS), steps, arm.joints)))))
    return np.concatenate(paths, axis=1)


def judge(path: Array, targets: Array) -> tuple[float, float]:
    """Mean error [mm] and overshoot [%] of a path (T, 3) [m]."""
    last, errors, overshoots = round(WINDOW / STEP), [], []
    start = path[0]
    for part, target in zip(np.split(path, len(targets)), targets, strict=True):
        end = part[-last:].mean(axis=0)
        errors.append(1e3 * np.linalg.norm(part[-last:] - target, axis=-1).mean())
        way = end - start
        along = (part - start) @ way / (way @ way)
        overshoots.append(100.0 * max(float(along.max()) - 1.0, 0.0))
        start = end
    return float(np.mean(errors)), float(np.mean(overshoots))


def ways(panels: Mapping[str, Sequence[Stroke]], views: Sequence[str] = ("from above", "from the side")) -> Figure:
    """Draw each panel in ``views``, one below the other, on common axes."""
    figure, grid = canvas((WIDE, 4.0 * len(views)), len(views), len(panels), sharex="row", sharey="row")
    for (row, column), axes in np.ndenumerate(grid):
        title, strokes = list(panels.items())[column]
        plane(axes, views[row], strokes, "" if row else title)
    return figure


def strokes_of(paths: Sequence[Array], targets: Array, look: Look) -> list[Stroke]:
    """TCP ``paths`` (T, 3) [m] with their starts, and ``targets`` (K, 3) [m]."""
    width, colour = 0.8 if len(paths) > 1 else 1.1, look.colour
    return [
        *((path, {"color": colour, "linewidth": width}) for path in paths),
        (np.stack([path[0] for path in paths]), {"color": colour, "marker": "s", "markersize": 4, "linestyle": ""}),
        (targets, {"color": INK, "marker": "+", "markersize": 6, "linestyle": ""}),
    ]


DRAWN = 12
"""paths on Fig. 11; chosen"""
ARMS = 256
"""episodes of Fig. 11"""
CONVERGED = -5.0
"""Reward reached in Fig. 12 of Park et al. 2024"""
LAST_POLICIES = 3
"""Averaged last policies; chosen"""
CONDITIONS = {
    "with Real2Sim ranges": (WORN, "worn", LOOKS["blue"]),
    "without, on the worn arms": (HEALTHY, "worn", LOOKS["red"]),
    "without, on its own normal arm": (HEALTHY, "healthy", LOOKS["orange"]),
}
"""Trainings, arms on which they are judged, look"""
_SEED = 1_000_003
"""Seed increment of the evaluated arms"""


def play(controller: PolicyController, ranges: Ranges, arms: int, *, seed: int, noise: float = 0.0) -> Columns:
    """Run one episode on each of N ``arms``; ``noise``: exploration in units of the action.

    Returns accumulated ``reward``, ``steps``, ``reached`` and ``collided`` (N,), the ``tcp`` (T, N, 3) [m] from the
    start, NaN after the end, and the ``target`` (N, 3) [m].
    """
    task = PaperTask(controller.arm, ranges, arms, PAPER.task, seed=_SEED + seed)
    rng = np.random.default_rng(seed)
    observation, _ = task.reset(staggered=False)
    target, paths = _point(observation, "target"), [_point(observation, "tcp")]
    going, found = np.ones(arms, dtype=bool), dict(zip(MEASURES, np.zeros((4, arms)), strict=True))
    while going.any():
        result = task.step(controller.act(observation) + rng.normal(0.0, noise, (arms, controller.arm.joints)))
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
    joints = (observation.shape[1] - 10) // 3
    slots = layout_slots("equation-16", joints)
    own = np.repeat([slot.name == name for slot in slots], [slot.size for slot in slots])
    return observation[:, own].astype(float) / layout_factors("equation-16", joints)[own]


def measure_paths(bench: Bench) -> Found:
    """Play the same episodes before and after training."""
    folder, ranges = bench.training(WORN[0]), ranges_of(bench.arm, "worn")
    noises = pq.read_table(folder.curves, columns=["noise"])["noise"].to_numpy()
    arms, found, played = min(ARMS, 4 * bench.judged), Found(), {}
    for key, file, noise in (
        ("first", folder.snapshot(0), noises[0]),
        ("quiet", folder.snapshot(0), 0.0),
        ("last", folder.policy, 0.0),
        ("busy", folder.policy, noises[-1]),
    ):
        controller = load_policy(file, bench.arm)
        played[key] = one = play(controller, ranges, arms, seed=bench.seed, noise=noise)
        way = np.nansum(np.linalg.norm(np.diff(one["tcp"], axis=0), axis=-1), axis=0)
        found[f"{key}_way"] = np.median(way / np.linalg.norm(one["target"] - one["tcp"][0], axis=-1))
        found |= {f"{key}_{name}": 100 * one[name].mean() for name in ("reached", "collided")}
    panels = {
        title: strokes_of(list(np.moveaxis(played[key]["tcp"][:, :DRAWN], 1, 0)), played[key]["target"][:DRAWN], look)
        for title, look, key in (
            ("first episode, exploring", LOOKS["red"], "first"),
            ("trained", LOOKS["blue"], "last"),
        )
    }
    bench.draw(ways(panels), "fig-11")
    return found | {"arms": arms}


def measure_course(bench: Bench) -> Found:
    """Judge the policies of all trainings on the same arms."""
    found = {}
    for done, (label, (names, arms, _)) in enumerate(CONDITIONS.items()):
        bench.on_progress(done / len(CONDITIONS), f"policies {label}")
        each = [course(bench, name, arms) for name in names]
        found[label] = {key: np.array([one[key] for one in each]) for key in each[0]}
    own, other, home = found.values()
    cycles = PAPER.ppo.rollout * own["updates"][0]
    below = np.flatnonzero(own["reward"].mean(axis=0) <= CONVERGED)
    first = int(below[-1]) + 1 if len(below) else 0
    ends = {
        f"{name}_{key}": factor * one[key][:, -LAST_POLICIES:].mean(axis=1)
        for name, one in (("own", own), ("other", other), ("home", home))
        for key, factor in zip(MEASURES, (1.0, 1.0, 100.0, 100.0), strict=True)
    }
    better = ends["own_reward"].min() > ends["other_reward"].max()
    panels = {
        f"{name} per episode": [_over(label, one[key]) for label, one in found.items()]
        for key, name in (("reward", "reward"), ("steps", "time steps"))
    }
    bench.draw(curves(panels, cycles, "time steps of each agent", (WIDE, 3.5)), "fig-12")
    return {name: f"{one.mean():.3g} ({one.min():.3g} to {one.max():.3g})" for name, one in ends.items()} | {
        "converged": f"{cycles[first]:.0f}" if first < len(cycles) else "never",
        "highest": cycles[np.argmax(other["reward"].mean(axis=0))],
        "apart": "yes" if better and ends["own_steps"].max() < ends["other_steps"].min() else "no",
        "every": bench.snapshot_every * PAPER.ppo.rollout,
        "judged": bench.judged,
    }


def course(bench: Bench, name: str, arms: str) -> Columns:
    """Judge the policies of a training: means (K,) over the episodes, with the ``updates`` (K,) of the policies."""
    folder, ranges = bench.training(name), ranges_of(bench.arm, arms)
    files = {int(file.stem.rpartition("-")[2]): file for file in sorted(folder.training.glob("policy-*.onnx"))}
    files[max(files) + bench.snapshot_every] = folder.policy
    played = [play(load_policy(file, bench.arm), ranges, bench.judged, seed=bench.seed) for file in files.values()]
    means = {key: np.array([one[key].mean() for one in played]) for key in MEASURES}
    return means | {"updates": np.array(list(files), float)}


def _over(label: str, values: Array) -> Series:
    """Means of ``values`` (R, K), with the smallest and the largest."""
    mean, *band = (over(axis=0) for over in (values.mean, values.min, values.max))
    return Series(label=label, look=CONDITIONS[label][2], value=mean, band=band)


FIG_9_DWELL = 5.0
"""[s] per target of Fig. 9; chosen"""
LAST_UPDATES = 5
"""last updates that are averaged; chosen"""
NAMES = {
    "default": "default",
    "pid-sum": "PID, plain sum",
    "pid-literal": "PID, as printed",
    "policy": "DT-DRL",
}


def trials(bench: Bench, profile: str, names: Sequence[str]) -> TrialRunner:
    """Trials of controllers, or policies of trainings, on a kind of arm; what is kept of them is not driven again."""
    file = bench.folder / "trials" / f"{profile}-hold-{bench.protocol.hold:g}s.json"
    return TrialRunner(
        lambda count, seed: open_robot(f"emulated:{profile}", arm=bench.arm, seed=seed, count=count),
        {
            name: partial(classical(name).make, ())
            if name in NAMES
            else partial(load_policy, bench.training(name).policy)
            for name in names
        },
        bench.targets,
        Settings(repetitions=bench.repetitions, seed=bench.seed, batched=True, protocol=bench.protocol),
        ledger=Ledger(file, repr((__version__, bench.protocol))),
        on_progress=bench.on_progress,
    )


def _together(found: Comparison, names: Sequence[str]) -> ControllerRow:
    """Statistics of trainings that count as repetitions of one."""
    columns = {
        metric: np.concatenate([found.array(metric, name) for name in names], axis=1)
        for metric in (*METRICS, *found.protocol.stay_names)
    }
    return row_of(names[0], columns, found.protocol)


def _mm(one: Spread | None, places: int = 2) -> str:
    if one is None:
        return "-"
    std = "" if one.std is None else f" ± {1e3 * one.std:.{places}f}"
    return f"{1e3 * one.mean.value:.2f}{std} mm"


def _ten(row: ControllerRow) -> str:
    """Time [s] for all targets of a set."""
    return "-" if row.cycle_time is None else f"{row.cycle_time.mean.value:.1f}"


def measure_wear(bench: Bench) -> Found:
    """Send the default controller of a healthy and of a worn arm to the same targets."""
    brief = replace(bench, protocol=replace(bench.protocol, hold=FIG_9_DWELL), repetitions=1)
    found, series, means = Found(), [], []
    for profile, look, paper in (("healthy", LOOKS["blue"], 3.09), ("worn", LOOKS["red"], 22.7)):
        compared = trials(brief, profile, ["default"]).compare()
        (row,), sets = compared.rows, 1e3 * compared.array("settled", "default")[:, 0]
        found |= {profile: _mm(row.settled, 1), f"{profile}_true": _mm(row.settled_true, 1)}
        means.append(sets.mean(axis=1))
        label = f"{profile}, mean {sets[0].mean():.1f} mm (paper {paper:g} mm)"
        series.append(Series(label=label, look=look, value=sets[0]))
    numbers = np.arange(1.0, bench.count + 1)
    bench.draw(curves({"error by the encoders [mm]": series}, numbers, "target", (WIDE, 3.2)), "fig-9")
    healthy, worn = means
    return found | {
        "ratio": worn.mean() / healthy.mean(),
        "low": worn.min(),
        "high": worn.max(),
        "sets": bench.sets,
        "targets": bench.count,
        "dwell": FIG_9_DWELL,
    }


def measure_trainings(bench: Bench) -> Found:
    """Compare trainings over the paper's open points, and their policies on the worn arm."""
    rows, success = [], {}
    compared = trials(bench, "worn", (*WORN, *LITERALLY)).compare()
    for row in compared.rows:
        name, (preset, offset) = row.controller, recipe(row.controller)
        trained, success[name] = read_curves(bench.training(name).curves), 100 * row.reached
        rows.append(
            (
                f"{np.degrees(preset.task.law.authority_limit):.0f}°",
                f"{np.degrees(ranges_of(bench.arm, name).joint_noise):.0f}°",
                "command - position" if preset.task.layout == "equation-16" else "last action",
                str(offset),
                f"{100 * trained.success_rate[-LAST_UPDATES:].mean():.0f}",
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
    row = _together(compared, WORN)
    return {
        "size": len(layout_factors(PAPER.task.layout, bench.arm.joints)),
        "transitions": trained.step[-1] / 1e6,
        "seconds": _seconds(bench),
        "success": f"{100 * row.reached:.1f} % ({min(worn):.1f} to {max(worn):.1f} over seeds)",
        "error": _mm(row.crossing_error),
        **{name.partition("-")[0]: success[name] for name in LITERALLY},
        "grids": [Grid("What the policies do on the worn arm", headers, rows)],
    }


def _seconds(bench: Bench) -> float:
    return float(np.mean([read_curves(bench.training(name).curves).wall_s[-1] for name in WORN]))


def measure_control(bench: Bench) -> Found:
    """Compare by the paper's protocol, and by holds."""
    found, panels = Found(), {}
    policies = {name: WORN if name == "policy" else (name,) for name in NAMES}
    runner = trials(bench, "worn", [one for names in policies.values() for one in names])
    compared = runner.compare()
    for name, names in policies.items():
        row = _together(compared, names)
        found |= {
            f"{name}_success": f"{measured(row.success, 100)} %",
            f"{name}_error": _mm(row.crossing_error),
            f"{name}_time": _ten(row),
        }
        _, recording = runner.drive_batch(Key(names[0], "crossing", ((0, 0),)))
        path = tcp_position(bench.arm, recording.position[:, 0])
        panels[NAMES[name]] = strokes_of([path], bench.targets[0], look_of(name))
    bench.draw(ways(panels), "fig-13")
    headers, cells = plain_table(result_columns(bench.protocol, bench.count), compared.rows, notes=True)
    title = f"The table of the comparison: every target held for {bench.protocol.hold:g} s as well (95 % intervals)"
    return found | {
        "seconds": _seconds(bench),
        "targets": bench.count,
        "sets": bench.sets,
        "repetitions": bench.repetitions,
        "grids": [Grid(title, headers, cells)],
    }
