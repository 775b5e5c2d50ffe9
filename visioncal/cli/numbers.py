"""Options that hold several numbers with commas between."""

import math

from visioncal.core.errors import DataError

# Digits of the width or height of an image, and more than any has.
_MOST_DIGITS = 6


def numbers_in(words: str, option: str, form: str) -> tuple[float, ...]:
    """Reads an option of numbers.

    Args:
        words: What the user wrote: `12.5,-3,0`.
        option: The option's name, for messages.
        form: What is needed, as names with commas between: `x,y,z`.

    Raises:
        DataError: It is not as many finite numbers.
    """
    try:
        values = tuple(float(it) for it in words.split(","))
    except ValueError:
        values = ()
    if len(values) != len(form.split(",")) or not all(map(math.isfinite, values)):
        raise DataError(
            f"{option} is {words[:80]!r}; {form} is needed, numbers with commas between.",
            culprits=[option],
        )
    return values


def size_in(words: str) -> tuple[int, int]:
    """Reads the width and height of images [px], written as 1280,800 or 1280x800.

    Raises:
        DataError: It is not two whole numbers above 0.
    """
    sides = words.replace("x", ",").split(",")
    numbers = [
        int(it) for it in sides if it.strip().isdecimal() and len(it.strip()) <= _MOST_DIGITS
    ]
    if len(sides) != 2 or len(numbers) != 2 or min(numbers) < 1:
        raise DataError(
            f"--resolution is {words[:40]!r}; width and height of the images are needed [px], two "
            "whole numbers above 0, as 1280,800.",
            culprits=["--resolution"],
        )
    return numbers[0], numbers[1]
