"""Quantiles against another implementation of them."""

import math

import pytest

from rejoint.system.statistics import student95


def test_students_quantiles_are_those_of_tables():
    assert [student95(n) for n in (1, 5, 30)] == pytest.approx([12.706, 2.571, 2.042], abs=5e-4)


def test_nothing_is_known_without_a_degree_of_freedom():
    assert student95(0) == math.inf
