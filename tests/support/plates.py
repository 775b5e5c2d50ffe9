"""A plate with markers before a calibrated camera: drawn pictures of it, and where it really is."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from support.picks import calibration_of

from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import Camera, FloatArray
from visioncal.frames.target_pose import Sight
from visioncal.results import Calibration, CameraResult
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE, pose_row
from visioncal.simulation import CellOptions, simulate
from visioncal.vision.boards.kind import aruco_dictionary

CLEAR = Camera("brown", (1280, 800), np.array([900.0, 900.0, 640.0, 400.0]), np.zeros(5))
CENTRES = {0: (-0.12, -0.06), 7: (0.1, -0.05), 21: (0.11, 0.07), 30: (-0.1, 0.06)}
DICTIONARY, SIZE_M = "DICT_5X5_100", 0.04
_TILTS = ((0.4, 0.1), (-0.3, 0.3), (0.1, -0.5), (0.3, -0.3))


def looking(tilt: tuple[float, float], spin: float, distance_m: float) -> FloatArray:
    """A target before the camera's middle, (4, 4) `cam_from_target`."""
    return compose(exp(np.array([*tilt, spin, 0, 0, 0]))[:3, :3], np.array([0.0, 0.0, distance_m]))


def marked_plate() -> tuple[Calibration, FloatArray, list[Sight]]:
    """A camera without distortion, where the plate is (4, 4) in the base, and four pictures."""
    cell = simulate(CellOptions(views=12, pixel_sigma_px=0.1, seed=9))
    calibration = calibration_of(cell)
    true = cell.transforms["flange_from_cam"]
    edge = replace(calibration.edges["flange_from_cam"], matrix=true)
    calibration = replace(
        calibration,
        edges={**calibration.edges, "flange_from_cam": edge},
        camera=CameraResult(CLEAR, estimated=False),
    )
    base_from_plate = compose(
        np.diag([1.0, -1.0, -1.0]), cell.transforms["base_from_target"][:3, 3]
    )
    sights, rng = [], np.random.default_rng(0)
    for at, tilt in enumerate(_TILTS):
        cam_from_plate = looking(tilt, 0.1 * at, 0.45)
        flange = base_from_plate @ invert(cam_from_plate) @ invert(true)
        reported = flange @ invert(exp(rng.normal(0.0, np.repeat([5e-5, 3e-5], 3))))
        sights.append(Sight(f"picture {at}", _picture(cam_from_plate), reported))
    return calibration, base_from_plate, sights


def plate_session(sights: Sequence[Sight]) -> Session:
    """The session of a plate's pictures; its target is a table of the markers' corners."""
    rows = [
        [str(at), f"{at}.png", *map(repr, pose_row(sight.base_from_flange).values())]
        for at, sight in enumerate(sights)
    ]
    files = {
        f"{at}.png": cv2.imencode(".png", sight.seen)[1].tobytes()
        for at, sight in enumerate(sights)
    }
    document = {
        "schema": 1,
        "name": "plate",
        "mount": "eye-in-hand",
        "target": "plate.toml",
        "camera": {},
    }
    corners = [
        (tag, corner, x + SIZE_M / 2 * along, y + SIZE_M / 2 * across)
        for tag, (x, y) in CENTRES.items()
        for corner, (along, across) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    ]
    tag, corner, x_m, y_m = map(list, zip(*corners, strict=True))
    points = {"point": [*range(len(tag))], "x_m": x_m, "y_m": y_m, "z_m": [0.0] * len(tag)}
    return Session.assemble(
        document,
        ("view", "image", *POSE),
        rows,
        MemoryImages(files),
        target_document={
            "kind": "points",
            "points": points | {"tag": tag, "corner": corner},
            "dictionary": DICTIONARY,
        },
    )


def _picture(cam_from_plate: FloatArray, sharper: int = 4) -> np.ndarray:
    """What the camera sees of the markers: each drawn through its homography, finely."""
    width, height = CLEAR.resolution
    canvas = np.full((height * sharper, width * sharper), 180, np.uint8)
    fx, fy, cx, cy = CLEAR.matrix
    for marker, (x, y) in CENTRES.items():
        tile = cv2.aruco.generateImageMarker(aruco_dictionary(DICTIONARY), marker, 210)
        tile = np.pad(tile, 30, constant_values=255)
        half = 0.02 * 135 / 105
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        points = np.column_stack([corners + np.array([x, y]), np.zeros(4)])
        cam = points @ cam_from_plate[:3, :3].T + cam_from_plate[:3, 3]
        px = np.column_stack([fx * cam[:, 0] / cam[:, 2] + cx, fy * cam[:, 1] / cam[:, 2] + cy])
        # Pixel centres are at integers: a finer raster's first centre lies at -0.5 + 0.5 / n.
        fine = (px + 0.5) * sharper - 0.5
        ends = np.array([[0, 0], [270, 0], [270, 270], [0, 270]]) - 0.5
        warp = cv2.getPerspectiveTransform(ends.astype(np.float32), fine.astype(np.float32))
        cv2.warpPerspective(
            tile, warp, canvas.shape[::-1], canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
        )
    return cv2.resize(canvas, CLEAR.resolution, interpolation=cv2.INTER_AREA)
