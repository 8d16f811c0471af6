"""A real arm's logs: a few of the 44 motions of the SO-101 that ship with NVIDIA's SAGE.

They are no part of this project: tests/real_so101.py says where they are looked for.
"""

import numpy as np
import pytest

from real_so101 import FOLDER, NO_RECORDINGS, recorded
from rejoint.arms import so101
from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.logs.importing import import_logs
from rejoint.twin.identify import FITTED, HEALTHY, LogSettings, identify_logs

ARM = so101()

pytestmark = pytest.mark.skipif(not recorded(), reason=NO_RECORDINGS)

FITTED_TO = ("multisine", "oscillation_low_freq", "diagonal_sweep", "coupled_joints")
HELD_OUT = ("ramp_motion", "figure_eight", "square_pattern", "symmetric_motion", "circular_motion")


def load(names, tmp_path):
    return [import_logs(FOLDER / name, ARM, out=tmp_path / name).logs[0] for name in names]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return load((*FITTED_TO, *HELD_OUT), tmp_path_factory.mktemp("so101"))


def test_the_arm_lies_on_its_table_in_some_motions(logs):
    height = table_height(ARM, logs)
    assert -0.050 < height < -0.030  # about 40 mm below the base frame
    touching = {
        log.label for log, rows in zip(logs, find_exclusions(ARM, logs, height), strict=True) if rows.contact.any()
    }
    assert touching == {"oscillation_low_freq", "diagonal_sweep", "figure_eight"}
    assert table_height(ARM, [log for log in logs if log.label not in touching]) is None


def test_the_wrist_runs_into_a_stop(tmp_path):
    log = load(("single_joint_wrist_roll",), tmp_path)[0]
    rows = find_exclusions(ARM, [log])[0]
    blocked = np.abs(log.command - log.position)[:, 4] > np.radians(15)
    assert blocked.any()
    assert (rows.stop | rows.stale)[blocked].all()
    assert rows.free.mean() > 0.5


def test_motions_that_the_fit_never_saw_are_predicted(logs):
    settings = LogSettings(
        hold_out=HELD_OUT,
        coarse_seconds=80.0,
        fit_seconds=160.0,
        contact_seconds=40.0,
    )
    found = identify_logs(ARM, logs, settings)
    assert sorted(found.fitted) == sorted(FITTED_TO)
    mean = found.judgement.mean
    fitted = mean[FITTED]
    assert fitted.free.tcp < 3e-3
    assert fitted.free.joint < np.radians(0.30)
    assert fitted.all.tcp < 4.5e-3
    assert fitted.free.tcp < 0.25 * mean[HEALTHY].free.tcp
    assert found.table is not None
    assert np.ptp(np.log(found.parameters.stiffness)) < 0.15  # five servos of one type at the same gains
