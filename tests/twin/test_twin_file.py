"""twin.toml: what was written is read, and what was damaged is named."""

from dataclasses import replace

import numpy as np
import pytest

from madetwin import made_twin
from rejoint.arms import mycobot280
from rejoint.system.errors import FileError
from rejoint.twin.parameters import pack, prior, unpack
from rejoint.twin.twin import HeldOut, PredictionError, read_twin

ARM = mycobot280()


def make_twin(seed=0):
    rng, belief = np.random.default_rng(seed), prior(ARM)
    k = len(belief.mean)
    root = np.diag(belief.sigma) @ rng.normal(0, 0.1, (k, k))
    covariance = root @ root.T + np.diag((0.05 * belief.sigma) ** 2)
    covariance = 0.5 * (covariance + covariance.T)
    errors = [PredictionError(joint=rng.uniform(0, 0.1), tcp=0.002) for _ in range(3)]
    return made_twin(
        ARM,
        unpack(np.clip(rng.normal(belief.mean, 0.3 * belief.sigma), belief.lower, belief.upper)),
        covariance=covariance,
        narrowing=np.sqrt(np.diag(covariance)) / belief.sigma,
        identified=rng.random(k) < 0.7,
        held_out=HeldOut(seconds=30.0, no_twin=errors[0], healthy_twin=errors[1], twin=errors[2]),
        fit_seconds=98.5,
        notes=('a note with "quotes"', "and another"),
    )


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_is_exact(tmp_path, seed):
    twin = make_twin(seed)
    twin.save(tmp_path / "twin.toml")
    back = read_twin(tmp_path / "twin.toml", ARM)
    np.testing.assert_array_equal(pack(back.parameters), pack(twin.parameters))
    for name in ("covariance", "lower", "upper", "narrowing", "identified"):
        np.testing.assert_array_equal(getattr(back, name), getattr(twin, name))
    assert back.digest() == twin.digest()
    assert (back.notes, back.arm, back.joint_names) == (twin.notes, twin.arm, twin.joint_names)
    assert back.held_out.no_twin == twin.held_out.no_twin


def test_digest_follows_what_decides_the_draws():
    twin = make_twin()
    assert twin.digest() == make_twin().digest()
    assert replace(twin, covariance=1.01 * twin.covariance).digest() != twin.digest()
    assert replace(twin, arm="other").digest() != twin.digest()
    assert replace(twin, identified=~twin.identified).digest() != twin.digest()
    assert replace(twin, notes=()).digest() == twin.digest()


def test_impossible_values_in_a_file_are_refused(tmp_path):
    twin = make_twin()
    wrong = replace(twin.parameters, stiction=0.5 * twin.parameters.stiction)
    replace(twin, parameters=wrong).save(tmp_path / "twin.toml")
    with pytest.raises(FileError, match="stiction"):
        read_twin(tmp_path / "twin.toml")
