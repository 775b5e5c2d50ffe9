"""Poses of flat prints by all pixels, beside corners and OpenCV's `findTransformECC`.

The images come from `tests/support/printed.py`: rays of 3 x 3 sub-pixels through OpenCV's lens,
true sub-poses of a motion, covers, light and noise; boards are drawn by OpenCV. Nothing of that is
shared with what registers them. Errors are of the print's middle and of its turn.

    PYTHONPATH=tests python tests/benchmarks/register.py [VIEWS]
    PYTHONPATH=tests python tests/benchmarks/register.py picks [SEEDS]
    PYTHONPATH=tests python tests/benchmarks/register.py sessions [SEEDS]
    PYTHONPATH=tests python tests/benchmarks/register.py hard [VIEWS]
"""

import base64
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from unittest.mock import patch

import cv2
import numpy as np
from results import WORDS, few, wished, write_section
from scipy.spatial.transform import Rotation
from support.misfits import misfit
from support.printed import PICTURES, Look, photographed, photographed_cell, pose_at

from visioncal import calibrate
from visioncal.core.types import Camera, FloatArray, Image, Target
from visioncal.simulation import CAMERAS
from visioncal.vision.boards import DetectedCorners, find_target
from visioncal.vision.boards import picture as of_pictures
from visioncal.vision.camera import project
from visioncal.vision.dense import drawn_print
from visioncal.vision.hard_matches import is_installed
from visioncal.vision.register.fit import Registered, register
from visioncal.vision.register.image_model import Print, Seen
from visioncal.vision.targets import corner_positions, target_from_document

# 1.3 MP.
CAMERA = replace(
    CAMERAS["wide"], resolution=(1280, 1024), matrix=CAMERAS["wide"].matrix + np.eye(4)[3] * 112
)
# What a calibration of few views leaves: of the focal length, the centre [px] and k1.
LENS_SIGMA = np.array([0.4, 0.5, 0.5, 0.002])


@dataclass(frozen=True)
class Row:
    """A print and how it is photographed; so many mm and deg is the start off."""

    words: str
    kind: str  # `charuco` or one of `PICTURES`.
    width_m: float
    distance_m: tuple[float, float]
    look: Look
    columns: int = 0
    motion_px: float = 0.0
    off: tuple[float, float] = (0.3, 0.05)
    # Half and whole sizes; motions and wide blurs have nothing finer than the half.
    factors: tuple[int, ...] = (2, 1)


ROWS = (
    Row("ChArUco 300 mm", "charuco", 0.3, (0.40, 0.52), Look(covered=0.15), 9),
    Row("ChArUco 100 mm", "charuco", 0.1, (0.28, 0.34), Look(covered=0.15), 6),
    Row("ChArUco 25 mm", "charuco", 0.025, (0.11, 0.14), Look(covered=0.15), 6, off=(0.1, 0.05)),
    *(
        Row(
            f"ChArUco 300 mm, motion {px} px", "charuco", 0.3, (0.40, 0.52), Look(covered=0.15), 9,
            px, (1.0, 0.1), (4, 2, 1),
        )
        for px in (5, 10, 14)
    ),
    *(
        Row(
            f"ChArUco 300 mm, defocus {radius / 2} px", "charuco", 0.3, (0.40, 0.52),
            Look(covered=0.15, disc_px=radius), 9, 0.0, (1.0, 0.1), (4, 2, 1),
        )
        for radius in (4.0, 9.0)
    ),
    *(
        Row(kind, kind, 0.3, (0.38, 0.56), Look(covered=0.15), factors=(4, 2, 1))
        for kind in PICTURES
    ),
)  # fmt: skip


