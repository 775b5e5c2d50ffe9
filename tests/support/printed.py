"""Pictures of flat prints by rays from sub-pixels; nothing here is shared with what registers them.

Each sub-pixel's ray is bent back by OpenCV, meets the plane of the print and takes its grey level
there; covers, the optics (Gaussian, disc), sub-poses of a motion, light, the sensor's pixels and
noise follow as in a camera.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from visioncal import Session
from visioncal.core.types import Target
from visioncal.simulation import CAMERAS, CellOptions, simulate
from visioncal.vision.targets import extent_m, load_target

SAMPLES = 3


def poster(seed=0, size=(1200, 900)):
    """Coloured areas, circles and large letters; (h, w) grey levels."""
    rng, (w, h) = np.random.default_rng(seed), size
    image = np.full((h, w), 225, np.uint8)
    for _ in range(14):
        points = (rng.uniform(0, 1, (rng.integers(3, 7), 2)) * size).astype(np.int32)
        cv2.fillPoly(image, [points], int(rng.integers(20, 240)), cv2.LINE_AA)
    for _ in range(25):
        at = tuple((rng.uniform(0, 1, 2) * size).astype(int).tolist())
        cv2.circle(image, at, int(rng.integers(6, 70)), int(rng.integers(10, 250)), -1, cv2.LINE_AA)
    for _ in range(18):
        text = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ23456789"), 5))
        at = tuple((rng.uniform(-0.05, 0.85, 2) * size).astype(int).tolist())
        grey = int(rng.integers(0, 255))
        cv2.putText(
            image, text, at, 2, rng.uniform(1, 4), grey, int(rng.integers(2, 7)), cv2.LINE_AA
        )
    return image


def label(seed=0, size=(1200, 800)):
    """Lines of small text, rules and a bar code."""
    rng, (w, h) = np.random.default_rng(seed), size
    image = np.full((h, w), 240, np.uint8)
    for y in range(70, int(0.7 * h), 52):
        text = "".join(rng.choice(list("abcdefghiklmnoprstu ABCD0123456789:.-/"), 46))
        scale = float(rng.uniform(0.9, 1.4))
        cv2.putText(image, text, (30, y), 0, scale, 20, int(rng.integers(2, 4)), cv2.LINE_AA)
    x = 60
    while x < 0.7 * w:
        wide = int(rng.integers(3, 14))
        cv2.rectangle(image, (x, int(0.76 * h)), (x + wide, int(0.95 * h)), 15, -1)
        x += wide + int(rng.integers(4, 14))
    cv2.rectangle(image, (10, 10), (w - 10, h - 10), 30, 5)
    cv2.circle(image, (int(0.85 * w), int(0.85 * h)), 80, 40, 18, cv2.LINE_AA)
    return image


def board(seed=0, size=(1200, 900)):
    """A circuit board: rows of alike parts, traces and pads, and some parts of their own."""
    rng, (w, h) = np.random.default_rng(seed), size
    image = np.full((h, w), 70, np.uint8)
    for x in range(60, w - 60, 120):
        for y in range(60, h - 60, 100):
            cv2.rectangle(image, (x, y), (x + 60, y + 40), 25, -1)
            for pin in range(6):
                cv2.rectangle(image, (x + 3 + 10 * pin, y - 8), (x + 8 + 10 * pin, y), 200, -1)
                cv2.rectangle(
                    image, (x + 3 + 10 * pin, y + 40), (x + 8 + 10 * pin, y + 48), 200, -1
                )
    for _ in range(60):
        at = np.array([rng.integers(0, w), rng.integers(0, h)])
        for _ in range(3):
            step = np.array([[1, 0], [0, 1], [1, 1], [1, -1]])[rng.integers(4)] * rng.integers(
                -150, 150
            )
            cv2.line(image, at.tolist(), (at + step).tolist(), 110, 3, cv2.LINE_AA)
            at = at + step
        cv2.circle(image, at.tolist(), 7, 190, -1, cv2.LINE_AA)
    for _ in range(12):
        x, y = int(rng.integers(0, w - 100)), int(rng.integers(0, h - 90))
        cv2.rectangle(
            image, (x, y), (x + int(rng.integers(30, 110)), y + int(rng.integers(30, 90))), 35, -1
        )
        text = "".join(rng.choice(list("UCRQ123456789"), 4))
        cv2.putText(image, text, (x, y - 4), 0, 0.8, 215, 2, cv2.LINE_AA)
    return image


def photo(seed=0, size=(1200, 900)):
    """Smooth areas with texture of all scales, as of a landscape."""
    rng, (w, h) = np.random.default_rng(seed), size
    image = np.zeros((h, w), np.float32)
    for cells in (4, 8, 16, 32, 64, 128, 256):
        noise = rng.normal(0, 1, (max(cells * h // w, 2), cells)).astype(np.float32)
        image += cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC) * cells**-0.7
    image = np.tanh(1.2 * (image - image.mean()) / image.std())
    return (128 + 100 * image).astype(np.uint8)


PICTURES = {"poster": poster, "label": label, "board": board, "photo": photo}


def pose_at(distance_m, tilt_deg, middle_m, rng, spin_deg=30.0, off=0.05):
    """(4, 4) cam_from_target of a print whose middle is about in the middle of the image."""
    axis = rng.uniform(0, 2 * np.pi)
    turn = Rotation.from_rotvec(np.deg2rad(tilt_deg) * np.array([np.cos(axis), np.sin(axis), 0]))
    turn = turn * Rotation.from_euler("z", rng.uniform(-spin_deg, spin_deg), degrees=True)
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    place = distance_m * np.array([*rng.uniform(-off, off, 2), 1.0])
    pose[:3, 3] = place - pose[:3, :3] @ middle_m
    return pose


@dataclass(frozen=True)
class Look:
    """How a print is photographed."""

    gauss_px: float = 0.5  # The lens's own blur.
    disc_px: float = 0.0  # Radius of the disc of defocus.
    twist: tuple[float, ...] = ()  # (6,) motion over the exposure, in the camera's frame [m, rad].
    covered: float = 0.0  # Share of the print that something covers.
    noise: float = 2.0  # Of a pixel [grey levels].
    light: float = 0.3  # By how much of itself the light falls off over the image.
    around: float = 110.0  # Grey level around the print.


def photographed(print_, width_m, camera, pose, look=Look(), seed=0, corner_m=(0.0, 0.0)):
    """(h, w) grey picture of a print (h, w), of that width, its corner at `corner_m`."""
    rng = np.random.default_rng([seed, 7])
    w, h = camera.resolution
    matrix = np.diag([*camera.matrix[:2], 1.0])
    matrix[:2, 2] = camera.matrix[2:]
    texel = width_m / print_.shape[1]
    size = np.array(print_.shape[::-1]) * texel
    # Of texels finer than sub-pixels some would be left out, and edges along rows be 0.04 px off: a
    # pixel sees most texels where the print is slanted most.
    corners = np.pad(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size + corner_m, ((0, 0), (0, 1)))
    corners = corners @ pose[:3, :3].T + pose[:3, 3]
    slants = np.abs(corners @ pose[:3, 2]) / np.linalg.norm(corners, axis=1)
    seen_m = (corners[:, 2] / np.maximum(slants, 0.2)).max() / camera.matrix[0]
    s = max(SAMPLES, round(float(seen_m / texel / 1.5)))
    ends = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size + np.array(corner_m)
    bounds = cv2.projectPoints(
        np.pad(ends, ((0, 0), (0, 1))),
        cv2.Rodrigues(pose[:3, :3])[0],
        pose[:3, 3],
        matrix,
        camera.distortion,
    )[0].reshape(-1, 2)
    margin = 12 + 4 * look.disc_px + 0.1 * np.ptp(bounds, axis=0).max()
    low = np.clip(np.floor(bounds.min(axis=0) - margin), 0, [w, h]).astype(int)
    high = np.clip(np.ceil(bounds.max(axis=0) + margin), 0, [w, h]).astype(int)
    steps = (np.arange(s) + 0.5) / s - 0.5
    u = (np.arange(low[0], high[0])[:, None] + steps).ravel()
    v = (np.arange(low[1], high[1])[:, None] + steps).ravel()
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-10)
    rays = cv2.undistortPointsIter(px, matrix, camera.distortion, None, None, criteria)
    rays = np.concatenate([rays[:, 0], np.ones((len(px), 1))], axis=1)
    paper = np.pad(print_.astype(np.float32), 2, mode="edge")
    covers = _covers(rng, look.covered, size, corner_m)
    total, moments = 0.0, 31 if look.twist else 1
    for k in range(moments):
        moved_pose = pose
        if look.twist:
            at = (k + 0.5) / moments - 0.5
            turn, place = np.eye(4), at * np.array(look.twist)
            turn[:3, :3] = Rotation.from_rotvec(place[3:]).as_matrix()
            turn[:3, 3] = place[:3]
            moved_pose = turn @ pose
        hit = rays @ np.linalg.inv(np.column_stack([moved_pose[:3, :2], moved_pose[:3, 3]])).T
        on = hit[:, :2] / hit[:, 2:] - corner_m
        at = (on / texel - 0.5 + 2).astype(np.float32).reshape(len(v), len(u), 2)
        grey = cv2.remap(
            paper, at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
        )
        off = ((on < 0) | (on > size)).any(axis=1).reshape(grey.shape)
        grey[off] = look.around
        total = total + grey
    picture = total / moments
    if covers is not None:
        # The cover stands before the camera, and does not move with the print.
        hit = rays @ np.linalg.inv(np.column_stack([pose[:3, :2], pose[:3, 3]])).T
        on = hit[:, :2] / hit[:, 2:]
        for polygon, grey in covers:
            inside = _inside(on, polygon)
            texture = grey + 25 * np.sin(on[inside, 0] * 900 + on[inside, 1] * 400)
            picture[inside.reshape(picture.shape)] = texture
    picture = cv2.GaussianBlur(picture, (0, 0), look.gauss_px * s, borderType=cv2.BORDER_REPLICATE)
    if look.disc_px:
        radius = look.disc_px * s
        reach = int(np.ceil(radius)) + 1
        grid = np.arange(-reach, reach + 1)
        fine = np.clip(radius + 0.5 - np.hypot(grid, grid[:, None]), 0, 1)
        picture = cv2.filter2D(picture, -1, fine / fine.sum(), borderType=cv2.BORDER_REPLICATE)
    part = picture.reshape(high[1] - low[1], s, high[0] - low[0], s).mean(axis=(1, 3))
    whole = np.full((h, w), look.around)
    whole[low[1] : high[1], low[0] : high[0]] = part
    fall = np.linspace(1, 1 - look.light, w)[None] * np.linspace(1, 1 - look.light / 3, h)[:, None]
    whole = 10 + 0.85 * whole * fall + rng.normal(0, look.noise, whole.shape)
    return np.clip(np.rint(whole), 0, 255).astype(np.uint8)


def _covers(rng, share, size, corner_m):
    """Polygons on the print that cover a share of it, and their grey levels."""
    if not share:
        return None
    count = int(rng.integers(1, 4))
    parts = rng.dirichlet(np.full(count, 4.0)) * share
    found = []
    for part in parts:
        side = np.sqrt(part * size[0] * size[1])
        middle = rng.uniform(0.1, 0.9, 2) * size + corner_m
        turn = rng.uniform(0, np.pi)
        square = (
            side * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * [1.4, 1 / 1.4]
        )
        turned = square @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        found.append((turned + middle, float(rng.uniform(40, 220))))
    return found


def _inside(points, polygon):
    left, right = np.ones((2, len(points)), dtype=bool)
    for (x, y), (along_x, along_y) in zip(
        polygon, np.roll(polygon, -1, axis=0) - polygon, strict=True
    ):
        cross = along_x * (points[:, 1] - y) - along_y * (points[:, 0] - x)
        left &= cross >= 0
        right &= cross <= 0
    return left | right


def photographed_cell(
    picture, described, views, seed=6, covered=0.0, paper_m=0.0, looks=(), **cell
):
    """A simulated cell's session whose board is a picture, and the cell.

    `described` is the target or its .toml; `paper_m` of the picture are around what it states;
    `looks` are those of all views, in place of every second one covered.
    """
    looks = looks or [Look(covered=covered * (at % 2)) for at in range(views)]
    wide = CAMERAS["wide"]
    # A quarter of the pixels.
    camera = replace(wide, resolution=(640, 400), matrix=wide.matrix / 2)
    target = described if isinstance(described, Target) else load_target(described)
    options = CellOptions(views=views, seed=seed, target=target, camera=camera, **cell)
    simulated = simulate(options)
    width_m = float(np.ptp(extent_m(target), axis=0)[0]) + 2 * paper_m
    images = [
        photographed(
            picture, width_m, camera, pose, look, at, (-paper_m, -paper_m)
        )
        for at, (pose, look) in enumerate(zip(simulated.cam_from_target, looks, strict=True))
    ]  # fmt: skip
    flanges = simulated.robot.base_from_flange
    camera_table = {"resolution": list(camera.resolution)}
    return Session.from_arrays(images, flanges, target, camera=camera_table), simulated
