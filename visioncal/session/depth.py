"""Depth pictures and clouds: reading of their files, and what they need of the camera.

A picture has one distance a pixel of the image, 16-bit or of floats; a cloud has points in the
camera's frame, organised where it has one for each pixel. Where nothing was measured, pictures have
0 or NaN, and clouds NaN or the origin.
"""

import io
import re
from contextlib import suppress
from pathlib import PurePosixPath
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.session.images import CLOUD_ENDINGS

# Types of PLY's properties, and of PCD's fields by type and size, as NumPy has them.
_PLY = {
    **dict.fromkeys(("char", "int8"), "i1") | dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2") | dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4") | dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4") | dict.fromkeys(("double", "float64"), "f8"),
}


def read_depth(
    data: bytes, path: str, size: tuple[int, int], unit_m: float | None = None
) -> FloatArray:
    """Distances at the pixels of an image, NaN where there are none.

    Args:
        data: Bytes of the file.
        path: Name of the file, whose ending says its format.
        size: (width, height) of the image [px].
        unit_m: Unit of a picture [m]; where None, millimetres of integers and metres of others.

    Returns:
        (h, w) distances, of clouds along the camera's z [m].

    Raises:
        DataError: It cannot be read, has another size, or holds no distance.
    """
    if not path.lower().endswith(CLOUD_ENDINGS):
        raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        if raw is None or raw.ndim != 2 or raw.dtype == np.uint8:
            is_image = raw is not None
            raise DataError(
                f"{path} {'is an image of 8 bits or colours' if is_image else 'is damaged'}, no "
                "depth picture, but must have one channel of 16 bits or of floats.",
                culprits=[path],
                next_step="Save the sensor's raw distances, not the picture that shows them.",
            )
        depth = _distances(raw, unit_m)
    elif (raw := _picture_of_npy(data, path)) is not None:
        depth = _distances(raw, unit_m)
    else:
        cloud = read_cloud(data, path)
        if cloud.ndim == 2 and len(cloud) == size[0] * size[1]:
            cloud = cloud.reshape(size[1], size[0], 3)
        if cloud.ndim == 2:
            raise DataError(
                f"{path} has {len(cloud)} points in no order, and the image {size[0]} x {size[1]} "
                "pixels: a cloud must be organised, with a point for each pixel.",
                culprits=[path],
                next_step="Save it ordered (organised), with NaN where nothing was measured.",
            )
        depth = cloud[..., 2]
    if depth.shape != size[::-1]:
        raise DataError(
            f"{path} has {depth.shape[1]} x {depth.shape[0]} distances, and the image "
            f"{size[0]} x {size[1]} pixels.",
            culprits=[path],
            next_step="Align depth to the image (RealSense: rs.align; OAK: setDepthAlign; "
            "ROS: aligned_depth_to_color), and record again.",
        )
    return _checked(depth, path)


def _picture_of_npy(data: bytes, path: str) -> npt.NDArray[Any] | None:
    """(h, w) a .npy of distances; None of what is none."""
    if not path.lower().endswith(".npy"):
        return None
    with suppress(ValueError, EOFError):
        raw = np.load(io.BytesIO(data), allow_pickle=False)
        return raw if raw.ndim == 2 and raw.shape[1] != 3 and raw.dtype.kind in "fiu" else None
    return None


def _distances(raw: npt.NDArray[Any], unit_m: float | None) -> FloatArray:
    """Distances of a picture [m]; the largest number of its type is a hole, too."""
    is_whole = np.issubdtype(raw.dtype, np.integer)
    unit = (0.001 if is_whole else 1.0) if unit_m is None else unit_m
    holes = raw == np.iinfo(raw.dtype).max if is_whole else np.zeros(raw.shape, dtype=bool)
    return np.where(holes, np.nan, np.asarray(raw, float) * unit)


def _checked(depth: FloatArray, path: str) -> FloatArray:
    valid = np.isfinite(depth) & (depth > 0.0)
    if not valid.any():
        is_behind = bool((depth < 0.0).any())
        raise DataError(
            f"{path} holds no distance: all {depth.size} are {'below ' * is_behind}0 or NaN.",
            culprits=[path],
            next_step="Its z points backwards (OpenGL): save it with z forward and y down."
            if is_behind
            else "Look whether the depth stream ran, the projector was on, and the board is within "
            "the sensor's range.",
        )
    return np.where(valid, depth, np.nan)


