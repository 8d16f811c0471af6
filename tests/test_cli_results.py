"""JSON that holds results and no traces."""

from pathlib import Path

import numpy as np

from rejoint.cli.console import results_of


def test_results_lose_only_their_traces():
    found = results_of({"a": [{"outcomes": [1] * 9, "b": (2, None)}], "c": np.arange(2.0), "d": Path("x")}, "outcomes")
    assert found == {"a": [{"b": [2, None]}], "c": [0.0, 1.0], "d": "x"}
