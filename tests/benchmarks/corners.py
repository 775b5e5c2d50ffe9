"""Corners against the truth: visioncal's template and OpenCV's detectors on the same pictures.

The pictures come from `tests/rendered.py`, whose edges are exact by area and which shares nothing
with the template. On checkerboards the peers are `findChessboardCornersSB` and `cornerSubPix` from
there on, the best of three windows in each row; on ChArUco boards what `CharucoDetector` gives; on
AprilGrids `cornerSubPix` from where OpenCV reads the tags; on circles `findCirclesGrid`, and the
middles of blobs.

    PYTHONPATH=tests python tests/benchmarks/corners.py
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from results import QUICK, few, write_section
from support.boards import aprilgrid, charuco, checkerboard, circles
from support.rendered import Shot, photograph

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.boards import DetectedCorners, find_target, kind_of

PICTURES, REPEATS = few((2, 7), (1, 1))
# Columns and rows of corners differ by an odd number: the checkerboard has one numbering.
CHECKERBOARD, CHARUCO = checkerboard(8, 5), charuco(8, 6)
APRILGRID = aprilgrid(5, 4)
CIRCLES = circles(5, 9, asymmetric=True, diameter_m=0.014)
# What a side is in pixels: of tags and of rows of circles not all that squares are.
SIDES = {"aprilgrid": (30, 50, 80), "circles": (12, 20, 40)}
WINDOWS = (3, 5, 9)
# Farther off, a corner counts as an outlier [px].
OUTLIER_PX = 0.1

PLAIN = Shot(noise=2.0)
CHANGES = {
    "motion of 4 px": {"motion_px": 4.0},
    "motion of 8 px": {"motion_px": 8.0},
    "motion of 12 px": {"motion_px": 12.0},
    "gamma 0.45": {"gamma": 0.45},
    "JPEG 60": {"jpeg": 60},
    "JPEG 75": {"jpeg": 75},
    "JPEG 95": {"jpeg": 95},
    "ink spread by 1 px": {"ink_px": 1.0},
    "light falls by half": {"uneven": 0.5},
    "colour mosaic": {"bayer": True},
    "white beyond the scale": {"levels": (0.0, 330.0)},
    "tilted by 60 deg": {"tilt_deg": 60.0},
    "bent by 15 %": {"bend": 0.15},
}


def shots(kind: str) -> Iterator[tuple[str, Shot]]:
    """All rows: first squares, defocus and noise, then one change at a time."""
    sides = SIDES.get(kind, (8, 12, 20, 40, 80))
    for side, disc, noise in product(sides, (0, 2, 4, 6), (1, 4, 8)):
        yield "", replace(PLAIN, square_px=side, disc_px=disc, noise=noise)
    for words, change in CHANGES.items():
        for side in SIDES.get(kind, (12, 20, 40)):
            yield words, replace(PLAIN, square_px=side, **change)


@dataclass(frozen=True)
class Row:
    """One row of the tables."""

    words: str
    shot: Shot
    corners: int  # How many were found in all pictures.
    peer_px: float  # Rms of a coordinate, of the best of the peers.
    core_px: float  # That of the template.
    # Rms of what the corners of a picture share, of peer and template.
    bias_px: tuple[float, float]
    outliers: tuple[float, float]  # Shares farther off than `OUTLIER_PX`, of peer and template.
    left: float  # Share of corners that the template does not fit.
    nees: float  # Mean squared error of the template over its variance.

    @property
    def ratio(self) -> float:
        """The template's rms by the peer's."""
        return self.core_px / self.peer_px


def compared(target: Target, words: str, shot: Shot) -> Row | None:
    """One row; None where OpenCV finds no board."""
    errors: dict[str, list[FloatArray]] = {}
    core, left, scaled = [], [], []
    for seed in range(PICTURES):
        image, truth = photograph(target, shot, seed)
        seen = detected(image, target)
        if seen is None:
            continue
        truth = truth[seen.ids]
        for name, px in peers(image, target, seen, shot.square_px):
            errors.setdefault(name, []).append(px - truth)
        refined = kind_of(target).refine(image, target, seen.ids, seen.px)
        fitted = refined.fitted
        core.append(refined.px[fitted] - truth[fitted])
        scaled.append(core[-1] / refined.sigma_px[fitted, None])
        left.extend(~fitted)
    if not core:
        return None
    best = min(errors.values(), key=lambda error: rms(np.concatenate(error)))
    methods = (best, core)
    return Row(
        words,
        shot,
        len(left),
        *(rms(np.concatenate(group)) for group in methods),
        tuple(rms([each.mean(axis=0) for each in group]) for group in methods),
        tuple(far(np.concatenate(group)) for group in methods),
        float(np.mean(left)),
        rms(np.concatenate(scaled)) ** 2,
    )


def detected(image: Image, target: Target) -> DetectedCorners | None:
    """What OpenCV's detector gives."""
    seen = kind_of(target).search(image, target)
    return seen if isinstance(seen, DetectedCorners) else None


