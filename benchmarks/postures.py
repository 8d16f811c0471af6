"""Choice of postures, planned and driven ways: rates, times on one core, and contacts in MuJoCo's collision check.

    python -m benchmarks postures

Places and poses of the first table are those of random postures that touch nothing. Ways go from one random target in
the reachable volume to the next, without boxes and with three random ones. `Judge` checks them at every degree of the
fastest joint, the guard cycle by cycle. Driven ways are the readings of worn emulated arms that hold targets anywhere,
by the gravity feed-forward on a twin of each. Times are the processor's, so that other programs do not count.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import mujoco
import numpy as np

from rejoint.arms import (
    Arm,
    Array,
    Box,
    JointTrajectory,
    Motors,
    PlanningError,
    choose_postures,
    clearances,
    frames,
    gravity_torque,
    mycobot280,
    plan,
    so101,
    tcp_position,
)
from rejoint.arms.collision import clearances_of, collision_shape
from rejoint.arms.postures import body_of, comfortable_postures
from rejoint.arms.rotations import Orientation, tool_axis
from rejoint.control.comparison.protocols import schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.loop import run
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import JointState
from rejoint.twin.table import twin_spec
from rejoint.twin.twin import Twin
from rejoint_lab.research.evaluation.evaluate import classical
from rejoint_lab.research.evaluation.family import (
    NEARBY,
    VARIANTS,
    ArmFamily,
    open_family,
    own_twins,
    targets_anywhere,
)

ROUNDS, WAYS, PERIOD = 5, 100, 0.025
"""Sets of boxes per arm, ways of each set, and the control period [s]"""
GROWN = 0.005
"""[m] by which the judge's capsules are thicker"""
NEAR = 2e-3
"""[m] of a target that is reached"""
_FAR = 0.03  # [m] to which the judge measures
SIDES = np.array([2.0, 1.0, 1.0])
"""How many of the two sides of a distance are capsules: of links, to the ground, to a box"""
TOUCH = 1e-4
"""[m] of depth from which two count as in contact (chosen: the planner rounds by less)"""


def main(arms: int = 4, targets: int = 30, seed: int = 9) -> None:
    """Print the tables; as many ``targets`` for each of the driven ``arms`` of the family ``seed``."""
    family = ArmFamily(arms=arms, targets=targets, seed=seed)
    for arm in (mycobot280(), so101()):
        begin = process_time()
        choose_postures(arm, arm.targets.sample(np.random.default_rng(0), (1,)) + 0.1, arm.rest)
        print(f"{arm.name}: first call {process_time() - begin:.2f} s (loops compiled or read, postures stored)")
        fresh = replace(arm)
        begin = process_time()
        choose_postures(fresh, np.array([[2.0, 0.0, 0.3]]), arm.rest)
        print(f"  postures of another arm stored: {process_time() - begin:.2f} s, with one refusal")
        _goals(arm)
        boxed = [with_boxes(arm, seed) for seed in range(ROUNDS)]
        _ways("no boxes", [arm] * ROUNDS)
        _ways("three boxes", boxed)
        with TemporaryDirectory() as folder:
            twins = own_twins(arm, family.wear_seeds, Path(folder), seed)
        _driven("no boxes", arm, family, twins)
        _driven("three boxes", boxed[0], family, twins)


def _goals(arm: Arm) -> None:
    q = _free(arm, 1000)
    f = frames(arm, q)
    limit = Motors(*[np.maximum(0.8 * np.abs(gravity_torque(arm, q)).max(axis=0), 0.05)] * 2)
    turns = {
        name: Orientation(
            rotation=f.tcp_rotation, whole=np.full(len(q), whole), weight=np.full(len(q), 0.05), axis=tool_axis(arm)
        )
        for name, whole in (("directions", False), ("poses", True))
    }
    kinds = [("places", None, None), ("places, torque limits", None, limit), *((k, t, None) for k, t in turns.items())]
    for name, turn, most in kinds:
        times, found = [], 0
        for k in range(len(q)):
            one = None if turn is None else turn[[k]]
            begin = process_time()
            goals = choose_postures(arm, f.tcp_position[[k]], arm.rest, turn=one, motors=most)
            times.append(process_time() - begin)
            found += not goals.refusals[0]
        mean, median, slow = 1e3 * np.mean(times), 1e3 * np.median(times), 1e3 * np.percentile(times, 95)
        print(f"  {name:22} {found:4d} of {len(q)} taken; mean {mean:.2f}, median {median:.2f}, 95 % {slow:.2f} ms")


