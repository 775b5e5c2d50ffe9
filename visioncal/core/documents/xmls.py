"""XML without document types and entities, with byte offsets of its elements."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from visioncal.core.documents.values import MAX_DEPTH, MAX_VALUES, too_deep, too_many
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes

_TAG = re.compile(rb"""<[^\s/>]+(\s+[^\s=]+\s*=\s*("[^"]*"|'[^']*'))*\s*/?>""")


@dataclass
class Element:
    """An element; its positions are byte offsets.

    Attributes:
        tag: Its name.
        line: Line of its begin.
        attributes: Its attributes.
        text: The text directly inside it, without surrounding blanks.
        children: Its child elements.
        begin: Begin of its start tag.
        inside: End of its start tag.
        close: Begin of its end tag; `begin` for an empty-element tag.
        end: End of its end tag.
    """

    tag: str
    line: int
    attributes: dict[str, str]
    text: str = ""
    children: list["Element"] = field(default_factory=list)
    begin: int = 0
    inside: int = 0
    close: int = 0
    end: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether it is an empty-element tag: `<a/>`."""
        return self.close == self.begin

    def child(self, tag: str) -> "Element | None":
        """The first child with a tag; None without one."""
        return next((child for child in self.children if child.tag == tag), None)


def read_xml(path: Path) -> Element:
    """Reads an XML file to its root; the errors are those of `parse_xml` and `read_bytes`."""
    return parse_xml(read_bytes(path), str(path))


def parse_xml(data: bytes, where: str) -> Element:
    """Parses XML to its root; `where` names its origin in errors.

    Raises:
        DataError: It is no XML, declares a document type, or is too large or too deep.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True
    root = Element("", 0, {})
    stack, texts = [root], [[""]]
    count = 0

    def counted(values: int) -> None:
        nonlocal count
        count += values
        if count > MAX_VALUES:
            raise too_many(where)

    def start(tag: str, attributes: dict[str, str]) -> None:
        counted(5)  # memory in units of values
        if len(stack) > MAX_DEPTH:
            raise too_deep(f"{where}, line {parser.CurrentLineNumber}")
        begin = parser.CurrentByteIndex
        element = Element(tag, parser.CurrentLineNumber, attributes, begin=begin)
        element.inside = _start_tag_end(data, begin)
        stack[-1].children.append(element)
        stack.append(element)
        texts.append([])

    def end(_: str) -> None:
        element = stack.pop()
        element.text = "".join(texts.pop()).strip()
        element.close, element.end = _end_tag(data, element, parser.CurrentByteIndex)

    def text(part: str) -> None:
        # Parts are a few kilobytes each, so that words are counted before memory grows.
        counted(len(part.split()))
        texts[-1].append(part)

    def doctype(*_: object) -> None:
        raise DataError(
            f"{where}, line {parser.CurrentLineNumber}: a document type is declared; plain XML "
            "without entities is needed.",
            culprits=[where],
            next_step="Remove the <!DOCTYPE ...>.",
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        words = expat.ErrorString(error.code)
        raise DataError(
            f"{where}, line {error.lineno} is no XML: {words}.", culprits=[where]
        ) from error
    except (ValueError, LookupError) as error:
        raise DataError(f"{where} is no XML: {error}.", culprits=[where]) from error
    return root.children[0]


def _start_tag_end(data: bytes, begin: int) -> int:
    """End of an element's start tag."""
    tag = _TAG.match(data, begin)
    return tag.end() if tag else begin


def _end_tag(data: bytes, element: Element, at: int) -> tuple[int, int]:
    """Begin and end of an element's end tag, which the parser reports at an offset."""
    if data[element.inside - 2 : element.inside] == b"/>":
        return element.begin, element.inside
    return at, data.find(b">", at) + 1
