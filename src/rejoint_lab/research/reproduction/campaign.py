"""The training of the paper to the letter; and its experiments: settings, folder, results, and the page of them.

Trainings: ``worn-0`` is Table 3's training on the paper's P and D, ``healthy-0`` on a normal arm's; the number adds to
the seed. ``limit-5`` takes the printed largest action, ``noise-5`` also the joint noise, ``literal`` also the last
action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, Mask, collides
from rejoint.arms.workspace import length_size, torque_size
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.observation import SUCCESS_DISTANCE
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.pages.html import write_page as fill
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, read_shipped, write_json, write_whole
from rejoint.system.progress import Progress, no_progress, part
from rejoint.system.records import value_type
from rejoint.training.ranges import Interval
from rejoint.training.task import Preset, ReachTask
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.parameters import TwinParameters, nominal_parameters
from rejoint.twin.simulation import Draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEALTHY_STIFFNESS, HEALTHY_DIVISOR = (1e4, 1e4), (10.0, 10.0)
"""P, and P over D, without wear; Park et al. 2024, section IV-C, first condition of Fig. 10"""


@value_type
class PaperRanges:
    """The randomisation of Park et al. 2024, section III-D, rescaled to an arm of this weight.

    0.06 P N m/rad and 0.012 D N m s/rad give their Fig. 10 (measured).
    """

    arm: Arm
    stiffness: Interval = (50.0, 200.0)
    """P of the paper"""
    damping_divisor: Interval = (10.0, 50.0)
    """D between P/50 and P/10"""
    stiffness_unit: float = 0.06
    """[N m/rad] per unit of P on a myCobot 280; goes with the load"""
    damping_unit: float = 0.012
    """[N m s/rad] per unit of D"""
    armature: float = 0.02
    """[kg m^2]"""
    joint_noise: float = float(np.radians(1.0))
    """[rad] sigma of equation 19, once per episode; the paper's 5 degrees cannot be learned (measured)"""
    frequency: Interval = (30.0, 60.0)
    """[Hz]"""

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        p = rng.uniform(*self.stiffness, (count, 1))
        d = rng.uniform(p / self.damping_divisor[1], p / self.damping_divisor[0])
        twin = replace(self.twins(p, d), offset=rng.normal(0.0, self.joint_noise, (count, self.arm.joints)))
        return replace(Draw.of(twin), period=1.0 / rng.uniform(*self.frequency, count))

    def twins(self, p: Array, d: Array) -> TwinParameters:
        """Twins with the paper's P and D (count, 1), ample torque, no friction or delay."""
        base, load, length = nominal_parameters(self.arm), torque_size(self.arm), length_size(self.arm)
        none = np.zeros((len(p), self.arm.joints))
        return TwinParameters(
            stiffness=none + load * self.stiffness_unit * p,
            damping=load * length**0.5 * self.damping_unit * d,
            coulomb=none,
            armature=np.array(load * length * self.armature),
            torque_limit=100.0 * base.torque_limit,
            offset=none,
            delay=np.zeros(()),
            ramp_speed=100.0 * base.ramp_speed,
        )


def paper_reward(
    distance: Array,
    joint_speed: Array,
    collided: Mask,
    reached: Mask,
    timed_out: Mask,
) -> Array:
    """Equation 25 of Park et al. 2024 for ``distance`` (N,) [m] and ``joint_speed`` (N, n) [rad/s].

    Our choice: centimetres, the mean joint speed; the time-out is a penalty.
    """
    travel = -0.1 * 100.0 * distance - 0.1 * np.abs(joint_speed).mean(axis=-1)
    return travel - 5.0 * timed_out - 10.0 * collided + 10.0 * reached


