"""Reading and writing of files, temporary ones, and small TOML tables on boards and robots."""

import errno
import hashlib
import json
import math
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean


def sha256(data: bytes) -> str:
    """Computes the SHA-256 digest of `data`, in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def write_atomically(path: Path | str, data: bytes | str) -> None:
    """Writes a file atomically: readers see the old content or the new one, never a part.

    Text is written as UTF-8 with unchanged line ends. If the process is killed, a temporary file
    stays in the folder until the next write there. Raises DataError.
    """
    with replacing_file(Path(path)) as aside, aside.open("wb") as file:
        file.write(data.encode("utf-8") if isinstance(data, str) else data)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path | str, document: Mapping[str, Any]) -> None:
    """Writes a document as JSON atomically; see `json_text` and `write_atomically`."""
    write_atomically(path, json_text(document))


def json_text(document: Mapping[str, Any]) -> str:
    """A document as indented JSON; NaN and infinite numbers are refused."""
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


@contextmanager
def replacing_file(path: Path) -> Iterator[Path]:
    """Yields a temporary file in the same folder, which replaces `path` at the end.

    After an exception it is removed, and `path` is unchanged; OSErrors become DataErrors.
    """
    with named_errors(path), temporary(path.parent, is_folder=False) as (aside, _):
        yield aside
        aside.replace(path)


def flush_folder(folder: Path) -> None:
    """Flushes a folder's entries to the disk; not possible on Windows."""
    if sys.platform == "win32":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Converts OSErrors on writing to DataErrors that name the file."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{path} cannot be written: {error.strerror or error}.",
            culprits=[str(path)],
            next_step="Name a file in it."
            if isinstance(error, IsADirectoryError)
            else "Choose a folder that exists, can be written, and has room.",
        ) from error


def check_free(path: Path, *, force: bool, replaceable: bool = True) -> None:
    """Checks that nothing is overwritten without permission.

    Args:
        path: The file or folder to be written.
        force: Whether the user allows to replace a file; folders are never replaced.
        replaceable: Whether that can be allowed.

    Raises:
        DataError: `path` exists.
    """
    with named_errors(path):
        # Broken links count as existing.
        exists = path.exists() or path.is_symlink()
        replaceable = replaceable and (path.is_file() or path.is_symlink())
    if not exists or (force and replaceable):
        return
    raise DataError(
        f"{path} exists, and nothing is overwritten.",
        culprits=[str(path)],
        next_step="Choose another name, or replace the file with --force."
        if replaceable
        else "Choose another name.",
    )


# Greatest sizes of files [bytes]; larger ones are of another kind, or broken. Thousands of views
# take a few megabytes as a table or JSON; TOML descriptions are written by hand.
MOST_BYTES, MOST_TOML_BYTES = 50_000_000, 2_000_000
# The largest sensors have 150 million pixels of 16 bits, uncompressed.
MOST_IMAGE_BYTES = 300_000_000
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Each value costs about a hundred bytes in memory once it is read.
MAX_VALUES = 1_000_000
# Matrices in lists in tables need six.
MAX_DEPTH = 40
# What people write of TOML's text and numbers, and what is meant.
_TOML_MISTAKES = (
    (r"\\", "/"),
    (r"(?<=\d),(?=\d)", "."),
    ("[\u201c-\u201f]", '"'),
    (r"\bTrue\b", "true"),
    (r"\bFalse\b", "false"),
    (r"=\s*([^\W\d][^\"'#=]*?)\s*$", r'= "\1"'),
)
_DEEP_KEY = re.compile(
    r"""(?<![\w-])(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
    rf"""(?:[ \t]*+\.[ \t]*+(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')){{{MAX_DEPTH + 1}}}"""
)


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """An open regular file; raises DataError where there is none, or it cannot be read."""
    if why_not := absence(path):
        raise DataError(
            f"{path} {why_not}.",
            culprits=[str(path)],
            next_step="Check the path and its spelling.",
        )
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror or error}.", culprits=[str(path)]
        ) from error


def read_bytes(path: Path | str, most: int = MOST_BYTES) -> bytes:
    """Reads a regular file; pipes and devices may not end.

    Args:
        path: The file.
        most: Greatest size [bytes].

    Raises:
        DataError: It is missing, no regular file, too large, or cannot be read.
    """
    with opened(Path(path)) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise DataError(
            f"{path} has more than {most / 1e6:.0f} MB; a file of its kind is read up to that "
            "size.",
            culprits=[str(path)],
            next_step="Check that it is the right file, or cut it into parts.",
        )
    return data


