"""Table 3 and Algorithm 1: the paper's training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.protocols import Columns, measure_crossings, schedule
from rejoint.control.loop import run as drive
from rejoint.control.observation import SUCCESS_DISTANCE, layout_size
from rejoint.control.policy import load_policy
from rejoint.control.targets import draw_targets
from rejoint.pages.report.contents import Curves, read_curves
from rejoint.research.reproduction.experiment import Bench, Experiment, Findings, Grid, Number
from rejoint.research.reproduction.trainings import LIMITED, LITERAL, LITERALLY, NOISY, WORN, recipe
from rejoint.robots import open_robot
from rejoint.training.presets import PAPER

LAST = 5
"""last updates that are averaged; chosen"""

NAMES = (*WORN, *LITERALLY)
WORDS = {
    LIMITED: "actions of at most 5°",
    NOISY: "joint noise of 5° as well",
    LITERAL: "the last action for Δθ as well",
}
LEARNED = 90.0
"""[%] of targets when learned; chosen"""
WORKS = 95.0
"""[%] of targets when working; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingOutcome:
    """One training, and its policy on the worn arm."""

    curves: Curves
    crossings: Columns

    @property
    def trained(self) -> float:
        """Targets [%] within 5 mm at the end, exploring."""
        return 100 * float(np.mean(self.curves.success_rate[-LAST:]))

    @property
    def success(self) -> float:
        """Targets [%] of the worn arm within 10 mm."""
        return 100 * float(self.crossings["crossed"].mean())

    @property
    def error_mm(self) -> Array:
        """Errors at the crossing or time-out."""
        error = self.crossings["crossing_error"]
        return 1e3 * error[np.isfinite(error)]


def run(bench: Bench) -> Findings:
    """Compare trainings over the paper's open points."""
    outcomes = {}
    for done, name in enumerate(NAMES):
        bench.on_progress(done / len(NAMES), f"policy of {name} on the worn arm")
        outcomes[name] = _try(bench, name)
    first, seconds = outcomes[WORN[0]], [float(outcomes[name].curves.wall_s[-1]) for name in WORN]
    success = [outcomes[name].success for name in WORN]
    error = np.concatenate([outcomes[name].error_mm for name in WORN])
    numbers = (
        Number.of("size of the state s", layout_size(PAPER.task.layout, bench.arm.joints), "{}", "28"),
        Number.of("transitions of a training", first.curves.step[-1] / 1e6, "{:.2f} million", "2.56 million"),
        Number.of("training time", np.mean(seconds), "{:.0f} s on one core", "below 300 s, RTX 3090"),
        Number.of(
            "success of --preset paper on the worn arm",
            np.mean(success),
            f"{{:.1f}} % ({min(success):.1f} to {max(success):.1f} over seeds)",
            "100 %",
        ),
        Number.of(
            "its error at the crossing of 10 mm", error.mean(), f"{{:.2f}} ± {error.std():.2f} mm", "8.21 ± 1.11 mm"
        ),
        *(Number.of(f"success, {WORDS[name]}", outcomes[name].success, "{:.1f} %") for name in LITERALLY),
    )
    return Findings(
        text=_text(outcomes), numbers=numbers, readings=_READINGS, grids=(_table_3(bench), _variants(outcomes))
    )


def _try(bench: Bench, name: str) -> TrainingOutcome:
    folder, scale, protocol = bench.training(name), bench.scale, bench.scale.protocol
    targets = draw_targets(bench.arm, sets=scale.sets, count=scale.targets, seed=bench.seed)
    targets = np.repeat(targets, scale.repetitions, axis=0)  # the trials of Table 4
    robot = open_robot("emulated:worn", arm=bench.arm, seed=bench.seed, count=len(targets), threads=bench.threads)
    try:
        controller = load_policy(folder.policy, bench.arm)
        recording = drive(robot, controller, targets, schedule("crossing", protocol, keep_going=True))
    finally:
        robot.close()
    return TrainingOutcome(
        curves=read_curves(folder.outputs.curves),
        crossings=measure_crossings(bench.arm, recording, targets, protocol),
    )


