"""The page shows the numbers of the results: all of them, rounded as they are printed, and each in its own places."""

import re

import numpy as np
from report_samples import begin, shown

from readpage import rounds
from rejoint.logs.runfolder import RunFolder
from rejoint.pages.words import parameter_name
from rejoint.system.files import write_json
from rejoint.twin.parameters import PARAMETERS

COMPARED = "comparison / Every controller on the same arm with the same targets"
JOINTS = "diagnosis / Measured values per joint"
TWIN = "twin / Parameters of the twin"
DEG = float(np.degrees(1.0))
QUANTITIES = {
    "stiffness [N m/rad]": ("stiffness_nm_per_rad", 1.0),
    "hysteresis [deg]": ("hysteresis_rad", DEG),
    "dry friction [N m]": ("coulomb_nm", 1.0),
    "lag [ms]": ("lag_s", 1e3),
    "damping ratio [1]": ("damping_ratio", 1.0),
    "overshoot [%]": ("overshoot", 1e2),
    "offset [deg]": ("offset_rad", DEG),
    "unrest [deg]": ("hunting_rad", DEG),
    "noise [deg]": ("noise_rad", DEG),
}
"""Name and unit in the table of joints, and field of `JointMetrics` with the factor to that unit"""
SHOWN = {"offset": ("deg", DEG), "delay": ("ms", 1e3), "ramp_speed": ("deg/s", DEG)}
"""Units of parameters that are not shown in SI units"""


def shows(places, place, value, low, high):
    """A cell and its small print are a number and its interval."""
    assert rounds(places[place], value), place
    if low == high:  # that of a single result
        assert " to " not in places.get(f"{place} / small", ""), place
        return
    ends = places[f"{place} / small"].split("\n")[0].split(" to ")
    assert len(ends) == 2
    assert all(rounds(text, end) for text, end in zip(ends, (low, high), strict=True)), place


def shows_spread(places, place, spread, factor):
    mean = spread.mean
    shows(places, place, *(factor * end for end in (mean.value, mean.low, mean.high)))


def test_the_table_of_controllers_holds_every_number_with_its_interval(whole, comparison):
    places = whole[0].places
    for row in comparison.rows:
        cell = f"{COMPARED} / {row.controller}"
        success = row.success
        shows(places, f"{cell} / success [%]", *(100 * end for end in (success.value, success.low, success.high)))
        mean, std = places[f"{cell} / error at the crossing [mm]"].split(" ± ")
        assert rounds(mean, 1e3 * row.crossing_error.mean.value)
        assert rounds(std, 1e3 * row.crossing_error.std)
        shows_spread(places, f"{cell} / 10 targets [s]", row.cycle_time, 1.0)
        shows_spread(places, f"{cell} / settled error, encoders [mm]", row.settled, 1e3)
        shows_spread(places, f"{cell} / settled error, true [mm]", row.settled_true, 1e3)
        stays = places[f"{cell} / time to stay within 10 / 5 / 2 mm [s]"].split(" / ")
        for text, stay in zip(stays, row.stays, strict=True):
            assert text == "never" if stay.median is None else rounds(text, stay.median)
        shares = places[f"{cell} / time to stay within 10 / 5 / 2 mm [s] / small"].removesuffix(" %").split(" / ")
        assert all(rounds(text, 100 * stay.share.value) for text, stay in zip(shares, row.stays, strict=True))
        assert rounds(places[f"{cell} / oscillation [mm]"], 1e3 * row.oscillation.mean.value)


def test_one_number_for_one_property_of_a_joint(whole):
    page = whole[0]
    for name in ("stiffness", "dry friction", "offset"):
        places = [place for place in page.places if re.search(rf" / {name} \[.*/ joint1$", place)]
        assert len(places) == 1
        assert places[0].startswith(TWIN)


def test_the_table_of_joints_holds_every_measurement_and_the_healthy_range(tmp_path, arm, diagnosis):
    folder = RunFolder(tmp_path)
    begin(tmp_path, arm)
    write_json(folder.diagnosis, diagnosis)
    places, shown_rows = shown(folder.path)[0].places, 0
    for title, (field, factor) in QUANTITIES.items():
        name = f"{JOINTS} / {title}"
        for i, (row, well) in enumerate(zip(diagnosis.measurement.joints, diagnosis.healthy.joints, strict=True), 1):
            found, healthy = getattr(row, field), getattr(well, field)
            shown_rows += 1
            assert rounds(places[f"{name} / joint{i}"], factor * found.value)
            if found.low is None:
                assert f"{name} / joint{i} / small" not in places
            else:
                shows(places, f"{name} / joint{i}", *(factor * e for e in (found.value, found.low, found.high)))
            text = places[f"{name}, healthy / joint{i} / small"]
            if healthy.low is None:
                assert text == "not known"
            else:
                ends = (healthy.low if field == "offset_rad" else max(healthy.low, 0.0), healthy.high)
                assert all(rounds(t, factor * end) for t, end in zip(text.split(" to "), ends, strict=True))
    assert shown_rows == 6 * 9


def test_the_table_of_the_twin_holds_every_parameter_and_says_which_are_not_identified(whole, twin):
    places, (low, high) = whole[0].places, twin.interval
    known = dict(zip(twin.names, twin.identified, strict=True))
    for p in PARAMETERS:
        unit, factor = SHOWN.get(p.name, (p.unit.replace("^2", "²"), 1.0))
        values, lows, highs = (np.atleast_1d(getattr(one, p.name)) * factor for one in (twin.parameters, low, high))
        for i in range(len(values)):
            cell = f"{TWIN} / {parameter_name(p.name)} [{unit}] / joint{i + 1}"
            assert rounds(places[cell], values[i])
            if known[f"{p.name}.joint{i + 1}" if p.per_joint else p.name]:
                shows(places, cell, values[i], lows[i], highs[i])
            else:
                assert places[f"{cell} / small"] == "not identified"
