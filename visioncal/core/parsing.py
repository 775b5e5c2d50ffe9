"""Parses option values: lists of numbers, views, sizes, planes."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.core.number_format import some_of

# A pose of the robot, as typed.
POSE = "x,y,z,qx,qy,qz,qw"
FORMS = (
    "z=20 (of the base, in mm), base_from_fixture or base_from_fixture:z=-5 (of a frame, whose z "
    "may point down: a board's points into it), or nx,ny,nz,d (a normal, and its product with any "
    "of the plane's points in mm)"
)

# A column, with its sign and a factor before it.
_TERM = r"([+-]?)(?:(\d[\d.]*(?:e-?\d+)?)\*)?([A-Za-z_]\w*)"


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
    needed = f"{form}, numbers" if form else "numbers"
    are_right = len(values) == count and all(map(math.isfinite, values))
    _check(are_right, words, option, f"{needed} with commas between")
    return tuple(scale * value for value in values)


def need_in(words: str, option: str) -> float:
    """Parses a required accuracy; raises DataError."""
    numbers = [float(words)] if re.fullmatch(r"\+?(\d+\.?\d*|\.\d+)(e-?\d\d?)?", words) else [0.0]
    _check(0.0 < numbers[0] <= 1e15, words, option, "a number above 0, with a decimal point")
    return numbers[0]


def pairs_in(words: str, option: str) -> tuple[int, ...]:
    """Parses the numbers of pairs of views, written as 8,17 or 8,17,9,16."""
    numbers = _whole_numbers(words)
    needed = "the numbers of two views, as 8,17, or of several pairs, as 8,17,9,16"
    _check(len(numbers) > 0 and len(numbers) % 2 == 0, words, option, needed)
    return tuple(numbers)


def views_in(words: str, option: str) -> tuple[int, ...]:
    """Parses numbers of views, written as 1-12,14."""
    found: list[int] = []
    for part in words.split(","):
        ends = _whole_numbers(part.replace("-", ","))
        is_range = 1 <= len(ends) <= 2 and ends[0] <= ends[-1]
        _check(is_range, words, option, "numbers of views, as 1-12,14")
        found += range(ends[0], ends[-1] + 1)
    return tuple(found)


def shift_in(words: str, option: str) -> tuple[tuple[int, ...], int, bool]:
    """Parses views, by how many rows they are apart, and of images: 12-24:2 or 12-24:2:images."""
    views, _, rest = words.partition(":")
    by, _, of = rest.partition(":")
    is_right = by.removeprefix("-").isdecimal() and int(by) != 0 and of in ("", "images")
    _check(is_right, words, option, "views and a number of rows, as 12-24:2 or 12-24:2:images")
    return views_in(views, option), int(by), bool(of)


def turn_in(words: str, option: str) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Parses views, and an angle [deg] and, of boards, a point [mm], written as 3,7:180,80,60."""
    views, _, turn = words.partition(":")
    parts = "deg,x,y" if "," in turn else "deg"
    return views_in(views, option), numbers_in(turn, option, parts)


def tool_in(words: str, option: str) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Parses views, and a tool's place [mm] and rotation vector [deg]: 3,7:0,0,140,0,0,30."""
    views, _, tool = words.partition(":")
    return views_in(views, option), numbers_in(tool, option, "x,y,z,rx,ry,rz")


def scale_in(words: str, option: str) -> tuple[str, float]:
    """Parses a board's true over its stated size, written as 1.01, or left:1.01 of several."""
    name, _, factor = words.rpartition(":")
    (scale,) = numbers_in(factor, option, "factor")
    _check(0.0 < scale < 1e3, words, option, "a factor above 0, as 1.01 or left:1.01")
    return name, scale


def places_in(
    words: str, option: str
) -> tuple[tuple[int, ...], tuple[tuple[tuple[float, str], ...], ...]]:
    """Parses views, and what their positions are, by axis: factors and names of columns.

    Written as 0,4-6:x,-y,z+0.001*rail_mm, in which x, y and z are the columns x_m, y_m and z_m.
    """
    views, _, axes = words.partition(":")
    parsed = tuple(
        tuple(
            (float(f"{sign}{factor or 1}"), f"{name}_m" if name in ("x", "y", "z") else name)
            for sign, factor, name in re.findall(_TERM, axis)
        )
        for axis in axes.split(",")
    )
    is_right = len(parsed) == 3 and all(
        re.fullmatch(f"(?:{_TERM})+", axis) for axis in axes.split(",")
    )
    _check(is_right, words, option, "views and three axes, as 0,4-6:x,-y,z+rail_m")
    return views_in(views, option), parsed


def serial_in(words: str, option: str) -> tuple[str, str]:
    """Parses what a serial number is of, and the number, written as camera=1234."""
    what, sign, number = words.partition("=")
    needed = "what it is of and the number, as camera=1234"
    _check(bool(sign and what), words, option, needed)
    return f"serial number, {what}", number


def size_in(words: str, option: str = "--resolution") -> tuple[int, int]:
    """Parses the width and height of images [px], written as 1280,800 or 1280x800."""
    numbers = _whole_numbers(words.replace("x", ","))
    needed = "width and height of the images [px], two whole numbers above 0, as 1280,800"
    _check(len(numbers) == 2 and min(numbers) > 0, words, option, needed)
    return numbers[0], numbers[1]


def address_in(words: str, option: str) -> tuple[str, int]:
    """Parses the address of a server, written as 0.0.0.0:8321."""
    host, _, port = words.rpartition(":")
    is_right = bool(host) and port.isdecimal() and 0 < int(port) < 1 << 16
    _check(is_right, words, option, "a host and a port up to 65535, as 0.0.0.0:8321")
    return host, int(port)


def text_in(words: str, option: str) -> str:
    """Reads the text of a file; raises DataError."""
    _check(bool(words), words, option, "a path")
    return read_text(Path(words))


def names_in(words: str, option: str) -> tuple[str, ...]:
    """Parses an option of names separated by commas."""
    names = tuple(part.strip() for part in words.split(","))
    are_names = all(names) and len(set(names)) == len(names)
    _check(are_names, words, option, "names, each once, with commas between")
    return names


def _check(is_right: bool, words: str, option: str, needed: str) -> None:
    """Refuses a value of an option."""
    if not is_right:
        raise DataError(f"{option} is {words[:80]!r}, but must be {needed}.", culprits=[option])


def _whole_numbers(words: str) -> list[int]:
    """Whole numbers separated by commas; empty where anything else is among them."""
    cells = [part.strip() for part in words.split(",")]
    are_whole = all(cell.isdecimal() and len(cell) <= 6 for cell in cells)
    return [int(cell) for cell in cells] if are_whole else []


def refuse_given(options: Mapping[str, object], why: str, next_step: str = "Leave it out.") -> None:
    """Refuses options that do not apply here.

    Values are by option, None for those that were not given; `why` is the reason in words.

    Raises:
        DataError: One is given.
    """
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise DataError(f"{some_of(given)}: {why}.", culprits=given, next_step=next_step)
