"""Targets by name, file or description; intrinsics in foreign formats as fields of `[camera]`."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from visioncal.core.documents.jsons import read_arrays
from visioncal.core.documents.structured import read_opencv, read_xml
from visioncal.core.documents.tables import is_number
from visioncal.core.documents.values import as_numbers, mapping, number
from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.core.types import FloatArray, Target
from visioncal.vision.boards import KINDS
from visioncal.vision.boards.kind import metres
from visioncal.vision.targets import read_target, target_from_document, target_names

_READ: Mapping[str, Callable[[str], object]] = {
    **dict.fromkeys(("columns", "rows", "id"), int),
    **dict.fromkeys(("square_m", "marker_m", "size_m"), lambda mm: metres(float(mm))),
    "dictionary": str,
    "spacing": float,
    **dict.fromkeys(("legacy", "asymmetric"), bool),
}
FORMS = (
    "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250 (squares, side of a square and of a marker), "
    "checkerboard_9x6_23.6mm (inner corners), aprilgrid_6x6_88mm_0.3 (tags, their side, the white "
    "between them as a share of it), circles_7x11_20mm and circles_4x11_20mm_asymmetric (circles, "
    "distance of rows), marker_DICT_APRILTAG_36h11_10_48mm (id)"
)


def read_target_description(words: str) -> Mapping[str, Any]:
    """Content of the `.toml` of a target: a shipped name, a path, or a word as in `FORMS`.

    Raises:
        DataError: It is none of these, or describes no target.
    """
    forms = {name: kind.in_a_word for name, kind in KINDS.items() if kind.in_a_word}
    matches = {name: re.fullmatch(f"{name}_{form}", words) for name, form in forms.items()}
    document: dict[str, Any] | None = None
    for kind, match in matches.items():
        if match is not None:
            groups = match.groupdict().items()
            read = {name: _READ[name](text) for name, text in groups if text is not None}
            document = {"kind": kind, **read}
    if document is None:
        is_file = words.lower().endswith((".toml", ".yaml", ".yml", ".json"))
        if not is_file and words not in target_names():
            raise DataError(
                f"There is no target {words[:80]!r}: it must be a name "
                f"({', '.join(target_names())}), the path of a .toml or of Kalibr's .yaml, or a "
                f"description: {FORMS}.",
                culprits=[words[:80]],
            )
        return read_target(words, None)[1]
    target_from_document(document, words)
    return document


def target_named(words: str, name: str = "") -> Target:
    """The target of `read_target_description`; its words are its name unless another is given."""
    return target_from_document(read_target_description(words), name or words)


_MATRIX_KEYS = (
    *("camera_matrix", "cameraMatrix", "camera_intrinsics", "intrinsic_matrix", "IntrinsicMatrix"),
    *("K", "k", "mtx", "M1", "intrinsic"),
)
_DISTORTION_KEYS = (
    *("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distCoeffs", "distortion"),
    *("dist", "D", "d", "D1", "coeffs"),
)
LENS_KEYS = (*_MATRIX_KEYS, *_DISTORTION_KEYS)
# By name as RealSense and others call the centre, too; coefficients by name in OpenCV's order.
_FOURS = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"))
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_SIZE_KEYS = (("imagewidth", "imageheight"), ("width", "height"), ("w", "h"))
# Sizes (width, height) in one list or mapping.
_BOTH_SIDES = ("resolution", "image_size", "image_size_wh", "img_size", "image_resolution")
# Key of the words why a lens beside other content is not read.
FAULT = "fault"
# Lists of coefficients in a mapping of the distortion.
_LISTED_KEYS = ("coefficients", "coeffs", "values", "data")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_BROWN = (
    *("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "brown", "none"),
    *("brown_conrady", "opencv", "opencv_standard"),
)


def _plain(names: Iterable[str]) -> dict[str, str]:
    """Names as they are written, by their letters and digits alone, in lower case."""
    return {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in map(str, names)}


def _named(content: Mapping[str, Any], names: Iterable[str]) -> str | None:
    """The key that is one of some names, however it is written; None where there is none."""
    written = _plain(content)
    return next((written[name] for name in _plain(names) if name in written), None)


def _four(content: Mapping[str, Any], where: str) -> list[float] | None:
    """Focal lengths and centre by their names; None where these are not all there."""
    written = _plain(content)
    four = next((names for names in _FOURS if written.keys() >= {*names}), None)
    if four is None:
        return None
    keys = [written[name] for name in four]
    return [number(content[key], f"{where}: {key}") for key in keys]


def read_intrinsics(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Reads the intrinsics of a camera; raises DataError.

    Supports ROS camera_info (YAML), OpenCV's FileStorage (YAML, XML, JSON), Kalibr's camchain,
    ViSP's camera XML, ROS-Industrial's fx, fy, cx, cy, .npz or JSON with a matrix under one of the
    usual names, a matrix alone as .npy, and a text of nothing but its nine numbers and the
    coefficients.

    Returns:
        model, matrix, distortion, and resolution where the file has it; and notes on assumptions.
    """
    if path.suffix.lower() in (".npz", ".npy"):
        arrays = read_arrays(path)
        is_matrix = path.suffix.lower() == ".npy"
        return intrinsics_from({"K": arrays["matrix"]} if is_matrix else arrays, str(path))
    if path.suffix.lower() in (".txt", ".csv"):
        numbers = re.split(r"[\s,;]+", read_text(path).strip())
        if len(numbers) in (9, 13, 14, 17) and all(map(is_number, numbers)):
            values = [float(text) for text in numbers]
            lens = {"K": np.reshape(values[:9], (3, 3)), "D": values[9:]}
            return intrinsics_from(lens, str(path))
    if path.suffix.lower() == ".xml":
        root = read_xml(path)
        if root.find("camera") is not None:
            return _visp(root, str(path)), ()
    return intrinsics_from(read_opencv(path), str(path))