def peers(
    image: Image, target: Target, seen: DetectedCorners, side_px: float
) -> Iterator[tuple[str, FloatArray]]:
    """What else is made of the detected corners."""
    yield "detector", seen.px
    if target.kind == "circles":
        size, flags = (target.columns, target.rows), cv2.CALIB_CB_ASYMMETRIC_GRID
        found, centres = cv2.findCirclesGrid(image, size, flags=flags)
        if found:
            centres = centres.reshape(-1, 2)
            away = np.linalg.norm(centres[:, None] - seen.px, axis=2)
            yield "grid", centres[away.argmin(axis=0)]
    # A window that reaches a neighbour diverges by pixels.
    clear_px = {"checkerboard": 0.4, "aprilgrid": 0.4 * target.spacing}.get(target.kind, 0.0)
    for reach in WINDOWS if clear_px else ():
        if reach == WINDOWS[0] or reach < clear_px * side_px:
            start = seen.px.astype(np.float32)[:, None].copy()
            ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
            yield f"{reach}", cv2.cornerSubPix(image, start, (reach, reach), (-1, -1), ends)[:, 0]


def rms(values: FloatArray | list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def far(errors: FloatArray) -> float:
    return float(np.mean(np.linalg.norm(errors, axis=1) > OUTLIER_PX))


def table(rows: list[Row]) -> str:
    head = "| squares px | disc px | noise | else | corners | OpenCV px | core px | ratio "
    head += "| shared px | outliers | not fitted | NEES |"
    lines = [head, "| ---: | ---: | ---: | --- |" + " ---: |" * 8]
    for row in rows:
        shot, (bias, core_bias), (out, few_out) = row.shot, row.bias_px, row.outliers
        lines.append(
            f"| {shot.square_px:.0f} | {shot.disc_px:.0f} | {shot.noise:.0f} | {row.words} "
            f"| {row.corners} | {row.peer_px:.4f} | {row.core_px:.4f} | {row.ratio:.2f} "
            f"| {bias:.4f}, {core_bias:.4f} | {out:.1%}, {few_out:.1%} | {row.left:.1%} "
            f"| {row.nees:.2f} |"
        )
    ratios = [row.ratio for row in rows]
    worst, median = max(ratios), statistics.median(ratios)
    summary = f"{len(rows)} rows; ratio at most {worst:.2f}, median {median:.2f}."
    return f"{summary}\n\n" + "\n".join(lines)


def took_ms(work: Callable[[], object]) -> float:
    """Milliseconds of this thread's processor, which a busy machine does not stretch."""
    if not QUICK:
        work()
    taken = []
    for _ in range(REPEATS):
        start = time.thread_time()
        work()
        taken.append(time.thread_time() - start)
    return 1e3 * statistics.median(taken)


def speed() -> str:
    """The times of five-megapixel images."""
    lines = [
        "| board | OpenCV in the image | in half of it | the template | all of visioncal |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    boards = (checkerboard(12, 7), charuco(12, 8), aprilgrid(6, 4), circles(5, 9, asymmetric=True))
    for target in boards:
        side = 170.0 if target.kind == "aprilgrid" else 110.0
        image = np.full(few((2048, 2448), (1024, 1224)), 200, np.uint8)
        part, _ = photograph(target, replace(PLAIN, square_px=few(side, 60.0), tilt_deg=15.0), 3)
        image[: len(part), : part.shape[1]] = part
        small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        seen = detected(image, target)
        times = [
            took_ms(lambda: detected(image, target)),  # noqa: B023 - called at once
            took_ms(lambda: detected(small, target)),  # noqa: B023
            took_ms(lambda: kind_of(target).refine(image, target, seen.ids, seen.px)),  # noqa: B023
            took_ms(lambda: find_target(image, target)),  # noqa: B023
        ]
        name = f"{target.kind}, {len(seen.ids)} corners"
        lines.append(f"| {name} | " + " | ".join(f"{value:.0f} ms" for value in times) + " |")
    return "\n".join(lines)


def main() -> None:
    """Prints the tables and keeps them."""
    cv2.setNumThreads(1)
    parts = []
    for target in (CHECKERBOARD, CHARUCO, APRILGRID, CIRCLES):
        every = list(shots(target.kind))
        # With `--quick` a picture in which each kind of board is found.
        rows = [compared(target, *pair) for pair in few(every, every[24:25])]
        found = [row for row in rows if row is not None]
        missing = len(rows) - len(found)
        parts.append(
            f"**{target.kind}**; in {missing} rows more OpenCV finds no board.\n\n{table(found)}"
        )
    text = (
        f"{PICTURES} pictures a row, tilted by 25 deg, with a lens distortion of 2 %, unless the "
        "row states otherwise. Px are rms of a coordinate, `shared` is the rms of the "
        "common error of a picture's corners, outliers are errors of more than "
        f"{OUTLIER_PX} px: OpenCV's (the best peer's) first. The aim for checkerboards is a "
        "ratio of 0.65 at most, for ChArUco boards of 1. For AprilGrids `squares` are tags, for "
        "circles distances of rows; an AprilGrid's corners are those of the detected tags, "
        "of "
        f"{4 * APRILGRID.columns * APRILGRID.rows} in a picture. NEES is the template's squared "
        "error over its stated variance.\n\n" + "\n\n".join(parts)
    )
    print(text, flush=True)
    text += f"\n\nImages of 2448 x 2048 px, median processor time of one thread:\n\n{speed()}\n"
    write_section("Corners", "PYTHONPATH=tests python tests/benchmarks/corners.py", text)


if __name__ == "__main__":
    main()