class Judge:
    """MuJoCo's model of an arm, its capsules thicker by ``grown`` [m], with the ground and the boxes.

    Links that the collision shape does not look at may touch: neighbours, and what overlaps at rest or at a target.
    """

    def __init__(self, arm: Arm, grown: float = GROWN) -> None:
        shape, spec, geom = collision_shape(arm), twin_spec(arm), mujoco.mjtGeom
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.arm, self.grown, radius = arm, grown, [shape.radius + grown, 0.0, 0.0]
        bodies = [spec.worldbody, *(spec.body(f"link{i + 1}") for i in range(arm.joints))]
        ends = [*arm.offset[:, :3, 3], arm.tip[:3, 3]]
        for link, (body, end) in enumerate(zip(bodies, ends, strict=True)):
            long = np.linalg.norm(end) > 1e-9
            line = {"fromto": [0.0, 0.0, 0.0, *end]} if long else {}
            _add(body, f"link{link}", geom.mjGEOM_CAPSULE if long else geom.mjGEOM_SPHERE, radius, **line)
        for end in shape.places.tolist():
            at = arm.tip[:3, 3] if end > arm.joints else np.zeros(3)
            _add(bodies[min(end, arm.joints)], f"end{end}", geom.mjGEOM_SPHERE, radius, pos=at)
        _add(spec.worldbody, "ground", geom.mjGEOM_PLANE, [0.0, 0.0, 1.0], pos=[0.0, 0.0, shape.ground])
        for k, box in enumerate(arm.keep_out):
            half = (box.upper - box.lower) / 2
            _add(spec.worldbody, f"box{k}", geom.mjGEOM_BOX, half, pos=box.lower + half)
        pairs = [(f"link{i}", f"link{j}") for i, j in shape.pairs] + [(f"end{e}", "ground") for e in shape.places]
        for one, two in pairs + [(f"link{i}", f"box{k}") for k in range(len(arm.keep_out)) for i in shape.moving]:
            spec.add_pair(geomname1=one, geomname2=two, margin=_FAR)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        names = [self._model.geom(g).name for g in range(self._model.ngeom)]
        self._kind = np.array([1 if name == "ground" else 2 if name[:3] == "box" else 0 for name in names])

    def distances(self, way: Array) -> Array:
        """Return the smallest distances (T, 3) [m] of links, to the ground and to a box, on a way (T, n) [rad].

        At most `_FAR`; below zero where thicker capsules touch.
        """
        found = np.full((len(way), 3), _FAR)
        for row, q in zip(found, way, strict=True):
            self._data.qpos[:] = q
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_collision(self._model, self._data)
            contact = self._data.contact
            np.minimum.at(row, self._kind[contact.geom].max(axis=-1), contact.dist)
        return found

    def nearest(self, way: Array) -> Array:
        """Return the smallest of the `distances` along a way (T, n) [rad], and by the planner, (2, 3) [m]."""
        return np.stack([self.distances(way).min(axis=0), own_distances(self.arm, way, self.grown).min(axis=0)])


def _add(body: mujoco.MjsBody, name: str, kind: mujoco.mjtGeom, size: Array | list[float], **place: object) -> None:
    body.add_geom(name=name, type=kind, size=size, contype=0, conaffinity=0, mass=0.0, **place)


def own_distances(arm: Arm, way: Array, grown: float = GROWN) -> Array:
    """Return what `Judge.distances` does, by the planner's clearances."""
    shape, clear = collision_shape(arm), clearances(arm, way)
    parts = np.split(clear, np.cumsum([len(shape.pairs), len(shape.places)]), axis=1)
    return np.minimum(np.stack([part.min(axis=1, initial=np.inf) for part in parts], axis=1) - grown * SIDES, _FAR)


def with_boxes(arm: Arm, seed: int) -> Arm:
    """Return an arm with three random boxes in its room, which are clear of it at rest."""
    rng, (low, high) = np.random.default_rng([seed, 3]), _room(arm)
    while True:
        centre, half = rng.uniform(low, high, (3, 3)), rng.uniform(0.02, 0.08, (3, 3))
        boxes = tuple(Box(lower=c - h, upper=c + h) for c, h in zip(centre, half, strict=True))
        boxed = replace(arm, keep_out=boxes)
        if (own_distances(boxed, arm.rest[None]) > 0.0).all():
            return boxed


def _room(arm: Arm) -> tuple[Array, Array]:
    places = tcp_position(arm, comfortable_postures(arm))
    return np.append(places.min(axis=0)[:2], arm.floor), places.max(axis=0)


def _ways(title: str, arms: list[Arm]) -> None:
    """Plan ways from target to target with each of the arms; print times and contacts."""
    times: dict[str, list[float]] = {kind: [] for kind in ("posture", "refused", "straight", "detour", "no way")}
    found, changed = [], 0
    for seed, arm in enumerate(arms):
        judge, limits, start, planned = Judge(arm), GuardLimits.of(arm), arm.rest, 0
        choose_postures(arm, tcp_position(arm, start)[None], start)
        for target in _places(arm, seed):
            begin = process_time()
            goals = choose_postures(arm, target[None], start)
            times["refused" if goals.refusals[0] else "posture"].append(process_time() - begin)
            if goals.refusals[0]:
                continue
            begin, way = process_time(), None
            with suppress(PlanningError):
                way = plan(arm, start, goals.q[0])
            kind = "no way" if way is None else "straight" if len(way.moves) <= 1 else "detour"
            times[kind].append(process_time() - begin)
            if way is None:
                continue
            changed += _guarded(limits, way.at(np.arange(0.0, way.duration + PERIOD, PERIOD)))
            found.append(judge.nearest(_dense(way)))
            start, planned = goals.q[0], planned + 1
            if planned == WAYS:
                break
    parts = [
        f"{len(taken)} {kind} ({1e3 * np.median(taken):.2f}, {1e3 * np.percentile(taken, 95):.2f} ms)"
        for kind, taken in times.items()
        if taken
    ]
    print(f"  {title} (median, 95 %): {', '.join(parts)}; {changed} ways are shortened by the guard")
    _tell("planned", found)