def lenses_in(document: object, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """All intrinsics in a document, at any depth, with where they stand.

    Of a lens that cannot be read as a whole there is its `FAULT` alone.
    """
    if not isinstance(document, Mapping):
        return
    written = _plain(document)
    is_lens = any(written.keys() >= {*names} for names in _FOURS)
    if is_lens or "cam0" in document or _named(document, _MATRIX_KEYS) is not None:
        with suppress(DataError):
            yield where, intrinsics_from(document, where)[0]
            return
    if (outer := _outer(document)) is not None:
        # Coefficients and the size of the image stand beside the matrix.
        try:
            yield f"{where}: {outer}", intrinsics_from(document, where)[0]
        except DataError as error:
            yield f"{where}: {outer}", {FAULT: error.message}
        return
    for name, value in document.items():
        yield from lenses_in(value, f"{where}: {name}")


def _outer(document: Mapping[str, Any]) -> str | None:
    """The key of the only mapping that names all four numbers of a matrix; None of others."""
    found = [
        name
        for name, value in document.items()
        if isinstance(value, Mapping) and any(_plain(value).keys() >= {*names} for names in _FOURS)
    ]
    return found[0] if len(found) == 1 else None


def _around(content: Mapping[str, Any], outer: str, where: str) -> dict[str, Any]:
    """Content of a lens and beside it: of single numbers those alone that are sides around it."""
    inner = content[outer]
    _, _, *centre = _four(inner, where) or []
    siblings = {name: value for name, value in content.items() if name != outer}
    sides = {name for names in _SIZE_KEYS for name in names}
    for plain, name in _plain(siblings).items():
        value = siblings[name]
        is_side = plain in sides and number(value, f"{where}: {name}") > max(centre)
        if not (is_side or isinstance(value, Mapping | list | str | np.ndarray)):
            del siblings[name]
    return {**siblings, **inner}


def intrinsics_from(
    content: Mapping[str, Any], where: str
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Reads the intrinsics from a document, as `read_intrinsics` does from a file."""
    if "cam0" in content:
        where = f"{where}: cam0"
        content = mapping(content["cam0"], where)
    key = _named(content, _MATRIX_KEYS)
    for of in (_named(content, ("intrinsics", "CameraIntrinsics")), key):
        inner = content.get(of or "")
        if isinstance(inner, Mapping) and "data" not in inner:
            rest = {name: value for name, value in content.items() if name != of}
            return intrinsics_from({**rest, **inner}, f"{where}: {of}")
    if key is None and _four(content, where) is None and (outer := _outer(content)) is not None:
        return intrinsics_from(_around(content, outer, where), f"{where}: {outer}")
    matrix = _four(content, where)
    if matrix is None and key is not None:
        k = _camera_matrix(_array(content[key], f"{where}: {key}"), f"{where}: {key}")
        matrix = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    elif matrix is None:
        # Kalibr's camchain (Kalibr wiki, "Yaml formats").
        matrix = (
            as_numbers(content.get("intrinsics") or [], f"{where}: intrinsics").reshape(-1).tolist()
        )
    if len(matrix) != 4 or content.get("camera_model", "pinhole") != "pinhole":
        raise DataError(
            f"{where} must have the camera matrix of a pinhole, but has "
            f"{', '.join(map(str, list(content)[:20]))}.",
            culprits=[where],
            next_step=f"The usual names are {', '.join(_MATRIX_KEYS[:5])}, or fx, fy, cx, cy.",
        )
    flat = _coefficients(content, where)
    notes: tuple[str, ...] = ()
    if len(flat) == 4 and "distortion_model" not in content:
        notes = (
            f"{where}: four distortion coefficients without a model are taken for k1, k2, p1, p2; "
            "OpenCV's fisheye model has four as well.",
        )
    return _lens(matrix, flat, content, where), notes


def _coefficients(content: Mapping[str, Any], where: str) -> list[float]:
    """Coefficients of the distortion, in a list or by their names; empty without any."""
    key = _named(content, _DISTORTION_KEYS)
    found = content if key is None else content[key]
    written = _plain(found) if isinstance(found, Mapping) else {}
    if known := [name for name in _COEFFICIENTS if name in written]:
        last = _COEFFICIENTS.index(known[-1]) + 1
        names = [written.get(name, "") for name in _COEFFICIENTS[:last]]
        return [number(found[name], f"{where}: {name}") if name else 0.0 for name in names]
    if key is not None and isinstance(found, Mapping):
        listed = _named(found, _LISTED_KEYS)
        key, found = (key, found) if listed is None else (f"{key}: {listed}", found[listed])
    return [] if key is None else _array(found, f"{where}: {key}").reshape(-1).tolist()


def _camera_matrix(numbers: FloatArray, where: str) -> FloatArray:
    """Reads the nine numbers of a camera matrix, by rows or, as 0, 0, 1 shows, by columns.

    Open3D and MATLAB write columns.
    """
    k = numbers.reshape(3, 3) if numbers.size == 9 else np.zeros((3, 3))
    last = [0.0, 0.0, 1.0]
    k = k.T if not np.array_equal(k[2], last) and np.array_equal(k[:, 2], last) else k
    # Largest skew relative to the focal length; more is another camera model.
    if not np.array_equal(k[2], last) or k[1, 0] or abs(k[0, 1]) > 1e-6 * abs(k[0, 0]):
        raise DataError(
            f"{where} is {np.array2string(numbers.reshape(-1)[:9], precision=6)}, but must be the "
            "nine numbers fx, 0, cx, 0, fy, cy, 0, 0, 1.",
            culprits=[where],
            next_step="Leave it out with --intrinsics estimate.",
        )
    return k


def _array(value: object, where: str) -> FloatArray:
    """Reads numbers, or the data of a ROS matrix."""
    if isinstance(value, Mapping):
        return as_numbers(value.get("data"), f"{where}: data")
    return as_numbers(value, where)


def _visp(root: Element, where: str) -> dict[str, Any]:
    """Reads ViSP's camera XML (ViSP, vpCameraParameters)."""
    # Its k_ud maps undistorted to distorted points with 1 + k_ud r^2, which is OpenCV's k1.
    camera = next(root.iterfind("camera"), root)
    models = camera.findall("model")
    kinds = [model.findtext("type", "").strip() for model in models]
    chosen = [
        model for model, kind in zip(models, kinds, strict=True) if kind.endswith("WithDistortion")
    ]
    if not models:
        raise DataError(f"{where}: the camera has no <model>.", culprits=[where])
    model = (chosen or models)[0]

    def read(element: Element, tag: str, default: float | None = None) -> float:
        found = element.findtext(tag)
        if found is None and default is not None:
            return default
        place, text = f"{where}: <{tag}>", (found or "").strip()
        return number(float(text) if is_number(text) else text, place)

    values = [read(model, name) for name in ("px", "py", "u0", "v0")]
    size = {"width": read(camera, "image_width", 0.0), "height": read(camera, "image_height", 0.0)}
    return _lens(values, [read(model, "kud", 0.0)], size if size["width"] else {}, where)


def _lens(
    matrix: list[float], coefficients: list[float], content: Mapping[str, Any], where: str
) -> dict[str, Any]:
    inner = content.get(_named(content, _DISTORTION_KEYS) or "")
    of_inner = inner.get("model", "none") if isinstance(inner, Mapping) else "none"
    name = str(content.get("distortion_model", of_inner)).lower()
    # As RealSense says it; another `model` is that of the camera.
    stated = str(content.get("model", "")).lower().rpartition(".")[2]
    if name == "none" and stated.endswith("brown_conrady") and any(coefficients):
        name = stated
    model = "fisheye" if name in _FISHEYE else "brown"
    count = 4 if model == "fisheye" else 5 if len(coefficients) <= 5 else 8
    fault = ""
    if name not in (*_FISHEYE, *_BROWN):
        fault = f"the lens model {name[:40]!r} is not known; {', '.join(_BROWN + _FISHEYE)} are"
    elif any(coefficients[count:]) or not np.isfinite([*matrix, *coefficients]).all():
        fault = f"{len(coefficients)} coefficients; up to {count} finite ones are known here"
    elif not (matrix[0] > 0 and matrix[1] > 0):
        fault = f"the focal lengths are {matrix[0]:g} and {matrix[1]:g} px; both must be above 0"
    if fault:
        step = "Leave it out with --intrinsics estimate."
        raise DataError(f"{where}: {fault}.", culprits=[where], next_step=step)
    lens: dict[str, Any] = {
        "model": model,
        "matrix": [float(value) for value in matrix],
        "distortion": [float(value) for value in (coefficients + [0.0] * count)[:count]],
    }
    size = _size(content, where)
    return lens | ({"resolution": list(size)} if size else {})


def _size(content: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    written = _plain(content)
    for names in _SIZE_KEYS:
        if set(names) <= written.keys():
            sides = [number(content[written[name]], f"{where}: {name}") for name in names]
            break
    else:
        key = _named(content, _BOTH_SIDES)
        if key is None:
            return None
        if isinstance(content[key], Mapping):
            return _size(content[key], f"{where}: {key}")
        sides = list(as_numbers(content[key], f"{where}: {key}").reshape(-1))
    if len(sides) != 2 or not all(side % 1 == 0 and 0 < side < 1e6 for side in sides):
        raise DataError(f"{where}: the size of the image is {sides}.", culprits=[where])
    return int(sides[0]), int(sides[1])
