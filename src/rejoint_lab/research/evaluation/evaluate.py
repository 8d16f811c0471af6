"""Controllers that take part in an evaluation, their trials on many arms, and what is concluded from them.

Intervals resample whole arms. Calibrations take part like controllers. Along moving targets each arm is first diagnosed
and identified; the twins are kept.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import Ledger
from rejoint.control.comparison.result import MODELLED, Columns, Comparison, ControllerRow, comparison_of, row_of
from rejoint.control.controllers.catalogue import (
    BASELINES,
    PREDICTIVE,
    SHELF,
    make_controller,
    shelf_arms,
    shelf_controller,
    shelf_path,
    shelf_policy,
)
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import load_policy
from rejoint.control.correction import NOT_KNOWN
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import Along, judge, missed, next_aim
from rejoint.control.moving.reference import LAG, LEAD_IN, STANDARD, Guide, PathReference, Stream, standard_path
from rejoint.control.moving.reference import Path as MotionPath
from rejoint.control.moving.tracker import PathPostures, Tracker, command_for
from rejoint.control.recording import Recording
from rejoint.control.robot import Controller
from rejoint.control.start import play
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.procedure import Suggestion, before, suggest
from rejoint.logs.history import plain_name, setup_of
from rejoint.pages.report.tables import ResultColumns, plain_table, result_columns
from rejoint.pages.words import MM, Cell, measured, number
from rejoint.session.context import believed_motors
from rejoint.system.errors import InputError
from rejoint.system.files import digest, write_json
from rejoint.system.progress import Progress, part
from rejoint.system.records import value_type
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, Spread, clustered_share, paired_difference, spread
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import (
    ArmFamily,
    Variant,
    family_targets,
    open_family,
    own_twins,
    targets_anywhere,
    try_on,
)
from rejoint_lab.research.rivals import RIVALS


class Contestant(NamedTuple):
    """One controller of an evaluation."""

    name: str
    """unique, such as ``policy default #0``"""
    make: Callable[[Sequence[Twin], Arm], Controller]
    """from the twins of the arms, if they have any"""
    identity: str
    """changes with everything that the behaviour depends on, except the software"""
    ours: bool = False
    """whether it is compared with all others, and is no rival itself"""
    calibrations: Callable[[Variant], Sequence[Calibration]] | None = None
    """of each arm, where they correct its targets"""


KNOWN = (*BASELINES, *RIVALS, SHELF)
"""Names that need neither file nor twins"""


def classical(name: str, gains: Mapping[str, Mapping[str, float]] | None = None) -> Contestant:
    """Baseline or rival by name; ``gains`` replace its own; InputError for other names or gains."""
    if name not in (*KNOWN, PREDICTIVE):
        raise InputError(f"no controller is called {name!r}; known: {', '.join(KNOWN)}, and --policy FILE")
    rival = RIVALS.get(name)
    own = {} if rival is None else rival.tuned if gains is None else gains.get(name, {})
    if rival and own.keys() != rival.gains.keys():
        raise InputError(f"{name}: gains {sorted(own)}, expected {sorted(rival.gains)}")
    shelf = _digest(*(shelf_path(arm) for arm in shelf_arms())) if name == SHELF else ""

    def make(twins: Sequence[Twin], arm: Arm) -> Controller:
        if rival:
            return rival.make(arm, own)
        if name == PREDICTIVE and twins:
            return planned(arm, twins)
        return make_controller(name, arm, stiffness=_stiffness(twins) if twins else None)

    return Contestant(name, make, f"{name} {sorted(own.items())} {shelf}", ours=name == SHELF)


def planned(arm: Arm, twins: Sequence[Twin]) -> Controller:
    """Predictive control on the arms' own twins, with the generic policy or, without one, the feed-forward."""
    return PredictiveController.of(
        arm, twins, shelf_controller(arm) if arm.name in shelf_arms() else FeedforwardController(arm, _stiffness(twins))
    )


def _stiffness(twins: Sequence[Twin]) -> Array:
    return np.stack([twin.parameters.stiffness for twin in twins])


def learned(path: Path, arm: Arm) -> Contestant:
    """Policy from a file; FileError or ContractError for a wrong one."""
    contract = load_policy(path, arm).contract
    name = f"policy {contract.preset}{' on its twin' if contract.twin_digest else ''} #{contract.seed}"
    return Contestant(name, lambda _, arm: load_policy(path, arm), _digest(path), ours=True)


