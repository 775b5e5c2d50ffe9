"""Frozen dataclasses as JSON: written, read with checks, by the types of their fields.

A field is a key of its own name, or of the one that `Key` gives. What is None is absent on disk, as
is an empty default. Keys that a class does not know are left out, or kept in its field of the kind
`REST`. An error names the path of the value, as `kinematics.levels[2].rms_mm`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

_T = TypeVar("_T")
_WORDS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}


@contextmanager
def reading(label: str, what: str, next_step: str) -> Iterator[None]:
    """Names the file in the errors of reading it, whatever its content has made fail.

    Args:
        label: What the content came from.
        what: What it has to be, such as `a calibration`.
        next_step: How to make it again.

    Raises:
        DataError: It is not that.
    """
    try:
        yield
    except DataError as error:
        raise error.within(label) from error
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(
            f"{label}: not {what} that this version can read: {error!r}.",
            culprits=[label],
            next_step=next_step,
        ) from error


@dataclass(frozen=True)
class Key:
    """The key of a field that is not of its own name."""

    name: str


@dataclass(frozen=True)
class Array:
    """The shape of an array.

    Attributes:
        shape: Its sizes, of which those that are negative may be any.
        fault: Says what else is wrong with one; empty for nothing.
    """

    shape: tuple[int, ...]
    fault: Callable[[FloatArray], str] | None = None


@dataclass(frozen=True, eq=False)
class WrittenForm:
    """How a value is written that is no dataclass of ours, or has another form on disk.

    Attributes:
        write: Makes JSON of it, or its form.
        read: Reads that; its path is for messages.
        form: The dataclass that it is on disk; None for JSON of any kind.
    """

    write: Callable[[Any], Any]
    read: Callable[[Any, str], Any]
    form: type | None = None


# Fields whose keys stand beside those of their owner, and one that has all keys of no other.
INLINE, REST = object(), object()
# A field that is on disk though it is empty, a text that is not, and one that is never.
KEPT, DROPPED, UNWRITTEN = object(), object(), object()
Vector = Annotated[FloatArray, Array((-1,))]
Matrix = Annotated[FloatArray, Array((-1, -1))]


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a result.

    Attributes:
        further: What a file has of it that this version does not know, as it is there.
    """

    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class Entry:
    """A field as it is on disk: its name, key and type, and whether it has to be there."""

    name: str
    key: str
    kind: Any
    required: bool
    marks: tuple[Any, ...]

    @property
    def keys(self) -> set[str]:
        """The keys that it has."""
        if INLINE in self.marks:
            forms = [mark.form for mark in self.marks if isinstance(mark, WrittenForm)]
            (inner,) = _alternatives(get_args(self.kind)[0])
            return set().union(*(entry.keys for entry in entries(forms[0] if forms else inner)))
        return set() if REST in self.marks else {self.key}

    def is_absent(self, value: object) -> bool:
        """Whether a value is not written."""
        is_empty = isinstance(value, tuple | Mapping) or DROPPED in self.marks
        can_be = not self.required and KEPT not in self.marks
        return value is None or (can_be and is_empty and not value)


@cache
def entries(cls: type) -> tuple[Entry, ...]:
    """The fields of a dataclass in their order."""
    hints = get_type_hints(cls, include_extras=True)
    found = []
    for entry in fields(cls):
        kind = hints[entry.name]
        marks = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
        if UNWRITTEN in marks:
            continue
        keys = [mark.name for mark in marks if isinstance(mark, Key)]
        required = entry.default is MISSING and entry.default_factory is MISSING
        found.append(Entry(entry.name, keys[0] if keys else entry.name, kind, required, marks))
    # What is of other things stands first.
    return tuple(sorted(found, key=lambda value: REST not in value.marks))


def names_but(cls: type, others: str) -> tuple[str, ...]:
    """The names of a dataclass' fields, but for some, with blanks between."""
    return tuple(entry.name for entry in fields(cls) if entry.name not in others.split())


def write(cls: type, value: object) -> dict[str, Any]:
    """Writes the fields that a dataclass has.

    Args:
        cls: The dataclass.
        value: One of it, or of a class that has its fields.
    """
    document: dict[str, Any] = {}
    for entry in entries(cls):
        mine = getattr(value, entry.name)
        if not entry.is_absent(mine):
            written = _written(entry.kind, mine)
            beside = INLINE in entry.marks or REST in entry.marks
            document |= written if beside else {entry.key: written}
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
        return {name: _written(get_args(kind)[1], number) for name, number in value.items()}
    if isinstance(value, tuple):
        return [_written(get_args(kind)[0], number) for number in value]
    return value


def read(cls: type[_T], document: object, path: str) -> _T:
    """Reads what `write` wrote.

    Args:
        cls: The dataclass.
        document: The JSON.
        path: Its place in the file, for messages.

    Raises:
        DataError: Something in it is missing or of another kind; the message names its place.
    """
    found = read_fields(cls, document, path)
    try:
        return cls(**found)
    except ValueError as error:
        place = path or "the document"
        raise DataError(f"{place}: {error}.", culprits=[place]) from error


