"""What each part of a diagnosis tells a twin: Fisher information under the prior, on arms of `benchmarks.truth`.

Readings are taken to be off by 0.12 deg, alike for 8 readings. A bit halves the range of one parameter.
"""

import numpy as np

from benchmarks.truth import excite, to_targets, worn
from rejoint.arms import Arm, mycobot280
from rejoint.diagnosis.excitation import Excitation, plan_excitation
from rejoint.twin.fit import Problem
from rejoint.twin.parameters import TIMESTEP, Layout, pack, prior
from rejoint.twin.replay import Replay, cut

OFF, ALIKE = np.radians(0.12), 8.0
SHOWN = ("stiffness", "damping", "coulomb", "torque_limit", "ramp_speed")


def told(arm: Arm, path: Excitation, seed: int) -> dict[str, tuple[float, np.ndarray]]:
    """Seconds and information (k, k) of each kind of segment."""
    rng = np.random.default_rng(seed)
    truth = worn(arm, rng)
    log = excite(arm, truth, rng, path)
    problem = Problem(Replay(arm, [log], cut([log], 6.0), TIMESTEP), prior(arm))
    signs = problem.inward(pack(truth), np.ones(problem.layout.size))
    base, *moved = problem.residuals(np.vstack([pack(truth), problem.perturbations(pack(truth), signs)]))
    jacobian = problem.jacobian(base, np.array(moved), signs)
    found: dict[str, tuple[float, np.ndarray]] = {}
    for segment in path.segments:
        rows = (log.time >= segment.start) & (log.time < segment.stop)
        seconds, information = found.get(segment.kind, (0.0, np.zeros((len(pack(truth)),) * 2)))
        for joint in range(arm.joints):
            place, slopes = problem.columns(joint), jacobian[rows, joint]
            information[np.ix_(place, place)] += slopes.T @ slopes / (OFF**2 * ALIKE)
        found[segment.kind] = (seconds + segment.stop - segment.start, information)
    return found


def main(arms: int = 2) -> None:
    """Print what each kind tells alone, and all together."""
    arm = mycobot280()
    belief, layout = prior(arm), Layout(arm.joints)
    known = np.linalg.slogdet(belief.precision)[1]
    for seed in range(arms):
        parts = told(arm, plan_excitation(arm, seed=0), seed) | told(arm, to_targets(arm), seed)
        together = (sum(seconds for seconds, _ in parts.values()), sum(found for _, found in parts.values()))
        for kind, (seconds, information) in {**parts, "all": together}.items():
            precision = belief.precision + information
            left = np.sqrt(np.diag(np.linalg.inv(precision))) / belief.sigma
            bits = (np.linalg.slogdet(precision)[1] - known) / 2.0 / np.log(2.0)
            listed = ", ".join(f"{name} {left[layout.at(name)].mean():.2f}" for name in SHOWN)
            print(f"arm {seed}, {kind:9}: {seconds:5.1f} s, {bits:4.0f} bits; left of the prior's sigma: {listed}")
