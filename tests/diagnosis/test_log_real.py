"""The diagnosis of a real SO-101 from its logs, which are no part of this project (see tests/real_so101.py)."""

import pytest

from real_so101 import FOLDER, NO_RECORDINGS, recorded
from rejoint.arms import so101
from rejoint.diagnosis.fromlogs import diagnose_logs
from rejoint.diagnosis.healthy import load_healthy
from rejoint.logs import import_logs
from rejoint.logs.exclusions import find_exclusions, table_height

ARM = so101()

pytestmark = pytest.mark.skipif(not recorded(), reason=NO_RECORDINGS)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Every other motion by name."""
    place = tmp_path_factory.mktemp("so101")
    names = sorted(path.name for path in FOLDER.iterdir() if (path / "state_motor.csv").exists())[::2]
    return [import_logs(FOLDER / name, ARM, out=place / name).logs[0] for name in names]


@pytest.fixture(scope="module")
def diagnosis(logs):
    return diagnose_logs(ARM, logs, load_healthy(ARM))


def test_stiffness_agrees_with_what_a_simulation_of_the_whole_arm_needs(diagnosis):
    """Twins fitted to the same arm have 19, 20 and 23 N m/rad, with 5 to 12 % of one sigma."""
    for joint, fitted in ((1, 19.0), (2, 20.0), (3, 23.0)):
        k = diagnosis.measurement.joints[joint].stiffness_nm_per_rad
        if k is not None:
            assert 0.8 * k.low < fitted < 1.2 * k.high, (joint, k)
    assert diagnosis.measurement.joints[1].stiffness_nm_per_rad is not None
    assert [diagnosis.measurement.joints[j].stiffness_nm_per_rad for j in (0, 4)] == [None, None]


def test_lag_and_hysteresis_are_those_of_the_fitted_twins(diagnosis):
    """Viscous friction over stiffness is 45 to 80 ms; twice Coulomb friction over stiffness 1.1 to 4.7 degrees."""
    for joint, row in enumerate(diagnosis.measurement.joints):
        assert 0.030 < row.lag_s.value < 0.095, joint
        expected = 2 * (0.25, 0.68, 0.82, 0.35, 0.33)[joint] / (25, 19, 20, 23, 26)[joint]
        assert 0.5 * expected < row.hysteresis_rad.value < 1.1 * expected, joint


def test_the_tool_rests_where_the_encoders_of_the_logs_say(diagnosis):
    assert 15.0 < diagnosis.evidence.rest_error_mm.value < 30.0
    assert diagnosis.condition == "bad"
    found = {(f.joint, f.kind) for f in diagnosis.findings}
    assert ("shoulder_lift", "friction") in found
    assert not any(kind == "weak_gain" for _, kind in found), "its servos give what new ones do with P = 32"


def test_motions_on_the_table_do_not_change_the_elbow(logs, diagnosis):
    rows = find_exclusions(ARM, logs, table_height(ARM, logs))
    free = [log for log, found in zip(logs, rows, strict=True) if not found.contact.any()]
    assert 8 <= len(free) < len(logs)
    alone = diagnose_logs(ARM, free, load_healthy(ARM)).measurement.joints[2]
    both = diagnosis.measurement.joints[2]
    assert max(alone.hysteresis_rad.low, both.hysteresis_rad.low) < min(
        alone.hysteresis_rad.high, both.hysteresis_rad.high
    )
    assert diagnosis.evidence.contact_seconds > 50.0