def _digest(*files: Path) -> str:
    return digest(b"".join(file.read_bytes() for file in files))


def group_of(name: str) -> str:
    """Return what tables put together: the name of a contestant without its training seed."""
    return name.partition(" #")[0]


@value_type
class Pair:
    """A controller against another, target by target on the same arms."""

    variant: str
    controller: str
    rival: str
    differences: dict[str, Estimate | None]
    """[m] or [s] by column, negative where the controller is better; never: the hold's length"""


@value_type
class Evaluation:
    """A comparison under each condition: arms are its target sets, seeds of a learner its repetitions."""

    family: ArmFamily
    comparisons: dict[str, Comparison]
    """by variant; controllers without their training seeds"""
    best: dict[str, str]
    """per variant, the rival that is soonest within the narrowest distance, else the nearest"""
    pairs: tuple[Pair, ...]
    """each of ours against all others"""


def evaluate(
    arm: Arm,
    contestants: Sequence[Contestant],
    variants: Collection[Variant],
    family: ArmFamily,
    file: Path,
    on_progress: Progress,
) -> Evaluation:
    """Evaluate on all variants and write the JSON ``file``, with finished trials, and twins, beside it.

    Finished trials are taken over. InputError for two contestants of one name, ContractError for an arm without a
    generic policy.
    """
    names = [one.name for one in contestants]
    if SHELF in names:
        shelf_policy(arm)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"these take part twice: {', '.join(twice)}; policies need different training seeds")
    twins = cache(lambda: own_twins(arm, family.wear_seeds, file.parent, family.seed))
    comparisons, total = dict[str, Comparison](), len(variants) * len(contestants)
    for variant in variants:
        known = twins() if variant.twins else ()
        targets, ways = family_targets(arm, family, variant.draw), None
        if variant.anywhere:
            targets[:, : family.targets], ways = targets_anywhere(arm, family, twins())
        found: dict[str, list[Columns]] = {}
        for place, one in enumerate(contestants, start=len(comparisons) * len(contestants)):
            calibrations = None if one.calibrations is None else partial(one.calibrations, variant)
            kept = file.parent / "outcomes" / f"{plain_name(f'{variant.name}--{one.name}')}.json"
            identity = repr((__version__, setup_of(arm), variant, one.identity, family))
            columns = try_on(
                arm,
                partial(open_family, arm, variant, family),
                partial(one.make, known),
                family,
                (targets, ways),
                calibrations,
                ledger=Ledger(kept, identity),
                on_progress=part(on_progress, place / total, (place + 1) / total, f"{variant.name}: {one.name}"),
            )
            found.setdefault(group_of(one.name), []).append(columns)
        comparisons[variant.name] = together(found, targets, family)
    result = judged(family, comparisons, {group_of(one.name) for one in contestants if one.ours})
    write_json(file, result)
    return result


def judged(family: ArmFamily, comparisons: dict[str, Comparison], ours: Collection[str]) -> Evaluation:
    """Compare each of ``ours`` with all others, per variant."""
    best, pairs = dict[str, str](), list[Pair]()
    for variant, found in comparisons.items():
        if rivals := [row for row in found.rows if row.controller not in ours]:
            best[variant] = min(rivals, key=_late).controller
        for one, rival in product(found.controllers, found.controllers):
            if one in ours and one != rival:
                pairs.append(pair(variant, found, one, rival))
    return Evaluation(family=family, comparisons=comparisons, best=best, pairs=tuple(pairs))


def together(found: Mapping[str, Sequence[Columns]], targets: Array, family: ArmFamily) -> Comparison:
    """Comparison of results (A, K) by controller and training seed, at ``targets`` (A, K, 3) [m]."""
    seeds, protocol = max(map(len, found.values())), family.protocol
    arms = np.indices((len(targets), seeds, targets.shape[1]))[0].ravel()
    keys = dict.fromkeys(key for each in found.values() for key in each[0])  # in order: the file is then the same

    def stacked(each: Sequence[Columns], key: str) -> Array:
        missing = np.full(targets.shape[:2], np.nan)
        return np.stack([one.get(key, missing) for one in (*each, *[{}] * (seeds - len(each)))], axis=1)

    whole = {name: {key: stacked(each, key) for key in keys} for name, each in found.items()}
    rows = tuple(row_of(name, columns, protocol, labels=arms) for name, columns in whole.items())
    return comparison_of(whole, targets, seed=family.seed, batched=True, protocol=protocol, rows=rows)


