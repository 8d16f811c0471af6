"""Arms on which nothing was chosen: a hundred worn ones, also under hard conditions.

Arm i of family s is the wear profile's neighbour ``?seed=`` `FAMILY_SIZE` (s + 1) + i. Family 0 is reported; recipes
and gains are chosen on others.
"""

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, Displacement, Mask, choose_postures, gravity_torque, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.postures import comfortable_postures
from rejoint.arms.rotations import Orientation, turned
from rejoint.arms.workspace import length_size
from rejoint.control.comparison.compare import Ledger, Settings, TrialRunner
from rejoint.control.comparison.protocols import metrics_of
from rejoint.control.comparison.result import MODELLED, Columns, Key, Kind, Protocol, collect
from rejoint.control.correction import Modelled
from rejoint.control.reference import Ways, with_ways
from rejoint.control.robot import Controller, Robot
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.logs.history import setup_of
from rejoint.logs.runfolder import RunFolder
from rejoint.session.context import believed_motors
from rejoint.system.files import read_shipped
from rejoint.system.progress import Progress, no_progress, part
from rejoint.system.records import value_type
from rejoint.twin.twin import Twin, read_twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel, Interval
from rejoint_lab.plant.wear import load_wear

HELD = 0.9
"""Share of the torque limits of an arm's twin that a target's posture needs at most"""
NEARBY = 0.03
"""[m] of a myCobot 280 from a place that the tool reaches (chosen: these lie 18 mm apart)"""
FAMILY_SIZE = 10_000
"""Wear seeds that belong to one family"""


@value_type
class Variant:
    """A condition that a family of arms is tried under."""

    name: str = ""
    """key of its table"""
    profile: str = "worn"
    """wear profile that the arms are neighbours of"""
    period: Interval = (0.020, 0.030)
    """[s] control period, redrawn every cycle"""
    latency: Interval = (0.008, 0.013)
    """[s] from sending a command to its arrival in the firmware"""
    twins: bool = False
    """whether controllers know each arm by a twin of its own"""
    anywhere: bool = False
    """whether targets are drawn wherever an arm can reach and hold, instead of its target region"""
    payload: float = 0.0
    """[kg] heaviest load at the tool; each arm's own is uniform up to it, and unknown"""
    tilt_deg: float = 0.0
    """[deg] by which the base stands askew, to the side"""
    mass: float = 0.0
    """share by which the mass of each link is off, up or down"""
    shift: float = 0.0
    """[m] standard deviation of each coordinate of the errors of the links"""
    turn_deg: float = 0.0
    """[deg] the same of the angles"""
    draw: int = 0
    """of the targets in the target region"""


_TABLES = read_shipped(__file__, "variants.toml", dict[str, dict[str, Variant]])
VARIANTS, CALIBRATED = (
    {name: replace(one, name=name) for name, one in _TABLES[command].items()} for command in ("evaluate", "calibrate")
)
"""The conditions of evaluations, and of calibrations, by name"""
WORN = VARIANTS["worn"]


@value_type
class ArmFamily:
    """Some arms of one family and the targets that each of them gets."""

    arms: int = 100
    targets: int = 5
    """held one after the other, per arm"""
    crossings: int = 10
    """in the protocol of Park et al. 2024, per arm; 0: it is not run"""
    seed: int = 0
    """number of the family"""
    protocol: Protocol = field(default_factory=Protocol)

    @property
    def wear_seeds(self) -> list[int]:
        """Seeds of all arms."""
        first = FAMILY_SIZE * (self.seed + 1)
        return list(range(first, first + self.arms))


def misdescribed(arm: Arm, variant: Variant, seed: int) -> Arm:
    """Draw an arm that differs from its description ``arm``."""
    rng = np.random.default_rng([seed, 2])
    twist = rng.normal(0.0, [variant.shift] * 3 + [np.radians(variant.turn_deg)] * 3, (arm.joints + 1, 6))
    moved = replace(Displacement.none(arm), twist=twist).moved(arm)
    factor = 1.0 + variant.mass * rng.choice([-1.0, 1.0], arm.joints)
    return replace(moved, mass=arm.mass * factor, inertia=arm.inertia * factor[:, None, None])


def family_targets(arm: Arm, family: ArmFamily, draw: int = 0) -> Array:
    """Targets (A, max(K, C), 3) [m] of both protocols, others for every arm."""
    count = max(family.targets, family.crossings)
    return draw_targets(arm, sets=family.arms, count=count, seed=family.wear_seeds[0] + draw)


def targets_anywhere(arm: Arm, family: ArmFamily, twins: Sequence[Twin]) -> tuple[Array, Ways]:
    """Draw targets (A, K, 3) [m] that the arms reach and hold by their ``twins``, and the ways of each arm."""
    places = tcp_position(arm, comfortable_postures(arm))
    low, high, nearby = places.min(axis=0), places.max(axis=0), NEARBY * length_size(arm)
    low[2] = arm.floor
    targets, ways = np.empty((family.arms, family.targets, 3)), []
    for i, (seed, twin) in enumerate(zip(family.wear_seeds, twins, strict=True)):
        motors, most = believed_motors(arm, twin), HELD * twin.parameters.torque_limit
        rng, start = np.random.default_rng([seed, 2]), arm.rest
        postures: list[Array] = []
        while len(postures) < family.targets:
            drawn = rng.uniform(low, high)
            if np.linalg.norm(places - drawn, axis=-1).min() > nearby:  # out of reach: to look for it takes long
                continue
            found = choose_postures(arm, drawn[None], start, motors=motors)
            if found.refusals[0] or not (np.abs(gravity_torque(arm, found.q[0])) <= most).all():
                continue
            targets[i, len(postures)], start = drawn, found.q[0]
            postures.append(start)
        ways.append(with_ways(arm, np.array(postures), arm.rest, motors=motors))
    return targets, ways


