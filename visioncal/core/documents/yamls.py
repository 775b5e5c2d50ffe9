"""Safe YAML of plain values and OpenCV's matrices; aliases are refused, sizes are bounded."""

import math
import re
from pathlib import Path
from typing import Any

import yaml

from visioncal.core.documents.values import (
    DECIMAL,
    MAX_DEPTH,
    MAX_VALUES,
    matrix_from,
    read_plain_text,
    too_deep,
    too_many,
)
from visioncal.core.errors import DataError

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
