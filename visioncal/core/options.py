"""Fields of records that the command line sets, with their help, in any package."""

from collections.abc import Mapping
from dataclasses import MISSING, field
from functools import partial
from typing import Any

from visioncal.core.parsing import numbers_in, size_in

# Of an option or an argument that has to be given.
REQUIRED: Any = MISSING


def option(words: str, *names: str, default: object = None, **attributes: object) -> Any:  # noqa: ANN401
    """A field of a record that the command line sets by an option.

    Args:
        words: What it is, with its unit.
        *names: Its names; by default that of the field.
        default: Its value where it is not given; `REQUIRED` for none.
        **attributes: `min`, `max`, `metavar`, `panel` (its heading in the help), or others of
            typer's; `parse`, which makes the value of the typed words and the option's name; and
            `needs`, a field without whose value the option is refused.
    """
    return field(default=default, metadata={"option": (words, names, attributes)})


def flag(words: str, *names: str, **attributes: object) -> Any:  # noqa: ANN401 - as `option`
    """A field that an option without a value switches on; see `option`."""
    return field(default=False, metadata={"flag": (words, names, attributes)})


def argument(words: str, default: object = REQUIRED, **attributes: object) -> Any:  # noqa: ANN401
    """A field that the command line sets by its place; see `option`."""
    return field(default=default, metadata={"argument": (words, (), attributes)})


# Of an option for the size of images.
SIZE: Mapping[str, Any] = {"parse": size_in, "metavar": "W,H"}


def numbers_option(
    words: str, *names: str, form: str, scale: float = 1.0, **attributes: object
) -> Any:  # noqa: ANN401 - as `option`
    """An option of numbers with commas between, as `form` names them; see `option`."""
    parse = partial(numbers_in, form=form, scale=scale)
    return option(words, *names, metavar=form.upper(), parse=parse, **attributes)
