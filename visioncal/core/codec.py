"""Codec of frozen dataclasses as JSON or TOML, with checks of types and ranges on reading.

A field's key is its name, or that of its `Key`. None and empty defaults are not written. Unknown
keys are ignored, or kept in a field marked `REST`. Errors name the path of the value, such as
`kinematics.levels[2].rms_mm`, and one error names all wrong fields of a table.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from datetime import date, time
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, listed
from visioncal.core.types import FloatArray, scalar_of

_T = TypeVar("_T")
_WORDS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
_SHOWN = 60  # Letters of a value in a message.
_SEVERAL = {float: "numbers", int: "whole numbers", str: "texts"}


@contextmanager
def reading(label: str, what: str, next_step: str) -> Iterator[None]:
    """Turns errors of reading a file (`label`) into DataErrors: it is not `what`; `next_step`."""
    try:
        yield
    except DataError as error:
        raise error.within(label) from error
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(
            f"{label}: not {what} that this version can read: {fault_words(error)}.",
            culprits=[label],
            next_step=next_step,
        ) from error


def fault_words(error: Exception) -> str:
    """Words of an error of reading; those of Python's own come with their kind."""
    return f"{error}" if type(error) is ValueError else f"{error!r}"


@dataclass(frozen=True)
class Key:
    """The key of a field, where it differs from the field's name."""

    name: str


@dataclass(frozen=True)
class Array:
    """Shape and check of an array."""

    shape: tuple[int, ...]  # Its sizes; negative for any size.
    # Message on other faults of an array; empty for none.
    fault: Callable[[FloatArray], str] | None = None

    @property
    def needed(self) -> str:
        """Words for an array of the shape."""
        sizes = " x ".join("n" if size < 0 else str(size) for size in self.shape)
        return f"an array of {sizes} numbers"


@dataclass(frozen=True)
class Check:
    """Condition of a value, and the words for a valid one."""

    needed: str
    fits: Callable[[Any], bool] = lambda _: True
    names: tuple[str, ...] = ()  # Valid texts, of which similar ones are named.


def one_of(*names: str) -> Check:
    """The check that a text is among known ones."""
    return Check(needed_of(Literal[names]), names.__contains__, names)


def within(least: float, most: float) -> Check:
    """The check that a number is in a range, ends included; whole numbers have whole ends."""
    noun = "a whole number" if isinstance(least, int) else "a number"
    return Check(f"{noun} from {least:g} to {most:g}", lambda value: least <= value <= most)


@dataclass(frozen=True)
class Lenient:
    """Conversion of other forms in which a value may be written, before it is read."""

    convert: Callable[[Any], Any]  # Its errors are those of the value.


@dataclass(frozen=True, eq=False)
class WrittenForm:
    """Custom conversion of a value to JSON, or to a dataclass that is written in its place."""

    write: Callable[[Any], Any]  # Converts the value to JSON, or to `form`.
    read: Callable[[Any, str], Any]  # Converts it back; takes the path for messages.
    form: type | None = None  # The dataclass that is written; None for plain JSON.


# Marks of fields: INLINE puts the keys among those of the owner, REST collects all unknown keys,
# BY_NAME reads a tuple of records from tables by their names.
INLINE, REST, BY_NAME = object(), object(), object()
# KEPT is written even if empty, DROPPED (a text or number) is not written if empty, UNWRITTEN
# never.
KEPT, DROPPED, UNWRITTEN = object(), object(), object()
Vector = Annotated[FloatArray, Array((-1,))]
Matrix = Annotated[FloatArray, Array((-1, -1))]
Finite = Annotated[float, Check("a finite number", math.isfinite)]
Count = Annotated[int, Check("a whole number from 1 on", lambda value: value >= 1)]
NotNegative = Annotated[float, Check("0 or more", lambda value: 0.0 <= value < math.inf)]
Positive = Annotated[float, Check("a number above 0", lambda value: 0.0 < value < math.inf)]


class Strict:
    """Base of records that users write alone: unknown keys are refused."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Base of the sections of a result."""

    # Unknown keys of a file, unchanged.
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class Entry:
    """Description of a field: name, key, type, whether it is required, and marks."""

    name: str
    key: str
    kind: Any
    required: bool
    marks: tuple[Any, ...]

    @property
    def keys(self) -> set[str]:
        """The keys that the field uses."""
        if INLINE in self.marks:
            forms = [mark.form for mark in self.marks if isinstance(mark, WrittenForm)]
            (inner,) = _alternatives(get_args(self.kind)[0])
            return set().union(*(entry.keys for entry in entries(forms[0] if forms else inner)))
        return set() if REST in self.marks else {self.key}


