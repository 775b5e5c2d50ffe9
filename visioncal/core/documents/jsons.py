"""JSON with checks of repeated keys, depth and size, and NumPy's .npy and .npz.

Arrays are read without pickles, and their headers are checked before memory is allocated.
"""

import io
import json
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from visioncal.core.documents.values import read_plain_text, shown
from visioncal.core.errors import DataError
from visioncal.core.files import (
    MAX_VALUES,
    MOST_BYTES,
    check_values,
    decode_text,
    read_bytes,
    too_deep,
    too_many,
)

Array: TypeAlias = npt.NDArray[Any]

_MAX_MEMBERS, _MOST_AXES = 1000, 8
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1  # a bit of a member's flags
_MAGIC = b"\x93NUMPY"
# Numbers and text of fixed width; an object array ("|O") is a pickle.
_DTYPE = re.compile(r"[<>|=](f[248]|[iu][1248]|b1|[US][1-9][0-9]{0,3})")
_HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<descr>[^']*)',\s*'fortran_order':\s*(?P<fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>[0-9, ]*)\),?\s*\}\s*"
)


def read_npy(path: Path) -> Array:
    """Reads an array of numbers or text; DataError if missing, invalid or too large."""
    return _parse_npy(read_bytes(path), str(path))


def read_npz(path: Path) -> Mapping[str, Array]:
    """Reads the arrays of an .npz by their names.

    Raises:
        DataError: It is missing, no .npz, damaged, holds Python objects, or unpacks to more than
            50 MB.
    """
    where, stored = str(path), io.BytesIO(read_bytes(path))
    try:
        with zipfile.ZipFile(stored) as archive:
            members = archive.infolist()
            if len(members) > _MAX_MEMBERS:
                raise DataError(
                    f"{where} holds {len(members)} arrays; up to {_MAX_MEMBERS} are read.",
                    culprits=[where],
                )
            unpacked, room = {}, MOST_BYTES
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name in unpacked:
                    raise DataError(
                        f"{where}: the array {name!r} is there twice.", culprits=[where]
                    )
                # As written by numpy.savez and savez_compressed.
                if member.compress_type not in _PACKINGS or member.flag_bits & _ENCRYPTED:
                    raise DataError(
                        f"{where}: {name[:60]} is encrypted or packed in another way than numpy's.",
                        culprits=[where],
                    )
                # The stated size may be wrong; the unpacked size counts.
                with archive.open(member) as file:
                    unpacked[name] = file.read(room + 1)
                room -= len(unpacked[name])
                if room < 0:
                    raise DataError(
                        f"{where} unpacks to more than {MOST_BYTES / 1e6:.0f} MB.",
                        culprits=[where],
                        next_step="Keep the poses in a file of their own.",
                    )
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError) as error:
        # ValueError: names that are no UTF-8, offsets before the beginning.
        raise DataError(
            f"{where} is no .npz: {str(error)[:120]}.",
            culprits=[where],
            next_step="numpy.savez writes one.",
        ) from error
    return {name: _parse_npy(data, f"{where}: {name}") for name, data in unpacked.items()}


