"""Figures show the given data, name their units and are the same every time."""

import io
import itertools
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from rejoint.pages.report import palette
from rejoint.pages.report.embed import inline_svg, save_png, theme_css
from rejoint.pages.report.figures import (
    Path3,
    Series,
    by_joint,
    error_over_time,
    error_per_target,
    intervals,
    ranked_bars,
    training_curves,
    trajectory,
)

RNG = np.random.default_rng(5)


def series(label="worn", look=palette.GREY, count=10):
    value = RNG.uniform(1, 30, count)
    return Series(label=label, look=look, value=value, low=value - 0.5, high=value + 1.0)


def test_bars_have_the_given_heights_and_unit():
    one, other = series(), series("healthy", palette.GREEN)
    axes = error_per_target([one, other]).axes[0]
    heights = [bar.get_height() for container in axes.containers for bar in getattr(container, "patches", [])]
    np.testing.assert_allclose(heights, [*one.value, *other.value])
    assert "[mm]" in axes.get_ylabel()
    assert [
        line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1 and len(line.get_xdata()) == 2
    ] == [10.0]


def test_error_over_time_draws_every_line_on_a_log_axis():
    time = np.linspace(0, 8, 50)
    lines = [
        Series(label=n, look=look, value=np.exp(-time) + i) for i, (n, look) in enumerate(palette.CONTROLLERS.items())
    ]
    axes = error_over_time(time, lines).axes[0]
    drawn = {line.get_label(): line for line in axes.lines}
    for one in lines:
        np.testing.assert_array_equal(drawn[one.label].get_ydata(), one.value)
        assert drawn[one.label].get_color() == one.look.colour
    assert axes.get_yscale() == "log"
    assert "[s]" in axes.get_xlabel()
    assert "[mm]" in axes.get_ylabel()


def test_trajectory_shows_both_views_in_mm():
    tcp, targets = RNG.uniform(0.1, 0.2, (40, 3)), RNG.uniform(0.1, 0.2, (3, 3))
    path = Path3(label="policy", look=palette.BLUE, tcp=tcp, targets=targets)
    above, side = trajectory(path, np.array([[0.05, 0.25]] * 3)).axes
    np.testing.assert_allclose(above.lines[0].get_xdata(), tcp[:, 1] * 1e3)
    np.testing.assert_allclose(above.lines[0].get_ydata(), tcp[:, 0] * 1e3)
    np.testing.assert_allclose(side.lines[0].get_xdata(), tcp[:, 0] * 1e3)
    np.testing.assert_allclose(side.lines[0].get_ydata(), tcp[:, 2] * 1e3)
    assert above.get_xlim() == (250, 50), "seen from above with x up, y points to the left"
    assert [text.get_text() for text in side.texts] == ["1", "2", "3"]
    assert side.get_ylabel() == "z [mm]"


def test_interval_rows_carry_value_and_ends():
    one = Series(label="policy", look=palette.BLUE, value=np.array([2.0]), low=np.array([1.5]), high=np.array([3.0]))
    axes = intervals([one, series(count=1)], "error [mm]").axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["policy", "worn"]
    (segment,) = axes.containers[0][2][0].get_segments()
    np.testing.assert_allclose(segment[:, 0], [1.5, 3.0])
    assert axes.get_ylim() == (1.5, -0.5), "the first row is on top"


def test_joint_figure_draws_measured_and_reference():
    measured = series("measured", palette.BLUE, 6)
    reference = Series(
        label="healthy", look=palette.GREY, value=np.full(6, 5.0), low=np.full(6, 4.0), high=np.full(6, 7.0)
    )
    axes = by_joint("stiffness [N m/rad]", [f"J{i}" for i in range(1, 7)], measured, reference).axes[0]
    assert {bar.get_height() for bar in axes.patches} == {3.0}
    assert axes.get_title(loc="left") == "stiffness [N m/rad]"
    np.testing.assert_allclose(axes.containers[-1][0].get_ydata(), measured.value)


def test_bars_and_curves():
    axes = ranked_bars(["no twin", "fitted"], np.array([20.0, 2.125]), [palette.GREY, palette.BLUE], "error [mm]").axes[
        0
    ]
    assert [bar.get_width() for bar in axes.patches] == [20.0, 2.125]
    assert [text.get_text() for text in axes.texts] == ["20", "2.12"]
    steps, reward = np.array([0.0, 5e5, 1e6]), np.array([-3.0, -1.0, 2.0])
    figure = training_curves(steps, [("reward", reward), ("error [mm]", reward + 9)], palette.BLUE)
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), reward)
    np.testing.assert_array_equal(figure.axes[1].lines[0].get_xdata(), [0, 0.5, 1.0])
    assert "million" in figure.axes[1].get_xlabel()


