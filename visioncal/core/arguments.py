"""Runtime type checks of the arguments of public functions."""

import inspect
import types
import typing
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, Union

import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Target

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

_NUMBERS: dict[Any, Any] = {float: Real, int: Integral, bool: bool | np.bool_}
_WORDS = {
    Path: "a path",
    str: "text",
    float: "a number",
    int: "a whole number",
    bool: "True or False",
    bytes: "bytes",
    types.NoneType: "None",
}


def typed(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Decorates a function to check the types of its arguments against its annotations.

    Shapes and values are left to the function, and so are types that cannot be checked.
    """

    @wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        signature, hints = _declared(function)
        try:
            arguments = signature.bind(*args, **kwargs).arguments
        except TypeError:
            # Python's own message names the function.
            return function(*args, **kwargs)
        for name, value in arguments.items():
            kind = signature.parameters[name].kind
            values = {name: value}
            if kind is inspect.Parameter.VAR_KEYWORD:
                values, hint = value, typing.get_args(hints.get(name))
                fields = typing.get_type_hints(hint[0]) if hint else {}
            else:
                fields = hints
            for key, argument in values.items():
                _check(function.__qualname__, key, argument, fields.get(key, Any))
        return function(*args, **kwargs)

    return checked


def check_fields(instance: Any) -> None:  # noqa: ANN401 - any dataclass
    """Checks the types of a dataclass' fields against its annotations; raises DataError."""
    kind = type(instance)
    for name, hint in _hints(typing.cast(Hashable, kind)).items():
        _check(kind.__name__, name, getattr(instance, name), hint)


@cache
def _declared(function: Callable[..., Any]) -> tuple[inspect.Signature, dict[str, Any]]:
    annotations = {
        name: annotation
        for name, annotation in function.__annotations__.items()
        if name != "return"
    }
    # Return types may be imported for type checkers only.
    parameters = types.SimpleNamespace(__annotations__=annotations)
    hints = typing.get_type_hints(parameters, getattr(function, "__globals__", None))
    return inspect.signature(function), hints


@cache
def _hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a function or a class
    return typing.get_type_hints(owner)


def _check(owner: str, name: str, value: object, hint: object) -> None:
    if _fits(value, hint):
        return
    options = list(_options(hint))
    for option in options:
        if isinstance(value, list | tuple) and _is_list(option):
            for index, element in enumerate(value):
                _check(owner, f"{name}[{index}]", element, typing.get_args(option)[0])
    if isinstance(value, str) and (names := _names(options)):
        raise DataError(
            f"{owner}: {name} {value!r} is not one of {', '.join(names)}.",
            culprits=[name],
            next_step=did_you_mean(value, names),
        )
    needed = " or ".join(
        dict.fromkeys(
            _words(option) for option in options if option is not str or Path not in options
        )
    )
    step = ""
    if isinstance(value, str | Path):
        loaders = [f"{option.__name__}.load" for option in options if hasattr(option, "load")]
        loaders += ["load_target"] * (Target in options)
        step = f"Load it first: visioncal.{loaders[0]}({str(value)!r})." if loaders else ""
    raise DataError(
        f"{owner}: {name} is {_described(value)}; {needed} is needed.",
        culprits=[name],
        next_step=step,
    )


def _described(value: object) -> str:
    if value is None:
        return "None"
    if isinstance(value, str | Path):
        return f"{_WORDS[str] if isinstance(value, str) else _WORDS[Path]} ({str(value)!r})"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}, of the shape {value.shape}"
    return f"of the type {type(value).__name__}"


def _options(hint: Any) -> Iterator[Any]:  # noqa: ANN401
    """The alternatives of a union, or the type itself."""
    if typing.get_origin(hint) in (Union, types.UnionType):
        for argument in typing.get_args(hint):
            yield from _options(argument)
    else:
        yield hint


def _names(options: Sequence[Any]) -> list[str]:
    literals = [
        typing.get_args(option) for option in options if typing.get_origin(option) is Literal
    ]
    return [name for names in literals for name in names if isinstance(name, str)]


def _is_list(hint: Any) -> bool:  # noqa: ANN401
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    return isinstance(origin, type) and issubclass(list, origin) and len(inner) == 1


def _words(hint: Any) -> str:  # noqa: ANN401
    origin = typing.get_origin(hint)
    if hint in _WORDS:
        return _WORDS[hint]
    if origin is np.ndarray:
        pixels = _pixels(typing.get_args(hint))
        return "an array" if pixels is None else f"an image of {pixels.__name__}"
    if origin is Literal:
        return " or ".join(map(repr, typing.get_args(hint)))
    if origin is Callable:
        return "a function"
    if origin is not None and issubclass(origin, Mapping):
        return "a dict"
    if origin is not None:
        return "a list"
    name = getattr(hint, "__name__", str(hint))
    return f"a{'n' if name[0] in 'AEIOU' else ''} {name}"


def _fits(value: object, hint: Any) -> bool:  # noqa: ANN401 - a type, or a form of one
    """Whether a value is of a type, as far as that can be checked without deep inspection."""
    options = list(_options(hint))
    if len(options) > 1:
        return hint is npt.ArrayLike or any(_fits(value, option) for option in options)
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is None:
        is_open = hint is Any or not isinstance(hint, type)
        return is_open or isinstance(value, _NUMBERS.get(hint, hint))
    if origin in _FORMS:
        return _FORMS[origin](value, inner)
    return not isinstance(origin, type) or _is_collection(value, origin, inner)


def _pixels(inner: tuple[Any, ...]) -> type | None:
    """The pixel type of an image; None for an array of numbers."""
    (kind,) = typing.get_args(inner[1])
    return kind if isinstance(kind, type) and issubclass(kind, np.unsignedinteger) else None


def _is_array(value: object, inner: tuple[Any, ...]) -> bool:
    pixels = _pixels(inner)
    if pixels is not None:
        return isinstance(value, np.ndarray) and value.dtype == pixels and value.ndim > 1
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except ValueError:
        # Rows differ in length; the function itself reports which.
        return not isinstance(value, str)


def _is_collection(value: object, origin: type, inner: tuple[Any, ...]) -> bool:
    if isinstance(value, np.ndarray):
        if value.ndim == 0 or not issubclass(Sequence, origin):
            return False
        elements: Sequence[Any] = list(value[:1])
    elif isinstance(value, str | bytes) or not isinstance(value, origin):
        return False
    else:
        elements = value if isinstance(value, list | tuple) else ()
    return len(inner) != 1 or all(_fits(element, inner[0]) for element in elements)


_FORMS: dict[Any, Callable[[object, tuple[Any, ...]], bool]] = {
    np.ndarray: _is_array,
    Literal: lambda value, inner: any(
        isinstance(value, type(number)) and value == number for number in inner
    ),
    Callable: lambda value, _: callable(value),
    tuple: lambda value, _: _is_collection(value, Sequence, (Any,)),
}
