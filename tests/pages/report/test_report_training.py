"""The training section with the contract of a policy, with and without a twin."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from readpage import Page
from rejoint.pages.html import render
from rejoint.pages.report.figures import Gallery
from rejoint.pages.report.page import read_curves
from rejoint.training.train import policy_contract
from rejoint_lab.research.reproduction.campaign import PAPER


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
    policy = contract and SimpleNamespace(contract=contract)
    html = render("report/training.html", it=SimpleNamespace(curves=curves, policy=policy), draw=Gallery())
    page = Page(html)
    names = [text for place, text in page.places.items() if "/ dt" in place]
    return page.words, dict(zip(names, (text for place, text in page.places.items() if "/ dd" in place), strict=True))


def test_either_part_may_be_missing(arm, curves):
    assert "The policy file" not in section(curves, None)[0]
    assert "learned by trial" not in section(None, contract(arm, ""))[0]
