"""Pages as a reader finds them: every word with its place, so that tests can say which places show which number."""

from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "br", "img", "link", "input", "hr"}
BLOCKS = {"h1", "h2", "h3", "h4", "p", "li", "dt", "dd", "figcaption", "footer", "code"}


class Page(HTMLParser):
    """Collects what tests ask about; fails on tags that do not nest."""

    def __init__(self, source: Path | str) -> None:
        """Read a file, or HTML itself."""
        super().__init__(convert_charrefs=True)
        self.text, self.tags, self.ids, self.rows, self._stack = [], [], [], [], []
        self.places: dict[str, str] = {}
        """text by its place: ``section / table / row / column`` for cells, ``... / small`` for their small print,
        ``section / tag`` with a number for other words, ``picture N`` for what is read out instead of it"""
        self._section, self._table, self._name, self._headers = "top", "", "", []
        self._seen: Counter[str] = Counter()
        self.feed(source if isinstance(source, str) else source.read_text())
        self.close()
        assert self._stack == []

    def handle_starttag(self, tag, attrs):
        self._note(tag, attrs)
        if tag == "section":
            self._section = dict(attrs).get("id") or "verdict"
        if tag == "tr":
            self.rows.append([])
        if tag == "table":
            self._table, self._headers, self._name = "", [], ""
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag in BLOCKS:
            self._seen[f"{self._section} / {tag}"] += 1
        if tag not in VOID:
            self._stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self._note(tag, attrs)

    def handle_endtag(self, tag):
        assert self._stack.pop() == tag

    def handle_data(self, data):
        if "style" in self._stack or "script" in self._stack:
            return
        self.text.append(data)
        inside = set(self._stack)
        if self.rows and inside & {"td", "th"}:
            small = self._stack[-1] == "small"
            self.rows[-1][-1] += (" | " if small else "") + data
            self._cell(data, small)
        elif "caption" in inside:
            self._table += data
        elif "svg" not in inside and (block := next((t for t in reversed(self._stack) if t in BLOCKS), None)):
            tag = f"{self._section} / {block}"
            self._add(f"{tag} {self._seen[tag]}", data)

    def _cell(self, data, small):
        column = len(self.rows[-1]) - 1
        if "thead" in self._stack:
            self._headers.append(data)
            return
        if column == 0 and self._stack[-1] == "th":
            self._name = data.strip()
        elif column == 0 and small and self.rows[-1][0] == f" | {data}":  # a second line of the row before
            self._name = f"{self._name}, {data}"
        place = f"{self._section} / {self._table} / {self._name} / {self._headers[column]}"
        self._add(f"{place} / small" if small else place, data)

    def _add(self, place, data):
        self.places[place] = f"{self.places.get(place, '')}{data}".replace("\N{NO-BREAK SPACE}", " ").strip()

    def _note(self, tag, attrs):
        found = dict(attrs)
        self.tags.append((tag, found))
        self.ids += [value for name, value in attrs if name == "id"]
        if tag == "svg":
            self._seen["picture"] += 1
            self.places[f"picture {self._seen['picture']}"] = found["aria-label"].replace("\N{NO-BREAK SPACE}", " ")

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


def rounds(text: str, value: float) -> bool:
    """Tell whether a printed number is the value to the decimals that it shows."""
    return abs(float(text) - value) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) * (1 + 1e-9)
