"""Bounded readers of YAML, XML, and OpenCV's FileStorage in any of its forms, without OpenCV.

YAML is of plain values and OpenCV's matrices; XML without document types and entities.
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

from visioncal.core.codec import shown
from visioncal.core.documents.jsons import read_json
from visioncal.core.documents.tables import is_number
from visioncal.core.documents.toml import MAX_DEPTH, MAX_VALUES, check_values, too_deep, too_many
from visioncal.core.documents.values import DECIMAL, matrix_from, read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes

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
        DataError: It is missing, no YAML, holds a key twice or a tag that would construct an
            object, or is too large or too deep.
    """
    return parse_yaml(read_plain_text(path), str(path))


def parse_yaml(text: str, where: str) -> object:
    """Parses YAML as `read_yaml` does; `where` names its origin in errors."""
    # OpenCV's `%YAML:1.0` is no valid directive; an empty comment keeps line numbers.
    loader = _Loader(re.sub(r"\A%YAML[^\n]*", "#", text))
    loader.where = where
    try:
        # The parser bounds the depth, and an alias is a reference.
        value = loader.get_data() if loader.check_data() else None
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise DataError(f"{where}{line} is not YAML: {error.problem}.", culprits=[where]) from error
    # Tags on values of another kind give the others.
    except (yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{where} is not YAML: {reason}.", culprits=[where]) from error
    except RecursionError as error:
        raise too_deep(where) from error
    check_values(value, where)
    return value


def _place(where: str, node: yaml.Node) -> str:
    return f"{where}, line {node.start_mark.line + 1}"


_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[misc] # which of two is chosen when imported
    """Loads plain values; `where` names the file in errors."""

    where = ""

    def mapping(self, node: yaml.MappingNode) -> object:
        """Reads a mapping, or one of OpenCV's matrices."""
        content: dict[str, object] = {}
        for key, value in node.value:
            is_scalar = isinstance(key, yaml.ScalarNode)
            if not is_scalar or key.value in content:
                place = _place(self.where, key)
                seen = shown(key.value) if is_scalar else f"a list of {len(key.value)}"
                raise DataError(
                    f"{place}: {seen} must be a key that occurs once.", culprits=[place]
                )
            content[key.value] = self.construct_object(value, deep=True)
        if node.tag.endswith("matrix"):
            return matrix_from(content, _place(self.where, node))
        return content

    def refuse(self, node: yaml.Node) -> object:
        """Refuses any other tag; raises DataError."""
        place = _place(self.where, node)
        raise DataError(
            f"{place}: the tag {node.tag.removeprefix(_STANDARD)[:60]!r} must be a plain value.",
            culprits=[place],
        )


_Loader.yaml_implicit_resolvers = {}
_Loader.yaml_constructors = {
    None: _Loader.refuse,
    f"{_STANDARD}str": _BASE.construct_scalar,
    f"{_STANDARD}int": lambda _, node: int(node.value),
    f"{_STANDARD}float": lambda _, node: float(node.value),
    f"{_STANDARD}bool": lambda _, node: _CONSTANTS[node.value.lower()],
    f"{_STANDARD}seq": lambda loader, node: loader.construct_sequence(node, deep=True),
    **dict.fromkeys((f"{_STANDARD}{kind}" for kind in ("map", "opencv-matrix")), _Loader.mapping),
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
    # An upper bound of its elements and words.
    if sum(map(data.count, (b"<", b" ", b"\n", b"\t", b"\r"))) > MAX_VALUES:
        raise too_many(where)
    parser = DefusedXMLParser(target=TreeBuilder(insert_comments=True), forbid_dtd=True)
    try:
        parser.feed(data)
        root: Element = parser.close()
    except DefusedXmlException as error:
        raise DataError(
            f"{where}: a document type is declared, but XML must be plain, without entities.",
            culprits=[where],
            next_step="Remove the <!DOCTYPE ...>.",
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise DataError(f"{where} is not XML: {error}.", culprits=[where]) from error
    pending = [(root, 1)]
    while pending:
        element, depth = pending.pop()
        if depth > MAX_DEPTH:
            raise too_deep(where)
        # Readers of robots' descriptions compare each attribute with all others of its element.
        if len(element.attrib) > MAX_DEPTH:
            raise DataError(
                f"{where}: {element.tag[:60]} has {len(element.attrib)} attributes; up to "
                f"{MAX_DEPTH} are read.",
                culprits=[where],
            )
        pending += [(child, depth + 1) for child in element]
    return root


_MATRIX = "opencv-matrix"


def read_opencv(path: Path) -> Mapping[str, Any]:
    """Values by name of a file of OpenCV's FileStorage (YAML, JSON or XML), matrices as arrays.

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


def rows_of_xml(root: Element) -> dict[str, list[object]]:
    """Elements of any XML, three and more alike beside each other, as rows of their texts by name.

    Rows are called as their parent's `name`, else its tag; those within rows are parts of these.
    """
    found: dict[str, list[object]] = {}
    alike: dict[str, list[Element]] = {}
    for child in _parts(root):
        alike.setdefault(child.tag, []).append(child)
    for each in alike.values():
        rows = [_texts(child) for child in each]
        # Elements that hold nothing but such ones are lists.
        tags = [[part.tag for part in _parts(child)] for child in each]
        is_flat = not any(len(inner) > 2 and len({*inner}) == 1 for inner in tags)
        if len(rows) > 2 and is_flat and not any(isinstance(row, str) for row in rows):
            found.setdefault(root.get("name") or _tag(root), rows)
        else:
            for child in each:
                found = rows_of_xml(child) | found
    return found


def _parts(element: Element) -> list[Element]:
    """The elements in one, without comments."""
    return [child for child in element if isinstance(child.tag, str)]


def _tag(element: Element) -> str:
    """A tag without its name space."""
    return element.tag.rpartition("}")[2]


def _texts(element: Element) -> object:
    """The text of an element, or texts in it and attributes by name, several alike as a list."""
    found: dict[str, list[object]] = {}
    for child in _parts(element):
        found.setdefault(_tag(child), []).append(_texts(child))
    texts = {tag: each[0] if len(each) == 1 else each for tag, each in found.items()}
    values: dict[str, object] = {**element.attrib, **texts}
    text = (element.text or "").strip()
    return values | ({_tag(element): text} if text else {}) if values else text


def _with_matrices(value: object, where: str) -> object:
    if isinstance(value, Mapping):
        if value.get("type_id") == _MATRIX:
            return matrix_from(value, where)
        return {key: _with_matrices(number, f"{where}: {key}") for key, number in value.items()}
    return value


def _from_xml(element: Element, where: str) -> object:
    place, children = f"{where}: <{element.tag}>", [*element.iterfind("*")]
    if element.get("type_id") == _MATRIX:
        texts = {child.tag: (child.text or "").strip('" \n') for child in children}
        return matrix_from(
            {tag: text if tag == "dt" else _numbers(text, place) for tag, text in texts.items()},
            place,
        )
    if children:
        values = [_from_xml(child, where) for child in children]
        tags = [child.tag for child in children]
        return values if {*tags} == {"_"} else dict(zip(tags, values, strict=True))
    text = (element.text or "").strip()
    try:
        numbers = _numbers(text, place)
    except DataError:
        return text.strip('"')
    return numbers[0] if len(numbers) == 1 else numbers or ""


def _numbers(text: str, where: str) -> list[float]:
    """Reads numbers separated by blanks; OpenCV writes `.Nan` and `-.Inf`."""
    words = text.replace(".N", "N").replace(".I", "I").split()
    if not all(is_number(word) for word in words):
        raise DataError(f"{where} must be numbers, but is {text[:60]!r}.", culprits=[where])
    return [float(word) for word in words]