@dataclass
class Ways:
    """Errors of the ways to a pose, over the views of a row."""

    mm: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    deg: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    squared: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, way: str, pose: FloatArray, truth: FloatArray, middle: FloatArray) -> None:
        """Keeps a pose's error."""
        off = np.linalg.inv(pose) @ truth
        turn = Rotation.from_matrix(off[:3, :3]).magnitude()
        self.deg[way].append(float(np.rad2deg(turn)))
        self.mm[way].append(1e3 * float(np.linalg.norm(((pose - truth) @ middle)[:3])))

    def figures(self, way: str, views: int) -> str:
        """Medians, and in how many views it gave nothing."""
        found = self.mm[way]
        if not found:
            return "none"
        missing = f" ({len(found)} of {views})" if len(found) < views else ""
        return f"{np.median(found):.4f} / {np.median(self.deg[way]):.4f}{missing}"


@lru_cache(maxsize=64)
def made(row: Row, seed: int) -> tuple[Image, Target, Print]:
    """A print's picture, its target and what is registered."""
    if row.kind != "charuco":
        picture = PICTURES[row.kind](seed)
        document = {
            "kind": "picture",
            "width_m": row.width_m,
            # As sure as the ChArUco board's, which it stands beside.
            "square_sigma_m": 1e-6 * 9,
            "image": base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode(),
        }
        flat = Print(
            np.asarray(picture / 255, np.float32), row.width_m / picture.shape[1], np.zeros(2)
        )
        return picture, target_from_document(document, row.kind), flat
    square_m = row.width_m / row.columns
    rows = {9: 6, 6: 4}[row.columns]
    marker_m = 0.75 * square_m
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((row.columns, rows), square_m, marker_m, words)
    # White paper around it, half a square wide; a marker's cell is 30 whole pixels.
    picture = np.pad(board.generateImage((280 * row.columns, 280 * rows)), 140, constant_values=255)
    target = Target("board", "charuco", row.columns, rows, square_m, 1e-6, marker_m=marker_m,
                    dictionary="DICT_5X5_100")  # fmt: skip
    return picture, target, drawn_print(target, 160)


def paper(row: Row) -> tuple[float, float]:
    """Width of what is printed with the paper around it, and of that paper on a side [m]."""
    side_m = row.width_m / row.columns / 2 if row.columns else 0.0
    return row.width_m + 2 * side_m, side_m


