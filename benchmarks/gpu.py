"""What a step of many twins costs on a GPU, where there is one, beside the processors' compiled step."""

import time

import numpy as np

from rejoint.arms import mycobot280
from rejoint.system.extras import installed
from rejoint.twin.chain.batch import ChainBatch
from rejoint.twin.friction import friction_terms
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import SUBSTEPS

ARMS, ROUNDS, CYCLES, THREADS = (1024, 8192, 65536), 5, 4, 2


def main() -> None:
    if not installed("warp"):
        print("Warp is not installed: pip install 'rejoint[gpu]'")
        return
    import warp as wp

    from rejoint.twin.chain.warpbatch import WarpBatch, device_at_hand

    device = device_at_hand("cuda") or "cpu"
    print(f"Warp on {wp.get_device(device).name}, in double precision; {THREADS} threads of the processor beside it")
    arm, rng = mycobot280(), np.random.default_rng(0)
    for count in ARMS:
        twins = nominal_parameters(arm).repeat(count)
        terms, start = friction_terms(twins, 1.5), np.tile(arm.rest, (count, 1))
        goal = (start[:, None] + rng.normal(0.0, 0.2, (count, 1, arm.joints))).repeat(SUBSTEPS, axis=1)
        batches = {"compiled": ChainBatch(arm, count, threads=THREADS), "Warp": WarpBatch(arm, count, device=device)}
        took: dict[str, list[float]] = {name: [] for name in batches}
        for _ in range(ROUNDS):
            for name, batch in batches.items():
                batch.restart(start)
                batch.rollout(goal, terms)
                begun = time.perf_counter()
                for _ in range(CYCLES):
                    batch.rollout(goal, terms)
                took[name].append(1e6 * (time.perf_counter() - begun) / count / CYCLES / SUBSTEPS)
        ours, theirs = (float(np.median(took[name])) for name in batches)
        print(f"{count:>6} arms: compiled {ours:.3f} us a step, Warp {theirs:.3f}, ratio {ours / theirs:.2f}")


if __name__ == "__main__":
    main()
