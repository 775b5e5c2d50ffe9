"""A page of HTML as tests read it."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """Collects text, references and elements, and checks that elements close."""

    VOID = frozenset(["meta", "link", "br", "img", "hr", "input"])

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.tags: list[str] = []
        self.references: list[str] = []
        self.rows: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []
        self.words = " ".join(self.text.split())

    # The names of these are the parser's.
    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.tags.append(tag)
        self.references += [
            value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")
        ]
        if tag == "tr":
            self.rows.append("")
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:  # noqa: D102
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:  # noqa: D102
        if self._open and self._open[-1] == "style":
            return
        self.text += f" {data}"
        if "tr" in self._open:
            self.rows[-1] += f" {data}"


def section(page: Page, heading: str, end: str) -> str:
    """The words from the last heading of that name on."""
    return page.words[page.words.rindex(heading) : page.words.rindex(end)]