def view(row: Row, seed: int) -> tuple[Image, Target, Print, FloatArray, FloatArray, FloatArray]:
    """An image, its target and print, the true pose, a start (4, 4), and the middle (4,) [m]."""
    rng = np.random.default_rng([seed, 3])
    picture, target, flat = made(row, seed if row.kind != "charuco" else 0)
    width_m, paper_m = paper(row)
    size_m = width_m * np.array([1.0, picture.shape[0] / picture.shape[1]])
    middle = np.array([*(size_m / 2 - paper_m), 0, 1])
    pose = pose_at(rng.uniform(*row.distance_m), rng.uniform(0, 35), middle[:3], rng)
    look = row.look
    if row.motion_px:
        turn = rng.uniform(0, 2 * np.pi)
        z = float((pose @ middle)[2])
        along = row.motion_px * z / CAMERA.matrix[0]
        spin = rng.normal(0, 0.2, 3) * along / row.width_m
        way = along * np.array([np.cos(turn), np.sin(turn), rng.normal(0, 0.3)])
        # A turn about the middle of the print.
        way = way - np.cross(spin, (pose @ middle)[:3])
        look = replace(look, twist=(*way.tolist(), *spin.tolist()))
    image = photographed(picture, width_m, CAMERA, pose, look, seed, (-paper_m, -paper_m))
    away = rng.normal(0, 1, (2, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    start = pose.copy()
    start[:3, :3] = (
        Rotation.from_rotvec(np.deg2rad(row.off[1]) * away[0]).as_matrix() @ pose[:3, :3]
    )
    start[:3, 3] = (pose @ middle)[:3] + 1e-3 * row.off[0] * away[1] - start[:3, :3] @ middle[:3]
    return image, target, flat, pose, start, middle


def by_points(places: FloatArray, px: FloatArray, camera: Camera) -> FloatArray | None:
    """(4, 4) pose by OpenCV, with one round of rejection."""
    matrix = np.diag([*camera.matrix[:2], 1.0])
    matrix[:2, 2] = camera.matrix[2:]
    for _ in range(2):
        if len(places) < 6:
            return None
        _, turn, place = cv2.solvePnP(places, px, matrix, camera.distortion)
        off = np.linalg.norm(
            cv2.projectPoints(places, turn, place, matrix, camera.distortion)[0][:, 0] - px, axis=1
        )
        near = off < max(4 * float(np.median(off)), 0.02)
        places, px = places[near], px[near]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], place[:, 0]
    return pose


def opencv_points(
    image: Image, target: Target, picture: Image
) -> tuple[FloatArray, FloatArray] | None:
    """Places and pixels of OpenCV's own: corners of a board, or features of a picture (SIFT)."""
    if target.kind == "charuco":
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        size = (target.columns, target.rows)
        board = cv2.aruco.CharucoBoard(size, target.square_m, target.marker_m, words)
        px, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < 6:
            return None
        return board.getChessboardCorners()[ids[:, 0]].astype(float), px[:, 0].astype(float)
    sift = cv2.SIFT.create(3000)
    (kept, known), (seen, described) = (
        sift.detectAndCompute(grey, None) for grey in (picture, image)
    )
    pairs = cv2.BFMatcher().knnMatch(described, known, k=2)
    good = [one for one, other in pairs if one.distance < 0.8 * other.distance]
    if len(good) < 8:
        return None
    texel = target.square_m / picture.shape[1]
    places = texel * (np.array([kept[m.trainIdx].pt for m in good]) + 0.5)
    px = np.array([seen[m.queryIdx].pt for m in good])
    _, inside = cv2.findHomography(places, px, cv2.USAC_MAGSAC, 3.0)
    taken = np.zeros(len(good), bool) if inside is None else inside[:, 0] > 0
    return np.pad(places[taken], ((0, 0), (0, 1))), px[taken]


def by_ecc(
    image: Image, row: Row, picture: Image, flat_m: tuple[float, float], start: FloatArray
) -> FloatArray | None:
    """(4, 4) pose by OpenCV's registration of the undistorted image by a homography."""
    matrix = np.diag([*CAMERA.matrix[:2], 1.0])
    matrix[:2, 2] = CAMERA.matrix[2:]
    straight = cv2.undistort(image, matrix, CAMERA.distortion)
    # At half size: it takes seconds at the whole one.
    straight = cv2.resize(straight, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = cv2.resize(
        picture, (600, 600 * picture.shape[0] // picture.shape[1]), None, 0, 0, cv2.INTER_AREA
    )
    halved = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    texel, low = flat_m[0] / small.shape[1], -flat_m[1]
    to_m = np.array([[texel, 0, texel / 2 + low], [0, texel, texel / 2 + low], [0, 0, 1]])
    warp = halved @ matrix @ start[:3, [0, 1, 3]] @ to_m
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-6)
    try:
        _, warp = cv2.findTransformECC(
            small, straight, (warp / warp[2, 2]).astype(np.float32), cv2.MOTION_HOMOGRAPHY, ends,
            None, 3,
        )  # fmt: skip
    except cv2.error:
        return None
    grid = np.stack(
        np.meshgrid(np.linspace(0, row.width_m, 9), np.linspace(0, 0.6 * row.width_m, 6)), -1
    )
    places = np.pad(grid.reshape(-1, 2), ((0, 0), (0, 1)))
    px = cv2.perspectiveTransform(
        places[None, :, :2], np.linalg.inv(halved) @ warp @ np.linalg.inv(to_m)
    )[0]
    return by_points(places, px, replace(CAMERA, distortion=np.zeros(5)))


def squared(found: Registered, truth: FloatArray) -> float:
    """Squared error over covariance, per component of the pose."""
    off = np.linalg.inv(found.seen.cam_from_target) @ truth
    error = np.concatenate([Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]])
    return float(error @ np.linalg.solve(found.covariance[:6, :6], error)) / 6


def measured(row: Row, views: int) -> Ways:
    """All ways on the views of a row."""
    ways = Ways()
    is_rough = bool(row.motion_px or row.look.disc_px)
    for seed in range(views):
        # Half of the prints are covered.
        seen = replace(row, look=replace(row.look, covered=row.look.covered * (seed % 2)))
        seen = row if row.kind == "charuco" else seen
        image, target, flat, truth, start, middle = view(seen, seed)
        picture = made(row, seed if row.kind != "charuco" else 0)[0]
        rng = np.random.default_rng([seed, 9])
        draw = LENS_SIGMA * rng.normal(size=4)
        wrong = replace(
            CAMERA, matrix=CAMERA.matrix + draw[[0, 0, 1, 2]],
            distortion=CAMERA.distortion + draw[3] * np.eye(5)[0],
        )  # fmt: skip
        points = opencv_points(image, target, picture)
        if points is not None:
            pose = by_points(*points, CAMERA)
            if pose is not None:
                ways.add("opencv", pose, truth, middle)
        begun = time.thread_time()
        corners = find_target(image, target)
        ways.seconds["find"].append(time.thread_time() - begun)
        if isinstance(corners, DetectedCorners):
            places = corner_positions(target)[corners.ids]
            for way, camera in (("own", CAMERA), ("own, lens off", wrong)):
                pose = by_points(places, corners.px, camera)
                if pose is not None:
                    ways.add(way, pose, truth, middle)
        pose = by_ecc(image, row, picture, paper(row), start)
        if pose is not None:
            ways.add("ecc", pose, truth, middle)
        for way, camera, sigma in (
            ("registered", CAMERA, None), ("registered, lens off", wrong, LENS_SIGMA),
        ):  # fmt: skip
            begun = time.thread_time()
            found = register(
                image, flat, camera, Seen(start), lens_sigma=sigma, moving=row.motion_px > 0,
                factors=row.factors, rough=is_rough,
            )  # fmt: skip
            ways.seconds[way].append(time.thread_time() - begun)
            if found is not None:
                ways.add(way, found.seen.cam_from_target, truth, middle)
                ways.squared[way].append(squared(found, truth))
    return ways


def lines(rows: Sequence[Row], views: int) -> Iterator[str]:
    """The table, row by row."""
    head = "| print | OpenCV | visioncal's corners | ECC | registered | sq. error / cov. "
    yield f"{head}| corners, lens off | registered, lens off | sq. error / cov. | s |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for row in rows:
        ways = measured(row, views)
        figures = [ways.figures(way, views) for way in ("opencv", "own", "ecc", "registered")]
        ratios = []
        for way in ("registered", "registered, lens off"):
            values = ways.squared[way] or [np.nan]
            ratios.append(f"{np.mean(values):.2f}, {np.median(values):.2f}")
        off = [ways.figures(way, views) for way in ("own, lens off", "registered, lens off")]
        took = [f"{np.median(ways.seconds[way]):.2f}" for way in ("find", "registered")]
        yield (
            f"| {row.words} | "
            + " | ".join([*figures, ratios[0], *off, ratios[1], ", ".join(took)])
            + " |"
        )


def picks(seeds: int) -> None:
    """Picks half a metre before a camera that was calibrated by a print, its lens unknown."""
    kinds, tables = ("charuco", *PICTURES), list[str]()
    errors, ratios, seconds = (defaultdict[str, list[float]](list) for _ in range(3))
    views: dict[str, int] = defaultdict(int)
    for seed in range(seeds):
        for kind in kinds:
            row = Row(kind, kind, 0.3, (0, 0), Look(), 9 if kind == "charuco" else 0)
            picture, target, _ = made(row, seed if kind != "charuco" else 0)
            session, cell = photographed_cell(
                picture, target, 10, seed, covered=0.15, paper_m=paper(row)[1]
            )
            begun = time.process_time()
            result = calibrate(session)
            seconds[kind].append((time.process_time() - begun) / 10)
            edge, truth = result.edges["flange_from_cam"], cell.transforms["flange_from_cam"]
            at = np.array([0, 0, 0.5, 1])
            errors[kind].append(1e3 * float(np.linalg.norm(((edge.matrix - truth) @ at)[:3])))
            ratios[kind].append(float(misfit(edge, truth)) / 6)
            views[kind] += sum(view.used for view in result.views)
            print(seed, kind, errors[kind][-1], ratios[kind][-1], flush=True)
    board = float(np.sqrt(np.mean(np.square(errors["charuco"]))))
    for kind in kinds:
        rms = float(np.sqrt(np.mean(np.square(errors[kind]))))
        tables.append(
            f"| {kind} | {rms:.3f} | {np.median(errors[kind]):.3f} | {rms / board:.2f} | "
            f"{np.mean(ratios[kind]):.2f} | {views[kind]} of {10 * seeds} | "
            f"{np.median(seconds[kind]):.2f} |"
        )
    text = (
        f"{seeds} cells a row of 10 views of 640 x 400 px, every second one 15 % covered, prints "
        "of 300 mm, the lens unknown. Pick errors at 0.5 m, beside a ChArUco board's in the same "
        "cells; squared errors of X over covariance per component. s: processor time a view, "
        "all of `calibrate`.\n\n| print | rms mm | median mm | ratio | sq. error / cov. | views | "
        "s |\n| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
    )
    command = "PYTHONPATH=tests python tests/benchmarks/register.py picks"
    write_section("Picks by pictures", command, text + "\n".join(tables))


def sessions(seeds: int) -> None:
    """Sessions, a third of whose views is far out of focus: X without these views, and by them."""
    row = Row("charuco", "charuco", 0.3, (0, 0), Look(), 9)
    picture, target, _ = made(row, 0)
    found = {dense: list[list[float]]() for dense in (False, True)}
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 5])
        looks = [Look(disc_px=rng.uniform(7, 12) if at % 3 == 1 else 0.0) for at in range(12)]
        session, cell = photographed_cell(
            picture, target, 12, seed, paper_m=paper(row)[1], looks=looks
        )
        for dense, rows in found.items():
            result = calibrate(session, dense=dense)
            edge, truth = result.edges["flange_from_cam"], cell.transforms["flange_from_cam"]
            off = (edge.matrix - truth) @ np.array([[0, 0], [0, 0], [0.5, 0], [1, 1]])
            sigma_mm = 1e3 * float(np.sqrt(np.trace(edge.covariance[3:, 3:])))
            used = sum(view.used for view in result.views)
            of_mm = (1e3 * np.linalg.norm(off[:3], axis=0)).tolist()
            rows.append([*of_mm, sigma_mm, float(misfit(edge, truth)) / 6, used])
            print(seed, dense, *rows[-1], flush=True)
    tables = []
    for dense, rows in found.items():
        picked, x, sigma = np.sqrt(np.mean(np.square(rows), axis=0)).tolist()[:3]
        ratio, used = np.mean(rows, axis=0).tolist()[3:]
        way = "by them (`--dense`)" if dense else "without them"
        tables.append(f"| {way} | {used:g} | {x:.3f} | {sigma:.3f} | {ratio:.2f} | {picked:.3f} |")
    text = (
        f"{seeds} cells of 12 views of 640 x 400 px of a ChArUco board of 300 mm, the lens "
        "unknown; four views are at rest and out of focus by a disc of 7 to 12 px radius, a third "
        "of a square. Errors of the camera and of picks at 0.5 m, rms in mm; squared errors of X "
        "over covariance per component.\n\n| the four views | used | camera | sigma | sq. error / "
        "cov. | picks |\n| --- | ---: | ---: | ---: | ---: | ---: |\n"
    )
    command = "PYTHONPATH=tests python tests/benchmarks/register.py sessions"
    write_section("Sessions with blurred views", command, text + "\n".join(tables))


