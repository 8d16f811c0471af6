"""Made-up outcomes of controllers on many arms."""

import numpy as np

from rejoint.research.evaluation.outcome import Outcome


def outcome(settled_mm: np.ndarray, stay: np.ndarray | None = None, cycle: float = 5.0) -> Outcome:
    """Holds with these settled errors (A, K); everything else at rest and unremarkable."""
    arms, targets = settled_mm.shape
    return Outcome(
        wear_seed=10_000.0 + np.arange(arms),
        target=np.zeros((arms, targets, 3)),
        settled=settled_mm / 1e3,
        settled_true=settled_mm / 1e3 + 0.007,
        oscillation=np.zeros((arms, targets)),
        stay=np.repeat((np.ones((arms, targets)) if stay is None else stay)[..., None], 3, axis=-1),
        tripped=np.zeros(arms),
        crossed=np.ones((arms, 2)),
        crossing_error=np.full((arms, 2), 0.009),
        crossing_true=np.full((arms, 2), 0.012),
        crossing_time=np.full((arms, 2), cycle / 10),  # of ten targets
    )
