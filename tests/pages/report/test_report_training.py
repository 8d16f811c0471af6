"""The training section with the contract of a policy, with and without a twin."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from readpage import Page
from rejoint.pages.html import render
from rejoint.pages.report.contents import read_curves
from rejoint.pages.report.figures import Gallery
from rejoint.training.presets import PAPER
from rejoint.training.train import policy_contract


@pytest.fixture
def curves(tmp_path):
    from report_samples import write_curves

    write_curves(tmp_path / "curves.parquet")
    return read_curves(tmp_path / "curves.parquet")


def contract(arm, digest):
    given = {"twin_digest": digest, "min_period": 0.018, "max_period": 0.055}
    return replace(policy_contract(arm, None, PAPER, 11), **given)


def section(curves, contract):
    """The words of the section, and its facts."""
    html = render("report/training.html", it=SimpleNamespace(curves=curves, contract=contract), draw=Gallery())
    page = Page(html)
    names = [text for place, text in page.places.items() if "/ dt" in place]
    return page.words, dict(zip(names, (text for place, text in page.places.items() if "/ dd" in place), strict=True))


@pytest.mark.parametrize(
    ("digest", "pupils", "twin"),
    [("0123abcd", "copies of the twin", "0123abcd"), ("", "simulated arms", "none: broad ranges alone")],
)
def test_contract_and_curves(arm, curves, digest, pupils, twin):
    words, facts = section(curves, contract(arm, digest))
    assert f"randomised {pupils}: 1.31 million" in words
    assert facts["control periods met in training"] == "18 to 55 ms"
    assert facts["twin it was trained on"] == twin
    assert facts["observation"].startswith("28 numbers"), "the paper's state size, section III-B"
    assert (facts["recipe"], facts["seed"]) == ("paper", "11")


def test_either_part_may_be_missing(arm, curves):
    assert "The policy file" not in section(curves, None)[0]
    assert "learned by trial" not in section(None, contract(arm, ""))[0]