def _driven(title: str, arm: Arm, family: ArmFamily, twins: list[Twin]) -> None:
    """Drive worn arms to targets anywhere; print the contacts of the planned and of the driven ways."""
    variant, judge = VARIANTS["anywhere"], Judge(arm)
    targets, ways = targets_anywhere(arm, family, twins)
    plan_of = schedule("hold", Protocol(hold=3.0), keep_going=True)
    controller = classical("feedforward").make(twins, arm)
    recording = run(open_family(arm, variant, family), controller, TargetSequence(arm, targets, ways=ways), plan_of)
    planned = [judge.nearest(_dense(way)) for row in ways for way in row]
    driven, late = [], []
    for b in range(family.arms):
        for k in range(family.targets):
            rows = recording.active[:, b] & (recording.target_index[:, b] == k)
            position, time = recording.position[rows, b], recording.time[rows, b]
            driven.append(judge.nearest(_filled(position)))
            off = np.linalg.norm(tcp_position(arm, position) - targets[b, k], axis=-1) > NEAR
            late.append(time[off].max(initial=time[0]) - time[0] - ways[b][k].duration)
    print(f"  within 2 mm for good: {np.median(late):.2f} s (median) after the planned motion's own time")
    print(f"  driven, {title}: {family.arms} worn arms, {np.count_nonzero(recording.tripped)} stopped by the guard")
    _tell("planned", planned)
    _tell("driven", driven)


def _tell(title: str, found: list[Array]) -> None:
    """Print how many of the ways come too near to what, by MuJoCo and by the planner; ``found``: rows (2, 3) [m]."""
    nearest = np.array(found)
    kinds = ", ".join(
        f"{kind} {(nearest[:, 0, k] < -TOUCH).sum()} ({(nearest[:, 1, k] < -TOUCH).sum()})"
        for k, kind in enumerate(("links", "ground", "boxes"))
    )
    close = (nearest[:, 0] < -TOUCH).any(axis=1).sum()
    touched = (nearest[:, 0] < -TOUCH - GROWN * SIDES).any(axis=1).sum()
    near = (nearest > 0.0).all(axis=1) & (nearest < _FAR).all(axis=1)
    apart = np.abs(nearest[:, 0] - nearest[:, 1])[near].max(initial=0.0)
    print(
        f"    {title:8} {len(found):4d} ways; {close} come within 5 mm (by the planner): {kinds}; deepest "
        f"{-1e3 * nearest[:, 0].min():.1f} mm; real contacts {touched}; difference {1e3 * apart:.3f} mm"
    )


def _places(arm: Arm, seed: int) -> Iterator[Array]:
    """Yield random places (3,) [m] that the tool comes near to."""
    rng, places = np.random.default_rng([seed, 4]), tcp_position(arm, comfortable_postures(arm))
    low, high = _room(arm)
    while True:
        drawn = rng.uniform(low, high)
        if np.linalg.norm(places - drawn, axis=-1).min() < NEARBY:
            yield drawn


def _dense(way: JointTrajectory) -> Array:
    """Return postures (T, n) [rad] of a way, at most a degree apart."""
    fastest = np.abs(way.at(np.linspace(0.0, way.duration, 200), 1)).max(initial=0.0)
    return way.at(np.linspace(0.0, way.duration, 2 + int(way.duration * fastest / np.radians(0.9))))


def _filled(readings: Array) -> Array:
    """Return readings (T, n) [rad] with others between them, at most a degree apart."""
    parts = 1 + int(np.abs(np.diff(readings, axis=0)).max(initial=0.0) / np.radians(1.0))
    place = np.arange(parts * (len(readings) - 1) + 1) / parts
    return np.stack([np.interp(place, np.arange(len(readings)), column) for column in readings.T], axis=1)


def _guarded(limits: GuardLimits, commands: Array) -> bool:
    """Tell whether the guard changes any of the commands (T, n) that follow one another."""
    sent, speed = commands[:1], 0.0 * commands[:1]
    for command in commands[1:, None]:
        state = JointState(time=np.zeros(1), position=sent, age=np.zeros(1))
        answer = guard(limits, command, sent, speed, state, PERIOD)
        if answer.reasons.any():
            return True
        sent, speed = answer.command, answer.speed
    return False


def _free(arm: Arm, count: int) -> Array:
    margin = np.radians(0.5)
    drawn = np.random.default_rng(5).uniform(arm.lower + margin, arm.upper - margin, (8 * count, arm.joints))
    least = np.append(np.full(arm.joints, 0.002), 1.1 * body_of(arm).least)
    found: Array = drawn[(clearances_of(arm, body_of(arm).shape, drawn) > least).all(axis=-1)][:count]
    return found
