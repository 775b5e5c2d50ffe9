"""XML without document types and entities, within bounds."""

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from visioncal.core.documents.values import MAX_DEPTH, MAX_VALUES, too_deep, too_many
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes


def read_xml(path: Path) -> Element:
    """Reads an XML file to its root; the errors are those of `parse_xml` and `read_bytes`."""
    return parse_xml(read_bytes(path), str(path))


def parse_xml(data: bytes, where: str) -> Element:
    """Parses XML to its root, comments included; `where` names its origin in errors.

    Raises:
        DataError: It is no XML, declares a document type, or is too large or too deep.
    """
    parser = DefusedXMLParser(target=_BoundedTree(where), forbid_dtd=True)
    try:
        parser.feed(data)
        return parser.close()
    except DefusedXmlException as error:
        raise DataError(
            f"{where}: a document type is declared; plain XML without entities is needed.",
            culprits=[where],
            next_step="Remove the <!DOCTYPE ...>.",
        ) from error
    except ParseError as error:
        raise DataError(f"{where} is no XML: {error}.", culprits=[where]) from error
    except (ValueError, LookupError) as error:
        raise DataError(f"{where} is no XML: {error}.", culprits=[where]) from error


class _BoundedTree(TreeBuilder):
    """Builds a tree of at most MAX_VALUES elements and words, and of MAX_DEPTH levels."""

    def __init__(self, where: str) -> None:
        super().__init__(insert_comments=True)
        self.where, self.count, self.depth = where, 0, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        # Memory in units of values.
        self._count(5)
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise too_deep(self.where)
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> Element:
        self.depth -= 1
        return super().end(tag)

    def data(self, data: str, /) -> None:
        # Parts are a few kilobytes each, so that words are counted before memory grows.
        self._count(len(data.split()))
        super().data(data)

    def _count(self, values: int) -> None:
        self.count += values
        if self.count > MAX_VALUES:
            raise too_many(self.where)