def pair(variant: str, found: Comparison, controller: str, rival: str) -> Pair:
    """Compare two controllers on the same arms and targets, as means over their training seeds."""
    names = ("settled", "settled_true", *found.protocol.stay_names, "crossing_time")
    means = {
        name: [np.ma.masked_invalid(found.array(name, one)).mean(axis=1).filled(np.nan) for one in (controller, rival)]
        for name in names
    }
    means["cycle_time"] = [found.shape[-1] * one for one in means.pop("crossing_time")]
    arms = np.indices(means["settled"][0].shape)[0].ravel()
    return Pair(
        variant=variant,
        controller=controller,
        rival=rival,
        differences={name: paired_difference(one.ravel(), other.ravel(), arms) for name, (one, other) in means.items()},
    )


def _late(row: ControllerRow) -> tuple[float, float]:
    return (row.stays[-1].median or np.inf) if row.stays else np.inf, row.settled.mean.value if row.settled else np.inf


FAR = 0.005
"""[m] settled encoder error beyond which a hold counts as failed"""


def outside(found: Comparison, controller: str) -> Array:
    """1 where a hold (A, seeds, K) ended beyond 5 mm or was stopped, else 0; NaN where there was none."""
    held = found.array("held", controller)
    return np.where(held == 1.0, ~(found.array("settled", controller) <= FAR), np.nan)


def inside(found: Mapping[str, Array]) -> Array:
    """1 where a true error lies in the interval of the calibration, else 0; NaN where either is not known."""
    error = found["settled_true"]
    hit = (error >= found["modelled_low"]) & (error <= found["modelled_high"])
    return np.where(np.isfinite(error + found["modelled_high"]), hit, np.nan)


def _columns(found: Comparison) -> ResultColumns:
    """Columns of a table, with those of calibrated arms."""

    def share(values: Array) -> Cell:
        arms = np.indices(values.shape)[0].ravel()
        return measured(clustered_share(values.ravel(), arms) if np.isfinite(values).any() else None, 100.0)

    columns = result_columns(found.protocol, found.shape[-1]) | {
        "95 % below, encoders [mm]": lambda row: _p95(row.settled, 3),
        "95 % below, true [mm]": lambda row: _p95(row.settled_true, 2),
        "farther than 5 mm [%]": lambda row: share(outside(found, row.controller)),
    }
    if "modelled" not in found.results:
        return columns
    return columns | {
        "expected by the calibration [mm]": lambda row: Cell((row.settled_modelled or NOT_KNOWN).millimetres),
        "in its interval [%]": lambda row: share(
            inside({name: found.array(name, row.controller) for name in ("settled_true", *MODELLED)})
        ),
        "corrected arms [%]": lambda row: share(found.array("used", row.controller)),
    }