@cache
def entries(cls: type) -> tuple[Entry, ...]:
    """The written fields of a dataclass in order, a REST field first."""
    hints = get_type_hints(cls, include_extras=True)
    result = []
    for entry in fields(cls):
        kind = hints[entry.name]
        marks = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
        if UNWRITTEN in marks:
            continue
        keys = [mark.name for mark in marks if isinstance(mark, Key)]
        required = entry.default is MISSING and entry.default_factory is MISSING
        result.append(Entry(entry.name, keys[0] if keys else entry.name, kind, required, marks))
    return tuple(sorted(result, key=lambda value: REST not in value.marks))


def field_names_except(cls: type, others: str) -> tuple[str, ...]:
    """Names of a dataclass' fields except for some, given as a space-separated list."""
    return tuple(entry.name for entry in fields(cls) if entry.name not in others.split())


def write(cls: type, value: object) -> dict[str, Any]:
    """Writes the fields of a dataclass from an instance, or an object that has them."""
    document: dict[str, Any] = {}
    for entry in entries(cls):
        field_value = getattr(value, entry.name)
        may_be_empty = isinstance(field_value, tuple | Mapping) or DROPPED in entry.marks
        can_be_absent = may_be_empty and not entry.required and KEPT not in entry.marks
        if field_value is not None and not (can_be_absent and not field_value):
            written = _written(entry.kind, field_value)
            is_inline = INLINE in entry.marks or REST in entry.marks
            document |= written if is_inline else {entry.key: written}
    return document