class PaperTask(ReachTask):
    """A reached target ends the episode; a collision exchanges the arm."""

    ends_on_success = True

    def judge(
        self,
        action: Array,  # noqa: ARG002 - costs nothing here
        before: Array,
        distance: Array,
        speed: Array,  # noqa: ARG002
        late: Mask,
    ) -> tuple[Array, Mask, Mask]:
        """Reward by equation 25; see `ReachTask`."""
        position = self.simulation.twins.qpos
        reached, collided = distance < SUCCESS_DISTANCE, collides(self.arm, position)
        joint_speed = (position - before) / self._period[:, None]
        return paper_reward(distance, joint_speed, collided, reached, late & ~reached), reached, collided


PAPER = replace(read_shipped(__file__, "paper.toml", Preset), make=PaperTask)
"""Park et al. 2024, section III-D and Table 3"""

DPI = 100
"""of a figure; chosen"""


@value_type
class Bench:
    """Folder, settings and size of all experiments."""

    folder: Path
    arm: Arm
    seed: int
    quick: bool = False
    """whether it is too small for a result"""
    sets: int = 5
    """the paper has one"""
    repetitions: int = 6
    """n of the paper's Table 4"""
    count: int = 10
    """targets of a set; Park et al. 2024, section IV-A"""
    protocol: Protocol = field(default_factory=Protocol)
    """20 s per target, 10 mm"""
    agents: int = 512
    """Table 3"""
    updates: int | None = None
    """None: Table 3's 5000 time steps"""
    snapshot_every: int = 5
    """updates between policies of Fig. 12; chosen"""
    judged: int = 96
    """arms per such policy; chosen"""
    on_progress: Progress = no_progress

    def quickly(self) -> Bench:
        """Return it at a size that is enough to try every step."""
        return replace(
            self,
            quick=True,
            sets=1,
            repetitions=2,
            count=2,
            protocol=Protocol(dwell=1.0, hold=1.5),
            agents=16,
            updates=1,
            judged=8,
        )

    @cached_property
    def targets(self) -> Array:
        """(S, K, 3) [m] of all sets."""
        return draw_targets(self.arm, sets=self.sets, count=self.count, seed=self.seed)

    def training(self, name: str) -> RunFolder:
        """Folder of a training (`recipe`)."""
        return RunFolder(self.folder / "trainings" / name)

    def result(self, experiment: str) -> Path:
        """File of what an experiment found."""
        return self.folder / "results" / f"{experiment}.json"

    def draw(self, figure: Figure, key: str) -> None:
        """Save a figure of the page."""
        path = self.folder / "figures" / f"{key}.png"
        write_whole(path, lambda temporary: figure.savefig(temporary, format="png", dpi=DPI, facecolor="white"))


class Grid(NamedTuple):
    """A table of the page."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]


@value_type
class Finished:
    """What an experiment found, in words."""

    text: Sequence[str]
    """paragraphs"""
    numbers: Sequence[tuple[str, str, str]]
    """what, ours and the paper's, as printed with unit and spread"""
    grids: Sequence[Grid]
    """further tables"""


Found = dict[str, Any]
"""Numbers or text by name; ``grids`` are further tables"""


class Experiment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An experiment of the paper; text and numbers are formats of what is measured."""

    title: str
    measure: str
    """function of the module `measures`"""
    trainings: tuple[str, ...] = ()
    text: tuple[str, ...]
    numbers: tuple[tuple[str, ...], ...]
    """what, ours, perhaps the paper's"""
    readings: tuple[str, ...]
    """how we read open points"""
    figure: str = ""
    """its file is FIGURE.png"""
    alt: str = ""
    caption: str = ""

    def run(self, bench: Bench) -> Finished:
        """Measure, and put what was found into words."""
        from rejoint_lab.research.reproduction import measures  # late: they load what trains

        found: Found = getattr(measures, self.measure)(bench)
        return Finished(
            text=[paragraph.format_map(found) for paragraph in self.text],
            numbers=[(what, ours.format_map(found), paper[0] if paper else "-") for what, ours, *paper in self.numbers],
            grids=found.get("grids", ()),
        )


