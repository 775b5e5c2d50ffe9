"""How much of a file is read, and how deep it may go."""

import re
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import decode_text, read_bytes, save_as_utf8

# Each value costs about a hundred bytes in memory once it is read.
MAX_VALUES = 1_000_000
# Matrices in lists in tables need six.
MAX_DEPTH = 40

_COMMENT_LINE = re.compile(rb"^[ \t]*(?:#|%|//).*$", re.MULTILINE)


def read_plain_text(path: Path) -> str:
    """Reads a bounded UTF-8 text file, with or without a byte-order mark.

    Lines that begin as comments may be in any encoding that leaves ASCII as it is.

    Raises:
        DataError: As `read_bytes`, or the bytes are not UTF-8 or hold NUL, as binary files do.
    """
    data = read_bytes(path)
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise DataError(
            f"{path}, line {line}: a NUL byte; it is no text file in UTF-8.",
            culprits=[str(path)],
            next_step=save_as_utf8("UTF-16"),
        )
    readable = _COMMENT_LINE.sub(lambda it: it[0].decode("utf-8", "replace").encode(), data)
    return decode_text(readable, str(path))


def too_many(where: str) -> DataError:
    """Builds the error for a document with more values than are read."""
    return DataError(
        f"{where}: more than {MAX_VALUES:,} values; documents of poses up to that size are read.",
        culprits=[where],
        next_step="Cut the recording into parts.",
    )


def too_deep(where: str) -> DataError:
    """Builds the error for a document that is nested deeper than any pose is."""
    return DataError(
        f"{where}: nested deeper than {MAX_DEPTH} levels, as no file of poses is.",
        culprits=[where],
    )
