"""Formatting of numbers, lists and names for messages and tables."""

import difflib
import math
from collections.abc import Collection, Iterable, Sequence
from decimal import ROUND_CEILING, Decimal
from typing import TypeVar

from visioncal.core.errors import DataError

_Name = TypeVar("_Name", bound=str)

# Least figures in sentences, and in tables [mm, deg or px]: smaller ones do not matter.
_LEAST, _SMALLEST = 1e-3, 1e-4


def figure(value: float) -> str:
    """Formats a figure [mm, deg or px] with two significant digits, tiny ones as `under ...`."""
    if not math.isfinite(value):
        return f"{value:g}"
    if 0.0 < abs(value) < _LEAST:
        return f"under {_LEAST:g}"
    exponent = int(f"{value:.1e}".partition("e")[2]) if value else 0
    decimals = max(1 - exponent, 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def rounded_up(value: float) -> float:
    """Rounds a non-negative limit up to the digits that `figure` and `significant` show."""
    if value == 0.0 or not math.isfinite(value):
        return value
    exponent = int(f"{value:.1e}".partition("e")[2])
    step = Decimal(1).scaleb(min(exponent - 1, 0))
    return float(Decimal(repr(float(value))).quantize(step, ROUND_CEILING))


def mm_and_deg(mm: float, deg: float) -> str:
    """Formats an error or sigma of a pose: `0.12 mm and 0.02 deg`."""
    return f"{figure(mm)} mm and {figure(deg)} deg"


def sigma_words(sigma: float, unit: str) -> str:
    """Formats a sigma in mm or deg; one beyond ten metres or half a turn means nothing."""
    most = 1e4 if unit == "mm" else 180.0
    return f"{figure(sigma)} {unit}" if sigma < most else f"not determined ({unit})"


def percent(probability: float) -> str:
    """Formats a probability as a percentage between `under 1 %` and `over 99 %`."""
    if probability > 0.99:
        return "over 99 %"
    return "under 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def decimals_for(sigma: float) -> int:
    """Number of decimals that show two significant digits of a standard deviation."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return 6
    # Rounded first, because 0.0996 is printed as 0.10.
    exponent = int(f"{sigma:.1e}".partition("e")[2])
    return min(max(1 - exponent, 0), 6)


def matched(value: float, sigma: float) -> str:
    """Formats a value with the decimals that match its standard deviation."""
    return fixed(value, decimals_for(sigma))


def fixed(value: float, decimals: int) -> str:
    """Formats a value with a number of decimals, without negative zeros."""
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def signed(value: float, decimals: int) -> str:
    """Formats a change with its sign; `0` if it rounds to zero."""
    text = f"{value:+.{decimals}f}"
    return text if text.strip("+-0.") else "0"


def significant(value: float | None, digits: int = 2) -> str:
    """Formats a non-negative figure with significant digits and no exponent.

    Returns:
        The text; an en dash for None.
    """
    if value is None:
        return "\N{EN DASH}"
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if value < _SMALLEST:
        return f"<{_SMALLEST}"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def counted(count: int, thing: str, verbs: tuple[str, str] | None = None) -> str:
    """A count with its noun, and its verb of (singular, plural): `1 stop`, `3 stops show`."""
    is_one = count == 1
    words = f"{count} {thing}{'' if is_one else 's'}"
    return words if verbs is None else f"{words} {verbs[0] if is_one else verbs[1]}"


def listed(words: Sequence[str], joint: str = "and") -> str:
    """Joins words: `a, b and c`."""
    *first, last = words
    return f"{', '.join(first)} {joint} {last}" if first else last


def ranges(numbers: Iterable[int]) -> str:
    """Formats integers with consecutive ones as ranges: `1-4,7`."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ",".join(str(run[0]) + (f"-{run[-1]}" if len(run) > 1 else "") for run in runs)


def some_of(names: Sequence[str], most: int = 8) -> str:
    """Joins words, shortened: `a, b and 3 more`."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def view_words(views: Sequence[int]) -> str:
    """Views in a sentence: `view 3`, or `views 3, 6 and 9 more`."""
    return f"view{'s' * (len(views) > 1)} {some_of([*map(str, views)])}"


def robot_words(name: str) -> str:
    """A robot in a sentence: `robot a`, or `the robot` where it has no name."""
    return f"robot {name}" if name else "the robot"


def row_words(views: Sequence[int]) -> str:
    """All rows of views in a sentence: `the row of view 3`, or `the rows of views 3 and 6`."""
    s = "s" * (len(views) > 1)
    return f"the row{s} of view{s} {listed([*map(str, views)])}"


def known_name(
    what: str,
    name: str,
    known: Collection[_Name],
    culprit: str = "",
    next_step: str = "",
    of: str = "",
) -> _Name:
    """The name, if it is among known ones, of an owner; else raises DataError with a similar one.

    `next_step` is the advice where none is similar.
    """
    for each in known:
        if each == name:
            return each
    names = some_of([*known], 20) or "none"
    raise DataError(
        f"{of} has no {f'{what} {name[:80]!r}'.strip()}; it has {names}."
        if of
        else f"There is no {what} named {name[:80]!r}; the names are {names}.",
        culprits=[culprit or name],
        next_step=did_you_mean(name, known) or next_step,
    )


def did_you_mean(word: str, known: Iterable[str], least: float = 0.6) -> str:
    """Suggestion of known names similar to `word`; empty if none is as similar as `least`."""
    names = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(word.lower(), names, n=3, cutoff=least)
    return f"Did you mean {' or '.join(names[name] for name in near)}?" if near else ""
