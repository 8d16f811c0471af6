"""Figures show the given data, name their units and are the same every time."""

import io
import xml.etree.ElementTree as ET

import numpy as np

from rejoint.arms import mycobot280, tcp_position
from rejoint.logs.runlog import RunLog
from rejoint.pages import html as palette
from rejoint.pages.report.figures import Gallery, Series, curves, inline_svg


def test_error_over_time_draws_every_line_on_a_log_axis():
    arm, time, logs = mycobot280(), 0.02 * np.arange(400), {}
    position = arm.rest + 0.1 * np.exp(-time)[:, None]
    tool = tcp_position(arm, position)
    for i, name in enumerate(palette.CONTROLLERS):
        logs[name] = RunLog.of(time, position, position, arm=arm, target=0 * tool + i)
    gallery = Gallery()
    gallery.error_over_time(arm, logs)
    axes = gallery.figures["error-over-time"].axes[0]
    drawn = {line.get_label(): line for line in axes.lines}
    for name, look in palette.CONTROLLERS.items():
        error = 1e3 * np.linalg.norm(tool - logs[name].target, axis=1)
        np.testing.assert_allclose(drawn[name].get_ydata(), error, atol=1e-9)
        assert drawn[name].get_color() == look.colour
    assert axes.get_yscale() == "log"
    assert "[s]" in axes.get_xlabel()
    assert "[mm]" in axes.get_ylabel()


def make():
    value = np.arange(1.0, 11.0)
    series = Series(label='a <worn> & "old" arm', look=palette.LOOKS["grey"], value=value)
    return curves({"": [series]}, value, "target", (10.4, 3.2))


def test_svg_is_deterministic_wellformed_and_follows_the_theme():
    alt = '"><script>alert(1)</script> back\\1slash & more'
    first, again = inline_svg(make(), "bars", alt), inline_svg(make(), "bars", alt)
    assert first == again
    assert palette.INK not in first
    assert "currentColor" in first
    assert palette.LOOKS["grey"].colour not in first
    assert "var(--look-0)" in first
    assert "http" not in first
    root = ET.fromstring(str(first).replace("xlink:href", "href"))
    assert (root.get("role"), root.get("aria-label")) == ("img", alt)
    text = "".join(root.itertext())
    assert 'a <worn> & "old" arm' in text
    assert "<style" not in first, "a style inside would leak into the whole page"


def test_png_is_whole_and_deterministic(tmp_path):
    for name in ("a", "b"):
        gallery = Gallery()
        gallery.show(name, make(), alt="alt")
        gallery.save(tmp_path / "figures")
    one = (tmp_path / "figures" / "a.png").read_bytes()
    assert one[:8] == b"\x89PNG\r\n\x1a\n"
    assert one == (tmp_path / "figures" / "b.png").read_bytes()
    assert io.BytesIO(one).getvalue()[-8:-4] == b"IEND"
