"""TOML, and small tables of it on boards and robots; bounds of all documents."""

import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal

from visioncal.core.codec import Finite, Positive, read_value, within, wrong_value
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_TOML_BYTES, absence, one_line, read_text
from visioncal.core.number_format import did_you_mean

# Each value costs about a hundred bytes in memory once it is read.
MAX_VALUES = 1_000_000
# Matrices in lists in tables need six.
MAX_DEPTH = 40
# Mistakes in TOML's text and numbers, and their corrections.
_TOML_MISTAKES = (
    (r"\\", "/"),
    (r"(?<=\d),(?=\d)", "."),
    ("[\u201c-\u201f]", '"'),
    # Numbers as NumPy prints them.
    (r"\bnp\.\w+\(([^()]*)\)", r"\1"),
    (r"\bTrue\b", "true"),
    (r"\bFalse\b", "false"),
    (r"=\s*([^\W\d][^\"'#=]*?)\s*$", r'= "\1"'),
)
_DEEP_KEY = re.compile(
    r"""(?<![\w-])(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
    rf"""(?:[ \t]*+\.[ \t]*+(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')){{{MAX_DEPTH + 1}}}"""
)


def read_toml(path: Path, label: str) -> dict[str, Any]:
    """Reads a TOML file; `label` names it in DataErrors of `read_text` and `parse_toml`."""
    return parse_toml(read_text(path, MOST_TOML_BYTES), label)


def parse_toml(text: str, label: str) -> dict[str, Any]:
    """Parses TOML; `label` names its origin in errors; raises DataError."""
    # The parser takes the square of their number for the parts of a dotted key.
    if _DEEP_KEY.search(text):
        raise too_deep(label)
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DataError(
            f"{label} is not valid TOML: {error}.",
            culprits=[label],
            next_step=f'{_mended_line(text, str(error))}Text is written in "double quotes", paths '
            "with /, numbers with a point, lists in [brackets, like, this]; a table or key "
            "occurs once.",
        ) from error
    except RecursionError as error:
        raise too_deep(label) from error
    except ValueError as error:
        # Integers of thousands of digits, and impossible dates.
        raise DataError(f"{label} is not valid TOML: {error}.", culprits=[label]) from error
    check_values(document, label)
    return document


def _mended_line(text: str, error: str) -> str:
    """A faulty line of a TOML file and its correction, as a sentence; empty where unknown."""
    found = re.search(r"\(at line (\d+)", error)
    if found and "Cannot overwrite" in error:
        return f"The key of line {found[1]} is there already: delete one of the two. "
    if found and "Illegal character '\\n'" in error:
        return f'The text of line {found[1]} has no end: put " behind it. '
    line = text.split("\n")[int(found[1]) - 1].strip() if found else ""
    for pattern, right in _TOML_MISTAKES:
        mended = re.sub(pattern, right, line)
        with suppress(tomllib.TOMLDecodeError):
            if found and mended != line and tomllib.loads(mended):
                return f"Correct line {found[1]} to `{one_line(mended)}`. "
    return ""


def check_values(document: object, label: str, largest: float | None = None) -> None:
    """Checks number, depth and size of a document's values without recursion; raises DataError."""
    pending: list[tuple[str, object, int]] = [("", document, 1)]
    count = 0
    while pending:
        path, value, depth = pending.pop()
        count += 1
        if count > MAX_VALUES:
            raise too_many(label)
        if depth > MAX_DEPTH:
            raise too_deep(f"{label}: {path[:80]}")
        if isinstance(value, Mapping):
            pending += [
                (f"{path}.{key}".lstrip("."), item, depth + 1) for key, item in value.items()
            ]
        elif isinstance(value, list):
            pending += [(f"{path}[{index}]", item, depth + 1) for index, item in enumerate(value)]
        elif isinstance(value, int) and value.bit_length() > 63:
            raise DataError(
                f"{label}: {path} has more than the 64 bits of a whole number.",
                culprits=[f"{label}: {path}"],
            )
        elif largest is not None and isinstance(value, float) and not abs(value) <= largest:
            raise DataError(
                f"{label}: {path} is {value}, but must be at most {largest:g} in size.",
                culprits=[f"{label}: {path}"],
            )


def too_many(where: str, most: int = MAX_VALUES) -> DataError:
    """Builds the error for a document with too many values."""
    return DataError(
        f"{where}: more than {most:,} values; documents up to that size are read.",
        culprits=[where],
        next_step="Cut the recording into parts.",
    )


def too_deep(where: str) -> DataError:
    """Builds the error for a document that is nested too deep."""
    return DataError(f"{where}: nested deeper than {MAX_DEPTH} levels.", culprits=[where])


def find_described(
    name_or_path: str,
    *,
    what: str,
    shipped: Mapping[str, Path],
    suffixes: tuple[str, ...],
    folder: Path | None,
) -> Path:
    """Finds the file that describes a board or a robot (`what`, for messages); raises DataError.

    It is a built-in one of `shipped`, or a path that ends in one of `suffixes`, relative to the
    folder or, where None, to the working directory.
    """
    if name_or_path.lower().endswith(suffixes):
        path = Path(name_or_path.replace("\\", "/"))
        path = path if folder is None else folder / path
        if path.is_file():
            return path
        named = str(path) if name_or_path.isprintable() else repr(str(path))
        raise DataError(
            f"The {what} file {named} {absence(path)}.",
            culprits=[named],
            next_step="Check the path and its spelling."
            if folder is None
            else "Its path is relative to the file that names it."
            if named == str(path)
            else "Write the path with / in the file that names it: there, a backslash and a letter "
            "stand for another character.",
        )
    if name_or_path in shipped:
        return shipped[name_or_path]
    hint = did_you_mean(name_or_path, shipped)
    raise DataError(
        f"There is no {what} named {name_or_path!r}. {hint}".strip(),
        culprits=[name_or_path],
        next_step=f"The names are {', '.join(sorted(shipped))}. A file of your own is named by its "
        f"path, ending in {' or '.join(suffixes)}.",
    )


@dataclass(frozen=True)
class DocumentTable:
    """Typed access to one table of a TOML or JSON document.

    Every method raises DataError, naming the field, where the value is absent without a default,
    of another type, or out of range.
    """

    content: Mapping[str, Any]  # The parsed table.
    label: str  # Its location, for messages.

    def read(self, key: str, kind: Any, default: object = None) -> Any:  # noqa: ANN401 - of `kind`
        """Reads a field as the codec reads a value of the type; None has no default."""
        value = self.content.get(key, default)
        return read_value(kind, MISSING if value is None else value, f"{self.label}: {key}")

    def refuse(self, key: str, value: object, needed: str, next_step: str = "") -> DataError:
        """Builds the error for a field with an invalid value."""
        return wrong_value(value, needed, f"{self.label}: {key}", next_step)

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """Reads a finite number, greater than zero if `positive`."""
        return float(self.read(key, Positive if positive else Finite, default))

    def numbers(self, key: str, count: int) -> list[float]:
        """Reads a list of `count` finite numbers."""
        return [*self.read(key, GenericAlias(tuple, (Finite,) * count))]

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """Reads a whole number from `low` to `high`."""
        return int(self.read(key, Annotated[int, within(low, high)], default))

    def text(self, key: str, default: str | None = None) -> str:
        """Reads a string."""
        return str(self.read(key, str, default))

    def flag(self, key: str) -> bool:
        """Reads true or false, which is the default."""
        return bool(self.read(key, bool, False))

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        """Reads one of several strings."""
        return str(self.read(key, Literal[choices], default))
