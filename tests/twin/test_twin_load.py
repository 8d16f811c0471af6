"""What was not told of an arm is doubted, and a limit is claimed only of the joint that reaches it."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, centre_of, record, wandering

import rejoint
from rejoint.arms.inertia import Payload, loaded
from rejoint.twin.identify import LogSettings, identify_logs


def motions(slower, size, **options):
    paths = [wandering(k, 20.0, centre_of(k), size) for k in range(4)]
    return [record(f"motion{k}", slower * time, path, **options) for k, (time, path) in enumerate(paths)]


def identified(logs):
    return identify_logs(ARM, logs, LogSettings(coarse_seconds=12.0, fit_seconds=30.0))


@pytest.mark.parametrize(
    ("up", "mass", "sign", "zero", "integral", "named"),
    [
        (1.0, 0.0, 1.0, 0, 0.0, ""),
        (-1.0, 0.0, 1.0, 0, 0.0, "gravity"),
        (1.0, 0.2, 1.0, 0, 0.0, "payload"),
        (1.0, 0.0, -1.0, 0, 0.0, "shoulder_lift"),
        (1.0, 0.0, 1.0, 15, 0.0, "shoulder_lift"),
        (1.0, 0.0, 1.0, 0, 1.0, "integral"),
    ],
)
def test_a_base_a_load_a_sign_a_zero_or_a_controller_that_is_wrong_is_doubted(up, mass, sign, zero, integral, named):
    turned, off = np.array([1.0, sign, 1.0, 1.0, 1.0]), np.radians(zero) * np.eye(ARM.joints)[1]
    base = np.diag([1.0, up, up, 1.0]) @ ARM.offset[:1]
    mounted = replace(ARM, offset=np.concatenate([base, ARM.offset[1:]]))
    logs = motions(2.0, 0.5, own=loaded(mounted, Payload(mass=mass), None), integral=integral)
    logs = [replace(log, position=turned * log.position + off, command=turned * log.command + off) for log in logs]
    twin = identified(logs)
    assert bool(twin.judgement.doubts) == bool(named)
    assert named in "".join(twin.judgement.doubts)
    assert twin.identified[twin.layout.at("stiffness")].any() == (not named)
    told = rejoint.diagnose(logs, arm=ARM, settings=rejoint.Settings(payload=mass)).verdict
    assert "payload" not in told


def test_a_torque_limit_is_known_where_a_joint_stalls_and_nowhere_else():
    twin = identified(motions(1.0, 0.25, truth=replace(TRUTH, torque_limit=np.array([20.0, 20.0, 1.2, 20.0, 20.0]))))
    low, high = (end.torque_limit for end in twin.interval)
    assert ((low < [20.0, 20.0, 1.2, 20.0, 20.0]) & (high > [19.0, 19.0, 1.2, 19.0, 19.0])).all()
    assert twin.identified[twin.layout.at("torque_limit")].tolist() == [False, False, True, False, False]
