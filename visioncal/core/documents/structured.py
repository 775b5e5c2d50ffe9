"""Bounded readers of YAML, XML, and OpenCV's FileStorage in any of its forms, without OpenCV.

YAML is of plain values and OpenCV's matrices, without aliases; XML without document types and
entities.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

import yaml
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from visioncal.core.documents.jsons import read_json
from visioncal.core.documents.tables import is_number
from visioncal.core.documents.values import DECIMAL, matrix_from, read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import MAX_DEPTH, MAX_VALUES, read_bytes, too_deep, too_many

_BLANKS = (b" ", b"\n", b"\t", b"\r")
_STANDARD = "tag:yaml.org,2002:"
_CONSTANTS: dict[str, object] = {"true": True, "yes": True, "on": True}
_CONSTANTS |= {"false": False, "no": False, "off": False, "": None, "~": None, "null": None}
_CONSTANTS |= {
    f"{sign}{dot}inf": float(f"{sign}inf") for sign in ("", "+", "-") for dot in ("", ".")
}
_CONSTANTS |= {"nan": math.nan, ".nan": math.nan}
# YAML 1.1 has octal and sexagesimal numbers and dates, and requires a point in floats. Other
# programs are not so strict: 010 is ten, 1e-3 a number, and a date is text.
_FORMS = {
    "int": r"[+-]?[0-9]{1,18}$",
    "float": rf"{DECIMAL}$",
    "bool": rf"(?i:{'|'.join(map(re.escape, _CONSTANTS))})$",
}


def read_yaml(path: Path) -> object:
    """Reads the first document of a YAML file, OpenCV's FileStorage dialect included.

    Raises:
        DataError: It is missing, no YAML, holds a key twice, an alias or a tag that would construct
            an object, or is too large or too deep.
    """
    return parse_yaml(read_plain_text(path), str(path))


def parse_yaml(text: str, where: str) -> object:
    """Parses YAML as `read_yaml` does; `where` names its origin in errors."""
    # OpenCV's `%YAML:1.0` is no valid directive; an empty comment keeps line numbers.
    plain = re.sub(r"\A%YAML[^\n]*", "#", text)
    try:
        _check_events(plain, where)
        loader = _Loader(plain)
        loader.where = where
        return loader.get_data() if loader.check_data() else None
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise DataError(f"{where}{line} is no YAML: {error.problem}.", culprits=[where]) from error
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{where} is no YAML: {reason}.", culprits=[where]) from error


def _check_events(text: str, where: str) -> None:
    """Checks size, depth and aliases before anything is built; raises DataError."""
    count = depth = 0
    for event in yaml.parse(text, Loader=_BASE):
        if isinstance(event, yaml.DocumentEndEvent):
            return
        count += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if count > MAX_VALUES:
            raise too_many(where)
        if depth > MAX_DEPTH:
            raise too_deep(f"{where}, line {_line(event)}")
        if isinstance(event, yaml.AliasEvent):
            seen = f"the alias *{event.anchor}"
            raise _refusal(where, event, seen, "values written out are needed")


def _line(item: yaml.Event | yaml.Node) -> int:
    return item.start_mark.line + 1 if item.start_mark else 0


def _refusal(where: str, item: yaml.Event | yaml.Node, seen: str, needed: str) -> DataError:
    place = f"{where}, line {_line(item)}"
    return DataError(f"{place}: {seen}; {needed}.", culprits=[place])


_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[misc] # which of two is chosen when imported
    """Loads plain values; `where` names the file in errors."""

    where = ""

    def mapping(self, node: yaml.MappingNode) -> object:
        """Reads a mapping, or one of OpenCV's matrices."""
        content: dict[str, object] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                seen = "a list or mapping as a key"
                raise _refusal(self.where, key, seen, "a word is needed")
            if key.value in content:
                seen = f"the key {key.value[:60]!r} a second time"
                raise _refusal(self.where, key, seen, "once is needed")
            content[key.value] = self.construct_object(value, deep=True)
        if node.tag.endswith("matrix"):
            return matrix_from(content, f"{self.where}, line {_line(node)}")
        return content

    def refuse(self, node: yaml.Node) -> object:
        """Refuses any other tag; raises DataError."""
        seen = f"the tag {node.tag.removeprefix(_STANDARD)[:60]!r}"
        raise _refusal(self.where, node, seen, "plain values are needed")