def read_cloud(data: bytes, path: str) -> FloatArray:
    """Points of a .ply, .pcd or .npy in the camera's frame, NaN where there are none.

    Coordinates are in metres, or in millimetres where metres would be too far.

    Args:
        data: Bytes of the file.
        path: Name of the file.

    Returns:
        (h, w, 3) of an organised cloud that says so, else (n, 3) [m].

    Raises:
        DataError: The file cannot be read, or holds no point.
    """
    try:
        points = _READERS[PurePosixPath(path.lower()).suffix](data)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        words = f"{error}".strip("'\n") or "it is damaged"
        raise DataError(
            f"{path} cannot be read as a cloud of points: {words}.",
            culprits=[path],
            next_step="Save it as binary .ply with x, y, z, or as .npy of (h, w, 3).",
        ) from None
    is_valid = np.isfinite(points).all(axis=-1) & (points != 0.0).any(axis=-1)
    if not is_valid.any():
        raise DataError(f"{path} holds no point: all are NaN or 0.", culprits=[path])
    # Farther than any camera of a cell measures [m]: clouds with such a median are in millimetres.
    unit_m = 1.0 if np.median(np.abs(points[..., 2][is_valid])) < 30.0 else 0.001
    return np.where(is_valid[..., None], points * unit_m, np.nan)


def _of_npy(data: bytes) -> FloatArray:
    points = np.load(io.BytesIO(data), allow_pickle=False)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise ValueError(f"its shape is {points.shape}, but must be (h, w, 3)")
    return np.array(points, float)


def _of_ply(data: bytes) -> FloatArray:
    head, found, body = data.partition(b"end_header\n")
    if not found:
        head, found, body = data.partition(b"end_header\r\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    if not found or lines[:1] != [["ply"]]:
        raise ValueError("it has no header of a PLY")
    count, names, kinds, at, form = 0, list[str](), list[str](), "", ""
    size = dict[str, int]()
    for words in lines:
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            if at and not count:
                raise ValueError("its points do not come first")
            at, count = words[1], int(words[2]) if words[1] == "vertex" else count
        elif words[:1] == ["property"] and at == "vertex":
            names.append(words[-1])
            kinds.append(_PLY[words[1]])
        elif words[:1] in (["obj_info"], ["comment"]) and len(words) == 3 and words[2].isdigit():
            size[words[1].lower()] = int(words[2])
    ends = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
    points = _columns(
        body, names, [ends[form] + kind for kind in kinds], count, is_text=not ends[form]
    )
    height = size.get("num_rows", size.get("height", 0))
    width = size.get("num_cols", size.get("width", 0))
    return points.reshape(height, width, 3) if height * width == count else points


def _of_pcd(data: bytes) -> FloatArray:
    head = re.match(rb"(?:.*\n)*?DATA (\w+)\r?\n", data)
    if head is None:
        raise ValueError("it has no header of a PCD")
    if head[1] not in (b"ascii", b"binary"):
        raise ValueError(f"its points are {head[1].decode()}, but must be ascii or binary")
    lines = (line.split() for line in head[0].decode("ascii").splitlines() if line.strip())
    fields = {words[0]: words[1:] for words in lines}
    width, height = int(fields["WIDTH"][0]), int(fields["HEIGHT"][0])
    counts = map(int, fields.get("COUNT", ["1"] * len(fields["FIELDS"])))
    columns = zip(fields["FIELDS"], fields["TYPE"], fields["SIZE"], counts, strict=True)
    names, kinds = list[str](), list[str]()
    for name, kind, size, count in columns:
        names += [name] if count == 1 else [f"{name}.{at}" for at in range(count)]
        kinds += [f"{kind.lower()}{size}"] * count
    points = _columns(data[head.end() :], names, kinds, width * height, is_text=head[1] == b"ascii")
    return points.reshape(height, width, 3) if height > 1 else points


def _columns(
    body: bytes, names: list[str], kinds: list[str], count: int, *, is_text: bool
) -> FloatArray:
    """(n, 3) the columns x, y, z of a table of points."""
    if is_text:
        table = np.array(body.split()[: count * len(names)], float).reshape(count, len(names))
        return table[:, [names.index(axis) for axis in "xyz"]]
    # Fields without a meaning may have equal names.
    dtype = np.dtype(
        [
            (name if name in "xyz" else f"{at}", kind)
            for at, (name, kind) in enumerate(zip(names, kinds, strict=True))
        ]
    )
    table = np.frombuffer(body, dtype, count)
    return np.stack([table[axis].astype(float) for axis in "xyz"], axis=-1)


_READERS: dict[str, Any] = {".ply": _of_ply, ".pcd": _of_pcd, ".npy": _of_npy}


def ply_of(points_m: FloatArray) -> bytes:
    """A binary .ply of (..., 3) points, without those that are NaN [m]."""
    flat = points_m.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])]
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\ncomment visioncal\nelement vertex {len(flat)}\n"
    head += f"{axes}end_header\n"
    return head.encode() + flat.astype("<f4").tobytes()


def npy_of(points_m: FloatArray) -> bytes:
    """A .npy of points, in their order [m]."""
    stored = io.BytesIO()
    np.save(stored, points_m)
    return stored.getvalue()
