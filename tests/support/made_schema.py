"""The JSON Schema of calibration.json, made of the dataclasses that it is read into."""

import inspect
import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np

from visioncal.core.codec import INLINE, REST, Array, WrittenForm, entries
from visioncal.results.document import CalibrationForm, CellForm
from visioncal.results.sections import CalibrationSections

_TYPES = {float: "number", int: "integer", str: "string", bool: "boolean"}


def calibration_schema() -> dict[str, Any]:
    """Describes calibration.json, of one camera and robot and of a whole cell."""
    found = _Schemas()
    forms = {
        "Calibration": found.table(CalibrationForm, CalibrationSections),
        "Cell": found.table(CellForm),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "calibration.json of visioncal",
        "if": {"required": ["tree"]},
        "then": {"$ref": "#/$defs/Cell"},
        "else": {"$ref": "#/$defs/Calibration"},
        "$defs": forms | dict(sorted(found.definitions.items())),
    }


class _Schemas:
    """Schemas of dataclasses, each described once."""

    def __init__(self) -> None:
        self.definitions: dict[str, Any] = {}

    def table(self, *classes: type) -> dict[str, Any]:
        """The keys of dataclasses that stand in one table, described as the first."""
        properties: dict[str, Any] = {}
        required: list[str] = []
        more: dict[str, Any] = {}
        for cls in classes:
            words = _words(cls)
            for entry in entries(cls):
                schema = self.of(entry.kind)
                if INLINE in entry.marks:
                    inner = self.definitions[schema["$ref"].rpartition("/")[2]]
                    properties |= inner["properties"]
                    required += inner["required"] if entry.required else []
                elif REST in entry.marks:
                    more = {"additionalProperties": schema.get("additionalProperties", {})}
                else:
                    note = {"description": words[entry.name]} if entry.name in words else {}
                    properties[entry.key] = note | schema
                    required += [entry.key] if entry.required else []
        described = {"description": inspect.cleandoc(classes[0].__doc__ or "").partition("\n")[0]}
        table = {"type": "object", "properties": properties, "required": required}
        return described | table | more

    def of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type."""
        origin, args = get_origin(kind), get_args(kind)
        if origin is Annotated:
            return self._marked(args)
        if origin in (Union, UnionType):
            several = [self.of(argument) for argument in args if argument is not NoneType]
            return several[0] if len(several) == 1 else {"anyOf": several}
        if origin is Literal:
            return {"enum": list(args)}
        if origin is tuple and args[-1] is Ellipsis:
            return {"type": "array", "items": self.of(args[0])}
        if origin is tuple:
            sizes = {"minItems": len(args), "maxItems": len(args)}
            return {
                "type": "array",
                "prefixItems": [self.of(argument) for argument in args],
            } | sizes
        if origin is not None and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self.of(args[1])}
        if isinstance(kind, type) and is_dataclass(kind):
            name = kind.__name__
            if name not in self.definitions:
                self.definitions[name] = self.table(kind)
            return {"$ref": f"#/$defs/{name}"}
        return {"type": _TYPES[kind]} if kind in _TYPES else {}

    def _marked(self, args: tuple[Any, ...]) -> dict[str, Any]:
        inner, *marks = args
        for mark in marks:
            if isinstance(mark, Array):
                (kind,) = get_args(get_args(inner)[1])
                return _array("boolean" if kind is np.bool_ else "number", mark.shape)
            if isinstance(mark, WrittenForm):
                return {"type": "object"} if mark.form is None else self.of(mark.form)
        return self.of(inner)


def _array(kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
    found: dict[str, Any] = {"type": kind}
    for size in reversed(shape):
        sizes = {} if size < 0 else {"minItems": size, "maxItems": size}
        found = {"type": "array", "items": found} | sizes
    return found


def _words(cls: type) -> dict[str, str]:
    """What the comments at the fields of a dataclass and its bases say: behind them, or above."""
    found: dict[str, str] = {}
    for base in filter(is_dataclass, reversed(cls.__mro__)):
        above: list[str] = []
        for line in inspect.getsource(base).splitlines():
            if comment := re.fullmatch(r"    # (.*)", line):
                above.append(comment[1])
                continue
            if field := re.match(r"    (\w+): [^#]*(?:# (.*))?$", line):
                found[field[1]] = field[2] or " ".join(above)
            above = []
    return {name: words for name, words in found.items() if words}
