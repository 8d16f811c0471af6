"""Arms from files at the command line: what an owner of an arm that nobody here knows sees.

The URDFs ship inside ManipulaPy, which is installed with the development extra and not imported.
"""

from modelfiles import packaged
from rejoint.runs.run import Run

UR10 = "ManipulaPy_data/universal_robots/ur10/ur10.urdf"


def test_a_worn_ur10_is_diagnosed_and_brought_to_its_targets(tmp_path, cli):
    run, ends = tmp_path / "run", ("--base", "base_link", "--tip", "tool0")
    done = cli("diagnose", "emulated:worn", "--arm", packaged("ManipulaPy", UR10), *ends, "--run", run, "--json")
    assert "arm ur10_robot: encoders: no resolution given; 16384 steps a turn assumed" in done.err
    found = done.last["diagnosis"]
    # 7.7 % of the 890 mm between its targets and its base's axis, where a healthy one misses by 1.6 %
    assert 45.0 < found["open_loop"]["error_mm"]["value"] < 110.0
    assert "shoulder_lift_joint" in {finding["joint"] for finding in found["findings"][:2]}
    assert Run.open(run).arm.joint_names[0] == "shoulder_pan_joint"
    done = cli("deploy", "emulated:worn", run, "--controller", "integrator", "--dwell", "6", "--json")
    errors = done.last["error_mm"]
    assert len(errors) == 10
    assert max(errors) < 10.0
