"""Every controller on the same arm: protocols, metrics, intervals, and a recommendation."""

from rejoint.runs.comparison.compare import Settings, Trial, compare
from rejoint.runs.comparison.recommend import Recommendation, difference, recommend
from rejoint.runs.comparison.result import Comparison, Protocol
from rejoint.runs.comparison.targets import draw_targets, read_targets

__all__ = [
    "Comparison", "Protocol", "Recommendation", "Settings", "Trial", "compare", "difference", "draw_targets",
    "read_targets", "recommend",
]  # fmt: skip
