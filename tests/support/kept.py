"""What several tests of recordings share: an exact comparison, and a session of literals."""

import datetime
import json

import numpy as np

from visioncal.results.evidence import ViewEvidence
from visioncal.session import MemoryImages, Session, Stream


def assert_same(one: Session, other: Session) -> None:
    """Compares every fact exactly; repr tells -0.0 from 0.0, which == does not."""
    assert other.document == one.document
    assert other.columns == one.columns
    assert other.target == one.target
    assert other.target_document == one.target_document
    # Written to calibration.json as they stand: their order counts too.
    assert json.dumps(other.robot_document) == json.dumps(one.robot_document)
    for a, b in zip(one.views, other.views, strict=True):
        assert repr(vars(b)) == repr(vars(a))
        if a.image:
            assert other.images.exists(a.image) == one.images.exists(a.image)
        if a.image and one.images.exists(a.image):
            assert other.images.read(a.image) == one.images.read(a.image)
    assert list(other.streams) == list(one.streams)
    for name, stream in one.streams.items():
        assert other.streams[name].columns == stream.columns
        np.testing.assert_array_equal(other.streams[name].values, stream.values)
    assert other.digest() == one.digest()


def assert_same_evidence(one: tuple[ViewEvidence, ...], other: tuple[ViewEvidence, ...]) -> None:
    """Compares exactly, the order included."""
    for a, b in zip(one, other, strict=True):
        assert (a.view, a.corners is None) == (b.view, b.corners is None)
        pairs = [
            (getattr(a, name), getattr(b, name))
            for name in ("predicted_px", "base_from_flange", "cam_from_target")
        ]
        if a.corners is not None and b.corners is not None:
            assert (a.corners.view, a.corners.blur_px) == (b.corners.view, b.corners.blur_px)
            pairs += [(a.corners.ids, b.corners.ids), (a.corners.px, b.corners.px)]
        for array, other_array in pairs:
            assert (array is None) == (other_array is None)
            if array is not None:
                assert array.dtype == other_array.dtype
                assert np.array_equal(array, other_array)


def kept_session() -> Session:
    """A session with facts of every kind, in literals."""
    document = {
        "schema": 1,
        "name": "kept, grün",
        "mount": "eye-to-hand",
        "target": "board.toml",
        "day": datetime.date(2026, 11, 20),
        "camera": {"name": "tiny", "resolution": [64, 48]},
        "robot": {"model": "arm.toml", "tip": "tool0"},
    }
    board = {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.03}
    arm = {"kind": "dh", "joints": [{"a_m": 0.1, "d_m": -0.0}, {"a_m": 1e-300, "d_m": 0.2}]}
    columns = ["view", "note", "image", "stamp_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
    rows = [
        ["7", 'a,"b"\n', "images/a.png", "5e-324", "0.1", "0.2", "0.3", "0", "0", "0", "1"],
        ["-3", "", "images/b.jpg", "1e+308", "-0.0", "0.2", "0.3", "0.6", "0", "0", "-0.8"],
        ["4", "gone", "images/none.tif", "", "0.1", "0.2", "0.3", "0", "0", "1", "0"],
    ]
    images = {"images/a.png": bytes(range(256)) * 8, "images/b.jpg": bytes(range(255, -1, -1)) * 4}
    return Session.assemble(
        document, columns, rows, MemoryImages(images), target_document=board, robot_document=arm
    )


def kept_streams() -> dict[str, Stream]:
    """Its streams."""
    samples = np.array([[0.0, 0.1, 20.5], [1e-3, -0.0, np.nan], [2e-3, 1e300, -5e-324]])
    return {"robot": Stream(("stamp_s", "q1_rad", "temp1_c"), samples)}
