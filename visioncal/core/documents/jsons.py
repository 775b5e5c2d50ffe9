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

from visioncal.core.documents.values import (
    MAX_VALUES,
    check_bounds,
    read_plain_text,
    shown,
    too_deep,
    too_many,
)
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_BYTES, decode_text, read_bytes

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
# Names of fields that hold numbers: quantities carry their unit.
_UNITS = r"mm|m|deg|rad|mrad|px|s|c|nm|kg|a|n|k|m_s2|rad_s2|kg_m2|sigma"
_NUMBERS = re.compile(
    rf".+_({_UNITS})|.+_per_.+|mm|deg|px|sigma|matrix|quaternion_xyzw|covariance|edge_covariance"
    "|view|corners|resolution|distortion|spectrum|inflation|likelihood_ratio|condition|unknowns"
    "|median|most|p95|value|nominal|change|misfit|correlation|placement|o[1-5]|bow_[xy]+|aspect|shear"
)
# Tables with keys chosen by users.
_NAMED = ("frames", "robots", "tree")
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


def parse_json(text: str, where: str) -> object:
    """Parses JSON as `read_json` does; `where` names its origin in errors."""
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
    check_bounds(value, where)
    return value


def _unique(pairs: Sequence[tuple[str, Any]], where: str) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise DataError(
            f"{where}: the key {twice[:60]!r} is there twice; once is needed.", culprits=[where]
        )
    return content


class StoredTable(dict[str, Any]):
    """A table of a document whose missing fields raise errors with their paths."""

    def __init__(self, content: dict[str, Any], path: str) -> None:
        super().__init__(content)
        self.path = path

    def __missing__(self, key: str) -> object:
        """Raises the error for a missing field."""
        raise DataError(f"{self.path}{key} is missing.", culprits=[f"{self.path}{key}"])


def parse_stored(text: bytes | str, label: str) -> StoredTable:
    """Parses a document that visioncal wrote.

    Returns:
        Its content, which raises DataError on access to a missing field.

    Raises:
        DataError: It is no JSON, no table, too large or too deep, or a field does not hold the
            number that its name, such as `rms_mm`, announces; the message has its path.
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
    table = _checked(parse_json(text, label), f"{label}: ", "")
    if not isinstance(table, StoredTable):
        raise DataError(f"{label} is {shown(table)}; a table is needed.", culprits=[label])
    return table


def _checked(value: Any, path: str, key: str) -> Any:  # noqa: ANN401 - what JSON may hold
    needed = _needed(value, key)
    if needed:
        place = path.rstrip(".")
        raise DataError(f"{place} is {shown(value)}; {needed} is needed.", culprits=[place])
    if isinstance(value, dict):
        return StoredTable(
            {
                name: _checked(item, f"{path}{name}.", "" if key in _NAMED else name)
                for name, item in value.items()
            },
            path,
        )
    if isinstance(value, list):
        stem = path.rstrip(".")
        return [_checked(item, f"{stem}[{index}].", key) for index, item in enumerate(value)]
    return value


def _needed(value: object, key: str) -> str:
    """The needed content of a field, by its name, that it lacks; empty where it is right."""
    if _NUMBERS.fullmatch(key) and isinstance(value, str | bool):
        return "a number"
    if isinstance(value, float) and not abs(value) <= _LARGEST:
        return "a number that a cell has"
    return ""
