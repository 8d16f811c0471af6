"""Damaged policy files: how each of many ends. Longer than the property tests, with a policy of our size."""

import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from rejoint.arms import Arm, mycobot280
from rejoint.control.policy import load_policy
from rejoint.system.errors import ContractError, FileError
from rejoint.training.export import export_policy
from rejoint.training.ppo import perceptron
from rejoint.training.presets import DEFAULT
from rejoint.training.train import know_stiffness, policy_contract

FILES = 20_000


def main() -> None:
    arm, rng, ends, longest = mycobot280(), np.random.default_rng(0), Counter(), 0.0
    recipe = know_stiffness(DEFAULT, arm, None)
    contract = policy_contract(arm, None, recipe, 0)
    torch.manual_seed(0)
    network = perceptron((contract.observation_size, *recipe.ppo.actor_layers, arm.joints))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        export_policy(path, network, contract)
        whole = path.read_bytes()
        for _ in range(FILES):
            path.write_bytes(damaged(whole, rng))
            start = time.perf_counter()
            kind, line = outcome(path, arm)
            assert "\n" not in line
            assert len(line) < 600
            ends[kind] += 1
            longest = max(longest, time.perf_counter() - start)
    assert ends["loaded"] == 0, ends
    said = ", ".join(f"{count} {name}" for name, count in ends.most_common())
    print(f"{FILES} damaged policy files: {said}; none was loaded; the longest took {1e3 * longest:.0f} ms")


def outcome(path: Path, arm: Arm) -> tuple[str, str]:
    """Load a policy file; returns the kind of its end and what was said."""
    try:
        load_policy(path, arm)
    except (FileError, ContractError) as error:
        return type(error).__name__, str(error)
    return "loaded", ""


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Flip, write, insert or remove some bytes, or cut the file; more often at its ends, where its structure is."""
    data = bytearray(whole)
    while data == whole:
        for _ in range(rng.choice([1, 1, 2, 8])):
            end = len(data)
            spans = ((0, end), (0, min(600, end)), (max(end - 9000, 0), end))
            place = int(rng.integers(*spans[rng.integers(3)])) if end else 0
            some = rng.bytes(int(rng.integers(1, 9)))
            match int(rng.integers(5)):
                case 0 if end:
                    data[place] ^= 1 << int(rng.integers(8))
                case 1:
                    data[place : place + len(some)] = some
                case 2:
                    data[place:place] = some
                case 3:
                    del data[place : place + len(some)]
                case 4 if rng.random() < 0.2:
                    del data[place:]
    return bytes(data)
