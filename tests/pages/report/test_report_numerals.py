"""Numbers are rounded to what they are worth, carry units and are never `nan`."""

import pytest

from rejoint.pages.words import interval, number


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (99.96, 3, "100"),
        (0.0996, 2, "0.10"),
    ],
)
def test_significant_digits(value, digits, text):
    assert number(value, digits) == text


def test_rounding_noise_is_zero():
    assert number(6.3e-17, 2) == "0.0"
    assert interval(-1e-15, 2.4e-14, 2) == "0.0 to 0.0"
    assert number(0.000213, 3) == "0.00021", "five decimals at most"