def open_family(arm: Arm, variant: Variant, family: ArmFamily) -> EmulatedRobot:
    """All arms as one batch, at rest."""
    seeds, described = family.wear_seeds, not (variant.mass or variant.shift or variant.turn_deg)
    return EmulatedRobot(
        arm,
        [load_wear(f"{variant.profile}?seed={seed}", arm) for seed in seeds],
        address=f"emulated:{variant.name}",
        seed=family.seed,
        channel=Channel(latency=variant.latency, period=variant.period),
        payload=variant.payload * np.array([np.random.default_rng([seed, 1]).random() for seed in seeds]),
        bodies=None if described else [misdescribed(arm, variant, seed) for seed in seeds],
        gravity=turned(np.radians([variant.tilt_deg, 0.0, 0.0])) @ GRAVITY,
    )


def own_twin(arm: Arm, wear_seed: int, folder: RunFolder, seed: int, on_progress: Progress = no_progress) -> Twin:
    """Return the twin in ``folder``; if missing, diagnose and identify ``worn?seed=WEAR_SEED`` first.

    ``seed`` is that of its motions.
    """
    from rejoint.diagnosis.excitation import record
    from rejoint.twin.identify import identify

    if not folder.twin.exists():
        robot = EmulatedRobot(arm, [load_wear(f"worn?seed={wear_seed}", arm)], seed=wear_seed)
        logs = record(robot, seed=seed, on_progress=part(on_progress, 0.0, 0.5))[0]
        identify(arm, [logs.excitation, logs.targets], part(on_progress, 0.5, 1.0)).save(folder.twin)
    return read_twin(folder.twin, arm)


def own_twins(
    arm: Arm, seeds: Sequence[int], folder: Path, seed: int, on_progress: Progress = no_progress
) -> list[Twin]:
    """Return a twin of each worn arm, fitted to an excitation of its own, kept in ``folder``."""
    ends = np.linspace(0.0, 1.0, len(seeds) + 1)
    return [  # one plan of excitation, of ``seed``: a few are not safe and are refused
        own_twin(
            arm,
            one,
            RunFolder(folder / "arms" / f"{arm.name}-{setup_of(arm)[:8]}-{one}"),
            seed,
            part(on_progress, *ends[i : i + 2]),
        )
        for i, one in enumerate(seeds)
    ]


def try_on(
    arm: Arm,
    opened: Callable[[], Robot],
    controller: Callable[[Arm], Controller],
    family: ArmFamily,
    targets: tuple[Array, Ways | None] | None = None,
    calibrations: Callable[[], Sequence[Calibration]] | None = None,
    *,
    ledger: Ledger | None = None,
    on_progress: Progress = no_progress,
) -> Columns:
    """Hold every arm at its targets, and run the crossing protocol; returns results (A, max(K, C)).

    ``opened`` puts all arms at rest. ``targets`` (A, max(K, C), 3) [m], with ways to the first K or None, are the
    family's by default. ``calibrations`` correct them, and model true errors; the column ``used`` says whether they do.
    The ``ledger`` keeps finished trials.
    """
    places, ways = targets or (family_targets(arm, family), None)
    ledger, protocol, arms = ledger or Ledger(), family.protocol, len(places)
    counts: dict[Kind, int] = {"hold": family.targets, "crossing": family.crossings}
    asked = [kind for kind, count in counts.items() if count]
    for done, kind in enumerate(asked):
        count, key = counts[kind], Key("", kind, tuple((a, 0) for a in range(arms)))
        if key in ledger.done:
            continue
        driven, recording = TrialRunner(
            lambda *_: opened(),
            {"": controller},
            places[:, :count],
            Settings(seed=family.seed, batched=True, protocol=protocol),
            ways=ways if kind == "hold" else None,
            correction=None if calibrations is None else OwnCorrections(calibrations()),
            on_progress=part(on_progress, done / len(asked), (done + 2) / len(asked)),  # a runner expects two kinds
        ).drive_batch(key)
        if calibrations is not None and kind == "hold":
            blind = replace(recording, true_tcp=np.full_like(recording.true_tcp, np.nan))
            said = metrics_of(arm, blind, places[:, :count], protocol, models=calibrations())
            driven.columns.update({name: said[name] for name in MODELLED})
            driven.columns["used"] = np.repeat([[float(one.used)] for one in calibrations()], count, axis=1)
        ledger.add(driven)
        on_progress((done + 1) / len(asked), f": {kind} protocol")
    found = collect(ledger.done.values(), (arms, 1, places.shape[1]), protocol)
    return {name: values[:, 0] for name, values in found.items()}


class OwnCorrections(Modelled):
    """Corrects the targets of each arm by its own calibration."""

    def __init__(self, found: Sequence[Calibration]) -> None:
        self._each = [Modelled(one.arm, one.displacement if one.used else Displacement.none(one.arm)) for one in found]

    def aim(
        self, target: Array, start: Array, where: Mask, near: Array | None = None, turn: Orientation | None = None
    ) -> tuple[Array, Orientation | None]:
        """Corrected targets (B, 3) [m]; points have no orientation."""
        rows = (target, start, where) if near is None else (target, start, where, near)
        each = zip(self._each, *(row[:, None] for row in rows), strict=True)
        return np.concatenate([one.aim(*own)[0] for one, *own in each]), turn
