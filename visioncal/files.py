"""Reading and writing of files, and of the small TOML tables that describe boards and robots."""

import difflib
import hashlib
import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visioncal.asides import aside_file
from visioncal.errors import DataError


def sha256(data: bytes) -> str:
    """Computes the SHA-256 digest of `data`, in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def write_atomically(path: Path | str, data: bytes | str) -> None:
    """Writes a file so that a reader sees the old content or the new one, never a part.

    The data goes to a file of another name in the same folder, is flushed to the disk, and takes
    the place of `path` in one step. Killed before that, it leaves the other file behind, which the
    next write in that folder removes.

    Args:
        path: The file to write; its folder must exist.
        data: Its content; text is written as UTF-8 with its line ends as they are.

    Raises:
        DataError: The folder is missing or cannot be written.
    """
    with written_beside(Path(path)) as aside, aside.open("wb") as file:
        file.write(data.encode("utf-8") if isinstance(data, str) else data)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def written_beside(path: Path) -> Iterator[Path]:
    """Gives an empty file in the same folder to write to, which takes the place of `path`.

    Where something goes wrong it is removed, and `path` stays as it was.

    Raises:
        DataError: What is done within cannot be written; it names `path`.
    """
    with named_errors(path), aside_file(path.parent) as aside:
        yield aside
        aside.replace(path)


def flush_folder(folder: Path) -> None:
    """Waits until the names in a folder are on the disk; Windows has no way to ask for it."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Turns an error of the operating system into one that names the file.

    Raises:
        DataError: In its place.
    """
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{path} cannot be written: {error.strerror or error}.",
            culprits=[str(path)],
            next_step="Choose a folder that exists, can be written, and has room.",
        ) from error


def check_free(path: Path, *, force: bool, replaceable: bool = True) -> None:
    """Checks that nothing is overwritten without a word of the user.

    Args:
        path: What is to be written.
        force: Whether the user allows that a file is replaced; a folder never is.
        replaceable: Whether it could be allowed.

    Raises:
        DataError: `path` is there.
    """
    with named_errors(path):
        # A link that leads nowhere is there, too.
        there = path.exists() or path.is_symlink()
        replaceable = replaceable and (path.is_file() or path.is_symlink())
    if not there or (force and replaceable):
        return
    raise DataError(
        f"{path} exists, and nothing is overwritten.",
        culprits=[str(path)],
        next_step="Choose another name, or replace the file with --force."
        if replaceable
        else "Choose another name.",
    )


def read_bytes(path: Path | str) -> bytes:
    """Reads a file.

    Raises:
        DataError: It is missing or cannot be read.
    """
    path = Path(path)
    try:
        return path.read_bytes()
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        what = "does not exist" if missing else f"cannot be read: {error.strerror or error}"
        raise DataError(
            f"{path} {what}.",
            culprits=[str(path)],
            next_step="Check the path and its spelling." if missing else "",
        ) from error


def read_text(path: Path | str) -> str:
    """Reads a UTF-8 text file, with or without a byte-order mark; line ends stay as they are.

    Raises:
        DataError: It is missing, cannot be read, or is not UTF-8.
    """
    return decode_text(read_bytes(path), str(path))


def decode_text(data: bytes, label: str) -> str:
    """Decodes UTF-8 with or without a byte-order mark; `label` names its origin in errors.

    Raises:
        DataError: The bytes are not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(
            f"{label}, line {line}: byte 0x{data[error.start]:02x} is not UTF-8 text.",
            culprits=[f"{label}, line {line}"],
            next_step=save_as_utf8("LATIN1"),
        ) from error


def save_as_utf8(encoding: str) -> str:
    """Words how a text file in another encoding is saved as UTF-8."""
    return (
        "Save the file as UTF-8: in Excel as the type `CSV UTF-8`, in an editor with that encoding "
        f"under `Save as`, or with `iconv -f {encoding} -t UTF-8 OLD > NEW`."
    )


