"""Keys of rows and files, by which those of one source belong to those of another."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import product, takewhile
from pathlib import Path, PureWindowsPath
from typing import Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray
from visioncal.session.images import IMAGE_ENDINGS


def is_image_name(name: str) -> bool:
    """Whether a name has an image's ending."""
    return name.lower().endswith(IMAGE_ENDINGS)


def number_in(name: str) -> int | None:
    """Last number in a file's name without its ending; None where there is none."""
    digits = re.findall(r"[0-9]+", Path(name).stem)
    return int(digits[-1]) if digits and len(digits[-1]) < 19 else None


def plain_name(cell: str) -> str:
    """A file's name, on whatever machine, without its folder and an image's ending."""
    name = PureWindowsPath(cell).name
    return (name.rpartition(".")[0] if is_image_name(name) else name).casefold()


_DATE = re.compile(
    r"((?:19|20)[0-9]{2})\D?([01][0-9])\D?([0-3][0-9])\D{0,3}([0-2][0-9])\D?([0-5][0-9])\D?([0-5][0-9])"
    r"(?:[._,-]?([0-9]{1,9}))?"
)


def time_in(name: str) -> float:
    """The time [s] in a name, as a date or as seconds of an epoch; NaN without one."""
    if match := _DATE.search(name):
        with suppress(ValueError):
            whole = datetime(*map(int, match.groups()[:6]))  # type: ignore[arg-type]
            return (whole - datetime(1970, 1, 1)).total_seconds() + float(f"0.{match[7] or 0}")
    digits = re.search(r"[0-9]{9,19}(?:\.[0-9]+)?|[0-9]+\.[0-9]{2,}", name)
    return float(in_seconds(np.array([float(digits[0])]))[0]) if digits else float("nan")


# Present epochs are about 1e9 s: (larger than, seconds a unit).
_EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


def in_seconds(stamps: FloatArray) -> FloatArray:
    """Converts stamps to seconds; the size of an epoch shows milli-, micro- or nanoseconds."""
    sizes = np.abs(stamps[np.isfinite(stamps)])
    largest = float(sizes.max()) if len(sizes) else 0.0
    return stamps * next((unit_s for limit, unit_s in _EPOCHS if largest > limit), 1.0)


@dataclass(frozen=True, eq=False)
class Keys:
    """The key of n rows or files, which matches them with those of another source."""

    count: int
    # By the kind of key, among `HOW`, and the column, which names of files have none of.
    found: Mapping[str, Mapping[str, Sequence[object]]]

    @classmethod
    def of(
        cls, count: int, names: Mapping[str, tuple[str, ...]], **known: Sequence[object]
    ) -> Self:
        """From (n,) names by column, and known (n,) `numbers` or `times`."""
        plain = {column: [*map(plain_name, cells)] for column, cells in names.items()}
        if "" in plain:
            # Words that all files of a kind have are no part of a view's name.
            start, end = (_shared(plain[""], step) for step in (1, -1))
            plain["*"] = [name[start : max(len(name) - end, start)] for name in plain[""]]
        found: list[dict[str, Sequence[object]]] = [
            # Names of digits alone are numbers.
            {k: cells for k, cells in plain.items() if not "".join(cells).isdecimal()},
            {column: [*map(number_in, cells)] for column, cells in plain.items()},
            {column: [*map(time_in, cells)] for column, cells in plain.items()},
        ]
        found[1] |= {"": known["numbers"]} if known.get("numbers") else {}
        found[2] |= {"": known["times"]} if "times" in known else {}
        sure = ({k: cells for k, cells in each.items() if _are_keys(cells)} for each in found)
        return cls(count, dict(zip(HOW, sure, strict=False)))


def _shared(names: Sequence[str], step: int) -> int:
    """The number of letters with which all names begin, or end where `step` is -1."""
    letters = zip(*(name[::step] for name in names), strict=False)
    return sum(1 for _ in takewhile(lambda each: len({*each}) == 1, letters))