def absence(path: Path) -> str:
    """Why there is no regular file at a path, as a predicate; empty where there is one."""
    try:
        if path.is_file():
            return ""
        if path.is_dir():
            return "is a folder, and no file"
        return "is no regular file" if path.exists() else "does not exist"
    except (OSError, ValueError) as error:
        words = error.strerror if isinstance(error, OSError) and error.strerror else error
        return f"cannot be read: {words}"


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path, which need not exist, is in a folder after links are resolved."""
    try:
        # Raises where a part of it is too long, or links go in a circle.
        with suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # RuntimeError: links in a circle
        return False


def read_text_inside(folder: Path, name: str, most: int = MOST_BYTES) -> str:
    """Reads a text file of an untrusted folder; refuses links that lead out of it (DataError)."""
    if not is_inside(folder / name, folder):
        raise DataError(
            f"{folder / name} is a link that leads out of its folder, and is not followed.",
            culprits=[str(folder / name)],
            next_step="Copy the file into the folder.",
        )
    return read_text(folder / name, most)


def read_text(path: Path | str, most: int = MOST_BYTES) -> str:
    """Reads UTF-8 with or without a byte-order mark, line ends unchanged; raises DataError."""
    return decode_text(read_bytes(path, most), str(path))


def decode_text(data: bytes, label: str) -> str:
    """Decodes UTF-8 with or without byte-order marks; `label` names its origin in DataErrors."""
    try:
        # Programs that mark a text which is marked already leave two.
        return data.decode("utf-8").lstrip("\ufeff")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(
            f"{label}, line {line}: byte 0x{data[error.start]:02x} is not UTF-8 text.",
            culprits=[f"{label}, line {line}"],
            next_step=save_as_utf8("UTF-16" if data[:2] in UTF16_MARKS else "LATIN1"),
        ) from error


def save_as_utf8(encoding: str) -> str:
    """Instruction to save a text file of another encoding as UTF-8."""
    return (
        "Save the file as UTF-8: in Excel as the type `CSV UTF-8`, in an editor with that encoding "
        f"under `Save as`, or with `iconv -f {encoding} -t UTF-8 FILE > COPY`."
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
            "with /, numbers with a point, lists in [brackets, like, this]; tables and keys are "
            "there once.",
        ) from error
    except RecursionError as error:
        raise too_deep(label) from error
    except ValueError as error:
        # Integers of thousands of digits, and impossible dates.
        raise DataError(f"{label} is not valid TOML: {error}.", culprits=[label]) from error
    check_values(document, label)
    return document


def _mended_line(text: str, error: str) -> str:
    """Which line of a TOML file is to be written otherwise, as a sentence; empty where unknown."""
    found = re.search(r"\(at line (\d+)", error)
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
                f"{label}: {path} is {value}; a number that a cell has is needed.",
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


def one_line(text: str) -> str:
    """Replaces unprintable characters, such as line ends, by spaces."""
    return "".join(character if character.isprintable() else " " for character in text)


def natural(path: Path) -> tuple[object, ...]:
    """Key of the natural order of file names: `view2` before `view10`."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple(
        (int(part), "") if part.isascii() and part.isdecimal() else (-1, part) for part in parts
    )


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

    def _value(self, key: str, default: object, needed: str) -> object:
        value = self.content.get(key, default)
        if value is None:
            raise DataError(
                f"{self.label}: {key} is missing; {needed} is needed.",
                culprits=[f"{self.label}: {key}"],
            )
        return value

    def refuse(self, key: str, value: object, needed: str, next_step: str = "") -> DataError:
        """Builds the error for a field with an invalid value."""
        return DataError(
            f"{self.label}: {key} is {value!r}; {needed} is needed.",
            culprits=[f"{self.label}: {key}"],
            next_step=next_step,
        )

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """Reads a finite number, greater than zero if `positive`."""
        needed = "a number above 0" if positive else "a number"
        value = self._value(key, default, needed)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(key, value, needed)
        if not math.isfinite(value) or (positive and value <= 0):
            raise self.refuse(key, value, needed)
        return float(value)

    def numbers(self, key: str, count: int) -> list[float]:
        """Reads a list of `count` finite numbers."""
        needed = f"a list of {count} numbers"
        values = self._value(key, None, needed)
        if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
            raise self.refuse(key, values, needed)
        return [DocumentTable({key: value}, self.label).number(key) for value in values]

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """Reads a whole number from `low` to `high`."""
        needed = f"a whole number from {low} to {high}"
        value = self._value(key, default, needed)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.refuse(key, value, needed)
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """Reads a string."""
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
        """Reads one of several strings."""
        needed = " or ".join(f'"{choice}"' for choice in choices)
        value = self._value(key, default, needed)
        if value not in choices:
            raise self.refuse(key, value, needed, did_you_mean(str(value), choices))
        return str(value)


