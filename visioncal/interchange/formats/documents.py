"""Documents that are no table: JSON, YAML, XML, arrays, HALCON's, keys and values, programs."""

import ast
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents.jsons import Array, read_arrays, read_json
from visioncal.core.documents.structured import (
    parse_yaml,
    read_opencv,
    read_xml,
    read_yaml,
    rows_of_xml,
)
from visioncal.core.documents.tables import is_number
from visioncal.core.documents.toml import check_values, parse_toml
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import (
    MOST_NUMBERS,
    POSE_SIZES,
    appearance,
    separate,
)
from visioncal.interchange.formats.lines import (
    COMMENTS,
)
from visioncal.session.columns import pose_row

KEYED = (".ini", ".cfg", ".conf", ".properties", ".meta")
# Words of JSON, and the same of Python.
_NAMES_OF = {"true": "True", "false": "False", "null": "None", "NaN": "None"}
_PYTHON = re.compile(rf"\b(?:{'|'.join(_NAMES_OF)})\b")
# An array as Python prints or assigns it.
CALLED = re.compile(
    r"\s*+(?:\w++\s*+=\s*+)?(?:\w++\.)?(?:array|matrix)\(\s*+(\[[-+0-9.eE,\s\[\]]++),?[^\[\]()]*+\)\s*+"
)
_HALCON = re.compile(r"^[ \t]*([frt])[ \t]+(\S.*)$", re.MULTILINE)


def halcon_record(text: str, path: Path) -> dict[str, object]:
    """A pose of HALCON's write_pose (`f` code, `r` rotation, `t` position [m]); empty for none.

    Codes are those of MVTec, "HALCON Operator Reference", create_pose: 0 Rx Ry Rz (`gba`), 2 Rz Ry
    Rx (`abg`) [deg], 4 a vector of length tan(angle / 2); plus 1 with negated angles, plus 8 where
    the position is subtracted before the rotation. Raises DataError.
    """
    words = {match[1]: match[2].split() for match in _HALCON.finditer(text)}
    if words.keys() != {*"frt"} or not all(is_number(w) for each in words.values() for w in each):
        return {}
    code, turns, place = (np.array(words[name], dtype=float) for name in "frt")
    kind, sizes = int(code[0]) & 6, (len(code), len(turns), len(place))
    if sizes != (1, 3, 3) or code[0] not in range(14) or kind == 6:
        fault = f"f is {' '.join(words['f'])}, and r and t have {sizes[1]} and {sizes[2]} numbers"
        needed = "must be 0 to 5 or 8 to 13, and have 3 each"
        raise DataError(f"{path}: {fault}, but {needed}.", culprits=[str(path)])
    turns = -turns if code[0] % 2 else turns
    order = {0: "XYZ", 2: "xyz"}.get(kind)
    # A vector of the tangent is a quaternion but for its length.
    vector = Rotation.from_quat([*turns, 1.0])
    rotation = Rotation.from_euler(order, turns, degrees=True) if order else vector
    place = rotation.apply(-place) if code[0] >= 8 else place
    return dict(pose_row(compose(rotation.as_matrix(), place)))


_SECTION = re.compile(r"\s*\[+\s*([^\[\]=:,]+?)\s*\]+\s*")
_ENTRY = re.compile(r"\s*([^\s=:#;,\[{(][^=:#;,\[{]*?)\s*[=:]\s*(.*?)\s*")


def keyed_record(text: str) -> dict[str, object]:
    """Keys and values, one a line, by section; empty for any other text."""
    found: dict[str, object] = {}
    section = found
    for line in text.splitlines():
        if not line.strip() or line.strip().startswith((*COMMENTS, ";")):
            continue
        title, entry = _SECTION.fullmatch(line), _ENTRY.fullmatch(line)
        if title and title[1] not in found:
            found[title[1]] = section = {}
        elif not title and entry and entry[1] not in section:
            word = entry[2].strip("\"'")
            section[entry[1]] = float(word) if is_number(word) else word
        else:
            return {}
    return found


