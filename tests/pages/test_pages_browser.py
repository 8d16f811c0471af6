"""Pages of many arms in a real browser: what to do is seen at once, on a desk, on a phone and on paper."""

from datetime import datetime

import pytest
from browser import CHROMIUM, chromium

from rejoint.pages.html import write_page
from rejoint.runs.fleet.campaign import HEADERS, FleetResult, FleetRow

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: install it to see pages in a browser"),
]
WHY = "diagnose: nothing answers at tcp://10.0.0.1:9000 ([Errno 111] Connection refused); is the arm switched on, its "
WHY += "server running, and the address right? `rejoint emulate` starts an arm to try"
SIDES = """(() => { const cell = [...document.querySelectorAll('td')].find(one => one.innerText.includes('mend that'));
const place = cell.getBoundingClientRect();
return [place.left, place.right, place.height, document.documentElement.scrollWidth]; })()"""


@pytest.mark.parametrize(("width", "medium"), [(1280, ""), (400, ""), (700, "print")])
def test_what_to_do_is_seen_without_scrolling_sideways(tmp_path, width, medium):
    row = FleetRow(
        name="bench-3",
        address="tcp://10.0.0.1:9000",
        end="failed",
        state="failed",
        error_mm=None,
        found=WHY,
        todo="mend that, then repeat the command",
        steps=(("diagnose", 3.0),),
        folder=tmp_path,
        code=4,
    )
    page = tmp_path / "repair.html"
    result = FleetResult(
        verb="repair", rows=(row,), ended=datetime(2026, 11, 22), seconds=9.0, page=page, finished=False
    )
    write_page(page, "fleet.html", result=result, headers=HEADERS)
    with chromium() as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 500)
        tab.call("Emulation.setEmulatedMedia", media=medium)
        tab.call("Page.navigate", url=page.as_uri())
        tab.wait_for("document.readyState == 'complete' && document.querySelector('td') !== null")
        left, right, height, whole = tab.ask(SIDES)
    assert 0.0 <= left < right <= width
    assert height > 0.0
    assert whole <= width