SEEDS = 3
"""Trainings of each kind; chosen"""
WORN = tuple(f"worn-{i}" for i in range(SEEDS))
HEALTHY = tuple(f"healthy-{i}" for i in range(SEEDS))
LITERALLY = ("limit-5", "noise-5", "literal")

LITERAL = float(np.radians(5.0))
"""[rad] sigma of equation 19, and joint change per frame; Park et al. 2024, section IV-D"""


def recipe(name: str) -> tuple[Preset, int]:
    """Preset and seed increment of a training."""
    kind, _, number = name.rpartition("-")
    if kind in ("worn", "healthy"):
        return replace(PAPER, name="paper" if kind == "worn" else "paper-healthy"), int(number)
    law = replace(PAPER.task.law, authority_floor=LITERAL, authority_limit=LITERAL)
    layout = "equation-16-action" if name == "literal" else PAPER.task.layout
    return replace(PAPER, name=f"paper-{name}", task=replace(PAPER.task, law=law, layout=layout)), 0


def ranges_of(arm: Arm, name: str) -> PaperRanges:
    """Arms of a training: with the paper's P and D, or ``healthy`` ones."""
    if name.startswith("healthy"):
        return PaperRanges(arm=arm, stiffness=HEALTHY_STIFFNESS, damping_divisor=HEALTHY_DIVISOR)
    return PaperRanges(arm=arm, joint_noise=LITERAL) if name in ("noise-5", "literal") else PaperRanges(arm=arm)


def finish_trainings(bench: Bench, names: Sequence[str]) -> None:
    """Run unfinished trainings, each on one core."""
    missing = [name for name in names if not bench.training(name).policy.exists()]
    for done, name in enumerate(missing):
        preset, offset = recipe(name)
        options = TrainingOptions(
            preset=preset,
            seed=bench.seed + offset,
            agents=bench.agents,
            iterations=bench.updates,
            snapshot_every=bench.snapshot_every,
            ranges=ranges_of(bench.arm, name),
        )
        ahead = part(bench.on_progress, done / len(missing), (done + 1) / len(missing), f"training {name}: ")
        train(bench.arm, None, out=bench.training(name).path, options=options, on_progress=ahead)


PAGE = "reproduction.md"
EXPERIMENTS = read_shipped(__file__, "experiments.toml", dict[str, Experiment])
"""by their names on the command line, in the paper's order"""


def run_experiments(
    bench: Bench, experiments: Mapping[str, Experiment], on_experiment: Callable[[Experiment], object]
) -> dict[str, Finished]:
    """Run experiments, called to ``on_experiment``, on what is kept of trainings and trials, and what is missing."""
    wanted, path = {"seed": bench.seed, "quick": bench.quick}, bench.folder / "reproduction.json"
    if path.exists() and (there := read_json(path, dict[str, int | bool])) != wanted:
        raise InputError(f"{bench.folder} is a reproduction of {there}, not of {wanted}; give another --run")
    write_json(path, wanted)
    finish_trainings(bench, list(dict.fromkeys(name for one in experiments.values() for name in one.trainings)))
    found = {}
    for name, one in experiments.items():
        on_experiment(one)
        found[name] = one.run(bench)
        write_json(bench.result(name), found[name])
    return found


def write_page(bench: Bench) -> Path:
    """Write all finished experiments to ``reproduction.md`` in the folder, beside the figures."""
    return fill(
        bench.folder / PAGE,
        "reproduction.md",
        bench=bench,
        recipe=PAPER,
        joint_noise=PaperRanges.joint_noise,
        experiments=EXPERIMENTS,
        found={name: read_json(path, Finished) for name in EXPERIMENTS if (path := bench.result(name)).exists()},
        anchor=lambda title: "".join(c for c in title.lower() if c.isalnum() or c in " -").replace(" ", "-"),
    )