def terminal_tables(evaluation: Evaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of a table per variant, and of pairs with its best rival."""
    tables = [
        (f"{variant}: {len(found.targets)} arms", *plain_table(_columns(found), found.rows))
        for variant, found in evaluation.comparisons.items()
    ]
    pairs = [one for one in evaluation.pairs if one.rival == evaluation.best.get(one.variant)]
    if pairs:
        factor = {name: (MM, "[mm]") if name.startswith("settled") else (1.0, "[s]") for name in pairs[0].differences}
        units = [f"{name} {unit}" for name, (_, unit) in factor.items()]
        rows = [
            [
                one.variant,
                f"{one.controller} against {one.rival}",
                *(str(measured(value, factor[name][0])) for name, value in one.differences.items()),
            ]
            for one in pairs
        ]
        headers = ["variant", "against the best rival", *units]
        tables.append(("Paired differences, 95 % intervals over arms", headers, rows))
    return tables


def _p95(one: Spread | None, digits: int) -> Cell:
    return Cell(number(None if one is None else one.p95 * MM, digits))


POINTS = (1, 3, 5, 10, 20)
"""Numbers of measurements from which arms are calibrated"""
SIGMA = 5e-4
"""[m] noise of each measured coordinate (chosen: a vernier ruler)"""
SPEED, WAIT = 0.5, 1.5
"""[rad/s] and [s]: speed to a posture, and wait before measuring (chosen)"""


def evaluate_calibrations(
    arm: Arm,
    conditions: Collection[Variant],
    contestant: Contestant,
    family: ArmFamily,
    file: Path,
    on_progress: Progress,
) -> Evaluation:
    """Try calibrations of the first 1, 3, ... measurements in the target region, and anywhere."""
    suggestion = suggest(arm, max(POINTS), visits=2, sigma=SIGMA)

    measured = cache(lambda arms: measure(open_family(arm, arms, family), suggestion, family.seed))
    calibrated = cache(lambda count, arms: [fit(arm, one.rows(np.arange(count))) for one in measured(arms)])
    places = {
        replace(one, name=f"{one.name}, {where}", anywhere=anywhere, draw=1): one
        for one in conditions
        for where, anywhere in (("target region", False), ("anywhere", True))
    }

    def by(count: int) -> Contestant:
        return contestant._replace(
            name=f"{count} points", ours=True, calibrations=lambda variant: calibrated(count, places[variant])
        )

    contestants = [contestant._replace(name="not calibrated", ours=False), *map(by, POINTS)]
    return evaluate(arm, contestants, places, family, file, on_progress)


def measure(robot: EmulatedRobot, suggestion: Suggestion, seed: int) -> list[Measurements]:
    """Bring all arms to the postures and measure their tools with noise; measurements of each arm."""
    rng = np.random.default_rng([seed, 3])
    sent, found = robot.read().position, []
    for visit, place in enumerate(suggestion.postures):
        for goal in (before(place, visit), place):
            sent = _go(robot, sent, goal)
        last = [robot.step(sent).position for _ in range(8)]
        point = robot.true_tcp() + rng.normal(0.0, SIGMA, (robot.count, 3))
        found.append((np.mean(last, axis=0), point))
    sigma, posture = np.full(len(found), SIGMA), suggestion.posture
    each = zip(*(np.stack(parts, axis=1) for parts in zip(*found, strict=True)), strict=True)
    return [Measurements(position=position, point=point, sigma=sigma, posture=posture) for position, point in each]


def _go(robot: EmulatedRobot, sent: Array, goal: Array) -> Array:
    """Bring all arms to ``goal`` (n,) [rad] and wait; returns the last command (B, n)."""
    way = goal - sent
    duration = float(np.abs(way).max()) / SPEED
    recording = play(robot, lambda time: sent + np.minimum(time / duration, 1.0)[:, None] * way, duration + WAIT)
    return recording.command[-1]


RATE = 30.0
"""[Hz] of a path's setpoints where it is not known ahead"""
REPETITIONS = 10
BLOCK = 5
"""Arms that move side by side (chosen)"""
SENT, HEALTHY, AHEAD, STREAM = "worn, sent as it comes", "healthy, sent as it comes", "known ahead", "as it goes, 30 Hz"
REPEATED = f"time {REPETITIONS} of one path"
CASES = (HEALTHY, SENT, AHEAD, REPEATED, STREAM)


@value_type
class MovingRow:
    """One case on one path, over the arms: rms errors."""

    case: str
    path: str
    error: Spread
    """[m] after the best single lag for online paths"""
    largest: float
    """[m] largest error of any arm at any time"""
    lag: float
    """[s] median"""
    stopped: int


def evaluate_moving(arm: Arm, family: ArmFamily, out: Path, on_progress: Progress) -> list[MovingRow]:
    """Let every arm follow the standard paths in all cases; twins are kept in ``out``."""
    found: dict[str, list[tuple[Along, bool]]] = {case: [] for case in CASES}
    for first in range(0, family.arms, BLOCK):
        seeds = family.wear_seeds[first : first + BLOCK]
        ahead = part(on_progress, first / family.arms, (first + len(seeds)) / family.arms)
        twins = own_twins(arm, seeds, out, family.seed, part(ahead, 0.0, 0.5))
        for case, errors in _follow(arm, seeds, twins, part(ahead, 0.5, 1.0)).items():
            found[case] += errors
    each = len(STANDARD)
    return [_moving_row(case, path, found[case][i::each]) for case in CASES for i, path in enumerate(STANDARD)]


def _follow(
    arm: Arm, seeds: Sequence[int], twins: Sequence[Twin], on_progress: Progress
) -> dict[str, list[tuple[Along, bool]]]:
    """Follow all paths with each arm; returns errors, and whether the guard stopped it, of each case."""
    pairs = [(twin, seed, name) for twin, seed in zip(twins, seeds, strict=True) for name in STANDARD]
    servos = TwinParameters.stacked([twin.parameters for twin, *_ in pairs])
    paths = [standard_path(name, arm, seed) for _, seed, name in pairs]  # random ones differ from arm to arm
    home = np.stack([_home_of(path, arm, own) for path, (own, *_) in zip(paths, pairs, strict=True)])
    driven = dict[str, Recording]()

    def drive(case: str, guides: Sequence[Guide], noise: int = 0) -> Recording:
        on_progress(len(driven) / len(CASES), case)
        tracks = case not in (HEALTHY, SENT)
        near = home if tracks else None
        start = PathPostures(arm, np.stack([path.place[0] for path in paths]), home=near).last
        wears = [load_wear("healthy" if case == HEALTHY else f"worn?seed={seed}", arm) for _, seed, _ in pairs]
        robot = EmulatedRobot(arm, wears, seed=seeds[0] + noise, start=start)
        sent = command_for(arm, servos, np.repeat(start[None], 3, axis=0)) if tracks else start  # what holds it there
        plan = Schedule(dwell=LEAD_IN + LAG + max(path.duration for path in paths), sent=sent, keep_going=True)
        controller = Tracker(arm, servos) if tracks else DefaultController(arm)
        driven[case] = run(robot, controller, PathReference(arm, guides, near), plan)
        return driven[case]

    drive(HEALTHY, paths)
    drive(SENT, paths)
    known, lessons = paths, [list[Array]() for _ in paths]
    for time in range(REPETITIONS):
        recording = drive(REPEATED if time else AHEAD, known, time)  # the last time counts
        known = [
            replace(path, aim=next_aim(path, lesson, one.aimed, *missed(arm, recording, path, b)))
            for b, (path, one, lesson) in enumerate(zip(paths, known, lessons, strict=True))
        ]
    drive(STREAM, [played(path, RATE) for path in paths])
    return {
        case: [(judge(arm, one, path, b).encoder, bool(one.tripped[b])) for b, path in enumerate(paths)]
        for case, one in driven.items()
    }


def _home_of(path: MotionPath, arm: Arm, twin: Twin) -> Array:
    """Home (n,) [rad] of an arm; one that is too weak for the path misses it, which counts."""
    try:
        return path.home(arm, believed_motors(arm, twin))
    except InputError:
        return path.home(arm)


def played(path: MotionPath, rate: float) -> Stream:
    """Play the places of a path as a stream of ``rate`` [Hz], after a rest."""
    times = np.concatenate([[0.0], np.arange(LEAD_IN, LEAD_IN + path.duration + 1.0 / rate, 1.0 / rate)])
    return Stream(time=times.tolist(), rows=list(path.at(times - LEAD_IN)))


def _moving_row(case: str, path: str, found: Sequence[tuple[Along, bool]]) -> MovingRow:
    errors, late = [one for one, _ in found], case == STREAM
    error = spread(np.array([one.rms_after if late else one.rms for one in errors]), np.arange(len(errors)))
    assert error is not None  # noqa: S101 - every arm has an error along the way
    return MovingRow(
        case=case,
        path=path,
        error=error,
        largest=max(one.largest_after if late else one.largest for one in errors),
        lag=float(np.median([one.lag for one in errors])),
        stopped=sum(stopped for _, stopped in found),
    )


def moving_table(rows: Sequence[MovingRow]) -> tuple[str, list[str], list[list[str]]]:
    """Title, headers and rows: mean (95th percentile) over the arms in mm."""
    title = (
        f"{rows[0].error.count} arms: root mean square encoder error along the way in mm, mean over the arms (95th "
        "percentile); as it goes: after the best single lag"
    )
    cells = [
        [case, *(f"{1e3 * row.error.mean.value:.2f} ({1e3 * row.error.p95:.2f})" for row in rows if row.case == case)]
        for case in CASES
    ]
    return title, ["case", *STANDARD], cells
