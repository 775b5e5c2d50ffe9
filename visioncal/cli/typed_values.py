"""Refusals of values on the command line: the value, and a possible one."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, listed


def refusal(param: Any, kind: Any, value: object, message: str) -> tuple[str, str]:  # noqa: ANN401
    """Words on a value that an option cannot have, and a remedy, which may be empty.

    Args:
        param: The option or argument, of typer.
        kind: The annotation of its value.
        value: What was typed.
        message: Words of typer, kept where the kind of value says no more.
    """
    name, kinds = shown_name(param), {kind, *get_args(kind)}
    choices = [word for each in kinds if get_origin(each) is Literal for word in get_args(each)]
    if choices:
        wanted, step = f"one of {listed(choices, 'or')}", did_you_mean(str(value), choices)
    elif kinds & {int, float}:
        wanted = f"a {'whole ' * (int in kinds)}number{_range_words(param)}"
        is_decimal = float in kinds and re.fullmatch(r"[+-]?\d*,\d+", str(value))
        step = f"Write {str(value).replace(',', '.')}." if is_decimal else ""
    elif Path in kinds and "is a file" in message:
        return f"{name} is {value}, a file, but must be a folder.", ""
    else:
        return message, ""
    return f"{name} is {value!r}, but must be {wanted}.", step


def check_paths(params: Iterable[Any], values: dict[str, object], typed: Sequence[str]) -> None:
    """Checks that no path is an empty text, which would be the current folder (DataError).

    Args:
        params: Options and arguments whose values are paths.
        values: What was typed for each parameter, by its name.
        typed: The words of the command.
    """
    for param in params if "" in typed or any(word.endswith("=") for word in typed) else ():
        value = values.get(param.name)
        if value == "" or (isinstance(value, list | tuple) and "" in value):
            raise DataError(
                f"{shown_name(param)} is empty, but must be a path.",
                culprits=[shown_name(param)],
                next_step="Write . for the folder where you are; or look whether a variable of "
                "the shell is set.",
            )


def shown_name(param: Any) -> str:  # noqa: ANN401 - of typer
    """The long name of an option, or that of an argument, as in usage."""
    name = str(param.opts[-1])
    return name if name.startswith("-") else name.upper()


def _range_words(param: Any) -> str:  # noqa: ANN401 - of typer
    least, most = getattr(param, "min", None), getattr(param, "max", None)
    if least is None:
        return "" if most is None else f" up to {most:g}"
    return f" of {least:g} or more" if most is None else f" from {least:g} to {most:g}"