def make():
    value = np.arange(1.0, 11.0)
    return error_per_target([Series(label='a <worn> & "old" arm', look=palette.GREY, value=value)])


def test_svg_is_deterministic_wellformed_and_follows_the_theme():
    first, again = inline_svg(make(), "bars", "alt"), inline_svg(make(), "bars", "alt")
    assert first == again
    assert palette.INK not in first
    assert "currentColor" in first
    assert palette.GREY.colour not in first
    assert "var(--look-0)" in first
    assert "http" not in first
    root = ET.fromstring(str(first).replace("xlink:href", "href"))
    assert root.get("role") == "img"
    text = "".join(root.itertext())
    assert 'a <worn> & "old" arm' in text
    assert "<style" not in first, "a style inside would leak into the whole page"


def test_identifiers_of_two_figures_never_meet():
    one, other = inline_svg(make(), "one", "a"), inline_svg(make(), "other", "a")
    found = [set(re.findall(r'\bid="([^"]+)"', svg)) for svg in (one, other)]
    assert found[0]
    assert not found[0] & found[1]
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', one))
    assert {a or b for a, b in used} <= found[0], "every reference points into its own figure"


@pytest.mark.parametrize("alt", ['"><script>alert(1)</script>', "back\\1slash & more"])
def test_hostile_alt_text_stays_text(alt):
    svg = inline_svg(make(), "k", alt)
    assert ET.fromstring(str(svg).replace("xlink:href", "href")).get("aria-label") == alt


def test_png_is_whole_and_deterministic(tmp_path):
    for name in ("a", "b"):
        save_png(make(), tmp_path / "figures" / f"{name}.png")
    one = (tmp_path / "figures" / "a.png").read_bytes()
    assert one[:8] == b"\x89PNG\r\n\x1a\n"
    assert one == (tmp_path / "figures" / "b.png").read_bytes()
    assert io.BytesIO(one).getvalue()[-8:-4] == b"IEND"


def luminance(colour):
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def test_controllers_under_tuned_gains_look_like_the_same_without_and_unlike_each_other():
    looks = [palette.look_of(name) for name in ("servo-gains", "servo-gains+integrator", "integrator", "mine")]
    assert looks[0].colour == palette.look_of("default").colour
    assert looks[1].colour == looks[2].colour
    assert len({(look.colour, look.marker) for look in looks}) == 4
    assert looks[3] is palette.BROWN
    for name, look in zip(("servo-gains", "mine"), (palette.GREY, palette.BROWN), strict=True):
        assert palette.LOOKS[palette.colour_number(name)] is look


@pytest.mark.parametrize("look", palette.LOOKS)
def test_looks_stand_out_from_their_ground(look):
    """Contrast as WCAG 2.2 defines it; 3 : 1 is its minimum for graphics (1.4.11)."""
    assert 1.05 / (luminance(look.colour) + 0.05) > 3.0
    assert (luminance(look.dark) + 0.05) / (luminance("#13171b") + 0.05) > 4.5


def test_no_two_looks_share_colour_marker_or_line():
    for attribute in ("colour", "dark", "marker", "dash", "hatch"):
        values = [str(getattr(look, attribute)) for look in palette.LOOKS]
        assert len(set(values)) >= len(values) - (attribute == "hatch"), attribute
    assert len(set(map(id, palette.CONTROLLERS.values()))) == len(palette.CONTROLLERS)
    css = theme_css()
    assert css["light"].count("--look-") == css["dark"].count("--look-") == len(palette.LOOKS)


@pytest.mark.parametrize(
    "names",
    [("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"), ("shoulder_pan", "shoulder_lift", "elbow") * 2],
)
def test_names_of_joints_do_not_run_into_each_other(names):
    figure = by_joint("lag [ms]", names, series(count=6))
    figure.draw_without_rendering()
    labels = figure.axes[0].get_xticklabels()
    assert [label.get_text() for label in labels] == list(names)
    level = labels[0].get_rotation() == 0.0
    assert level == (names[0] == "joint1")
    boxes = [label.get_window_extent() for label in labels]
    if level:
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))
    else:  # slanted lines of text keep their distance: the anchors lie further apart than a line is high
        anchors = np.array([label.get_transform().transform(label.get_position())[0] for label in labels])
        height = labels[0].get_fontsize() * figure.dpi / 72
        assert (np.diff(anchors) * np.sin(np.radians(35)) > height).all()
