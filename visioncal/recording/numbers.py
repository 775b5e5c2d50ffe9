"""How report and recording write numbers: with the digits that the uncertainty supports."""

import math

_MAX_DECIMALS = 6
# Nobody acts on less, be it millimetres, degrees or pixels.
_LEAST = 0.0001


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
    """Writes a value with so many decimals."""
    return _without_negative_zero(f"{value:.{decimals}f}")


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
    if value < _LEAST:
        return f"<{_LEAST}"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def _without_negative_zero(text: str) -> str:
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text
