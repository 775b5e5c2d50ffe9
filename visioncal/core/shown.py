"""How results show themselves in a console and in a notebook, and how their names are looked up."""

from collections.abc import Iterable, Mapping
from html import escape
from typing import TypeVar

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean

_T = TypeVar("_T")
_COLOURS = {"good": "#2e7d32", "check": "#b26a00", "bad": "#c62828"}


class UnknownNameError(DataError, KeyError):
    """A name that is not there; the message has the nearest one."""


class ByName(dict[str, _T]):
    """Values by name, which suggests the nearest name for one that is not there."""

    def __missing__(self, name: str) -> _T:
        raise UnknownNameError(
            f"There is no {name!r} here. {did_you_mean(name, self)}".strip(),
            culprits=[name],
            next_step=f"The names are {', '.join(self)}.",
        )


def text_card(title: str, facts: Mapping[str, str]) -> str:
    """A few lines: what it is, then its facts."""
    return "\n".join([title, *(f"  {name}: {value}" for name, value in facts.items())])


def html_card(
    title: str, facts: Mapping[str, str], status: str = "", says: Iterable[str] = ()
) -> str:
    """A card for a notebook, of text that may come from anywhere.

    Args:
        title: What it is.
        facts: Its figures by name.
        status: `good`, `check` or `bad`; empty without a verdict.
        says: Sentences below.
    """
    badge = (
        f'<span style="background:{_COLOURS[status]};color:#fff;border-radius:3px;'
        f'padding:1px 8px;margin-right:8px">{status}</span>'
        if status in _COLOURS
        else ""
    )
    rows = "".join(
        f'<tr><td style="text-align:left;color:#767676;padding-right:1.5em">{escape(name)}</td>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in facts.items()
    )
    items = "".join(f"<li>{escape(say)}</li>" for say in says)
    return (
        '<div style="border:1px solid #bbb;border-radius:6px;padding:8px 12px;max-width:46em">'
        f"<div>{badge}<b>{escape(title)}</b></div><table>{rows}</table>"
        f"{f'<ul>{items}</ul>' if items else ''}</div>"
    )
