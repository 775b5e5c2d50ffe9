"""Text and HTML summaries of results, and dictionaries that suggest similar names."""

from collections.abc import Iterable, Mapping
from html import escape
from typing import TypeVar

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean

_T = TypeVar("_T")
_COLOURS = {"good": "#2e7d32", "check": "#b26a00", "bad": "#c62828"}


class UnknownNameError(DataError, KeyError):
    """An unknown name; the message suggests a similar one."""


class ByName(dict[str, _T]):
    """Values by name; the error for an unknown name suggests a similar one."""

    def __missing__(self, name: str) -> _T:
        raise UnknownNameError(
            f"There is no {name!r} here. {did_you_mean(name, self)}".strip(),
            culprits=[name],
            next_step=f"The names are {', '.join(self)}.",
        )


def text_card(title: str, facts: Mapping[str, str]) -> str:
    """Summary of a result: its title, then its facts line by line."""
    return "\n".join([title, *(f"  {name}: {value}" for name, value in facts.items())])


def html_card(
    title: str, facts: Mapping[str, str], status: str = "", says: Iterable[str] = ()
) -> str:
    """Summary of a result for a notebook: title, figures, and sentences; all text is escaped.

    The status is `good`, `check` or `bad`, or empty without a verdict.
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
        '<div style="border:1px solid #bbb;border-radius:6px;padding:8px 12px;max-width:46em;'
        'font-family:sans-serif">'
        f"<div>{badge}<b>{escape(title)}</b></div><table>{rows}</table>"
        f"{f'<ul>{items}</ul>' if items else ''}</div>"
    )
