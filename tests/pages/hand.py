"""A hand that only clicks and types on a page of viser, in a headless Chromium."""

import json
import time

_FIELD = """((label) => {
  const exact = (e) => e.childElementCount === 0 && e.textContent.trim() === label;
  for (const e of [...document.querySelectorAll('label, div, span')].filter(exact))
    for (let at = e, up = 0; at && up < 5; at = at.parentElement, up++) {
      const field = at.querySelector('input, textarea');
      if (field && field.getClientRects().length) return field;
    }
  return null; })"""
_BUTTON = """((label) => [...document.querySelectorAll('button')].find(
  (b) => b.getClientRects().length && b.innerText.trim() === label))"""


class Hand:
    """Clicks and types by what is written on the page, and waits for what appears."""

    def __init__(self, tab) -> None:
        self.tab = tab

    def open(self, address: str) -> None:
        self.tab.call("Page.navigate", url=address)

    def press(self, label: str, seconds: float = 60.0) -> None:
        """Click a button as soon as it is there and on."""
        there = f"(() => {{ const b = {_BUTTON}({json.dumps(label)}); return !!b && !b.disabled; }})()"
        self.tab.wait_for(there, seconds)
        self.tab.ask(f"{_BUTTON}({json.dumps(label)}).click()")

    def press_text(self, text: str) -> None:
        """Click what reads so, such as the title of a folder."""
        every = "[...document.querySelectorAll('*')]"
        found = f"{every}.filter((e) => (e.innerText || '').trim() === {json.dumps(text)}).pop()"
        self.tab.wait_for(f"!!{found}")
        self.tab.ask(f"{found}.click()")
        time.sleep(0.5)

    def type(self, label: str, text: str) -> None:
        """Replace the content of the field with this label."""
        field = f"{_FIELD}({json.dumps(label)})"
        self.tab.wait_for(f"!!{field}")
        self.tab.ask(f"(() => {{ const f = {field}; f.focus(); f.select(); }})()")
        self.tab.call("Input.insertText", text=text)
        self.tab.ask(f"{field}.blur()")
        time.sleep(0.3)

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self.tab.wait_for(f"!!{_FIELD}({json.dumps(label)})")
        field = f"{_FIELD}({json.dumps(label)})"
        self.tab.ask(f"{field}.scrollIntoView({{block: 'center'}}), {field}.click()")
        found = (
            "[...document.querySelectorAll('[role=option]')].find((o) => o.getClientRects().length && "
            f"o.innerText.trim() === {json.dumps(option)})"
        )
        self.tab.wait_for(f"!!{found}")
        self.tab.ask(f"{found}.click()")
        time.sleep(0.3)

    def tick(self, label: str) -> None:
        """Tick a box, or take the tick away."""
        self.tab.wait_for(f"!!{_FIELD}({json.dumps(label)})")
        self.tab.ask(f"{_FIELD}({json.dumps(label)}).click()")
        time.sleep(0.3)

    def reads(self, text: str, seconds: float = 60.0) -> None:
        """Wait until the page says something."""
        self.tab.wait_for(f"document.body.innerText.includes({json.dumps(text)})", seconds)

    def sees(self, label: str) -> bool:
        """Whether a button is on the screen, with nothing above it."""
        return self.tab.ask(
            f"(() => {{ const b = {_BUTTON}({json.dumps(label)}); if (!b) return false;"
            "const r = b.getBoundingClientRect();"
            "return b.contains(document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2)); })()"
        )

    def touch(self, x: float, y: float) -> None:
        """Click at a place of the window [px]."""
        for kind in ("mousePressed", "mouseReleased"):
            self.tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        time.sleep(0.5)
