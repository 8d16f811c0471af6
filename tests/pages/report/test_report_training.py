"""The training section with the contract of a policy, with and without a twin."""

import pytest

from rejoint.control.contract import PolicyContract, law_digests
from rejoint.control.observation import layout_slots
from rejoint.control.residual import CommandLaw
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.sections.training import read_curves, training_section


@pytest.fixture
def curves(tmp_path):
    from report_samples import write_curves

    write_curves(tmp_path / "curves.parquet")
    return read_curves(tmp_path / "curves.parquet")


def contract(arm, digest):
    return PolicyContract(
        arm=arm.name, arm_digests=law_digests(arm), joint_names=arm.joint_names, lower=tuple(arm.lower),
        upper=tuple(arm.upper), layout="equation-16", observation=layout_slots("equation-16", arm.joints),
        law=CommandLaw(), min_period=0.018, max_period=0.055, probe=(), twin_digest=digest, preset="paper", seed=11,
        software="0.1.0",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("digest", "pupils", "twin"),
    [("0123abcd", "copies of the twin", "0123abcd"), ("", "simulated arms", "none: broad ranges alone")],
)
def test_contract_and_curves(arm, curves, digest, pupils, twin):
    shown, policy = training_section(curves, contract(arm, digest), Gallery()).parts
    assert f"randomised {pupils}: 1.31 million" in shown.texts[0]
    facts = dict(policy.facts)
    assert facts["control periods met in training"] == "18 to 55\N{NO-BREAK SPACE}ms"
    assert facts["twin it was trained on"] == twin
    assert facts["observation"].startswith("28 numbers"), "the paper's state size, section III-B"
    assert (facts["recipe"], facts["seed"]) == ("paper", "11")


def test_either_part_may_be_missing(arm, curves):
    assert len(training_section(curves, None, Gallery()).parts) == 1
    assert len(training_section(None, contract(arm, ""), Gallery()).parts) == 1
