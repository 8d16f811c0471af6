"""Arms on which nothing was chosen: a hundred worn ones, and the same under conditions that make control hard.

Arm i of family s is the wear profile's neighbour ``?seed=`` `FAMILY_SIZE` (s + 1) + i. Family 0 is reported; recipes
and gains are chosen on others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array, Displacement, JointTrajectory, choose_postures, gravity_torque, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.postures import comfortable_postures
from rejoint.arms.rotations import rotation_about
from rejoint.arms.workspace import length_size
from rejoint.control.comparison.result import Protocol
from rejoint.control.goal import Ways, with_ways
from rejoint.control.targets import draw_targets
from rejoint.session.context import believed_motors
from rejoint.system.errors import InputError
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import Wear, load_wear

Interval = tuple[float, float]

HELD = 0.9
"""Share of the torque limits of an arm's twin that a target's posture needs at most"""
NEARBY = 0.03
"""[m] of a myCobot 280 from a place that the tool reaches (chosen: these lie 18 mm apart)"""
FAMILY_SIZE = 10_000
"""Wear seeds that belong to one family"""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A condition that a family of arms is tried under."""

    name: str
    meaning: str
    """what differs from the arms that were trained for, in words"""
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
    tilt: float = 0.0
    """[rad] by which the base stands askew, to the side"""
    mass: float = 0.0
    """share by which the mass of each link is off, up or down"""
    shift: float = 0.0
    """[m] standard deviation of each coordinate of the errors of the links"""
    turn: float = 0.0
    """[rad] the same of the angles"""


WORN = Variant(name="worn", meaning="worn arms")
HEALTHY = Variant(name="healthy", meaning="healthy arms", profile="healthy")
PLAY_IN_LOOP = Variant(
    name="play-in-loop", meaning="worn arms whose encoders sit behind the gears' play", profile="play-in-loop"
)
VARIANTS = (
    WORN,
    PLAY_IN_LOOP,
    Variant(name="long-latency", meaning="worn arms, commands arrive after 30 to 50 ms", latency=(0.030, 0.050)),
    Variant(name="slow-wire", meaning="worn arms at a control period of 45 to 55 ms", period=(0.045, 0.055)),
    Variant(name="any-wire", meaning="worn arms, every control cycle takes 20 to 50 ms", period=(0.020, 0.050)),
    Variant(name="payload", meaning="worn arms with up to 250 g at the tool", payload=0.250),
    HEALTHY,
    Variant(name="known", meaning="worn arms with a twin each", twins=True),
    Variant(
        name="anywhere",
        meaning="worn arms with a twin each, targets wherever they reach and hold the arm with 90 % of the torque",
        twins=True,
        anywhere=True,
    ),
)
"""The conditions; latency, period and load are those that hobby arms of this size meet (chosen)"""

CALIBRATED = (
    WORN,
    Variant(name="askew", meaning="worn arms on a base tilted by 8 degrees", tilt=np.radians(8.0)),
    Variant(name="wedge", meaning="worn arms on a base raised by 2 degrees on one side", tilt=np.radians(2.0)),
    Variant(
        name="misdescribed",
        meaning="worn arms, masses 15 % off, links off by 1 mm and 0.3 deg",
        mass=0.15,
        shift=1e-3,
        turn=np.radians(0.3),
    ),
    HEALTHY,
    PLAY_IN_LOOP,
)
"""The conditions of calibrations"""


@dataclass(frozen=True, kw_only=True)
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
    threads: int = field(default=1, repr=False, compare=False)
    """of the simulation; no effect on results"""

    def __post_init__(self) -> None:
        if not 1 <= self.arms <= FAMILY_SIZE or min(self.targets, self.crossings, self.seed) < 0:
            raise InputError(
                f"family: {self.arms} arms, {self.targets} and {self.crossings} targets, seed {self.seed}; expected "
                f"1 to {FAMILY_SIZE} arms, and no negative number"
            )

    def wear_seed(self, index: int) -> int:
        """Seed of arm ``index``."""
        return FAMILY_SIZE * (self.seed + 1) + index

    @property
    def wear_seeds(self) -> list[int]:
        """Seeds of all arms."""
        return list(map(self.wear_seed, range(self.arms)))


def find_variant(name: str, among: Sequence[Variant] = VARIANTS) -> Variant:
    """Look up a variant; InputError names the alternatives."""
    for variant in among:
        if variant.name == name:
            return variant
    raise InputError(f"no variant is called {name!r}; known variants: {', '.join(v.name for v in among)}")


def family_wears(arm: Arm, variant: Variant, family: ArmFamily) -> list[Wear]:
    """Draw the arms."""
    return [load_wear(f"{variant.profile}?seed={seed}", arm) for seed in family.wear_seeds]


def family_payloads(variant: Variant, family: ArmFamily) -> Array:
    """Draw the loads (A,) [kg] at the tools."""
    return variant.payload * np.array([np.random.default_rng([seed, 1]).random() for seed in family.wear_seeds])


def misdescribed(arm: Arm, variant: Variant, seed: int) -> Arm:
    """Draw an arm that differs from its description ``arm``."""
    rng = np.random.default_rng([seed, 2])
    twist = rng.normal(0.0, [variant.shift] * 3 + [variant.turn] * 3, (arm.joints + 1, 6))
    moved = replace(Displacement.none(arm), twist=twist).moved(arm)
    factor = 1.0 + variant.mass * rng.choice([-1.0, 1.0], arm.joints)
    return replace(moved, mass=arm.mass * factor, inertia=arm.inertia * factor[:, None, None])


def family_targets(arm: Arm, family: ArmFamily, count: int) -> Array:
    """Targets (A, count, 3) [m], others for every arm."""
    return draw_targets(arm, sets=family.arms, count=count, seed=FAMILY_SIZE * (family.seed + 1))


def targets_anywhere(arm: Arm, family: ArmFamily, twins: Sequence[Twin]) -> tuple[Array, Ways]:
    """Draw targets (A, K, 3) [m] that the arms reach and hold by their ``twins``, and the ways of each arm."""
    places = tcp_position(arm, comfortable_postures(arm))
    low, high, nearby = places.min(axis=0), places.max(axis=0), NEARBY * length_size(arm)
    low[2] = arm.floor
    targets, ways = np.empty((family.arms, family.targets, 3)), list[Sequence[JointTrajectory]]()
    for i, twin in enumerate(twins):
        motors, most = believed_motors(twin), HELD * twin.parameters.torque_limit
        rng, start = np.random.default_rng([family.wear_seed(i), 2]), arm.rest
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
    described = not (variant.mass or variant.shift or variant.turn)
    return EmulatedRobot(
        arm,
        family_wears(arm, variant, family),
        address=f"emulated:{variant.name}",
        seed=family.seed,
        period=variant.period,
        command_latency=variant.latency,
        threads=family.threads,
        payload=family_payloads(variant, family),
        bodies=None if described else [misdescribed(arm, variant, seed) for seed in family.wear_seeds],
        gravity=rotation_about(np.array([1.0, 0.0, 0.0]), variant.tilt) @ GRAVITY,
    )