def _written(kind: Any, value: Any) -> Any:  # noqa: ANN401 - what JSON may hold
    kind = _fitting(_alternatives(kind), value)
    if get_origin(kind) is Annotated:
        inner, *marks = get_args(kind)
        for mark in marks:
            if isinstance(mark, WrittenForm):
                return (
                    mark.write(value) if mark.form is None else write(mark.form, mark.write(value))
                )
        return _written(inner, value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return write(type(value), value)
    if kind is not Any and isinstance(value, Mapping):
        return {name: _written(get_args(kind)[1], item) for name, item in value.items()}
    if isinstance(value, tuple):
        return [_written(get_args(kind)[0], item) for item in value]
    return value


def read(cls: type[_T], document: object, path: str) -> _T:
    """Reads a dataclass from JSON of `write`; `path` is that of the document in the file.

    Raises:
        DataError: A value is missing or of another type; the message names its path.
    """
    values = read_fields(cls, document, path)
    try:
        return cls(**values)
    except ValueError as error:
        place = path or "the document"
        raise DataError(f"{place}: {error}.", culprits=[place]) from error


def read_fields(cls: type, document: object, path: str) -> dict[str, Any]:
    """Reads the fields of a dataclass by name; its errors are those of `read`."""
    table, known_fields = _table(document, path), entries(cls)
    known_keys = set().union(*(entry.keys for entry in known_fields))
    values, faults = dict[str, Any](), list[DataError]()
    for key in table.keys() - known_keys if issubclass(cls, Strict) else ():
        place, known = _joined(path, key), [entry.key for entry in known_fields]
        words = f"{place} is not known; the fields are {', '.join(known)}."
        faults.append(DataError(words, culprits=[place], next_step=did_you_mean(key, known)))
    for entry in known_fields:
        try:
            if REST in entry.marks:
                rest = {key: value for key, value in table.items() if key not in known_keys}
                values[entry.name] = read_value(entry.kind, rest, path)
            elif INLINE in entry.marks:
                if entry.required or entry.keys & table.keys():
                    values[entry.name] = read_value(entry.kind, table, path)
            elif entry.required or entry.key in table:
                place = _joined(path, entry.key)
                values[entry.name] = read_value(entry.kind, table.get(entry.key, MISSING), place)
        except DataError as error:
            faults.append(error)
    if faults:
        raise _together(faults)
    return values


def _together(faults: Sequence[DataError]) -> DataError:
    """One error in place of several, or the only one."""
    if len(faults) == 1:
        return faults[0]
    return DataError(
        f"{'; '.join(fault.message.removesuffix('.') for fault in faults)}.",
        culprits=[culprit for fault in faults for culprit in fault.culprits],
        next_step=" ".join(dict.fromkeys(filter(None, (fault.next_step for fault in faults)))),
    )


def read_value(kind: Any, value: Any, path: str) -> Any:  # noqa: ANN401 - what JSON may hold
    """Reads a value of a type; `MISSING` is refused; the errors are those of `read`."""
    origin, args = get_origin(kind), get_args(kind)
    if value is MISSING:
        raise _missing(kind, path)
    if kind is Any:
        return value
    if origin is Annotated:
        return _read_marked(kind, value, path)
    if origin in (Union, UnionType):
        return read_value(_fitting(_alternatives(kind), value), value, path)
    if origin is Literal:
        return _one_of(args, value, kind, path)
    if origin is tuple:
        return _read_tuple(kind, value, path)
    if origin is not None and issubclass(origin, Mapping):
        items = _table(value, path).items()
        return {name: read_value(args[1], item, _joined(path, name)) for name, item in items}
    if is_dataclass(kind):
        return read(kind, value, path)  # type: ignore[arg-type] # no instance, but a class
    return plain(kind, value, path)


def _missing(kind: Any, path: str) -> DataError:  # noqa: ANN401 - see `read_value`
    """Builds the error for a value that is absent; of an only name, with the line to add."""
    inner = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    names = get_args(inner) if get_origin(inner) is Literal else ()
    step = f"Add {path} = {names[0]!r}." if len(names) == 1 else ""
    words = f"{path} is missing, but must be {needed_of(kind)}."
    return DataError(words, culprits=[path], next_step=step)


def _one_of(names: Sequence[Any], value: object, kind: Any, path: str) -> Any:  # noqa: ANN401
    """The name that a value is: `True` is no 1, and a text of another class is a text."""
    for name in names:
        is_same_kind = isinstance(value, bool) == isinstance(name, bool)
        if is_same_kind and isinstance(value, type(name)) and value == name:
            return name
    step = _similar(value, names) or _unquoted(value, names)
    raise wrong_value(value, needed_of(kind), path, step)


def _read_marked(kind: Any, value: Any, path: str) -> Any:  # noqa: ANN401 - see `read_value`
    inner, *marks = get_args(kind)
    for mark in marks:
        if isinstance(mark, Array):
            return _array(kind, mark, value, path)
        if isinstance(mark, WrittenForm):
            content = value if mark.form is None else read(mark.form, value, path)
            return _converted(mark.read, path, content, path)
        if isinstance(mark, Lenient):
            value = _converted(mark.convert, path, value)
        if mark is BY_NAME:
            return _read_by_name(get_args(inner)[0], value, path)
    checked = read_value(inner, value, path)
    for mark in marks:
        if isinstance(mark, Check) and not mark.fits(checked):
            raise wrong_value(value, mark.needed, path, _similar(value, mark.names))
    return checked


def _read_by_name(kind: Any, value: Any, path: str) -> tuple[Any, ...]:  # noqa: ANN401
    if not all(isinstance(each, Mapping) for each in (value, *getattr(value, "values", tuple)())):
        raise wrong_value(value, f"tables [{path}.NAME]", path)
    named = next((_joined(path, name) for name, row in value.items() if "name" in row), None)
    if named is not None:
        words = f"{named}.name is not known: the table has the name."
        raise DataError(words, culprits=[f"{named}.name"])
    rows = ((name, {**row, "name": name}) for name, row in value.items())
    return tuple(read_value(kind, row, _joined(path, name)) for name, row in rows)


def _converted(convert: Callable[..., Any], path: str, *given: object) -> Any:  # noqa: ANN401
    try:
        return convert(*given)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        why = str(error) or type(error).__name__
        raise DataError(f"{path}: {why}.", culprits=[path]) from error


def needed_of(kind: Any) -> str:  # noqa: ANN401 - a type
    """Words for a valid value of a type."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        stated = (mark.needed for mark in args[1:] if isinstance(mark, Check | Array))
        return next(stated, None) or needed_of(args[0])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(needed_of, _alternatives(kind))))
    if origin is Literal:
        return listed([f'"{each}"' if isinstance(each, str) else repr(each) for each in args], "or")
    if origin is tuple:
        item = (get_args(args[0]) or args)[0]
        of = "" if args[-1] is Ellipsis else f" of {len(args)} {_SEVERAL.get(item, '')}"
        return f"a list{of}".rstrip()
    return _WORDS.get(kind, "a table")


def _alternatives(kind: Any) -> list[Any]:  # noqa: ANN401 - a type
    """The alternatives of a union except None, or the type itself."""
    if get_origin(kind) in (Union, UnionType):
        return [argument for argument in get_args(kind) if argument is not NoneType]
    return [kind]


def _fitting(kinds: list[Any], value: object) -> Any:  # noqa: ANN401 - a type
    """The alternative that fits a value: of dataclasses, the one with most of its keys present."""
    if len(kinds) == 1:
        return kinds[0]
    if not isinstance(value, Mapping):
        is_row = isinstance(value, list | tuple)
        return next((kind for kind in kinds if (get_origin(kind) is tuple) == is_row), kinds[0])

    def fit(kind: type) -> tuple[int, int]:
        present = sum(entry.key in value for entry in entries(kind))
        return present, present - len(entries(kind))

    return max(kinds, key=fit)


def _read_tuple(kind: Any, value: object, path: str) -> tuple[Any, ...]:  # noqa: ANN401
    args = get_args(kind)
    if isinstance(value, list | tuple) and args[-1] is Ellipsis:
        args = (args[0],) * len(value)
    if not isinstance(value, list | tuple) or len(value) != len(args):
        raise wrong_value(value, needed_of(kind), path)
    return tuple(
        read_value(kind, item, f"{path}[{index}]")
        for index, (kind, item) in enumerate(zip(args, value, strict=True))
    )


def _array(kind: Any, form: Array, value: object, path: str) -> Any:  # noqa: ANN401
    """Reads an array of a type such as `Annotated[FloatArray, Array((3,))]`."""
    wanted = scalar_of(get_args(kind)[0])
    # Rows may differ in length.
    with suppress(ValueError):
        array = np.asarray(value)
        if not array.size:
            array = np.zeros((*array.shape, *(0,) * len(form.shape))[: len(form.shape)])
        elif array.dtype.kind not in ("b" if wanted is np.bool_ else "iuf"):
            raise wrong_value(value, needed_of(kind), path)
        sizes = zip(array.shape, form.shape, strict=False)
        if array.ndim == len(form.shape) and all(has == size or size < 0 for has, size in sizes):
            if fault := form.fault(array) if form.fault else "":
                raise DataError(f"{path} {fault}.", culprits=[path])
            return array.astype(wanted)
    raise wrong_value(value, needed_of(kind), path)


def plain(kind: type[_T], value: Any, path: str) -> _T:  # noqa: ANN401 - what JSON may hold
    """Checks that a value is a number, a text, or a boolean; raises DataError."""
    kinds = (int, float) if kind is float else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
        raise wrong_value(value, needed_of(kind), path, _unquoted(value, (), kind))
    try:
        return kind(value)  # type: ignore[call-arg] # float of an int, or what it is
    except OverflowError as error:
        raise wrong_value(value, needed_of(kind), path) from error


def _similar(value: object, names: Collection[Any]) -> str:
    texts = [name for name in names if isinstance(name, str)]
    return did_you_mean(value, texts) if isinstance(value, str) else ""


def _unquoted(value: object, names: Collection[Any], kind: type = int) -> str:
    """Advice on a number that is written as a text: one of some names, or any of a kind."""
    if not isinstance(value, str) or kind not in (int, float):
        return ""
    try:
        number = kind(value)
    except ValueError:
        return ""
    fits = number in names if names else math.isfinite(number)
    return f"Write it without quotes: {value.strip()}." if fits else ""


def wrong_value(value: object, needed: str, path: str, next_step: str = "") -> DataError:
    """Builds the error for another value than needed."""
    place = path or "the document"
    return DataError(
        f"{place} is {shown(value)}, but must be {needed}.", culprits=[place], next_step=next_step
    )


def shown(value: object) -> str:
    """A value as text for a message, shortened."""
    text = repr(value)
    if value is None or isinstance(value, bool):
        text = {None: "null", True: "true", False: "false"}[value]
    elif isinstance(value, date | time):
        text = value.isoformat()
    if len(text) <= _SHOWN:
        return text
    if isinstance(value, Mapping):
        return f"a mapping of {', '.join(map(str, list(value)[:8]))}"[:_SHOWN]
    return f"a list of {len(value)}" if isinstance(value, list) else f"{text[:_SHOWN]}..."


def _table(value: object, path: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise wrong_value(value, "a table", path)
    return value


def _joined(path: str, key: str) -> str:
    return f"{path}.{key}".lstrip(".")
