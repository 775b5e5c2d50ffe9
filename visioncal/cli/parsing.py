"""Parses option values: lists of numbers, views, sizes, planes."""

import math
from collections.abc import Mapping

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of

# Digits of a view's number, and of the width or height of an image.
_MOST_DIGITS = 6
# A pose of the robot, as typed.
POSE = "x,y,z,qx,qy,qz,qw"
FORMS = (
    "z=20 (of the base, in mm), base_from_fixture or base_from_fixture:z=-5 (of a frame, whose z "
    "may point down: a board's points into it), or nx,ny,nz,d (a normal, and its product with any "
    "of the plane's points in mm)"
)


def numbers_in(words: str, option: str, form: str = "", scale: float = 1.0) -> tuple[float, ...]:
    """Parses an option of numbers, such as `12.5,-3,0`, and multiplies them by `scale`.

    `form` has their names, separated by commas, as `x,y,z`; empty for any number of them.

    Raises:
        DataError: It is not that many finite numbers.
    """
    try:
        values = tuple(float(part) for part in words.split(","))
    except ValueError:
        values = ()
    count = len(form.split(",")) if form else max(len(values), 1)
    if len(values) != count or not all(map(math.isfinite, values)):
        needed = f"{form} is needed, numbers" if form else "numbers are needed,"
        raise DataError(
            f"{option} is {words[:80]!r}; {needed} with commas between.",
            culprits=[option],
        )
    return tuple(scale * value for value in values)


def pair_in(words: str, option: str) -> tuple[int, int]:
    """Parses the numbers of two views, written as 8,17.

    Raises:
        DataError: It is not two whole numbers.
    """
    numbers = _whole_numbers(words)
    if len(numbers) != 2:
        raise DataError(
            f"{option} is {words[:40]!r}; the numbers of two views are needed, as 8,17.",
            culprits=[option],
        )
    return numbers[0], numbers[1]


def views_in(words: str, option: str) -> tuple[int, ...]:
    """Parses numbers of views, written as 1-12,14.

    Raises:
        DataError: It is not whole numbers, or a range ends before it begins.
    """
    found: list[int] = []
    for part in words.split(","):
        ends = _whole_numbers(part.replace("-", ","))
        if not 1 <= len(ends) <= 2 or ends[0] > ends[-1]:
            raise DataError(
                f"{option} is {words[:40]!r}; numbers of views are needed, as 1-12,14.",
                culprits=[option],
            )
        found += range(ends[0], ends[-1] + 1)
    return tuple(found)


def serial_in(words: str, option: str) -> tuple[str, str]:
    """Parses what a serial number is of, and the number, written as camera=1234.

    Raises:
        DataError: One of both is missing.
    """
    what, sign, number = words.partition("=")
    if not sign or not what:
        raise DataError(
            f"{option} is {words!r}; what it is of and the number are needed, as camera=1234.",
            culprits=[option],
        )
    return f"serial number, {what}", number


def size_in(words: str, option: str = "--resolution") -> tuple[int, int]:
    """Parses the width and height of images [px], written as 1280,800 or 1280x800.

    Raises:
        DataError: It is not two whole numbers above 0.
    """
    numbers = _whole_numbers(words.replace("x", ","))
    if len(numbers) != 2 or min(numbers) < 1:
        raise DataError(
            f"{option} is {words[:40]!r}; width and height of the images are needed [px], two "
            "whole numbers above 0, as 1280,800.",
            culprits=[option],
        )
    return numbers[0], numbers[1]


def _whole_numbers(words: str) -> list[int]:
    """Whole numbers separated by commas; empty where anything else is among them."""
    cells = [part.strip() for part in words.split(",")]
    are_whole = all(cell.isdecimal() and len(cell) <= _MOST_DIGITS for cell in cells)
    return [int(cell) for cell in cells] if are_whole else []


def names_in(words: str, option: str) -> tuple[str, ...]:
    """Parses an option of names separated by commas.

    Raises:
        DataError: A name is empty or occurs twice.
    """
    names = tuple(part.strip() for part in words.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise DataError(
            f"{option} is {words[:80]!r}; names are needed, each once, with commas between.",
            culprits=[option],
        )
    return names


def refuse_given(options: Mapping[str, object], why: str, next_step: str = "Leave it out.") -> None:
    """Refuses options that do not apply here.

    Values are by option, None for those that were not given; `why` is the reason in words.

    Raises:
        DataError: One is given.
    """
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise DataError(f"{some_of(given)}: {why}.", culprits=given, next_step=next_step)