def parse_toml(text: str, label: str) -> dict[str, Any]:
    """Parses TOML; `label` names its origin in errors.

    Raises:
        DataError: The text is not TOML; the message gives line and column.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DataError(
            f"{label} is not valid TOML: {error}.",
            culprits=[label],
            next_step='Text is written in "double quotes", lists in [brackets, like, this].',
        ) from error


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Words a hint at the known names nearest to `word`; empty where none is near."""
    names = {it.lower(): it for it in sorted(known)}
    near = difflib.get_close_matches(word.lower(), names, n=3, cutoff=0.6)
    return f"Did you mean {' or '.join(names[it] for it in near)}?" if near else ""


def one_line(text: str) -> str:
    """Replaces by spaces what does not print, such as line ends."""
    return "".join(it if it.isprintable() else " " for it in text)


def natural(path: Path) -> tuple[object, ...]:
    """Orders names as people do: `view2` before `view10`."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple((int(it), "") if it.isascii() and it.isdecimal() else (-1, it) for it in parts)


def some_of(names: Sequence[str], most: int = 8) -> str:
    """Words a list, cut short: `a, b and 3 more`."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def find_described(
    name_or_path: str,
    *,
    what: str,
    shipped: Mapping[str, Path],
    suffixes: tuple[str, ...],
    folder: Path | None,
) -> Path:
    """Finds the file that describes a board or a robot.

    Args:
        name_or_path: A shipped name, or a path that ends in one of `suffixes`.
        what: What is looked for, for messages: `target`, `robot`.
        shipped: The files that come with visioncal, by name.
        suffixes: The endings by which a path is told from a name.
        folder: Relative paths start here; the working directory where None.

    Raises:
        DataError: The name is unknown or the file does not exist.
    """
    if name_or_path.lower().endswith(suffixes):
        path = Path(name_or_path.replace("\\", "/"))
        path = path if folder is None else folder / path
        if path.is_file():
            return path
        raise DataError(
            f"The {what} file {path} does not exist.",
            culprits=[str(path)],
            next_step="Check the path and its spelling."
            if folder is None
            else "Its path is relative to the file that names it.",
        )
    if name_or_path in shipped:
        return shipped[name_or_path]
    hint = did_you_mean(name_or_path, shipped)
    raise DataError(
        f"There is no {what} named {name_or_path!r}; the names are {', '.join(sorted(shipped))}.",
        culprits=[name_or_path],
        next_step=f"{hint} A file of your own is named by its path, "
        f"ending in {' or '.join(suffixes)}.".strip(),
    )


@dataclass(frozen=True)
class Table:
    """Typed access to one table of a TOML or JSON document.

    Every method raises DataError, naming the field, where the value is absent without a default,
    of another type, or out of range.

    Attributes:
        content: The table as it was read.
        label: Where it stands, for messages.
    """

    content: Mapping[str, Any]
    label: str

    def _value(self, key: str, default: object, needed: str) -> object:
        value = self.content.get(key, default)
        if value is None:
            raise DataError(
                f"{self.label}: {key} is missing; {needed} is needed.",
                culprits=[f"{self.label}: {key}"],
            )
        return value

    def refuse(self, key: str, value: object, needed: str) -> DataError:
        """Builds the error for a field whose value does not serve."""
        return DataError(
            f"{self.label}: {key} is {value!r}; {needed} is needed.",
            culprits=[f"{self.label}: {key}"],
        )

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """Reads a finite number, above zero where `positive`."""
        needed = "a number above 0" if positive else "a number"
        value = self._value(key, default, needed)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(key, value, needed)
        if not math.isfinite(value) or (positive and value <= 0):
            raise self.refuse(key, value, needed)
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int:
        """Reads a whole number from `low` to `high`."""
        needed = f"a whole number from {low} to {high}"
        value = self._value(key, None, needed)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.refuse(key, value, needed)
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """Reads a text."""
        value = self._value(key, default, "a text")
        if not isinstance(value, str):
            raise self.refuse(key, value, "a text")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """Reads true or false."""
        value = self._value(key, default, "true or false")
        if not isinstance(value, bool):
            raise self.refuse(key, value, "true or false")
        return value

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        """Reads one of a few words."""
        needed = " or ".join(f'"{choice}"' for choice in choices)
        value = self._value(key, default, needed)
        if value not in choices:
            raise self.refuse(key, value, needed)
        return str(value)
