"""OpenCV's FileStorage, in YAML, XML or JSON, without OpenCV."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from visioncal.core.documents.jsons import read_json
from visioncal.core.documents.tables import is_number
from visioncal.core.documents.values import matrix_from
from visioncal.core.documents.xmls import read_xml
from visioncal.core.documents.yamls import read_yaml
from visioncal.core.errors import DataError

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
