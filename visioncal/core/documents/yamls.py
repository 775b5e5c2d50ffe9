"""Safe YAML, built from parser events: no constructors; aliases are refused."""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from visioncal.core.documents.values import (
    MAX_DEPTH,
    MAX_VALUES,
    matrix_from,
    read_plain_text,
    too_deep,
    too_many,
)
from visioncal.core.errors import DataError

_STANDARD = "tag:yaml.org,2002:"
_PLAIN_TAGS = {
    f"{_STANDARD}{name}" for name in ("map", "seq", "str", "int", "float", "bool", "null")
}
_MATRIX_TAGS = {f"{_STANDARD}opencv-matrix", f"{_STANDARD}opencv-nd-matrix"}

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
# YAML 1.1 requires a point in floats; other programs are not always so strict.
_FLOAT = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_WORDS = {
    "": None,
    "~": None,
    "null": None,
    "true": True,
    "yes": True,
    "on": True,
    "false": False,
    "no": False,
    "off": False,
    ".nan": math.nan,
    "nan": math.nan,
    ".inf": math.inf,
    "+.inf": math.inf,
    "inf": math.inf,
    "-.inf": -math.inf,
    "-inf": -math.inf,
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
    builder = _Builder(where)
    try:
        for event in yaml.parse(plain, Loader=_LOADER):
            if isinstance(event, yaml.DocumentEndEvent):
                break
            builder.take(event)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise DataError(f"{where}{line} is no YAML: {error.problem}.", culprits=[where]) from error
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{where} is no YAML: {reason}.", culprits=[where]) from error
    return builder.result


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass
class _Level:
    """A list or mapping under construction; `key` awaits its value."""

    content: dict[str, Any] | list[Any]
    line: int
    tag: str | None = None
    key: str | None = None


@dataclass
class _Builder:
    """Builds plain values from the parser's events."""

    where: str
    result: object = None
    count: int = 0
    levels: list[_Level] = field(default_factory=list)

    def take(self, event: yaml.Event) -> None:
        """Processes an event."""
        if isinstance(event, yaml.AliasEvent):
            raise self._refusal(
                event, f"the alias *{event.anchor}", "values written out are needed"
            )
        if isinstance(event, yaml.ScalarEvent):
            self._check_tag(event)
            self._put(_scalar(event), event)
        elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            self._check_tag(event)
            self._open(event)
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            level = self.levels.pop()
            if level.tag in _MATRIX_TAGS:
                self._put(matrix_from(level.content, f"{self.where}, line {level.line}"), event)
            else:
                self._put(level.content, event)

    def _open(self, event: yaml.CollectionStartEvent) -> None:
        if len(self.levels) >= MAX_DEPTH:
            raise too_deep(self._place(event))
        is_map = isinstance(event, yaml.MappingStartEvent)
        self.levels.append(_Level({} if is_map else [], _line(event), event.tag))

    def _put(self, value: object, event: yaml.Event) -> None:
        self.count += 1
        if self.count > MAX_VALUES:
            raise too_many(self.where)
        if not self.levels:
            self.result = value
            return
        level = self.levels[-1]
        if isinstance(level.content, list):
            level.content.append(value)
        elif level.key is None:
            level.key = self._key(value, level.content, event)
        else:
            level.content[level.key] = value
            level.key = None

    def _key(self, value: object, content: dict[str, Any], event: yaml.Event) -> str:
        if isinstance(value, dict | list):
            raise self._refusal(event, "a list or mapping as a key", "a word is needed")
        key = event.value if isinstance(event, yaml.ScalarEvent) else str(value)
        if key in content:
            raise self._refusal(event, f"the key {key[:60]!r} a second time", "once is needed")
        return key

    def _check_tag(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> None:
        tag = event.tag
        matrix = isinstance(event, yaml.MappingStartEvent) and tag in _MATRIX_TAGS
        if tag in (None, "!") or tag in _PLAIN_TAGS or matrix:
            return
        words = tag.removeprefix(_STANDARD)[:60]
        raise self._refusal(event, f"the tag {words!r}", "plain values are needed")

    def _place(self, event: yaml.Event) -> str:
        return f"{self.where}, line {_line(event)}"

    def _refusal(self, event: yaml.Event, seen: str, needed: str) -> DataError:
        place = self._place(event)
        return DataError(f"{place}: {seen}; {needed}.", culprits=[place])


def _line(event: yaml.Event) -> int:
    return event.start_mark.line + 1 if event.start_mark else 0


def _scalar(event: yaml.ScalarEvent) -> object:
    """Converts a scalar: quoted ones are text, plain ones a number or constant if they match."""
    text = event.value
    if not event.implicit[0]:
        return text
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return _WORDS.get(text.lower(), text)