def hard(views: int) -> None:
    """Prints that are tilted by 40 to 70 deg and covered by 30 %, found by several features."""
    ways = ("SIFT, OpenCV", "SIFT", "AdaLAM") if is_installed() else ("SIFT, OpenCV", "SIFT")
    found = {(kind, way): list[bool]() for kind in PICTURES for way in ways}
    for at in range(views):
        kind = list(PICTURES)[at % len(PICTURES)]
        row = Row(kind, kind, 0.3, (0.38, 0.56), Look(covered=0.3))
        rng = np.random.default_rng([at, 7])
        picture, target, _ = made(row, at)
        middle = np.array([0.15, 0.15 * picture.shape[0] / picture.shape[1], 0.0])
        pose = pose_at(rng.uniform(*row.distance_m), rng.uniform(40, 70), middle, rng)
        image = photographed(picture, row.width_m, CAMERA, pose, row.look, at)
        places = corner_positions(target)
        true = project(CAMERA, places @ pose[:3, :3].T + pose[:3, 3])
        for way in ways:
            if way == "SIFT, OpenCV":
                seen = opencv_points(image, target, picture)
                by_features = None if seen is None else by_points(*seen, CAMERA)
                is_found = by_features is not None and bool(
                    np.linalg.norm((by_features - pose) @ [*middle, 1.0]) < 5e-3
                )
            else:
                with patch.object(of_pictures, "is_installed", lambda way=way: way == "AdaLAM"):
                    corners = find_target(image, target)
                is_found = isinstance(corners, DetectedCorners) and bool(
                    np.median(np.linalg.norm(corners.px - true[corners.ids], axis=1)) < 0.2
                )
            found[kind, way].append(is_found)
        print(at, kind, {way: found[kind, way][-1] for way in ways}, flush=True)
    rows = [
        f"| {kind} | " + " | ".join(f"{sum(found[kind, way])}" for way in ways)
        + f" | {len(found[kind, ways[0]])} |"
        for kind in PICTURES
    ]  # fmt: skip
    text = (
        f"{views} views of {CAMERA.resolution[0]} x {CAMERA.resolution[1]} px of prints of 300 mm, "
        "tilted by 40 to 70 deg, 30 % covered. Found: by OpenCV's features, ratio test and "
        "MAGSAC, with solvePnP and the true lens, to 5 mm; by all pixels after a start by SIFT's "
        "ratio test, and by AdaLAM on the same features where that fails, to 0.2 px. LightGlue "
        "has no weights here.\n\n| print | "
        + " | ".join(ways) + " | of |\n|" + " --- |" * (len(ways) + 2) + "\n"
    )  # fmt: skip
    command = "PYTHONPATH=tests python tests/benchmarks/register.py hard"
    write_section("Hard views of pictures", command, text + "\n".join(rows))


