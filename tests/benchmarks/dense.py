"""Corners by all pixels around them (`calibrate --dense`), and what they are worth to X.

The pictures of the first tables are those of `corners.py`, by a renderer that shares nothing with
what is fitted. X is calibrated in three worlds of simulated cells: sharp, defocused, and smeared by
motion; with the corners of OpenCV, those of the template, and those by all pixels.

    PYTHONPATH=tests python tests/benchmarks/dense.py [SEEDS]
"""

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from corners import CHARUCO, CHECKERBOARD, detected, peers, rms, shots
from results import few, first, need, wished, write_section
from support.boards import charuco
from support.cells import calibrated, error_of, reporting, session_of
from support.rendered import Shot, photograph
from support.smeared import smeared

from visioncal.calibration.stages.dense import Dense, fit_densely
from visioncal.calibration.stages.detect import find_corners, image_of
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.estimation.viewnoise import weights_by_view
from visioncal.session import MemoryImages
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.vision.finders.board import find_board
from visioncal.vision.finders.template import refine

need("torch", "'visioncal[dense]'")
need("kornia", "'visioncal[dense]'")

from visioncal.vision.dense.fit import fit_corners  # noqa: E402 - where the extra is missing, it ends above

PICTURES, SEEDS = few(2, 1), wished(20)
WORLDS = {"sharp": {}, "defocus 3 px": {"disc_px": 3.0}, "motion 6 px": {"motion_px": 6.0}}
KINDS = ("OpenCV", "template", "dense")
NOISES_MM = (0.03, 0.0)
VIEWS = few(16, 8)
LARGEST_PX = 80
# What the session's sample of images chooses by their scatter, each picture chooses here.
SMOOTH_PX, HELPS = 0.7, 0.95


@dataclass(frozen=True)
class Row:
    """One row of a table of corners.

    Attributes:
        rms_px: Of a coordinate: the best of OpenCV's, the template's, and by all pixels.
        nees: Mean squared error over the variance, as stated.
        squares: By picture, what a pose leaves of the squared errors over the stated variance.
        freedom: Their degrees of freedom.
        errors: By picture, mean squared error over the stated variance.
    """

    words: str
    shot: Shot
    rms_px: tuple[float, float, float]
    nees: float
    squares: tuple[float, ...]
    freedom: tuple[float, ...]
    errors: tuple[float, ...]


def compared(target: Target, words: str, shot: Shot) -> Row | None:
    """One row; None where OpenCV finds no board."""
    peer: dict[str, list[FloatArray]] = {}
    core, dense, scaled, squares, freedom = [], [], [], [], []
    for seed in range(PICTURES):
        image, truth = photograph(target, shot, seed)
        seen = detected(image, target)
        if seen is None:
            continue
        start = refine(image, target, seen.ids, seen.px)
        given = (image, target, seen.ids, start.px, start.blur_px)
        fits = [fit_corners(*given, smooth_px=value) for value in (0.0, SMOOTH_PX)]
        if None in fits:
            continue
        fit = fits[fits[1].scatter_px < HELPS * fits[0].scatter_px]
        for name, px in peers(image, target, seen, shot.square_px):
            peer.setdefault(name, []).append((px - truth[seen.ids])[fit.fitted])
        core.append((start.px - truth[seen.ids])[fit.fitted])
        dense.append((fit.px - truth[seen.ids])[fit.fitted])
        scaled.append(dense[-1] / fit.sigma_px[fit.fitted, None])
        # What a calibration's poses leave of the errors: six unknowns a view.
        places = np.column_stack([np.ones(len(fit.px)), fit.px - fit.px.mean(axis=0)])[fit.fitted]
        left = scaled[-1] - places @ np.linalg.lstsq(places, scaled[-1], rcond=None)[0]
        squares.append(float(np.sum(left**2)))
        freedom.append(left.size - 6.0)
    if not core or min(freedom) <= 0:
        return None
    best = min(rms(np.concatenate(group)) for group in peer.values())
    return Row(
        words,
        shot,
        (best, rms(np.concatenate(core)), rms(np.concatenate(dense))),
        rms(np.concatenate(scaled)) ** 2,
        tuple(squares),
        tuple(freedom),
        tuple(rms(value) ** 2 for value in scaled),
    )


def table(rows: list[Row]) -> str:
    """The table of one kind of board, and what it amounts to."""
    head = "| squares px | disc px | noise | else | OpenCV px | template px | dense px | ratio "
    head += "| NEES |"
    lines = [head, "| ---: | ---: | ---: | --- |" + " ---: |" * 5]
    for row in rows:
        shot, (peer, core, dense) = row.shot, row.rms_px
        lines.append(
            f"| {shot.square_px:.0f} | {shot.disc_px:.0f} | {shot.noise:.0f} | {row.words} "
            f"| {peer:.4f} | {core:.4f} | {dense:.4f} | {dense / peer:.2f} | {row.nees:.2f} |"
        )
    ratios = [row.rms_px[2] / row.rms_px[0] for row in rows]
    by_core = statistics.median(row.rms_px[2] / row.rms_px[1] for row in rows)
    squares, freedom, errors = (
        np.concatenate([getattr(row, name) for row in rows])
        for name in ("squares", "freedom", "errors")
    )
    weights = weights_by_view(squares, freedom)
    weights = np.ones(len(squares)) if weights is None else weights
    # The typical view's variance, and each one's by its weight.
    typical = np.exp(np.mean(np.log(squares / freedom)))
    nees = errors * weights**2 / typical
    inside = np.mean((nees > 0.8) & (nees < 1.3))
    summary = (
        f"{len(rows)} rows; dense over OpenCV at most {max(ratios):.2f}, median "
        f"{statistics.median(ratios):.2f}; over the template's median {by_core:.2f}. NEES by view "
        f"with the factor of its residuals: mean {np.mean(nees):.2f}, median "
        f"{np.median(nees):.2f}, {inside:.0%} of {len(nees)} views within 0.8 to 1.3."
    )
    return f"{summary}\n\n" + "\n".join(lines)


