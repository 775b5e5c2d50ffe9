"""Runtime checks of the arguments of public functions by pydantic, which converts none of them."""

import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, wraps
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BeforeValidator, InstanceOf, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Target, scalar_of

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# Classes of NumPy's numbers, too.
_NUMBERS: dict[Any, Any] = {float: Real, int: Integral}
# Words for pydantic's kinds of errors, and for the classes that a value is no instance of.
_WORDS = {
    "none_required": "None",
    "callable_type": "a function",
    "list_type": "a list",
    "str": "text",
    "Path": "a path",
    "Real": "a number",
    "Integral": "a whole number",
    "bool": "True or False",
    "bytes": "bytes",
    "Mapping": "a dict",
}


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


def check_fields(instance: Any) -> None:  # noqa: ANN401 - any dataclass
    """Checks the types of a dataclass' fields against its annotations; raises DataError."""
    _check(type(instance).__name__, vars(instance), _hints(instance.__class__))


_signature = cache(signature)


@cache
def _hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a function or a class
    """Annotations of a function's parameters, those of `Unpack` one by one, or of a class."""
    if isinstance(owner, type):
        return typing.get_type_hints(owner)
    # Return types may be imported for type checkers only.
    declared = {name: hint for name, hint in owner.__annotations__.items() if name != "return"}
    hints = typing.get_type_hints(
        types.SimpleNamespace(__annotations__=declared), owner.__globals__
    )
    for name, hint in list(hints.items()):
        if get_origin(hint) is typing.Unpack:
            hints |= typing.get_type_hints(get_args(hints.pop(name))[0])
    return hints


def _check(owner: str, values: Mapping[str, object], hints: Mapping[str, Any]) -> None:
    for name, value in values.items():
        try:
            _adapter(hints.get(name, Any)).validate_python(value)
        except ValidationError as error:
            raise _refusal(owner, name, value, hints[name], error) from error


@cache
def _adapter(hint: Any) -> TypeAdapter[Any]:  # noqa: ANN401 - a type
    return TypeAdapter(_checkable(hint))


def _checkable(hint: Any) -> Any:  # noqa: ANN401 - a type
    """The type by which pydantic checks, of all but collections, only whose instance it is."""
    origin, inner = get_origin(hint), get_args(hint)
    dtype = scalar_of(hint)
    if hint is npt.ArrayLike or dtype is not None:
        is_image = isinstance(dtype, type) and issubclass(dtype, np.unsignedinteger)
        return Annotated[Any, AfterValidator(partial(_array, dtype if is_image else None))]
    if hint is bool:
        return InstanceOf[bool] | InstanceOf[np.bool_]
    if origin in (Union, types.UnionType):
        return Union[tuple(map(_checkable, inner))]  # noqa: UP007 - of any number of types
    if origin is tuple:
        return Annotated[list[Any], BeforeValidator(partial(_elements, Sequence))]
    if isinstance(origin, type) and issubclass(list, origin):
        return Annotated[list[_checkable(inner[0])], BeforeValidator(partial(_elements, origin))]  # type: ignore[misc]
    if hint in (Any, types.NoneType) or origin in (Literal, Callable):
        return hint
    kind: Any = _NUMBERS.get(hint, origin or hint)
    return typing.cast(Any, InstanceOf)[kind] if isinstance(kind, type) else Any


def _array(pixel: type | None, value: object) -> object:
    """Refuses what is no image of a type of pixels, or no array of numbers for None."""
    if pixel is not None:
        is_sound = isinstance(value, np.ndarray) and value.dtype == pixel and value.ndim > 1
    else:
        try:
            is_sound = np.asarray(value).dtype.kind in "biuf"
        except ValueError:
            # Rows differ in length; the function itself reports which.
            is_sound = not isinstance(value, str)
    if not is_sound:
        raise ValueError("an array" if pixel is None else f"an image of {pixel.__name__}")
    return value


def _elements(kind: type, value: object) -> object:
    """The elements of a collection that are checked: none of one that reading would use up."""
    if isinstance(value, np.ndarray) and issubclass(Sequence, kind):
        return list(value[:1]) if value.ndim else value
    if not isinstance(value, kind) or isinstance(value, str | bytes | Mapping):
        return None
    return list(value) if isinstance(value, list | tuple) else []


def _refusal(
    owner: str, name: str, given: object, hint: object, error: ValidationError
) -> DataError:
    """Says what was given, what is needed, and how to get that."""
    errors = error.errors(include_url=False)
    places = [[part for part in entry["loc"] if isinstance(part, int)] for entry in errors]
    # Of a union's members, the one that got to an element says most.
    place = max(places, key=len)
    worst = [entry for entry, at in zip(errors, places, strict=True) if at == place]
    value = worst[0]["input"] if place else given
    needed = " or ".join(dict.fromkeys(map(_needed, worst)))
    seen, step = "None" if value is None else f"of the type {type(value).__name__}", ""
    if isinstance(value, np.ndarray):
        seen = f"an array of {value.dtype}, of the shape {value.shape}"
    if isinstance(value, str | Path):
        seen = f"{_WORDS['str' if isinstance(value, str) else 'Path']} ({str(value)!r})"
        options = (hint, *get_args(hint))
        loaders = [f"{option.__name__}.load" for option in options if hasattr(option, "load")]
        loaders += ["load_target"] * (Target in options)
        step = f"Load it first: visioncal.{loaders[0]}({str(value)!r})." if loaders else ""
        if any(entry["type"] == "literal_error" for entry in worst):
            step = did_you_mean(str(value), re.findall("'(.*?)'", needed))
    at = "".join(f"[{index}]" for index in place)
    message = f"{owner}: {name}{at} is {seen}, but must be {needed}."
    return DataError(message, culprits=[name], next_step=step)


def _needed(entry: ErrorDetails) -> str:
    """Words for valid input in place of that of an error."""
    context = entry.get("ctx", {})
    kind = context.get("class", entry["type"])
    article = "an" if kind[0] in "AEIOU" else "a"
    words = context.get("error", context.get("expected", _WORDS.get(kind, f"{article} {kind}")))
    return str(words)