def _text(outcomes: dict[str, TrainingOutcome]) -> tuple[str, ...]:
    works = "works" if min(outcomes[name].success for name in WORN) >= WORKS else "does not work"
    text: tuple[str, ...] = (
        "`--preset paper` is Algorithm 1 with equations 16 to 25 and Table 3, on 512 randomised twins; what had to be "
        f"added to them stands in the table. Trained so, the policy {works} in the paper's protocol on the "
        "worn arm, which it has never seen.",
        "In three places it departs from what is printed, and three more trainings (one seed each) go back to it one "
        "step at a time. " + " ".join(_step(name, outcomes[name]) for name in LITERALLY),
    )
    if outcomes[NOISY].trained < LEARNED:
        text += (
            "Joint noise of 5° is more than can be learned away: it is drawn once per episode (Algorithm 1, line 6) "
            "and so is an unknown offset of every joint, which together with the sag of a soft servo exceeds actions "
            "of 5°. The worn arm has no such offsets, so a policy that fails in its training may still do there.",
        )
    return text


def _step(name: str, outcome: TrainingOutcome) -> str:
    trained, success = outcome.trained, outcome.success
    learned, works = trained >= LEARNED, success >= WORKS
    verdict = "the task is learned" if learned else "the task is not learned"
    deployed = "works" if works else "reaches a part of the targets" if success >= 50 else "fails"
    return (
        f"With {WORDS[name]} {verdict} ({trained:.0f} % of the targets within 5 mm at the end of the training), "
        f"{'and' if learned == works else 'yet'} the policy {deployed} on the worn arm ({success:.0f} % within 10 mm)."
    )


def _table_3(bench: Bench) -> Grid:
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
        ("agents", "512", str(bench.scale.agents)),
        ("learning rate", "not given", f"{ppo.learning_rate:g}, constant"),
        ("time steps between updates", "not given", str(ppo.rollout)),
        ("entropy bonus", "not given", "none"),
        ("first policy", "not given", f"action near 0, noise of {np.exp(ppo.log_std):.1f} of the largest action"),
        ("input of the value network", "the state", "the state and the parameters of the simulated arm"),
        ("largest action", "0.5° to 5° a frame", f"{np.degrees(task.law.authority_limit):.0f}°"),
        ("joint noise, standard deviation", "5°", f"{np.degrees(PAPER.joint_noise):.0f}°"),
        ("success distance in training", "5 mm", f"{1e3 * SUCCESS_DISTANCE:g} mm"),
        ("control frequency", "30 to 60 Hz", f"{1 / task.max_period:.0f} to {1 / task.min_period:.0f} Hz"),
    )
    return Grid(title="Table 3 and section IV-D", headers=("", "paper", "run"), rows=rows)


def _variants(outcomes: dict[str, TrainingOutcome]) -> Grid:
    rows = []
    for name, outcome in outcomes.items():
        preset, offset = recipe(name)
        rows.append(
            (
                f"{np.degrees(preset.task.law.authority_limit):.0f}°",
                f"{np.degrees(preset.joint_noise):.0f}°",
                "command - position" if preset.task.layout == "equation-16" else "last action",
                str(offset),
                f"{outcome.trained:.0f}",
                f"{outcome.success:.1f}",
                f"{outcome.error_mm.mean():.2f} ± {outcome.error_mm.std():.2f}",
                f"{np.nanmean(outcome.crossings['crossing_time'].sum(axis=-1)):.1f}",
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
    return Grid(title="What the policies do on the worn arm", headers=headers, rows=tuple(rows))


_READINGS = (
    "Equation 16: with θ_target the state would have 34 numbers and without it the 28 that the paper states; it was "
    "left out. Δθ is taken as command minus position, with which a policy without memory can learn to hold a sagging "
    "arm; the other reading, the last action, is in the table.",
    "Equation 15 is an absolute error; the squared error was run, as the library that the paper cites has it.",
    "Equation 17: θ_t is the measured position, as printed. The preset takes 10° for the largest action; for the 5° a "
    "frame that section IV-D derives from the joints' speed, see the table.",
    "Equation 19: the preset has σ = 1°; for the printed 5° see the table. The noise is drawn once per episode.",
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
    trainings=NAMES,
    run=run,
)
