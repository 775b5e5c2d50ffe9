"""JSON with checks of repeated keys, depth and size, and NumPy's .npy and .npz, without pickles."""

import io
import json
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from visioncal.core.codec import shown, wrong_value
from visioncal.core.documents.toml import MAX_VALUES, check_values, too_deep, too_many
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_BYTES, decode_text, read_bytes

Array: TypeAlias = npt.NDArray[Any]


_OPAQUE = "its values are a table or other objects of MATLAB"


def _parts(name: str, array: Array) -> Iterator[tuple[str, Array]]:
    """An array; those of a structure by its fields, and those of cells that are alike as one."""
    from scipy.io.matlab import MatlabOpaque

    cells = [*array.flat] if array.dtype.kind == "O" else []
    objects = [cell for cell in cells if isinstance(cell, MatlabOpaque)]
    if objects or isinstance(array, MatlabOpaque):
        yield name, objects[0] if objects else array
    elif array.dtype.names:
        for key in array.dtype.names:
            yield from _parts(f"{name}.{key}", array[key])
    elif len({*map(np.shape, cells)}) == 1 and all(isinstance(c, np.ndarray) for c in cells):
        yield from _parts(name, cells[0] if len(cells) == 1 else np.stack(cells))
    else:
        yield name, array


def _of_matlab(data: io.BytesIO) -> dict[str, Array]:
    """The arrays of a .mat by name; raises TypeError where objects are all that it holds."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    loaded = {name: each for name, each in loadmat(data).items() if name[:2] != "__"}
    found = dict(part for name, each in loaded.items() for part in _parts(name, each))
    # Other kinds hold no numbers.
    arrays = {name: each for name, each in found.items() if each.dtype.kind in "fiubU"}
    if not arrays and any(isinstance(each, MatlabOpaque) for each in found.values()):
        raise TypeError(_OPAQUE)
    return arrays


def pictures_in(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of an .npz that are pictures, by name, without reading these.

    They are (h, w) or (h, w, 3) of one, or (n, h, w) or (n, h, w, 3) of several, in bytes.
    """
    found = dict[str, tuple[int, ...]]()
    with suppress(Exception), zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                version = np.lib.format.read_magic(member)
                header = np.lib.format.read_array_header_1_0
                header = header if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, kind = header(member)
                sides = shape[:-1] if shape[-1:] == (3,) else shape
                # Sides of a picture [px].
                if kind == np.uint8 and len(sides) in (2, 3) and min(sides[-2:]) >= 64:
                    found[name.removesuffix(".npy")] = shape
    return found


def read_arrays(path: Path) -> Mapping[str, Array]:
    """Reads the arrays of an .npz or a .mat by their names, or the one of an .npy as `matrix`.

    Raises:
        DataError: It is missing, no such file, damaged, holds Python objects, or unpacks to more
            than 50 MB.
    """
    where, data = str(path), io.BytesIO(read_bytes(path))
    try:
        unpacked = 0
        if zipfile.is_zipfile(data):
            with zipfile.ZipFile(data) as archive:
                # No member yields more than its stated size.
                unpacked = sum(member.file_size for member in archive.infolist())
        data.seek(0)
        if unpacked <= MOST_BYTES:
            # Memory is allocated lazily, so that a size beyond the data costs nothing.
            if path.suffix.lower() == ".mat":
                return _of_matlab(data)
            loaded = np.load(data, allow_pickle=False)
            arrays = (
                dict(loaded) if isinstance(loaded, np.lib.npyio.NpzFile) else {"matrix": loaded}
            )
    # Damaged archives and headers raise a dozen kinds of errors.
    except Exception as error:
        raise DataError(
            f"{where} holds no arrays of numbers: {str(error)[:120]}.",
            culprits=[where],
            next_step="In MATLAB, writetable(T, 'poses.csv') writes a table, and T.A the matrix of "
            "a rigidtform3d."
            if str(error) == _OPAQUE
            else "numpy.save and numpy.savez write them; Python objects are not read.",
        ) from error
    if unpacked > MOST_BYTES:
        raise DataError(
            f"{where} unpacks to more than {MOST_BYTES / 1e6:.0f} MB.",
            culprits=[where],
            next_step="Keep the poses in a file of their own.",
        )
    if sum(np.size(array) for array in arrays.values()) > MAX_VALUES:
        raise too_many(where)
    kinds = {name: getattr(array, "dtype", np.dtype("V")).kind for name, array in arrays.items()}
    wrong = [name for name, kind in kinds.items() if kind not in "fiubUS"]
    if wrong:
        raise DataError(f"{where}: {wrong[0][:60]} holds no numbers or text.", culprits=[where])
    return arrays


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
        # Longer integers are read as floats: Python parses them in quadratic time.
        value: object = json.loads(
            text,
            object_pairs_hook=lambda pairs: _unique(pairs, where),
            parse_int=lambda digits: int(digits) if len(digits) <= 18 else float(digits),
        )
    except json.JSONDecodeError as error:
        raise DataError(
            f"{where}, line {error.lineno}, column {error.colno} is not JSON: {error.msg}.",
            culprits=[where],
        ) from error
    except RecursionError as error:
        raise too_deep(where) from error
    check_values(value, where, largest)
    try:
        # Half of a pair of UTF-16, which JSON can name, can be written nowhere.
        if "\\ud" in text or "\\uD" in text:
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        half = ascii(error.object[error.start])
        raise DataError(
            f"{where} must be text, but holds {half} alone, half of a letter.", culprits=[where]
        ) from error
    return value


def _unique(pairs: Sequence[tuple[str, Any]], where: str) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise DataError(
            f"{where}: the key {twice[:60]!r} occurs twice, but must occur once.", culprits=[where]
        )
    return content


def parse_stored(text: bytes | str, label: str) -> dict[str, Any]:
    """Parses a document that visioncal wrote; the codec checks the types of its fields.

    Raises:
        DataError: It is no JSON, no table, too large or too deep, or a number in it is not finite
            or too large for squares; the message has its path.
    """
    text = decode_text(text, label) if isinstance(text, bytes) else text
    if Path(label).suffix != ".json" and not (begin := text.lstrip()[:40]).startswith("{"):
        raise DataError(
            f"{label} begins with {shown(begin)}, but must be a JSON document that visioncal "
            "wrote.",
            culprits=[label],
            next_step="Name its file, as calibration.json, or its folder; nothing need be changed "
            "in this one.",
        )
    # Squares and products of larger numbers may overflow.
    document = parse_json(text, label, 1e60)
    if not isinstance(document, dict):
        raise wrong_value(document, "a table", label)
    return document


def check_schema(document: Mapping[str, Any], known: int, next_step: str) -> None:
    """Checks that a stored document is of the schema that this version reads; raises DataError.

    `next_step` is the remedy for an older one.
    """
    schema = document.get("schema")
    if schema != known:
        is_newer = isinstance(schema, int) and schema > known
        raise DataError(
            f"schema is {'missing' if schema is None else shown(schema)}, this version reads "
            f"{known}.",
            culprits=["schema"],
            next_step="A newer visioncal reads it." if is_newer else next_step,
        )
