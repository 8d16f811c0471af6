"""Made-up results of controllers on many arms."""

import numpy as np

from rejoint.control.comparison.result import METRICS, MODELLED, Columns, Protocol


def outcome(settled_mm: np.ndarray, stay: np.ndarray | None = None, **columns: np.ndarray) -> Columns:
    """Holds with these settled errors (A, K); everything else at rest and unremarkable."""
    shape = settled_mm.shape
    found = {name: np.zeros(shape) for name in METRICS if not name.startswith("modelled")}
    found |= {name: np.full(shape, np.nan) for name in MODELLED}
    found |= {name: np.ones(shape) if stay is None else stay for name in Protocol().stay_names}
    found |= {"held": np.ones(shape), "crossed": np.ones(shape), "crossing_time": np.full(shape, 5.0 / shape[1])}
    found |= {"settled": settled_mm / 1e3, "settled_true": settled_mm / 1e3 + 0.007}
    return found | columns