_BRACED = re.compile(r"^([^\n{}=:]*+)[=:]?[ \t]*+\{[ \t\r]*+\n([^{}]*+)\}", re.MULTILINE)


def braced_records(text: str) -> list[dict[str, object]]:
    """Records of keys and values, one a line, within braces; empty for any other text."""
    found = [{"name": m[1].strip(), **keyed_record(m[2])} for m in _BRACED.finditer(text)]
    keys = {key for record in found for key in record if key != "name"}
    # A letter before each key says of what type it is.
    at = all(re.match("[a-z][A-Z]", key) for key in keys)
    records = [{key[at * (key != "name") :]: v for key, v in each.items()} for each in found]
    return records if len(records) > 2 and keys else []


def read_document(path: Path) -> object:
    """Reads a document's mappings and lists, arrays without large ones; raises DataError."""
    suffix = path.suffix.lower()
    if suffix in (".npz", ".npy", ".mat"):
        return {
            name: _by_view(array).tolist()
            for name, array in read_arrays(path).items()
            if array.ndim and 0 < array.size <= MOST_NUMBERS * max(array.shape)
        }
    if suffix == ".json":
        return read_json(path)
    if suffix == ".xml":
        root = read_xml(path)
        rows = root.tag != "opencv_storage" and rows_of_xml(root)
        return rows or _with_extrinsics(read_opencv(path))
    text = read_plain_text(path)
    if suffix == ".toml":
        with suppress(DataError):
            return parse_toml(text, str(path))
    if suffix in (".toml", *KEYED):
        return keyed_record(text)
    parts = re.split(r"^---.*$", text, flags=re.MULTILINE)
    several = [part for part in parts if part.strip() and not part.startswith("%")]
    # As programs write that print one message after the other.
    if several[1:]:
        return [parse_yaml(part, str(path)) for part in several]
    return _with_extrinsics(read_yaml(path))


def _with_extrinsics(document: object) -> object:
    """A document whose poses of the board by OpenCV's calibration are a rotation and a position.

    Source: OpenCV, samples/cpp/calibration.cpp, "a set of 6-tuples (rotation vector + translation
    vector) for each view".
    """
    if not isinstance(document, Mapping) or "camera_matrix" not in document:
        return document
    called = {str(key).lower(): key for key in document}
    halves = [called.get(f"{half}_vectors", "") for half in ("rotation", "translation")]
    keys = halves if all(halves) else [called.get("extrinsic_parameters", "")]
    with suppress(KeyError, ValueError, TypeError):
        arrays = [np.array(document[key], dtype=float) for key in keys]
        extrinsics = np.hstack([*map(_vectors, arrays)] if all(halves) else arrays)
        if extrinsics.ndim != 2 or extrinsics.shape[1] != 6:
            return document
        turns, places = np.split(extrinsics, 2, axis=1)
        rest = {name: value for name, value in document.items() if name not in keys}
        found = {"board_to_camera_rvecs": [*turns], "board_to_camera_tvecs": [*places]}
        return {**rest, **{f"extrinsic_parameters.{name}": rows for name, rows in found.items()}}
    return document


def _vectors(array: FloatArray) -> FloatArray:
    """(n, 3) vectors of n views from rows, or of other than three from columns; or ValueError."""
    if array.ndim == 2 and len(array) == 3 != array.shape[1]:
        array = array.T
    if array.shape[1:] not in ((3,), (1, 3), (3, 1)):
        raise ValueError(f"no vectors: {array.shape}")
    return array.reshape(-1, 3)


