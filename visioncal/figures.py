"""How sentences write figures: two digits, and never an exponent."""

import math

# Nobody acts on less, be it millimetres, degrees or pixels.
_LEAST = 1e-3


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