def corners_by_kind(session) -> dict[str, dict[int, Corners]]:
    """What OpenCV, the template, and all pixels find in a session's images."""
    target, images = (
        session.target,
        {view.number: image_of(session, view) for view in session.views},
    )
    plain, fine = {}, {}
    for view, image in images.items():
        seen, found = detected(image, target), find_corners(image, target, view)[0]
        if seen is not None and isinstance(found, Corners):
            plain[view], fine[view] = Corners(view, seen.ids, seen.px, found.blur_px), found
    dense = fit_densely(session, session.views, fine, Dense("cpu"))[0]
    return dict(zip(KINDS, (plain, fine, dense), strict=True))


def errors_mm(
    cell: SimulatedCell, kinds: dict[str, dict[int, Corners]]
) -> Iterator[tuple[str, float, float]]:
    """X's distance from the truth, by kind of corners and by the robot's noise."""
    for noise in NOISES_MM:
        poses = cell.robot.base_from_flange if noise else cell.robot.true_base_from_flange
        for kind, corners in kinds.items():
            known = calibrated(
                reporting(cell, base_from_flange=poses, corners=tuple(corners.values())),
                joints=False,
            )
            yield kind, noise, 1e3 * float(np.linalg.norm(error_of(cell, known)[3:6]))


def worlds() -> str:
    """X in three worlds."""
    lines = [
        "| world | robot's noise mm | "
        + " | ".join(f"{kind}: median, rms mm" for kind in KINDS)
        + " |",
        "| --- | ---: |" + " ---: |" * len(KINDS),
    ]
    for world, blur in first(list(WORLDS.items())):
        found: dict[tuple[float, str], list[float]] = {}
        for seed in range(SEEDS):
            # The robot's noise is that of the options or none; blur comes afterwards.
            cell = simulate(replace(CellOptions(), views=VIEWS, seed=seed, blur_px=0.5))
            for kind, noise, error in errors_mm(cell, corners_by_kind(smeared(cell, **blur))):
                found.setdefault((noise, kind), []).append(error)
            print(world, seed, {key: round(values[-1], 4) for key, values in found.items()})
        for noise in NOISES_MM:
            cells = [
                f"{statistics.median(group):.4f}, {rms(group):.4f}"
                for group in (found[noise, kind] for kind in KINDS)
            ]
            lines.append(f"| {world} | {noise:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def speed() -> str:
    """Seconds for 16 views of 1280 x 800."""
    target = charuco(12, 8)
    cell = simulate(replace(CellOptions(), views=VIEWS, seed=1))
    session, files, found = session_of(cell), {}, {}
    for view in session.views:
        image = np.full((800, 1280), 200, np.uint8)
        part = photograph(target, Shot(square_px=few(60.0, 20.0), motion_px=3.0), view.number)[0]
        part = part[:800, :1280]
        image[: len(part), : part.shape[1]] = part
        files[view.image] = cv2.imencode(".png", image)[1].tobytes()
        seen = find_board(image, target)
        found[view.number] = Corners(view.number, seen.ids, seen.px, 1.0)
    session = replace(session, target=target, images=MemoryImages(files))
    start, used = time.perf_counter(), time.process_time()
    fit_densely(session, session.views, found, Dense("cpu"))
    took, used = time.perf_counter() - start, time.process_time() - used
    return (
        f"{VIEWS} views of 1280 x 800 px with {len(found[0].ids)} corners each: {took:.1f} s on "
        f"four cores that others used, too, {used:.1f} s of processor time."
    )


def main() -> None:
    """Prints the tables and keeps them."""
    parts = []
    for target in (CHECKERBOARD, CHARUCO):
        # The largest squares take half of the time and have the least to gain.
        wanted = [shot for shot in shots(target.kind) if shot[1].square_px < LARGEST_PX]
        rows = [compared(target, *pair) for pair in few(wanted, wanted[24:26])]
        found = [row for row in rows if row is not None]
        missing = len(rows) - len(found)
        parts.append(
            f"**{target.kind}**; in {missing} rows more OpenCV finds no board.\n\n{table(found)}"
        )
        print(parts[-1])
    text = (
        f"{PICTURES} pictures a row, as in the section on corners, without the largest squares; "
        "px are rms of a coordinate, OpenCV's the best of its detector and three windows of "
        "`cornerSubPix`. The aim is a ratio of 0.5 at most in all rows and of 0.35 in the "
        "median.\n\n"
        + "\n\n".join(parts)
        + f"\n\n**X**, eye-in-hand, {VIEWS} views with given intrinsics, {SEEDS} seeds: its "
        f"distance from the truth.\n\n{worlds()}\n\n{speed()}\n"
    )
    print(text)
    write_section("Dense corners", "PYTHONPATH=tests python tests/benchmarks/dense.py", text)


if __name__ == "__main__":
    main()
