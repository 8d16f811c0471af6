from runs.test_connect import a_twin


def rows_of(cli, command, out, *words):
    return cli("research", command, *words, "--out", out, "--json").last["rows"]


def test_a_family_is_evaluated_and_resumed(cli, tmp_path):
    one = "--arms", "2", "--targets", "1", "--variants", "worn", "--controllers", "integrator", "--crossings", "0"
    row = rows_of(cli, "evaluate", tmp_path, *one)[0]
    assert 0.0 < row["settled"]["mean"]["value"] < 0.005
    assert row["cycle_time"] is None
    kept = tmp_path / "outcomes" / "worn--integrator.json"
    before = kept.stat().st_mtime_ns
    assert rows_of(cli, "evaluate", tmp_path, *one) == [row]
    assert kept.stat().st_mtime_ns == before


def test_targets_anywhere_are_held_by_controllers_that_know_each_arm_by_its_twin(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("rejoint_lab.research.evaluation.family.own_twin", lambda *_: a_twin())
    held = "--variants", "anywhere,known", "--controllers", "feedforward,predictive", "--crossings", "0", "--seed", "1"
    rows = rows_of(cli, "evaluate", tmp_path, "--arms", "1", "--targets", "1", *held)
    assert [row["controller"] for row in rows] == 2 * ["feedforward", "predictive"]
    settled = [row["settled"]["mean"]["value"] for row in rows]
    assert max(settled) < 0.002, settled


def test_calibrations_are_tried_in_the_target_region_and_anywhere(cli, tmp_path, monkeypatch):
    monkeypatch.setattr("rejoint_lab.research.evaluation.family.own_twin", lambda *_: a_twin())
    monkeypatch.setattr("rejoint_lab.research.evaluation.evaluate.POINTS", (20,))
    rows = rows_of(cli, "calibrate", tmp_path, "--arms", "1", "--targets", "1", "--variants", "worn")
    error = {(row["variant"], row["controller"]): row["settled_true"]["mean"]["value"] for row in rows}
    for where in ("worn, target region", "worn, anywhere"):
        assert error[where, "20 points"] < 0.5 * error[where, "not calibrated"]


def test_gains_found_before_a_search_fails_are_kept(cli, tmp_path, monkeypatch):
    found, out = [{"rate": 1.0}], tmp_path / "gains.json"
    monkeypatch.setattr("rejoint_lab.research.rivals.tune", lambda *_, **__: found.pop())
    cli("research", "tune", "tuned-feedforward", "pid-sum", "--out", out, code=None)
    assert "rate" in out.read_text()