if sys.platform != "win32":
    import fcntl

# Lock file of a folder.
LOCK = "lock"
_NAME = re.compile(r"\.[0-9a-f]{32}\.tmp")


def free_name(folder: Path) -> Path:
    """An unused name in a folder; short, to leave room for long names within."""
    return folder / f".{uuid4().hex}.tmp"


@contextmanager
def temporary(folder: Path, *, is_folder: bool) -> Iterator[tuple[Path, bool]]:
    """Yields an empty file or folder `.HEX.tmp`, removed at the end if it still exists.

    A lock (flock) on it ends with its process: an unlocked one is abandoned, and the next writer in
    the same folder removes it. Without such locks (Windows, some network drives) they stay.

    Yields:
        Its path, and whether it is locked.
    """
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        if is_folder:
            path.mkdir()
        else:
            path.touch(exist_ok=False)
        with locked(path / LOCK if is_folder else path, wait=True) as held:
            # Another writer may have removed it as abandoned before it was locked.
            if held is not False:
                try:
                    yield path, bool(held)
                finally:
                    _remove(path, is_folder=is_folder)
                return


def _remove(path: Path, *, is_folder: bool) -> None:
    if is_folder:
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[bool | None]:
    """Locks a file, which is created if needed.

    Yields:
        Whether the lock is held: not if another process has it (and `wait` is false), or the file
        was moved or removed meanwhile. None where there are no locks.
    """
    if sys.platform == "win32":
        # An open file could neither be renamed nor removed.
        if exists := path.parent.is_dir():
            path.touch()
        yield None if exists else False
        return
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except FileNotFoundError:
        yield False
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            # A moved or removed file is another one.
            is_locked: bool | None = os.path.samestat(os.fstat(descriptor), path.lstat())
        except (BlockingIOError, FileNotFoundError):
            is_locked = False
        except OSError:
            is_locked = None
        yield is_locked
    finally:
        os.close(descriptor)


def check_journal(database: Path) -> None:
    """Refuses a journal of SQLite that names a file: that of several databases, to be deleted.

    SQLite follows links to a database, and looks for its journal there. Raises DataError.
    """
    journal = Path(f"{database.resolve()}-journal")
    end = read_bytes(journal)[-8:] if journal.is_file() else b""
    if end == bytes.fromhex("d9d505f920a163d7") or (journal.exists() and not journal.is_file()):
        why = f"{journal} is not of visioncal: it names a file, which SQLite would delete."
        raise DataError(why, culprits=[str(journal)], next_step="Remove it, and what it came with.")


def remove_abandoned(folder: Path) -> None:
    """Removes the temporary files of killed processes from a folder, as far as possible."""
    with suppress(OSError), os.scandir(folder) as entries:
        temporary = [entry for entry in entries if _NAME.fullmatch(entry.name)]
        for entry in temporary:
            path, is_folder = Path(entry.path), entry.is_dir(follow_symlinks=False)
            with suppress(OSError), locked(path / LOCK if is_folder else path, wait=False) as held:
                if held:
                    _remove(path, is_folder=is_folder)


# Atomic replacement of all files of an output folder, even if the process is killed.
#
# The new files are written into a temporary folder, which is then renamed to `.visioncal-switch`;
# an output folder has at most one of that name:
#
#     new/       the new files
#     old/       the files of the previous generation, as hard links
#     current    a symlink to old/, then to new/
#
# Each file is replaced by a symlink through `current`, first to its old version; one rename of
# `current` switches all of them; then each link is replaced by the file it points to. Files that
# exist in one generation only are broken links while the other is current. After a kill, the next
# writer replaces the links likewise, by the files of the current generation.
_SWITCH = ".visioncal-switch"
_OLD, _NEW, _CURRENT = "old", "new", "current"


