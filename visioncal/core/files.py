"""Reading and writing of files: whole or not at all, of bounded size."""

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from stat import S_ISREG
from typing import Any, BinaryIO

from visioncal.core.errors import DataError
from visioncal.core.temporary import temporary

ABSENT = "does not exist"


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


def check_own(path: Path) -> None:
    """Checks that what a result is to replace names its author: visioncal; raises DataError.

    An empty file loses nothing. Pages, recordings and documents have the name in their beginning.
    """
    if absence(path):
        return
    with opened(path) as file:
        beginning = file.read(1_000_000)
    if beginning and b"visioncal" not in beginning:
        raise DataError(
            f"{path} exists and was not written by visioncal, and nothing of others is "
            "overwritten.",
            culprits=[str(path)],
            next_step="Choose another place with -o, or move that file away.",
        )


# Greatest sizes of files [bytes]; larger ones are of another kind, or broken. Thousands of views
# take a few megabytes as a table or JSON; TOML descriptions are written by hand.
MOST_BYTES, MOST_TOML_BYTES = 50_000_000, 2_000_000
# The largest sensors have 150 million pixels of 16 bits, uncompressed.
MOST_IMAGE_BYTES = 300_000_000
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """An open regular file; raises DataError where there is none, or it cannot be read."""
    if why_not := absence(path):
        raise DataError(
            f"{path} {why_not}.", culprits=[str(path)], next_step="Check the path and its spelling."
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
        return "is not a regular file" if path.exists() else ABSENT
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
    # No text begins with one; two-byte letters do, where nothing marks them.
    if b"\0" in data[:4] and data[:2] not in UTF16_MARKS:
        raise DataError(
            f"{label} has a zero byte in its first letters: it is UTF-16 without a mark, and must "
            "be UTF-8.",
            culprits=[label],
            next_step=save_as_utf8(f"UTF-16{'BE' if data[:1] == bytes(1) else 'LE'}"),
        )
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


def one_line(text: str) -> str:
    """Replaces unprintable characters, such as line ends, by spaces."""
    return "".join(character if character.isprintable() else " " for character in text)


def natural(path: Path) -> tuple[object, ...]:
    """Key of the natural order of file names: `view2` before `view10`."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple(
        (int(part), "") if part.isascii() and part.isdecimal() else (-1, part) for part in parts
    )


def check_journal(database: Path) -> None:
    """Refuses a journal of SQLite that names a file: that of several databases, to be deleted.

    SQLite follows links to a database, and looks for its journal there. Raises DataError.
    """
    journal = Path(f"{database.resolve()}-journal")
    try:
        is_regular, end = S_ISREG(journal.stat().st_mode), b""
        if is_regular:
            with journal.open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - 8))
                end = file.read()
    except (FileNotFoundError, NotADirectoryError):
        # There is none, or another process has ended its transaction meanwhile.
        return
    except OSError as error:
        why = f"{journal} cannot be read: {error.strerror or error}."
        raise DataError(why, culprits=[str(journal)]) from error
    if end == bytes.fromhex("d9d505f920a163d7") or not is_regular:
        why = f"{journal} is not of visioncal: it names a file, which SQLite would delete."
        raise DataError(why, culprits=[str(journal)], next_step="Remove it, and what it came with.")
