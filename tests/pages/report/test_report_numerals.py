"""Numbers are rounded to what they are worth, carry units and are never `nan`."""

import pytest

from rejoint.pages.report.numerals import UNKNOWN, interval, number, spread


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (22.04, 3, "22.0"), (8.2149, 3, "8.21"), (0.3312, 2, "0.33"), (197.3, 3, "197"), (1234.6, 3, "1235"),
        (99.96, 3, "100"), (0.0996, 2, "0.10"), (0.0, 2, "0.0"), (-0.001, 3, "-0.00100"), (100.0, 3, "100"),
    ],
)  # fmt: skip
def test_significant_digits(value, digits, text):
    assert number(value, digits) == text


@pytest.mark.parametrize("missing", [None, float("nan"), float("inf"), float("-inf")])
def test_what_is_missing_is_said(missing):
    assert number(missing, unit="mm") == UNKNOWN
    assert spread(missing, 1.0, unit="mm") == UNKNOWN
    assert interval(missing, 1.0) == ""
    assert interval(0.0, missing) == ""
    assert spread(1.0, missing) == "1.00"


def test_rounding_noise_is_zero():
    assert number(6.3e-17, 2) == "0.0"
    assert number(-2e-12, 3) == "0.00"
    assert interval(-1e-15, 2.4e-14, 2) == "0.0 to 0.0"
    assert number(0.00213, 3) == "0.00213"
    assert number(0.000213, 3) == "0.00021", "five decimals at most"


def test_units_do_not_break_off():
    assert number(3.0, 2, "mm") == "3.0\N{NO-BREAK SPACE}mm"


def test_spread_takes_the_decimals_of_its_mean():
    assert spread(22.04, 14.567, unit="mm") == "22.0 ± 14.6\N{NO-BREAK SPACE}mm"
    assert spread(0.331, 0.1234, 2) == "0.33 ± 0.12"


def test_interval_has_the_decimals_of_its_larger_end():
    assert interval(0.2954, 1.2345, 2) == "0.3 to 1.2"
    assert interval(-0.00001, 0.5, 2) == "0.00 to 0.50"
    assert interval(-12.3, -1.0, 3) == "-12.3 to -1.0"
