"""The page shows the numbers of the results: all of them, rounded as they are printed, and each in its own places."""

import dataclasses
import re

import numpy as np
import pytest
from report_samples import make_comparison, shown

from readpage import changed, put, rounds
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.pages.report.sections.joints import QUANTITIES
from rejoint.pages.report.sections.twin import NAMES, SHOWN
from rejoint.system.files import write_json
from rejoint.twin.file import write_twin
from rejoint.twin.parameters import PARAMETERS

COMPARED = "comparison / Every controller on the same arm with the same targets"
JOINTS = "diagnosis / Measured values per joint"
TWIN = "twin / Parameters of the twin"


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
        success = row.crossing.success
        shows(places, f"{cell} / success [%]", *(100 * end for end in (success.value, success.low, success.high)))
        mean, std = places[f"{cell} / error at the crossing [mm]"].split(" ± ")
        assert rounds(mean, 1e3 * row.crossing.error.mean.value)
        assert rounds(std, 1e3 * row.crossing.error.std)
        shows_spread(places, f"{cell} / 10 targets [s]", row.crossing.cycle_time, 1.0)
        shows_spread(places, f"{cell} / settled error, encoders [mm]", row.hold.settled, 1e3)
        shows_spread(places, f"{cell} / settled error, true [mm]", row.hold.settled_true, 1e3)
        stays = places[f"{cell} / time to stay within 10 / 5 / 2 mm [s]"].split(" / ")
        for text, stay in zip(stays, row.hold.stays, strict=True):
            assert text == "never" if stay.median is None else rounds(text, stay.median)
        shares = places[f"{cell} / time to stay within 10 / 5 / 2 mm [s] / small"].removesuffix(" %").split(" / ")
        assert all(rounds(text, 100 * stay.share.value) for text, stay in zip(shares, row.hold.stays, strict=True))
        assert rounds(places[f"{cell} / oscillation [mm]"], 1e3 * row.hold.oscillation.mean.value)


def test_one_number_for_one_property_of_a_joint(whole):
    page, figures = whole
    same = [quantity for quantity in QUANTITIES if quantity.parameter]
    assert [quantity.parameter for quantity in same] == ["stiffness", "coulomb", "offset"]
    for quantity in same:
        places = [place for place in page.places if re.search(rf" / {quantity.name} \[.*/ joint1$", place)]
        assert len(places) == 1
        assert places[0].startswith(TWIN)
        assert f"joint-{quantity.name.replace(' ', '-')}" not in figures


def test_the_table_of_joints_holds_every_measurement_and_the_healthy_range(tmp_path, diagnosis):
    folder = RunFolder(tmp_path)
    write_json(folder.diagnosis, diagnosis)
    places, shown_rows = shown(folder.path)[0].places, 0
    for quantity in QUANTITIES:
        name = f"{JOINTS} / {quantity.name} [{quantity.unit}]"
        for i, (row, well) in enumerate(zip(diagnosis.measurement.joints, diagnosis.healthy.joints, strict=True), 1):
            found, healthy = getattr(row, quantity.field), getattr(well, quantity.field)
            shown_rows += 1
            assert rounds(places[f"{name} / joint{i}"], quantity.factor * found.value)
            if found.low is None:
                assert f"{name} / joint{i} / small" not in places
            else:
                shows(
                    places, f"{name} / joint{i}", *(quantity.factor * e for e in (found.value, found.low, found.high))
                )
            text = places[f"{name}, healthy / joint{i} / small"]
            if healthy.low is None:
                assert text == "not known"
            else:
                ends = (healthy.low if quantity.signed else max(healthy.low, 0.0), healthy.high)
                assert all(rounds(t, quantity.factor * end) for t, end in zip(text.split(" to "), ends, strict=True))
    assert shown_rows == 6 * 9


def test_the_table_of_the_twin_holds_every_parameter_and_says_which_are_not_identified(whole, twin):
    places, (low, high) = whole[0].places, twin.interval
    known = dict(zip(twin.names, twin.identified, strict=True))
    for p in PARAMETERS:
        unit, factor = SHOWN.get(p.name, (p.unit.replace("^2", "²"), 1.0))
        values, lows, highs = (np.atleast_1d(getattr(one, p.name)) * factor for one in (twin.parameters, low, high))
        for i in range(len(values)):
            cell = f"{TWIN} / {NAMES[p.name]} [{unit}] / joint{i + 1}"
            assert rounds(places[cell], values[i])
            if known[f"{p.name}.joint{i + 1}" if p.per_joint else p.name]:
                shows(places, cell, values[i], lows[i], highs[i])
            else:
                assert places[f"{cell} / small"] == "not identified"