def _by_view(array: Array) -> Array:
    """An array of n views whose first dimension is theirs, where the last is.

    Its rotations show that, or no row of a pose or of joints is as long.
    """
    if array.dtype.kind == "S":
        return np.asarray(np.char.decode(array, "latin-1"))
    if array.ndim == 2 and len(array) <= max(POSE_SIZES) < MOST_NUMBERS < array.shape[1]:
        return array.T
    if array.ndim > 1 and array.dtype.kind in "fiu" and not appearance(array.astype(float)):
        turned = np.moveaxis(array, -1, 0)
        return turned if appearance(turned.astype(float)) else array
    return array


def messages_in(text: str, path: Path) -> list[object]:
    """Documents of YAML in a text, as `rostopic echo` prints one message after the other."""
    parts = [part for part in re.split(r"^---\s*$", text, flags=re.MULTILINE) if part.strip()]
    if len(parts) < 3 or not all(re.match(r"\s*\w+:", part) for part in parts):
        return []
    with suppress(DataError):
        return [parse_yaml(part, str(path)) for part in parts]
    return []


def literals_in(text: str, path: Path) -> list[object]:
    """Records of JSON or of Python, one a line; empty where a line is none."""
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines or not all(line.lstrip().startswith("{") for line in lines):
        return []
    records = list[object]()
    with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
        for line in lines:
            records.append(_listed(ast.literal_eval(_PYTHON.sub(lambda m: _NAMES_OF[m[0]], line))))
    check_values(records, str(path))
    return records if len(records) == len(lines) else []


# Programs whose lists are read where they are named as the source.
SOURCES = (".py", ".cpp", ".cc")
# An array that a C++ program initialises, and a matrix of OpenCV that it fills.
_INITIALISED = re.compile(r"\b(\w++)\s*+(?:\[\w*+\]\s*+)*+=?\s*+(\{[-+0-9.eE,\s{}]++)\s*+;")
_FILLED = re.compile(
    r"\b(\w++)\s*+=\s*+\(?(?:cv::)?Mat_<\w++>\(\s*+([0-9]++)[\s,0-9]++\)\s*+<<([-+0-9.eE,\s]++)"
)
# A list that a Python program assigns to a name, over several lines or of lists.
_ASSIGNED = re.compile(r"^\w+ *= *(?:\w+\.)?(?:as)?(?:array\()?\[ *(?:#.*|\[.*)?$", re.MULTILINE)


def scripted_record(text: str, path: Path) -> dict[str, object]:
    """Lists of views that a Python program assigns to names, also as arrays of NumPy."""
    found = dict[str, object]()
    if path.suffix.lower() != ".py" and not _ASSIGNED.search(text):
        return found
    with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Name):
                continue
            value = node.value
            if isinstance(value, ast.Call) and ast.unparse(value.func).endswith("array"):
                value = value.args[0] if value.args else value
            with suppress(ValueError, TypeError):
                listed = _listed(ast.literal_eval(value))
                # A list of four may be a matrix.
                if isinstance(listed, list) and len(listed) > 4:
                    found[node.targets[0].id] = listed
    check_values(found, str(path))
    return found


def initialised_record(text: str, path: Path) -> dict[str, object]:
    """Rows with which a C++ program initialises arrays, or fills matrices of OpenCV."""
    found, lists = dict[str, object](), str.maketrans("{}", "[]")
    plain = re.sub("//.*", "", text) if path.suffix.lower() in SOURCES[1:] else ""
    for name, cells in _INITIALISED.findall(plain):
        with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
            listed = ast.literal_eval(cells.translate(lists))
            # Four rows may be a matrix.
            found |= {name: listed} if len(listed) > 4 else {}
    for name, count, cells in _FILLED.findall(plain):
        with suppress(ValueError):
            found[name] = np.reshape([*separate(cells)], (int(count), -1)).tolist()
    check_values(found, str(path))
    return found


def _listed(value: object) -> object:
    """A value with lists in the place of tuples."""
    if isinstance(value, Mapping):
        return {str(key): _listed(part) for key, part in value.items()}
    return [_listed(part) for part in value] if isinstance(value, list | tuple) else value
