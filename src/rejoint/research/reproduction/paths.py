"""Fig. 11: paths of the TCP before and after training."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq

from rejoint.control.policy import load_policy
from rejoint.pages.html import BLUE, RED
from rejoint.pages.report.figures import Ways, ways
from rejoint.research.reproduction.experiment import Bench, Drawing, Experiment, Findings, Number
from rejoint.research.reproduction.trainings import WORN, Episodes, play, worn_ranges

DRAWN = 12
"""paths on the figure; chosen"""
ARMS = 256
"""episodes"""


def run(bench: Bench) -> Findings:
    """Play the same episodes before and after training."""
    folder, ranges = bench.training(WORN[0]), worn_ranges(bench.arm)
    noises = pq.read_table(folder.outputs.curves, columns=["noise"])["noise"].to_numpy()
    arms = min(ARMS, 4 * bench.scale.judged)

    def episodes(policy: str, exploration: float) -> Episodes:
        file = folder.policy if policy == "last" else folder.outputs.snapshot(0)
        controller = load_policy(file, bench.arm)
        return play(controller, ranges, arms, seed=bench.seed, noise=exploration, threads=bench.threads)

    first, quiet = episodes("first", noises[0]), episodes("first", 0.0)
    last, busy = episodes("last", 0.0), episodes("last", noises[-1])
    text: tuple[str, ...] = (
        f"One episode each on {arms} randomised arms, from the same start to random targets. At the beginning the "
        "policy explores with a random action every cycle; at the end it acts as it is deployed.",
    )
    if busy.reached.mean() > last.reached.mean():
        text += (
            "The trained policy touches 5 mm more often while it still explores than without: the noise shakes an arm "
            "over the last millimetres at which it would come to rest.",
        )
    numbers = (
        _reached("targets reached within 5 mm, first episode", first),
        _reached("the same without exploration: equation 17 with action 0", quiet),
        _reached("targets reached, trained", last),
        _reached("the same, exploring as at the end of the training", busy),
        _length("length of the path over the straight way, first episode (median)", first),
        _length("the same, trained", last),
        Number.of("episodes that end in a collision, first", 100 * first.collided.mean(), "{:.1f} %"),
        Number.of("the same, trained", 100 * last.collided.mean(), "{:.1f} %"),
    )
    readings = (
        "The paper shows pictures and gives no numbers here. It speaks of the policy after 20 episodes; the last one, "
        "after Table 3's 5000 time steps (20 episodes of 250), was taken.",
    )
    return Findings(text=text, numbers=numbers, readings=readings, drawings=(_figure(bench, first, last),))


def _reached(what: str, episodes: Episodes) -> Number:
    return Number.of(what, 100 * episodes.reached.mean(), "{:.1f} %")


def _length(what: str, episodes: Episodes) -> Number:
    steps = np.nansum(np.linalg.norm(np.diff(episodes.tcp, axis=0), axis=-1), axis=0)
    return Number.of(what, np.median(steps / np.linalg.norm(episodes.target - episodes.tcp[0], axis=-1)), "{:.1f}")


def _figure(bench: Bench, first: Episodes, last: Episodes) -> Drawing:
    shown = min(DRAWN, len(first.steps))
    panels = [
        Ways(
            title=title,
            look=look,
            paths=[one.tcp[:, i] for i in range(shown)],
            targets=one.target[:shown],
            numbered=False,
            radius=0.005,
        )
        for title, look, one in (("first episode, exploring", RED, first), ("trained", BLUE, last))
    ]
    box = np.stack([bench.arm.targets.lower, bench.arm.targets.upper], axis=1)
    start = last.tcp[0, 0]
    limits = np.stack([np.minimum(box[:, 0], start) - 0.06, np.maximum(box[:, 1], start) + 0.06], axis=1)
    return bench.draw(
        ways(panels, limits),
        key="fig-11",
        alt="Tangled paths before the training, straight ones to every target after it.",
        caption=f"Fig. 11. Paths of the TCP in {shown} episodes, from above and from the side; circles of 5 mm.",
    )


FIG_11 = Experiment(
    name="fig-11",
    title="Fig. 11: paths before and after the training",
    about="TCP paths of the untrained and the trained policy on randomised twins",
    trainings=WORN[:1],
    run=run,
)