def _are_keys(cells: Sequence[object]) -> bool:
    """Whether the filled cells are most of them, and no two are the same."""
    filled = [cell for cell in cells if cell not in ("", None) and cell == cell]
    return len({*filled}) == len(filled) and 2 * len(filled) >= len(cells) > 0


@dataclass(frozen=True, eq=False)
class Match:
    """How rows of one source belong to those of another."""

    how: str  # A name among `HOW`.
    rows: IntArray  # (n,) the other's row of each; -1 for none.
    is_sure: bool = True  # Whether the keys are no small numbers in columns of different names.


HOW = ("equal names", "their numbers", "their times", "their order")


def matched(first: Keys, second: Keys) -> Match | None:
    """Matches rows by equal names, else numbers, else times, else by their order; None if none."""
    fewest = min(first.count, second.count)
    for how in HOW[:3]:
        best: tuple[tuple[int, bool, bool], IntArray, bool] = (
            (1, False, False),
            np.zeros(0, int),
            False,
        )
        for (a, keys), (b, other_keys) in product(
            first.found[how].items(), second.found[how].items()
        ):
            is_time = how == HOW[2]
            rows, is_equal = (
                (_nearest(keys, other_keys), True) if is_time else _equal(keys, other_keys)
            )
            common, is_same = int((rows >= 0).sum()), a == b
            # Columns of different names have some numbers in common by chance.
            is_sure = is_same or how != HOW[1] or any(len(str(key)) > 4 for key in other_keys)
            fits = common == fewest or (2 * common > fewest and is_sure)
            if fits and (common, is_equal, is_same) > best[0]:
                best = (common, is_equal, is_same), rows, is_sure
        if len(best[1]):
            return Match(how, *best[1:])
    return Match(HOW[3], np.arange(first.count)) if first.count == second.count else None


def _equal(keys: Sequence[object], other_keys: Sequence[object]) -> tuple[IntArray, bool]:
    """(n,) the other's row of each key, -1 for none, and whether the keys are equal.

    Numbers of two counts of the same rows, one begun later, are the same.
    """
    place = {key: at for at, key in enumerate(other_keys) if key not in ("", None)}
    whole = [key for key in keys if isinstance(key, int)]
    others = [key for key in place if isinstance(key, int)]
    by = 0
    if len(whole) == len(others) == len(keys) == len(other_keys):
        steps = {b - a for a, b in zip(sorted(whole), sorted(others), strict=True)}
        by = steps.pop() if len(steps) == 1 else 0
    if by:
        return np.array([place[key + by] for key in whole]), False
    return np.array([place.get(key, -1) for key in keys]), True


def _nearest(first_s: Sequence[object], second_s: Sequence[object]) -> IntArray:
    """(n,) the other's row of the nearest time, but for a constant offset; -1 for none."""
    row_s, other_s = np.array(first_s, dtype=float), np.array(second_s, dtype=float)
    best = np.full(len(row_s), -1)
    if len(row_s) > len(other_s):
        back = _nearest(second_s, first_s)
        best[back[back >= 0]] = np.flatnonzero(back >= 0)
        return best
    finite_s, order = row_s[np.isfinite(row_s)], np.argsort(other_s)
    ends = other_s[order][np.isfinite(other_s[order])]
    if len(finite_s) < 3 or len(ends) < 3:
        return best
    # A fifth of the usual step is no other row's.
    within, most = 0.2 * float(np.median(np.diff(np.sort(finite_s)))), 0
    offsets = np.concatenate([[0.0], (ends[:200, None] - finite_s[:2]).ravel()])
    for offset in offsets[np.argsort(np.abs(offsets), kind="stable")]:
        after = np.searchsorted(ends, row_s + offset).clip(1, len(ends) - 1)
        at = after - (row_s + offset - ends[after - 1] <= ends[after] - row_s - offset)
        near = np.abs(ends[at] - row_s - offset) <= within
        if (count := len({*at[near]})) > most and count == near.sum():
            best, most = np.where(near, order[at], -1), count
    return best
