"""Options and arguments of commands, declared as fields of the records that commands take."""

from dataclasses import MISSING, field
from typing import Any

# Of an option or an argument that has to be given.
REQUIRED: Any = MISSING


def option(words: str, *names: str, default: object = None, **attributes: object) -> Any:  # noqa: ANN401
    """A field of a record that the command line sets by an option.

    Args:
        words: What it is, with its unit.
        *names: Its names; by default that of the field.
        default: Its value where it is not given; `REQUIRED` for none.
        **attributes: `min`, `max`, `metavar`, `panel` (its heading in the help), or others of
            typer's.
    """
    return field(default=default, metadata={"option": (words, names, attributes)})


def flag(words: str, *names: str, **attributes: object) -> Any:  # noqa: ANN401 - as `option`
    """A field that an option without a value switches on; see `option`."""
    return field(default=False, metadata={"flag": (words, names, attributes)})


def argument(words: str, default: object = REQUIRED, **attributes: object) -> Any:  # noqa: ANN401
    """A field that the command line sets by its place; see `option`."""
    return field(default=default, metadata={"argument": (words, (), attributes)})