def main() -> None:
    """Prints the tables and keeps each as soon as it is whole."""
    cv2.setNumThreads(1)
    for measure, count in ((picks, 12), (sessions, 12), (hard, 24)):
        if measure.__name__ in WORDS:
            measure(int(WORDS[1]) if len(WORDS) > 1 else few(count, 1))
            return
    views = wished(16)
    text = (
        f"{views} views a row of {CAMERA.resolution[0]} x {CAMERA.resolution[1]} px, boards 15 % "
        "covered, of pictures every second one. Medians of the views in which a way gave a pose, "
        "mm / deg of the print's middle and turn. OpenCV: its ChArUco detector, or SIFT and "
        "MAGSAC, and solvePnP, with the true lens; ECC: `findTransformECC` at half size. "
        "Where the lens is off (a focal length by 0.4 px, a centre by 0.5 px and k1 by 0.002, "
        "drawn view by view), registration estimates it with these sigmas. Squared errors over "
        "covariances are per component: mean, median. s: median processor time of one thread, to "
        "find the print and to register it.\n\n"
    )
    blurred = [row for row in ROWS if row.motion_px or row.look.disc_px]
    sharp = [row for row in ROWS if row not in blurred]
    for name, rows in (("Flat prints", sharp), ("Blurred prints", blurred)):
        kept = []
        for line in lines(few(rows, rows[1:2]), views):
            print(line, flush=True)
            kept.append(line)
        command = "PYTHONPATH=tests python tests/benchmarks/register.py"
        write_section(f"{name} by all pixels", command, text + "\n".join(kept))


if __name__ == "__main__":
    main()
