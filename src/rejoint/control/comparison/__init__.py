"""Every controller on the same arm: protocols, metrics, intervals, and a recommendation."""

from rejoint.control.comparison.compare import Settings, Trial, compare
from rejoint.control.comparison.recommend import Recommendation, difference, recommend
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.comparison.targets import draw_targets, read_targets

__all__ = [
    "Comparison", "Protocol", "Recommendation", "Settings", "Trial", "compare", "difference", "draw_targets",
    "read_targets", "recommend",
]  # fmt: skip
