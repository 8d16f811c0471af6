"""twin.toml: what was written is read, and what was damaged is named."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.system.errors import FileError
from rejoint.twin.file import read_twin, write_twin
from rejoint.twin.judgement import PredictionError
from rejoint.twin.parameters import pack, prior, unpack
from rejoint.twin.twin import HeldOut, Twin

ARM = mycobot280()


def make_twin(seed=0):
    rng, belief = np.random.default_rng(seed), prior(ARM)
    k = len(belief.mean)
    root = np.diag(belief.sigma) @ rng.normal(0, 0.1, (k, k))
    covariance = root @ root.T + np.diag((0.05 * belief.sigma) ** 2)
    covariance = 0.5 * (covariance + covariance.T)
    errors = [PredictionError(joints=tuple(rng.uniform(0, 0.1, 6).tolist()), joint=0.03, tcp=0.002) for _ in range(3)]
    return Twin(
        arm=ARM.name,
        joint_names=ARM.joint_names,
        parameters=unpack(belief.mean + 0.3 * belief.sigma * rng.standard_normal(k), ARM.joints),
        covariance=covariance,
        lower=belief.lower,
        upper=belief.upper,
        narrowing=np.sqrt(np.diag(covariance)) / belief.sigma,
        identified=rng.random(k) < 0.7,
        held_out=HeldOut(seconds=30.0, no_twin=errors[0], healthy_twin=errors[1], twin=errors[2]),
        fit_seconds=98.5,
        notes=('a note with "quotes"', "and another"),
    )


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("twin") / "twin.toml"
    write_twin(path, make_twin())
    return path


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_is_exact(tmp_path, seed):
    twin = make_twin(seed)
    write_twin(tmp_path / "twin.toml", twin)
    back = read_twin(tmp_path / "twin.toml", ARM)
    np.testing.assert_array_equal(pack(back.parameters), pack(twin.parameters))
    for name in ("covariance", "lower", "upper", "narrowing", "identified"):
        np.testing.assert_array_equal(getattr(back, name), getattr(twin, name))
    assert back.digest() == twin.digest()
    assert (back.notes, back.arm, back.joint_names) == (twin.notes, twin.arm, twin.joint_names)
    np.testing.assert_array_equal(back.held_out.no_twin.joints, twin.held_out.no_twin.joints)


def test_digest_follows_what_decides_the_draws():
    twin = make_twin()
    assert twin.digest() == make_twin().digest()
    assert replace(twin, covariance=1.01 * twin.covariance).digest() != twin.digest()
    assert replace(twin, arm="other").digest() != twin.digest()
    assert replace(twin, identified=~twin.identified).digest() != twin.digest()
    assert replace(twin, notes=()).digest() == twin.digest()


def test_an_edited_value_is_noticed(path, tmp_path):
    value = f"value = [{float(make_twin().parameters.stiffness[0])!r}"
    text = path.read_text()
    assert value in text
    (tmp_path / "t.toml").write_text(text.replace(value, "value = [7.5"))
    with pytest.raises(FileError, match="digest"):
        read_twin(tmp_path / "t.toml")


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(cut=st.floats(0.0, 0.999))
def test_a_truncated_file_is_named(path, tmp_path, cut):
    whole = path.read_bytes().rstrip()
    (tmp_path / "t.toml").write_bytes(whole[: int(cut * len(whole))])
    with pytest.raises(FileError, match=r"t\.toml"):
        read_twin(tmp_path / "t.toml")


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(place=st.integers(0, 10**6), byte=st.integers(0, 255))
def test_a_changed_byte_is_named_or_harmless(path, tmp_path, place, byte):
    data = bytearray(path.read_bytes())
    data[place % len(data)] = byte
    (tmp_path / "t.toml").write_bytes(data)
    try:
        digest = read_twin(tmp_path / "t.toml").digest()
    except FileError:
        return
    assert digest == make_twin().digest()