def write_generation(
    folder: Path, names: Sequence[str], write: Callable[[Path], None]
) -> tuple[Path, ...]:
    """Replaces files of a folder, all at once or not at all, even if the process is killed.

    First cleans up after an earlier writer that was killed. Where the file system has no links or
    locks (Windows, FAT, some network drives), files are renamed one by one: a kill at that moment
    leaves a mixture of new and old files, and hidden folders stay.

    Args:
        folder: The output folder, created if needed. Other files in it are not changed.
        names: The files of a generation, the main one last.
        write: Writes them into the folder that it is given. Files that it does not write are
            removed.

    Returns:
        The written files, in reverse order.

    Raises:
        DataError: The folder cannot be written, or one of the names is a folder.
    """
    taken = [folder / name for name in names if (folder / name).is_dir()]
    if taken:
        raise DataError(
            f"{taken[0]} is a folder, where a file is to be written.",
            culprits=[str(taken[0])],
            next_step="Move it away, or name another folder with -o.",
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _recover(folder, wait=False)
        with temporary(folder, is_folder=True) as (aside, is_locked):
            new = aside / _NEW
            new.mkdir()
            try:
                write(new)
            except DataError as error:
                message, *culprits = (
                    name.replace(str(new), str(folder)) for name in (error.message, *error.culprits)
                )
                step = error.next_step
                raise DataError(message, culprits=culprits, next_step=step) from error.__cause__
            written = [name for name in names if (new / name).exists()]
            if is_locked:
                with _switch(folder, aside) as switch:
                    _replace_together(folder, switch, names)
            else:
                _replace_one_by_one(folder, new, names)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written: {error.strerror or error}.",
            culprits=[str(folder)],
            next_step="Make room on its disk, or choose another folder."
            if error.errno == errno.ENOSPC
            else "Choose another folder, or one that may be written.",
        ) from error
    return tuple(folder / name for name in reversed(written))


@contextmanager
def _switch(folder: Path, aside: Path) -> Iterator[Path]:
    """Renames a temporary folder to the switch of an output folder, and back at the end."""
    switch = folder / _SWITCH
    while True:
        try:
            aside.rename(switch)
            break
        except OSError as error:
            # Another writer's switch exists.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            _recover(folder, wait=True)
    try:
        yield switch
    finally:
        _resolve_links(folder)
        switch.rename(aside)


def _replace_together(folder: Path, switch: Path, names: Sequence[str]) -> None:
    links, following = switch / "links", switch / "following"
    try:
        links.mkdir()
        following.symlink_to(_NEW)
        (switch / _CURRENT).symlink_to(_OLD)
        (switch / _OLD).mkdir()
        for name in names:
            path, old = folder / name, switch / _OLD / name
            if path.is_symlink():
                # A relative link would be wrong in another folder.
                old.symlink_to(os.path.realpath(path))
            elif path.exists():
                os.link(path, old)
            (links / name).symlink_to(_through_switch(name))
        for path in (switch / _NEW, switch / _OLD, switch):
            flush_folder(path)
    except OSError:
        _replace_one_by_one(folder, switch / _NEW, names)
        return
    for name in names:
        (links / name).replace(folder / name)
    flush_folder(folder)
    following.replace(switch / _CURRENT)
    flush_folder(switch)


def _through_switch(name: str) -> str:
    return f"{_SWITCH}/{_CURRENT}/{name}"


def _replace_one_by_one(folder: Path, new: Path, names: Sequence[str]) -> None:
    for name in names:
        if (new / name).exists():
            (new / name).replace(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


def _resolve_links(folder: Path) -> None:
    """Replaces each link through the switch by the file that it points to, or removes it."""
    current = folder / _SWITCH / _CURRENT
    for path in folder.iterdir():
        if path.is_symlink() and path.readlink() == Path(_through_switch(path.name)):
            try:
                (current / path.name).replace(path)
            except FileNotFoundError:
                path.unlink()
    flush_folder(folder)


def _recover(folder: Path, *, wait: bool) -> None:
    """Completes the switch of a killed writer; waits for a live one, or leaves it alone."""
    switch = folder / _SWITCH
    with locked(switch / LOCK, wait=wait) as held:
        if held:
            _resolve_links(folder)
            aside = free_name(folder)
            switch.rename(aside)
            shutil.rmtree(aside, ignore_errors=True)
