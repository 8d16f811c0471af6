"""A twin is trusted only where something moved, on one clock, often enough, and the commands predict it worse."""

import re
from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, as_log, problem_of, record, wandering

from rejoint.pages.report.tables import answer
from rejoint.twin.fit import fit
from rejoint.twin.identify import FREEDOM
from rejoint.twin.judge import Candidate, judge, predict_logs
from rejoint.twin.parameters import healthy_parameters, pack, unknown_prior, unpack
from rejoint.twin.replay import cut
from rejoint.twin.structure import Structure
from rejoint.twin.twin import smaller

LOGS = [record(f"motion{k}", *wandering(k, 10.0)) for k in range(4)]
TWIN = Candidate(name="twin", parameters=TRUTH)


def judged(candidate, logs):
    return judge(ARM, predict_logs(ARM, [candidate], logs), logs)


def shifted(log, rows):
    """The log with readings that come so many rows later, or earlier if negative."""
    time, command, position = log.time, log.command, log.position
    if rows > 0:
        return as_log(log.label, time[rows:], position[:-rows], command[rows:])
    return as_log(log.label, time[:rows], position[-rows:], command[:rows])


def still(log):
    resting = np.tile(log.position[:1], (len(log), 1))
    return replace(log, position=resting, command=np.tile(log.command[:1], (len(log), 1)))


CASES = {
    "no joint moved by more than": still,
    "readings are 0.34 s apart, expected at most 0.11 s": lambda log: log.rows(slice(None, None, 17)),
    "measurably better than the command": lambda log: replace(
        log, position=np.vstack([log.command[:1], log.command[:-1]])
    ),
    r"follow the commands by 0.[67]\d s, expected 0 to 0.3 s": lambda log: shifted(log, 30),
    r"follow the commands by -0.2\d s": lambda log: shifted(log, -15),
}


@pytest.mark.parametrize("says", CASES)
def test_what_is_missing_is_said_in_place_of_trust(says):
    judgement = judged(TWIN, [CASES[says](log) for log in LOGS])
    assert len(judgement.doubts) >= 1
    first = answer(judgement)[0]
    assert first.startswith("Trust none of them: ")
    assert sum(bool(re.search(says, doubt)) for doubt in judgement.doubts) == 1


def test_a_twin_that_beats_the_commands_is_trusted_and_one_that_does_not_is_not():
    good = judged(TWIN, LOGS)
    assert good.doubts == ()
    assert answer(good)[0].startswith("Trust “twin”")
    healthy = replace(TWIN, parameters=replace(healthy_parameters(ARM), offset=np.full(ARM.joints, 0.05)))
    bad = judged(healthy, LOGS)
    assert any("no twin predicts measurably better than the command" in doubt for doubt in bad.doubts)


def test_a_motion_that_no_twin_follows_counts_less_and_is_named():
    """One motion of five is shaken by five degrees: it spoils the fit only where all count alike."""
    rng = np.random.default_rng(0)
    shaking = np.cumsum(rng.standard_normal(LOGS[0].position.shape), axis=0)
    shaking = np.radians(5.0) * (shaking - shaking.mean(axis=0)) / shaking.std(axis=0)
    logs = [*LOGS, replace(LOGS[0], label="shaken", position=LOGS[0].position + shaking)]
    structure = Structure(belief=unknown_prior(ARM))
    start = np.clip(pack(TRUTH), structure.prior.lower, structure.prior.upper)
    off = []
    for freedom in (FREEDOM, np.inf):
        found = fit(problem_of(structure, cut(logs, 5.0), freedom=freedom), start, 4)
        off.append(np.abs(np.log(unpack(found.vector).coulomb / TRUTH.coulomb)).mean())
    assert off[0] < 0.05 < off[1]


def test_what_differs_no_more_than_by_chance_is_not_smaller():
    fitted = np.array([2.0, 3.0, 1.0, 2.0])
    assert smaller(fitted, np.array([17.0, 19.0, 15.0, 18.0]))
    assert not smaller(fitted, np.array([2.5, 2.0, 1.8, 1.9]))
