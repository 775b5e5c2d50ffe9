"""Depth pictures and clouds: the same points in every form, and refusals that say what is wrong."""

import io

import cv2
import numpy as np
import pytest

from visioncal.core.errors import DataError
from visioncal.present.recording import write_recording
from visioncal.session import MemoryImages, Session
from visioncal.session.depth import read_cloud, read_depth

SIZE = (40, 30)
POSE = {"x_m": "0.5", "y_m": "0", "z_m": "0.4", "qx": "1", "qy": "0", "qz": "0", "qw": "0"}


@pytest.fixture
def cloud():
    """An organised cloud of a tilted plane with a hole [m]."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    z = 0.8 + 1e-3 * u + 2e-3 * v
    points = np.stack([(u - 20) * z / 50, (v - 15) * z / 50, z], axis=-1)
    points[4:7, 9:12] = np.nan
    return points


def ply(points, form="binary_little_endian", *, mm=True, more=True):
    """A PLY as depth cameras write it: ordered, in millimetres, with colours."""
    flat = (1e3 if mm else 1.0) * points.reshape(-1, 3)
    names = ["x", "y", "z"]
    table = np.zeros(len(flat), [(name, "f8") for name in names] + [("red", "u1")] * more)
    for axis, name in enumerate(names):
        table[name] = flat[:, axis]
    lines = ["ply", f"format {form} 1.0", f"element vertex {len(flat)}"]
    lines += [f"property double {name}" for name in names] + ["property uchar red"] * more
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header\n"]
    if form == "ascii":
        body = "\n".join(" ".join(map(str, row)) for row in table.tolist()).encode()
    else:
        order = ">" if form == "binary_big_endian" else "<"
        body = table.astype(table.dtype.newbyteorder(order)).tobytes()
    return "\n".join(lines).encode() + body


def pcd(points, form="binary"):
    """A PCD with a field of other meaning between the axes and padding."""
    height, width = points.shape[:2]
    table = np.zeros(height * width, [("x", "f8"), ("y", "f8"), ("_", "u1", 4), ("z", "f8")])
    for axis, name in enumerate("xyz"):
        table[name] = points[..., axis].ravel()
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y _ z\nSIZE 8 8 1 8\nTYPE F F U F\nCOUNT 1 1 4 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\n"
        f"DATA {form}\n"
    ).encode()
    if form == "binary":
        return head + table.tobytes()
    rows = [f"{x} {y} 0 0 0 0 {z}" for x, y, _, z in table.tolist()]
    return head + "\n".join(rows).encode()


def npy(points):
    stored = io.BytesIO()
    np.save(stored, points)
    return stored.getvalue()


def png(values):
    return cv2.imencode(".png", values)[1].tobytes()


def tiff(values):
    return cv2.imencode(".tiff", values)[1].tobytes()


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.ply", ply),
        ("b.ply", lambda points: ply(points, "ascii", mm=False)),
        ("c.ply", lambda points: ply(points, "binary_big_endian", more=False)),
        ("d.pcd", pcd),
        ("e.pcd", lambda points: pcd(points, "ascii")),
        ("f.npy", npy),
    ],
)
def test_every_form_of_a_cloud_gives_the_same_points(cloud, name, write):
    # Whole form and distances; doubles in millimetres round by far less than a nanometre.
    assert np.allclose(read_cloud(write(cloud), name).reshape(cloud.shape), cloud, 0, 1e-9, True)
    assert np.allclose(read_depth(write(cloud), name, SIZE), cloud[..., 2], 0, 1e-9, True)


def test_pictures_are_in_the_stated_unit_and_have_holes(cloud):
    tenths = np.nan_to_num(np.round(1e4 * cloud[..., 2])).astype(np.uint16)
    depth = read_depth(png(tenths), "a.png", SIZE, 1e-4)
    assert np.isnan(depth[5, 10])
    assert np.allclose(depth, tenths * 1e-4 + np.where(tenths, 0, np.nan), 0, 1e-12, True)
    metres = cloud[..., 2].astype(np.float32)  # as ROS has them, with NaN
    assert np.allclose(read_depth(tiff(metres), "a.tiff", SIZE), metres, 0, 1e-12, True)


def test_pictures_of_numpy_are_read_with_the_largest_number_as_a_hole(cloud):
    metres = cloud[..., 2].astype(np.float32)
    assert np.allclose(read_depth(npy(metres), "a.npy", SIZE), metres, 0, 1e-12, True)
    millimetres = np.where(np.isfinite(metres), np.nan_to_num(1e3 * metres), 65535).astype("u2")
    for name, data in (("a.npy", npy(millimetres)), ("a.png", png(millimetres))):
        depth = read_depth(data, name, SIZE)
        assert np.array_equal(np.isnan(depth), np.isnan(metres))
        # Whole millimetres.
        assert np.nanmax(np.abs(depth - metres)) < 1.01e-3


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.png", png(np.ones((20, 30), np.uint16)), r"30 x 20 distances.*40 x 30 pixels.*align"),
        ("a.png", png(np.zeros((30, 40), np.uint16)), "no distance: all 1200 are 0 or NaN"),
        ("a.png", png(np.ones((30, 40), np.uint8)), "8 bits"),
        ("a.tif", tiff(np.full((30, 40), np.nan, np.float32)), "no distance: all 1200 are 0 or N"),
        ("a.png", b"\x89PNG", "damaged"),
        ("a.tif", tiff(np.full((30, 40), -0.5, np.float32)), "below 0 or NaN.*z forward"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "no header"),
        ("a.ply", ply(np.ones((5, 5, 3)))[:-9], "cannot be read as a cloud"),
        ("a.ply", ply(np.ones((5, 5, 3))), "25 points in no order.*organised"),
        ("a.pcd", pcd(np.ones((5, 5, 3))).replace(b"DATA binary", b"DATA binary_lzf"), "asc"),
        ("a.npy", npy(np.ones((30, 40, 2))), r"\(h, w, 3\)"),
        ("a.npy", npy(np.full((30, 40, 3), np.nan)), "no point"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_depth_of_the_image_is_named(name, data, words):
    with pytest.raises(DataError, match=f"(?s){name}.*{words}"):
        read_depth(data, name, SIZE)


def test_a_session_keeps_depth_in_its_folder_digest_and_recording(tmp_path, cloud):
    document = {
        "schema": 1, "name": "bin", "mount": "eye-in-hand", "target": "charuco_9x6_30mm",
        "camera": {"resolution": list(SIZE), "depth_unit_m": 1e-4, "depth_of": "ray"},
    }  # fmt: skip
    tenths = png(np.nan_to_num(1e4 * cloud[..., 2]).astype(np.uint16))
    files = {"images/0.png": png(np.zeros(SIZE[::-1], np.uint8)), "depth/0.png": tenths}
    columns = ["view", "image", "depth", *POSE]
    cells = [["0", "images/0.png", "depth/0.png", *POSE.values()]]
    session = Session.assemble(document, columns, cells, MemoryImages(files))
    assert session.views[0].depth == "depth/0.png"
    assert session.declaration.camera.depth_of == "ray"
    session.save(tmp_path / "bin")
    write_recording(tmp_path / "bin.rrd", session, None, (), None)
    for stored in (Session.load(tmp_path / "bin"), Session.load(tmp_path / "bin.rrd")):
        assert stored.images.read("depth/0.png") == tenths
        assert stored.digest() == session.digest()
    other = MemoryImages(files | {"depth/0.png": png(np.ones(SIZE[::-1], np.uint16))})
    assert session.with_content(images=other).digest() != session.digest()


@pytest.mark.parametrize("path", ["depth/a.zdf", "../a.png", "depth/a.jpg"])
def test_a_path_that_is_no_depth_is_refused(path):
    document = {
        "schema": 1, "name": "bin", "mount": "eye-in-hand", "target": "charuco_9x6_30mm",
        "camera": {"resolution": list(SIZE)},
    }  # fmt: skip
    cells = [["0", "a.png", path, *POSE.values()]]
    with pytest.raises(DataError, match="column depth"):
        Session.assemble(document, ["view", "image", "depth", *POSE], cells, MemoryImages({}))