_Loader.yaml_implicit_resolvers = {}
_Loader.yaml_constructors = {
    None: _Loader.refuse,
    f"{_STANDARD}str": lambda _, node: node.value,
    f"{_STANDARD}int": lambda _, node: int(node.value),
    f"{_STANDARD}float": lambda _, node: float(node.value),
    f"{_STANDARD}bool": lambda _, node: _CONSTANTS[node.value.lower()],
    f"{_STANDARD}seq": lambda loader, node: loader.construct_sequence(node, deep=True),
    **dict.fromkeys(
        (f"{_STANDARD}{kind}" for kind in ("map", "opencv-matrix", "opencv-nd-matrix")),
        _Loader.mapping,
    ),
}
for _kind, _form in _FORMS.items():
    _Loader.add_implicit_resolver(f"{_STANDARD}{_kind}", re.compile(_form), None)


def read_xml(path: Path) -> Element:
    """Reads an XML file to its root; the errors are those of `parse_xml` and `read_bytes`."""
    return parse_xml(read_bytes(path), str(path))


def parse_xml(data: bytes, where: str) -> Element:
    """Parses XML to its root, comments included; `where` names its origin in errors.

    Raises:
        DataError: It is no XML, declares a document type, or is too large or too deep.
    """
    # An upper bound: words by blanks, and elements, each as large as five, by half their tags.
    if 5 * data.count(b"<") // 2 + sum(map(data.count, _BLANKS)) > MAX_VALUES:
        raise too_many(where)
    parser = DefusedXMLParser(target=TreeBuilder(insert_comments=True), forbid_dtd=True)
    try:
        parser.feed(data)
        root: Element = parser.close()
    except DefusedXmlException as error:
        raise DataError(
            f"{where}: a document type is declared; plain XML without entities is needed.",
            culprits=[where],
            next_step="Remove the <!DOCTYPE ...>.",
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise DataError(f"{where} is no XML: {error}.", culprits=[where]) from error
    pending = [(root, 1)]
    while pending:
        element, depth = pending.pop()
        if depth > MAX_DEPTH:
            raise too_deep(where)
        pending += [(child, depth + 1) for child in element]
    return root


_MATRICES = ("opencv-matrix", "opencv-nd-matrix")


def read_opencv(path: Path) -> Mapping[str, Any]:
    """Reads a file of OpenCV's FileStorage, matrices as arrays.

    Args:
        path: A `.yaml`, `.yml`, `.json` or `.xml`.

    Returns:
        The values by their names: numbers, text, lists, mappings and (rows, cols) arrays.

    Raises:
        DataError: It has another format, or a matrix in it is incomplete.
    """
    suffix = path.suffix.lower()
    value: object
    if suffix == ".xml":
        value = _from_xml(read_xml(path), str(path))
    elif suffix == ".json":
        value = _with_matrices(read_json(path), str(path))
    else:
        value = read_yaml(path)
    if not isinstance(value, Mapping):
        raise DataError(f"{path}: no names with values, as OpenCV writes.", culprits=[str(path)])
    return value


def _with_matrices(value: object, where: str) -> object:
    if isinstance(value, Mapping):
        if value.get("type_id") in _MATRICES:
            return matrix_from(value, where)
        return {key: _with_matrices(number, f"{where}: {key}") for key, number in value.items()}
    return value


def _from_xml(element: Element, where: str) -> object:
    place, children = f"{where}: <{element.tag}>", [*element.iterfind("*")]
    text = (element.text or "").strip()
    if element.get("type_id") in _MATRICES:
        content = {
            tag: words.strip('" \n') if tag == "dt" else _numbers(words, place)
            for tag, item in _by_tag(element, where).items()
            for words in [item.text or ""]
        }
        return matrix_from(content, place)
    if children and all(child.tag == "_" for child in children):
        return [_from_xml(child, where) for child in children]
    if children:
        return {tag: _from_xml(item, where) for tag, item in _by_tag(element, where).items()}
    try:
        numbers = _numbers(text, place)
    except DataError:
        return text.strip('"')
    return numbers[0] if len(numbers) == 1 else numbers or ""


def _by_tag(element: Element, where: str) -> dict[str, Element]:
    by_tag: dict[str, Element] = {}
    for child in element.iterfind("*"):
        if by_tag.setdefault(child.tag, child) is not child:
            raise DataError(
                f"{where}: <{child.tag[:60]}> is there twice; once is needed.", culprits=[where]
            )
    return by_tag


def _numbers(text: str, where: str) -> list[float]:
    """Reads numbers separated by blanks; OpenCV writes `.Nan` and `-.Inf`."""
    words = text.replace(".N", "N").replace(".I", "I").split()
    if not all(is_number(word) for word in words):
        raise DataError(f"{where}: {text[:60]!r}; numbers are needed.", culprits=[where])
    return [float(word) for word in words]
