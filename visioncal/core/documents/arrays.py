"""NumPy's .npy and .npz, without pickles; headers are checked before memory is allocated."""

import io
import math
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.files import MOST_BYTES, read_bytes

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
            unpacked = _unpacked(archive, where)
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError) as error:
        # ValueError: names that are no UTF-8, offsets before the beginning.
        raise DataError(
            f"{where} is no .npz: {str(error)[:120]}.",
            culprits=[where],
            next_step="numpy.savez writes one.",
        ) from error
    return {name: _parse_npy(data, f"{where}: {name}") for name, data in unpacked.items()}


def _unpacked(archive: zipfile.ZipFile, where: str) -> dict[str, bytes]:
    members = archive.infolist()
    if len(members) > _MAX_MEMBERS:
        raise DataError(
            f"{where} holds {len(members)} arrays; up to {_MAX_MEMBERS} are read.", culprits=[where]
        )
    arrays, room = {}, MOST_BYTES
    for member in members:
        name = member.filename.removesuffix(".npy")
        if name in arrays:
            raise DataError(f"{where}: the array {name!r} is there twice.", culprits=[where])
        # As written by numpy.savez and savez_compressed.
        if member.compress_type not in _PACKINGS or member.flag_bits & _ENCRYPTED:
            raise DataError(
                f"{where}: {name[:60]} is encrypted or packed in another way than numpy's.",
                culprits=[where],
            )
        # The stated size may be wrong; the unpacked size counts.
        with archive.open(member) as file:
            arrays[name] = file.read(room + 1)
        room -= len(arrays[name])
        if room < 0:
            raise DataError(
                f"{where} unpacks to more than {MOST_BYTES / 1e6:.0f} MB.",
                culprits=[where],
                next_step="Keep the poses in a file of their own.",
            )
    return arrays


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
