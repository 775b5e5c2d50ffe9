"""How figures, lists and names are written: in sentences, and in tables with their sigmas."""

import difflib
import math
from collections.abc import Iterable, Sequence

# Nobody acts on less, in millimetres, degrees or pixels: in sentences, and in tables.
_LEAST, _SMALLEST = 1e-3, 1e-4
_MAX_DECIMALS = 6


def figure(value: float) -> str:
    """Writes a figure [mm, deg or px] with two significant digits, in words where it is tiny."""
    if not math.isfinite(value):
        return f"{value:g}"
    if 0.0 < abs(value) < _LEAST:
        return f"under {_LEAST:g}"
    exponent = int(f"{value:.1e}".partition("e")[2]) if value else 0
    decimals = max(1 - exponent, 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def mm_and_deg(mm: float, deg: float) -> str:
    """Writes how far something is off, or known: `0.12 mm and 0.02 deg`."""
    return f"{figure(mm)} mm and {figure(deg)} deg"


def percent(probability: float) -> str:
    """Writes a probability; none is certain."""
    if probability > 0.99:
        return "over 99 %"
    return "under 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def decimals_for(sigma: float) -> int:
    """Decimals at which a standard deviation shows two significant digits."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return _MAX_DECIMALS
    # Rounding first keeps 0.0996, which prints as 0.10, from asking for one decimal too many.
    exponent = int(f"{sigma:.1e}".partition("e")[2])
    return min(max(1 - exponent, 0), _MAX_DECIMALS)


def matched(value: float, sigma: float) -> str:
    """Writes a value with the decimals that its standard deviation supports."""
    return fixed(value, decimals_for(sigma))


def fixed(value: float, decimals: int) -> str:
    """Writes a value with so many decimals, and nothing as no negative zero."""
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def signed(value: float, decimals: int) -> str:
    """Writes a change with its sign; what rounds to nothing has none."""
    text = f"{value:+.{decimals}f}"
    return text if text.strip("+-0.") else "0"


def significant(value: float | None, digits: int = 2) -> str:
    """Writes a non-negative figure with so many significant digits and no exponent.

    Returns:
        The text; an en dash where there is no figure.
    """
    if value is None:
        return "\N{EN DASH}"
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if value < _SMALLEST:
        return f"<{_SMALLEST}"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def counted(count: int, thing: str) -> str:
    """Writes how many of something there are: `1 stop`, `3 stops`."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def listed(words: Sequence[str]) -> str:
    """Writes words one after the other: `a, b and c`."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def ranges(numbers: Iterable[int]) -> str:
    """Writes whole numbers with runs drawn together: `1-4,7`."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ",".join(str(run[0]) + (f"-{run[-1]}" if len(run) > 1 else "") for run in runs)


def some_of(names: Sequence[str], most: int = 8) -> str:
    """Words a list, cut short: `a, b and 3 more`."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def did_you_mean(word: str, known: Iterable[str], least: float = 0.6) -> str:
    """Words a hint at the known names nearest to `word`; empty where none is as near as `least`."""
    names = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(word.lower(), names, n=3, cutoff=least)
    return f"Did you mean {' or '.join(names[name] for name in near)}?" if near else ""
