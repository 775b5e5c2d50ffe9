"""Runtime checks of the arguments of public functions against their annotations."""

import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt

from visioncal.core.codec import Check
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, listed
from visioncal.core.types import Target, scalar_of

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# Classes of NumPy's numbers, too.
_CLASSES: dict[Any, Any] = {float: Real, int: Integral, bool: (bool, np.bool_)}
# Words for a value of a class.
_WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "text",
    Path: "a path",
    bytes: "bytes",
    Mapping: "a dict",
}


class _Fault(NamedTuple):
    """A value that does not fit its annotation."""

    place: tuple[int, ...]  # Its indices in the argument.
    value: object
    needed: str  # Words for a valid value.
    choices: tuple[Any, ...] = ()  # The values of a Literal.


def typed(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Decorates a function to check the types of its arguments against its annotations.

    Shapes and values are left to the function, and so are types that cannot be checked.
    """

    @wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        try:
            given = _signature(function).bind(*args, **kwargs).arguments
        except TypeError:
            # Python's own message names the function.
            return function(*args, **kwargs)
        _check(function.__qualname__, given | kwargs, _hints(function))
        return function(*args, **kwargs)

    return checked


def check_fields(instance: Any, label: str = "") -> None:  # noqa: ANN401 - any dataclass
    """Checks a dataclass' fields against its annotations and their `Check`s; raises DataError.

    `label` names it in messages, in place of its class.
    """
    _check(label or type(instance).__name__, vars(instance), _hints(instance.__class__))


_signature = cache(signature)


@cache
def _hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a function or a class
    """Annotations of a function's parameters, those of `Unpack` one by one, or of a class."""
    if isinstance(owner, type):
        return typing.get_type_hints(owner, include_extras=True)
    # Return types may be imported for type checkers only.
    declared = {name: hint for name, hint in owner.__annotations__.items() if name != "return"}
    hints = typing.get_type_hints(
        types.SimpleNamespace(__annotations__=declared), owner.__globals__, include_extras=True
    )
    for name, hint in list(hints.items()):
        if get_origin(hint) is typing.Unpack:
            hints |= typing.get_type_hints(get_args(hints.pop(name))[0], include_extras=True)
    return hints


def _check(owner: str, values: Mapping[str, object], hints: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if faults := _faults(hints.get(name, Any), value):
            raise _refusal(owner, name, hints[name], faults)


def _faults(hint: Any, value: object, place: tuple[int, ...] = ()) -> list[_Fault]:  # noqa: ANN401
    """The faults of a value: of a union those by all of its members."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType) and hint is not npt.ArrayLike:
        by_member = [_faults(member, value, place) for member in inner]
        faults = [fault for faults in by_member for fault in faults if fault.needed != "None"]
        return faults if all(by_member) else []
    if origin is typing.Annotated:
        checks = [mark for mark in inner[1:] if isinstance(mark, Check)]
        return _faults(inner[0], value, place) or [
            _Fault(place, value, check.needed) for check in checks if not check.fits(value)
        ]
    if isinstance(origin, type) and (origin is tuple or issubclass(list, origin)):
        elements = _elements(Sequence if origin is tuple else origin, value)
        if elements is None:
            return [_Fault(place, value, "a list")]
        kind = Any if origin is tuple else inner[0]
        checked = (_faults(kind, item, (*place, at)) for at, item in enumerate(elements))
        return [fault for faults in checked for fault in faults]
    needed = _needed(hint, value)
    return [_Fault(place, value, needed, inner if origin is Literal else ())] if needed else []


def _needed(hint: Any, value: object) -> str:  # noqa: ANN401 - a type
    """Words for a valid value of a type that has no parts; empty where the value is one."""
    origin, dtype = get_origin(hint), scalar_of(hint)
    if hint is npt.ArrayLike or dtype is not None:
        is_image = isinstance(dtype, type) and issubclass(dtype, np.unsignedinteger)
        return _array_needed(dtype if is_image else None, value)
    if hint is types.NoneType:
        return "None" if value is not None else ""
    if origin is Literal:
        choices = get_args(hint)
        is_one = any(value == choice for choice in choices if isinstance(value, type(choice)))
        return "" if is_one else listed([*map(repr, choices)], "or")
    if origin is Callable:
        return "" if callable(value) else "a function"
    kind = origin or hint
    if hint is Any or not isinstance(kind, type) or isinstance(value, _CLASSES.get(kind, kind)):
        return ""
    name = public(kind).__name__
    return _WORDS.get(kind, f"{'an' if name[0] in 'AEIOU' else 'a'} {name}")


def _array_needed(pixel: type | None, value: object) -> str:
    """Words for an image of a type of pixels, or an array of numbers for None; or empty."""
    if pixel is not None:
        is_sound = isinstance(value, np.ndarray) and value.dtype == pixel and value.ndim > 1
        return "" if is_sound else f"an image of {pixel.__name__}"
    try:
        is_sound = np.asarray(value).dtype.kind in "biuf"
    except ValueError:
        # Rows differ in length; the function itself reports which.
        is_sound = not isinstance(value, str)
    return "" if is_sound else "an array"


def _elements(kind: type, value: object) -> Sequence[object] | None:
    """The elements that are checked: none of what reading would use up; None for no collection."""
    if isinstance(value, np.ndarray) and issubclass(Sequence, kind):
        return list(value[:1]) if value.ndim else None
    if not isinstance(value, kind) or isinstance(value, str | bytes | Mapping):
        return None
    return value if isinstance(value, list | tuple) else ()


def public(kind: object) -> Any:  # noqa: ANN401 - any type of an annotation
    """The class by which users know a kind: the one with its files, of what it contains alone."""
    if not isinstance(kind, type) or hasattr(kind, "load"):
        return kind
    known: list[type] = kind.__subclasses__()
    return next((each for each in known if hasattr(each, "load")), kind)


def _refusal(owner: str, name: str, hint: object, faults: Sequence[_Fault]) -> DataError:
    """Says what was given, what is needed, and how to get that."""
    # Of a union's members, the one that got to an element says most.
    place = max((fault.place for fault in faults), key=len)
    worst = [fault for fault in faults if fault.place == place]
    value, needed = worst[0].value, " or ".join(dict.fromkeys(fault.needed for fault in worst))
    is_short = value is None or isinstance(value, Real | np.bool_)
    seen, step = repr(value) if is_short else f"of the type {type(value).__name__}", ""
    if isinstance(value, np.ndarray):
        seen = f"an array of {value.dtype}, of the shape {value.shape}"
    if isinstance(value, str | Path):
        seen = f"{_WORDS[str if isinstance(value, str) else Path]} ({str(value)!r})"
        options = (hint, *get_args(hint))
        loaders = [
            f"{option.__name__}.load" for option in map(public, options) if hasattr(option, "load")
        ]
        loaders += ["load_target"] * (Target in options)
        step = f"Load it first: visioncal.{loaders[0]}({str(value)!r})." if loaders else ""
        if choices := [choice for fault in worst for choice in fault.choices]:
            step = did_you_mean(str(value), choices)
    at = "".join(f"[{index}]" for index in place)
    message = f"{owner}: {name}{at} is {seen}, but must be {needed}."
    return DataError(message, culprits=[name], next_step=step)