def read_fields(cls: type, document: object, path: str) -> dict[str, Any]:
    """Reads the fields of a dataclass by name; its errors are those of `read`."""
    table, known = _table(document, path), entries(cls)
    ours = set().union(*(entry.keys for entry in known))
    found = {}
    for entry in known:
        if REST in entry.marks:
            rest = {key: value for key, value in table.items() if key not in ours}
            found[entry.name] = _read(entry.kind, rest, path)
        elif INLINE in entry.marks:
            if entry.required or entry.keys & table.keys():
                found[entry.name] = _read(entry.kind, table, path)
        elif entry.key in table:
            found[entry.name] = _read(entry.kind, table[entry.key], _joined(path, entry.key))
    for entry in known:
        if entry.required and entry.name not in found:
            place = _joined(path, entry.key)
            raise DataError(f"{place} is missing.", culprits=[place])
    return found


def _read(kind: Any, value: Any, path: str) -> Any:  # noqa: ANN401 - what JSON may hold
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Annotated:
        return _read_marked(args, value, path)
    if origin in (Union, UnionType):
        return _read(_fitting(_alternatives(kind), value), value, path)
    if origin is Literal:
        if value not in args:
            words = ", ".join(map(repr, args))
            raise other(value, f"one of {words}" if len(args) > 1 else words, path)
        return value
    if origin is tuple:
        return _read_tuple(args, value, path)
    if origin is not None and issubclass(origin, Mapping):
        table = _table(value, path)
        return {name: _read(args[1], number, _joined(path, name)) for name, number in table.items()}
    if is_dataclass(kind):
        return read(kind, value, path)  # type: ignore[arg-type] # no instance, but a class
    return plain(kind, value, path)


def _read_marked(args: tuple[Any, ...], value: Any, path: str) -> Any:  # noqa: ANN401 - see `_read`
    inner, *marks = args
    for mark in marks:
        if isinstance(mark, Array):
            return _array(inner, mark, value, path)
        if isinstance(mark, WrittenForm):
            known = value if mark.form is None else read(mark.form, value, path)
            try:
                return mark.read(known, path)
            except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
                why = str(error) or type(error).__name__
                raise DataError(f"{path}: {why}.", culprits=[path]) from error
    return _read(inner, value, path)


def _alternatives(kind: Any) -> list[Any]:  # noqa: ANN401 - a type
    """What a type that may be None may be beside it."""
    if get_origin(kind) in (Union, UnionType):
        return [argument for argument in get_args(kind) if argument is not NoneType]
    return [kind]


def _fitting(kinds: list[Any], value: object) -> Any:  # noqa: ANN401 - a type
    """The type that a value is of: of dataclasses, that of whose keys it has most, missing few."""
    if len(kinds) == 1:
        return kinds[0]
    if not isinstance(value, Mapping):
        is_row = isinstance(value, list | tuple)
        return next((kind for kind in kinds if (get_origin(kind) is tuple) == is_row), kinds[0])

    def fit(kind: type) -> tuple[int, int]:
        there = sum(entry.key in value for entry in entries(kind))
        return there, there - len(entries(kind))

    return max(kinds, key=fit)


def _read_tuple(args: tuple[Any, ...], value: object, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise other(value, "a list", path)
    if args[-1] is Ellipsis:
        args = (args[0],) * len(value)
    if len(value) != len(args):
        raise other(value, f"a list of {len(args)}", path)
    return tuple(
        _read(kind, number, f"{path}[{at}]")
        for at, (kind, number) in enumerate(zip(args, value, strict=True))
    )


def _array(kind: Any, form: Array, value: object, path: str) -> Any:  # noqa: ANN401
    """An array of a type, as `npt.NDArray[np.float64]`."""
    (wanted,) = get_args(get_args(kind)[1])
    sizes = " x ".join("n" if index < 0 else str(index) for index in form.shape)
    needed = other(value, f"an array of {sizes} numbers", path)
    try:
        found = np.asarray(value)
    except ValueError as error:
        raise needed from error
    if not found.size:
        found = np.zeros((*found.shape, *(0,) * len(form.shape))[: len(form.shape)])
    elif found.dtype.kind not in ("b" if wanted is np.bool_ else "iuf"):
        raise needed
    pairs = zip(found.shape, form.shape, strict=False)
    if found.ndim != len(form.shape) or not all(mine == its or its < 0 for mine, its in pairs):
        raise needed
    fault = form.fault(found) if form.fault else ""
    if fault:
        raise DataError(f"{path} {fault}.", culprits=[path])
    return found.astype(wanted)


def plain(kind: type[_T], value: Any, path: str) -> _T:  # noqa: ANN401 - what JSON may hold
    """Checks a value that is a number, a text, or true or false.

    Raises:
        DataError: It is something else.
    """
    kinds = (int, float) if kind is float else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
        raise other(value, _WORDS[kind], path)
    return kind(value)  # type: ignore[call-arg] # float of an int, or what it is


def other(value: object, needed: str, path: str) -> DataError:
    """Says what is there, and what is needed."""
    place = path or "the document"
    return DataError(f"{place} is {value!r:.60}; {needed} is needed.", culprits=[place])


def _table(value: object, path: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise other(value, "a table", path)
    return value


def _joined(path: str, key: str) -> str:
    return f"{path}.{key}".lstrip(".")