def _parse_npy(data: bytes, where: str) -> Array:
    """Parses the format of numpy.save, versions 1 and 2 (NumPy, "NEP 1")."""
    width = {b"\x01\x00": 2, b"\x02\x00": 4}.get(data[6:8], 0)
    if not data.startswith(_MAGIC) or not width:
        raise DataError(f"{where} is no .npy array.", culprits=[where])
    start = 8 + width
    end = start + int.from_bytes(data[8:start], "little")
    # Real headers have about a hundred bytes.
    header = _HEADER.fullmatch(data[start : min(end, start + 2000)].decode("latin-1"))
    if header is None:
        raise DataError(f"{where} has no header of a plain array.", culprits=[where])
    if _DTYPE.fullmatch(header["descr"]) is None:
        raise DataError(
            f"{where} holds {header['descr']!r}; numbers or text are needed.",
            culprits=[where],
            next_step="Arrays of Python objects are not read: they run code when they are loaded.",
        )
    sizes = [part.strip() for part in header["shape"].split(",") if part.strip()]
    plain = len(sizes) <= _MOST_AXES and all(len(size) <= 12 and size.isdecimal() for size in sizes)
    shape = tuple(int(size) for size in sizes) if plain else ()
    # An axis of size 0 must not hide the others.
    if not plain or math.prod(max(index, 1) for index in shape) > MOST_BYTES:
        raise DataError(
            f"{where} has the shape ({header['shape'][:60]}); up to {_MOST_AXES} axes and "
            f"{MOST_BYTES:,} entries are read.",
            culprits=[where],
        )
    dtype = np.dtype(header["descr"])
    needed = math.prod(shape) * dtype.itemsize
    if needed != len(data) - end:
        raise DataError(
            f"{where} has {len(data) - end} bytes of content; the shape {shape} needs {needed}.",
            culprits=[where],
            next_step="The file is cut off or damaged; copy it again.",
        )
    flat = np.frombuffer(data, dtype, count=math.prod(shape), offset=end)
    return flat.reshape(shape, order="F" if header["fortran"] == "True" else "C")


# Longer integers are read as floats: Python parses them in quadratic time.
_MAX_DIGITS = 18
# Suffixes of files of other kinds, and number of characters of them in a message.
_OTHER_KINDS, _SHOWN = (".csv", ".toml", ".txt", ".png", ".urdf", ".xml", ".html", ".rrd"), 40
# Squares and products of larger numbers may overflow.
_LARGEST = 1e60


def read_json(path: Path) -> object:
    """Reads a JSON file; NaN and Infinity, as Python writes them, are accepted.

    Raises:
        DataError: It is missing, no JSON, holds a key twice, or is too large or too deep.
    """
    return parse_json(read_plain_text(path), str(path))


def parse_json(text: str, where: str, largest: float | None = None) -> object:
    """Parses JSON as `read_json` does; `where` names its origin, `largest` bounds its floats."""
    # An upper bound of the number of values: every value follows a comma or a bracket.
    if text.count(",") + text.count("[") + text.count("{") > MAX_VALUES:
        raise too_many(where)
    try:
        value: object = json.loads(
            text,
            object_pairs_hook=lambda pairs: _unique(pairs, where),
            parse_int=lambda digits: int(digits) if len(digits) <= _MAX_DIGITS else float(digits),
        )
    except json.JSONDecodeError as error:
        raise DataError(
            f"{where}, line {error.lineno}, column {error.colno} is no JSON: {error.msg}.",
            culprits=[where],
        ) from error
    except RecursionError as error:
        raise too_deep(where) from error
    check_values(value, where, largest)
    return value


def _unique(pairs: Sequence[tuple[str, Any]], where: str) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise DataError(
            f"{where}: the key {twice[:60]!r} is there twice; once is needed.", culprits=[where]
        )
    return content


def parse_stored(text: bytes | str, label: str) -> dict[str, Any]:
    """Parses a document that visioncal wrote; the codec checks the types of its fields.

    Raises:
        DataError: It is no JSON, no table, too large or too deep, or a number in it is not finite
            or too large for squares; the message has its path.
    """
    text = decode_text(text, label) if isinstance(text, bytes) else text
    begins = text.lstrip()[:_SHOWN].partition("\n")[0]
    if Path(label).suffix in _OTHER_KINDS and not begins.startswith("{"):
        raise DataError(
            f"{label} begins with {shown(begins)}; a JSON document that visioncal wrote is needed "
            "here.",
            culprits=[label],
            next_step="Name its file, as calibration.json, or its folder. This one is of another "
            "kind; nothing need be changed in it.",
        )
    document = parse_json(text, label, _LARGEST)
    if not isinstance(document, dict):
        raise DataError(f"{label} is {shown(document)}; a table is needed.", culprits=[label])
    return document