@pytest.fixture(scope="module")
def changes(tmp_path_factory):
    """What changes on the page of one result alone, by place without its number, when one number of it changes."""
    pages = {}

    def places(file, value, path, new, write=write_json):
        folder, before = pages.get(file, (None, None))
        if folder is None:
            folder = RunFolder(tmp_path_factory.mktemp(file))
            write(getattr(folder, file), value)
            pages[file] = folder, before = folder, shown(folder.path)[0]
        write(getattr(folder, file), put(value, path, new))
        found = changed(before, shown(folder.path)[0])
        bare = {}
        for place, words in found.items():
            name = re.sub(r"(p|li|dd|picture) \d+$", r"\1", place)
            bare[name if name not in bare else f"{name}, again"] = words
        assert len(bare) == len(found)
        return bare

    return places


def expect(found, expected):
    """Exactly these places changed, and each holds its words."""
    assert found.keys() == expected.keys()
    for place, words in expected.items():
        assert words in found[place], place


CONTROLLERS = ("default", "integrator", "policy")
ENCODERS, TRUE = "settled error, encoders [mm]", "settled error, true [mm]"


def cell(controller, column, small=False):
    return f"{COMPARED} / {controller} / {column}{' / small' * small}"


@pytest.mark.parametrize(
    ("path", "new", "expected"),
    [
        ("rows.1.hold.settled.mean.value", 2.2e-3, {cell("integrator", ENCODERS): "2.20",
                                                    "picture": "integrator: 2.20 mm"}),
        ("rows.1.hold.settled.mean.high", 4.4e-3, {cell("integrator", ENCODERS, True): " to 4.40"}),
        ("rows.2.hold.settled.mean.value", 0.44e-3, {
            "verdict / p": "brings this arm to 0.44 mm of its targets",
            "verdict / p, again": "After, with 'policy': 0.44 mm (encoders)", "verdict / dd": "0.44 mm95 %:",
            "verdict / li": "settles at 0.44 mm", cell("policy", ENCODERS): "0.440", "picture": "policy: 0.440 mm"}),
        ("rows.2.hold.settled.mean.low", 0.11e-3, {
            "verdict / dd": "95 %: 0.11 to", "verdict / li": "(0.11 to", cell("policy", ENCODERS, True): "0.110 to"}),
        ("rows.0.hold.settled.mean.value", 33.3e-3, {
            "verdict / p": "its own controller leaves 33.3 mm, so that 33.0 mm are gained",
            "verdict / p, again": "Before: 33.3 mm off (encoders)",
            cell("default", ENCODERS): "33.3", "picture": "default: 33.3 mm"}),
        ("rows.2.hold.settled_true.mean.value", 5.5e-3, {
            "verdict / p": "5.5 mm (tool)", "verdict / dd": "5.5 mmbefore: 29.1 mm",
            "verdict / li": "The tool itself is 5.5 mm off",
            cell("policy", TRUE): "5.5"}),
        ("rows.1.crossing.success.value", 0.777, {cell("integrator", "success [%]"): "77.7"}),
        ("rows.1.crossing.success.low", 0.555, {cell("integrator", "success [%]", True): "56 to"}),
        ("rows.1.crossing.error.std", 4.44e-3, {cell("integrator", "error at the crossing [mm]"): "8.20 ± 4.44"}),
        ("rows.2.crossing.cycle_time.mean.value", 6.66, {
            "verdict / dd": "6.66 sbefore: 181 s", "verdict / li": "(6.7 s for 10)",
            cell("policy", "10 targets [s]"): "6.66", "picture": "policy: 6.66 s"}),
        ("rows.1.hold.stays.0.median", 3.3, {
            cell("integrator", "time to stay within 10 / 5 / 2 mm [s]"): "3.3 / 2.7 / never"}),
        ("rows.1.hold.stays.0.share.value", 0.5, {
            cell("integrator", "time to stay within 10 / 5 / 2 mm [s]", True): "50 / 100 / "}),
        ("rows.1.hold.oscillation.mean.value", 0.99e-3, {cell("integrator", "oscillation [mm]"): "0.99"}),
        ("rows.2.guard.0.share", 0.0777, {cell("policy", "guard"): "7.8 % step"}),
        ("targets.0.2", (0.1, 0.0, 0.2), {
            f"details / Targets in the base frame / set 1, target 3 / {axis} [mm]": value
            for axis, value in (("x", "100.0"), ("y", "0.0"), ("z", "200.0"))}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_number_of_the_comparison_stands_in_its_own_places_and_in_no_other(changes, arm, path, new, expected):
    comparison = make_comparison(arm, CONTROLLERS)
    expect(changes("comparison", comparison, path, new), expected)


STIFFNESS = f"{JOINTS} / stiffness [N m/rad]"


@pytest.mark.parametrize(
    ("path", "new", "expected"),
    [
        ("open_loop.error_mm.value", 44.4, {"verdict / dd": "44.4 mm95 %"}),
        ("open_loop.error_mm.low", 11.1, {"verdict / dd": "95 %: 11.1 to"}),
        ("open_loop.targets.3.error_mm", 66.0, {"picture": "target 4 66,"}),
        ("findings.0.tcp_mm", 33.0, {"diagnosis / Findings, the worst at the tool first / joint3 / at the tool [mm]":
                                     "33"}),
        ("measurement.joints.2.stiffness_nm_per_rad.value", 5.5,
         {f"{STIFFNESS} / joint3": "5.5", "picture": "joint3 5.5"}),
        ("measurement.joints.2.stiffness_nm_per_rad.low", 2.0, {f"{STIFFNESS} / joint3 / small": "2.0 to 9.9"}),
        ("measurement.joints.4.lag_s.value", 0.077, {f"{JOINTS} / lag [ms] / joint5": "77", "picture": "joint5 77"}),
        ("healthy.joints.2.stiffness_nm_per_rad.high", 55.0, {f"{STIFFNESS}, healthy / joint3 / small": "34 to 55"}),
        ("healthy.error_mm.value", 4.4, {"verdict / dd": "a healthy arm: 4.4 mm"}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_number_of_the_diagnosis_stands_in_its_own_places_and_in_no_other(changes, diagnosis, path, new, expected):
    expect(changes("diagnosis", diagnosis, path, new), expected)


@pytest.mark.parametrize(
    ("path", "new", "expected"),
    [
        ("held_out.twin.tcp", 4.4e-3, {"verdict / li": "within 4.4 mm (with", "picture": "twin of this arm: 4.40 mm"}),
        ("held_out.no_twin.tcp", 33e-3, {"verdict / li": "(without a twin: 33 mm)", "picture": "command): 33.0 mm"}),
        ("held_out.healthy_twin.tcp", 11e-3, {"picture": "twin of a healthy arm: 11.0 mm"}),
        ("held_out.twin.joint", 0.05, {"twin / p": "within 2.9 deg (root mean square)"}),
        ("held_out.seconds", 77.0, {"twin / p": "judged on 77 s"}),
        ("fit_seconds", 55.0, {"twin / p": "fitted to 55 s"}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_number_of_the_twin_stands_in_its_own_places_and_in_no_other(changes, twin, path, new, expected):
    expect(changes("twin", twin, path, new, write_twin), expected)


def test_swapping_two_controllers_swaps_their_rows(tmp_path, arm):
    comparison = make_comparison(arm, CONTROLLERS)
    default, integrator, policy = comparison.rows
    swapped = [
        dataclasses.replace(integrator, controller="policy"), dataclasses.replace(policy, controller="integrator")
    ]  # fmt: skip
    pages = []
    for rows in ((default, integrator, policy), (default, *swapped)):
        write_json(RunFolder(tmp_path).comparison, dataclasses.replace(comparison, rows=tuple(rows)))
        pages.append(shown(tmp_path)[0])
    cells = [
        {place: text for place, text in page.places.items() if place.startswith(COMPARED) and "paper" not in text}
        for page in pages
    ]
    for column in (ENCODERS, TRUE, "success [%]", "10 targets [s]", "oscillation [mm]", "guard"):
        assert cells[0][cell("policy", column)] == cells[1][cell("integrator", column)]
        assert cells[0][cell("integrator", column)] == cells[1][cell("policy", column)]
    assert "Use the controller “policy”" in pages[0].words
    assert "Use the controller “integrator”" in pages[1].words, "the recommendation goes with the numbers"
