"""Table 3 and Algorithm 1: the paper's training, what it leaves open, and the joint noise as printed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.comparison.protocols import Crossings, measure_crossings, schedule
from rejoint.comparison.targets import draw_targets
from rejoint.control.loop import run as drive
from rejoint.control.observation import layout_size
from rejoint.control.policy import load_policy
from rejoint.report.sections.training import Curves, read_curves
from rejoint.reproduction.experiment import Bench, Experiment, Findings, Grid, Number
from rejoint.reproduction.trainings import LIMITED, LITERAL, WORN, recipe
from rejoint.robots import open_robot
from rejoint.training.presets import PAPER

LAST = 5
"""updates at the end of a training that are averaged (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """One training: its end, and its policy on the worn arm."""

    curves: Curves
    crossings: Crossings


def run(bench: Bench) -> Findings:
    """Compare the trainings that differ in what the paper prints or leaves open."""
    names = (*WORN, LIMITED, LITERAL)
    outcomes = {}
    for done, name in enumerate(names):
        bench.on_progress(done, len(names), f"policy of {name} on the worn arm")
        outcomes[name] = _try(bench, name)
    seconds = [float(outcomes[name].curves.wall_s[-1]) for name in WORN]
    literal = outcomes[LITERAL]
    success = [100 * float(outcomes[name].crossings.crossed.mean()) for name in WORN]
    failed = 100 * float(literal.crossings.crossed.mean())
    numbers = (
        Number(what="size of the state s", ours=str(layout_size(PAPER.task.layout, bench.arm.joints)), paper="28",
               value=layout_size(PAPER.task.layout, bench.arm.joints)),
        Number(what="transitions of a training", ours=f"{outcomes[WORN[0]].curves.step[-1] / 1e6:.2f} million",
               paper="2.56 million", value=float(outcomes[WORN[0]].curves.step[-1])),
        Number(what="training time", ours=f"{np.mean(seconds):.0f} s on one core",
               paper="below 300 s, RTX 3090", value=float(np.mean(seconds))),
        Number(what="success on the worn arm, joint noise of 1°", ours=f"{np.mean(success):.1f} % "
               f"({min(success):.1f} to {max(success):.1f} over seeds)", paper="100 %", value=float(np.mean(success))),
        Number(what="the same, joint noise of 5° and actions up to 5°, as printed", ours=f"{failed:.1f} %",
               value=failed),
    )  # fmt: skip
    return Findings(
        text=_text(failed, success), numbers=numbers, readings=_READINGS, grids=(_table_3(), _variants(outcomes))
    )


def _try(bench: Bench, name: str) -> Outcome:
    folder, scale, protocol = bench.training(name), bench.scale, bench.scale.protocol
    targets = draw_targets(bench.arm, sets=scale.sets, count=scale.targets, seed=bench.seed)
    robot = open_robot("emulated:worn", arm=bench.arm, seed=bench.seed, count=len(targets), threads=bench.threads)
    try:
        controller = load_policy(folder.policy, bench.arm)
        recording = drive(robot, controller, targets, schedule("crossing", protocol, keep_going=True))
    finally:
        robot.close()
    return Outcome(
        curves=read_curves(folder.training / "curves.parquet"),
        crossings=measure_crossings(bench.arm, recording, targets, protocol),
    )


def _text(failed: float, success: list[float]) -> tuple[str, ...]:
    works = "reaches" if min(success) >= 95 else "does not reach"
    sentence = (
        "With the printed noise of 5° per joint, and the largest joint change of 5° a frame that section IV-D derives, "
        "the same training fails. The noise is drawn once per episode (Algorithm 1, line 6), so it is an unknown "
        "offset of every joint; together with the sag of a soft servo it is more than such an action can take back."
        if failed < 0.5 * min(success)
        else "With the printed noise of 5° per joint the training does not fail here."
    )
    return (
        "`--preset paper` is Algorithm 1 with equations 16 to 25 and Table 3, on 512 randomised twins; nothing of our "
        f"own recipe is in it. Trained so, the policy {works} the 95 % of the paper's protocol on the worn arm, which "
        "it has never seen.",
        sentence,
    )


def _table_3() -> Grid:
    ppo, task = PAPER.ppo, PAPER.task
    layers = ", ".join(str(width) for width in ppo.actor_layers)
    rows = (
        ("learning epochs", "8", str(ppo.epochs)),
        ("mini-batches", "8", str(ppo.mini_batches)),
        ("hidden layers, policy and value", "3", f"{len(ppo.actor_layers)} of {layers}, ELU"),
        ("clipping ratio", "0.10", f"{ppo.clip:.2f}"),
        ("GAE λ", "0.95", f"{ppo.gae_lambda:.2f}"),
        ("discount", "0.99", f"{ppo.discount:.2f}"),
        ("longest episode, time steps", "250", str(task.hold_steps)),
        ("time steps in all", "5000", str(ppo.rollout * ppo.iterations)),
        ("agents", "512", "512"),
        ("learning rate", "not given", f"{ppo.learning_rate:g}, constant"),
        ("time steps between updates", "not given", str(ppo.rollout)),
        ("entropy bonus", "not given", "none"),
        ("largest action", "0.5° to 5° a frame", f"{np.degrees(task.law.authority_limit):.0f}°"),
        ("joint noise, standard deviation", "5°", f"{np.degrees(PAPER.joint_noise):.0f}°"),
        ("success distance in training", "5 mm", "5 mm"),
        ("control frequency", "30 to 60 Hz", f"{1 / task.max_period:.0f} to {1 / task.min_period:.0f} Hz"),
    )
    return Grid(title="Table 3 and section IV-D", headers=("", "paper", "run"), rows=rows)


def _variants(outcomes: dict[str, Outcome]) -> Grid:
    rows = []
    for name, outcome in outcomes.items():
        preset, offset = recipe(name)
        found, curves = outcome.crossings, outcome.curves
        error = 1e3 * found.error[np.isfinite(found.error)]
        rows.append(
            (
                f"{np.degrees(preset.task.law.authority_limit):.0f}°",
                f"{np.degrees(preset.joint_noise):.0f}°",
                str(offset),
                f"{100 * np.mean(curves.success_rate[-LAST:]):.0f}",
                f"{100 * found.crossed.mean():.1f}",
                f"{error.mean():.2f} ± {error.std():.2f}",
                f"{np.nanmean(found.time.sum(axis=-1)):.1f}",
            )
        )
    headers = (
        "largest action", "joint noise", "seed", "success in training %, 5 mm", "success on the worn arm %, 10 mm",
        "error at the crossing mm", "ten targets s",
    )  # fmt: skip
    return Grid(title="What the policies do on the worn arm", headers=headers, rows=tuple(rows))


_READINGS = (
    "Equation 16: with θ_target the state would have 34 numbers and without it the 28 that the paper states; it was "
    "left out. Δθ is taken as command minus position, with which a policy without memory can learn to hold a sagging "
    "arm.",
    "Equation 15 is an absolute error; the squared error was run, as the library that the paper cites has it.",
    "Equation 17: θ_t is the measured position, as printed. The largest action is 10° instead of 5°, since a worn "
    "servo holds the arm only with its command that far ahead; with 5° see the table.",
    "Equation 19: σ = 5° has been read as printed, and fails; 1° was run. The noise is drawn once per episode.",
    "Equation 20: the unit of the distance is not given; centimetres, with which the terms of equation 25 are of one "
    "size.",
    "Equation 21 is a vector and signed; the mean over the joints of its absolute value was run.",
    "Equation 22 with the weight of -5 would reward a time-out; its text calls it a penalty, and so it was run.",
    "Equation 23: the arm collides when a link comes nearer to another one, or to the ground, than its housing is "
    "thick. Algorithm 1 then goes on without the motion, section IV-A sets arm and target back to the start: the "
    "latter was run, and the return goes on over the restart, so that crashing is no way out of a bad episode.",
    "Algorithm 1 starts every episode at the initial posture, section IV-A where the last target was reached; the "
    "former was run. On the worn arm the targets follow one another.",
)

TABLE_3 = Experiment(
    name="table-3",
    also=("algorithm-1",),
    title="Table 3 and Algorithm 1: the training",
    about="--preset paper, its variants, and the joint noise of 5 degrees as printed",
    trainings=(*WORN, LIMITED, LITERAL),
    run=run,
)
