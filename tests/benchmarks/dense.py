"""What `calibrate --dense` brings in of refused images, and what it is worth to X.

Of each cell's images the first are sharp, and the others out of focus or smeared by motion.

    PYTHONPATH=tests python tests/benchmarks/dense.py [SEEDS]
"""

import statistics
from dataclasses import replace

import numpy as np
from results import few, first, wished, write_section
from support.smeared import smeared

from visioncal.calibration.pipeline import run
from visioncal.core.transforms import invert, log
from visioncal.session import MemoryImages
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.optics import wide_camera
from visioncal.simulation.options import BOARDS

SEEDS, VIEWS, SHARP = wished(8), few(14, 8), 6
BLURS = {"motion 18 px": {"motion_px": 18.0}, "defocus 9 px": {"disc_px": 9.0}}
CAMERA = wide_camera()
# A quarter of the pixels: rendering takes most of the time.
CAMERA = replace(CAMERA, resolution=(640, 400), matrix=CAMERA.matrix / 2)


def row(kind: str, words: str, blur: dict[str, float]) -> str:
    """One row: views in the fit, X's distance from the truth, and its squares over covariance."""
    found: dict[bool, list[tuple[int, float, float]]] = {False: [], True: []}
    for seed in range(SEEDS):
        options = CellOptions(
            views=VIEWS, seed=seed, blur_px=0.5, target=BOARDS[kind], camera=CAMERA
        )
        cell = simulate(options)
        sharp, poor = smeared(cell), smeared(cell, **blur)
        files = {
            view.image: (sharp if view.number < SHARP else poor).images.read(view.image)
            for view in sharp.views
        }
        session = replace(sharp, images=MemoryImages(files))
        for dense, group in found.items():
            known = run(session, dense=dense).calibration
            edge = known.edges["flange_from_cam"]
            error = log(invert(cell.transforms["flange_from_cam"]) @ edge.matrix)
            squares = float(error @ np.linalg.solve(edge.covariance, error)) / 6
            in_fit = sum(view.used for view in known.views)
            group.append((in_fit, 1e3 * float(np.linalg.norm(error[3:])), squares))
        print(kind, words, seed, found[False][-1], found[True][-1], flush=True)
    cells = []
    for group in found.values():
        views, off, squares = zip(*group, strict=True)
        rms = float(np.sqrt(np.mean(np.square(off))))
        cells.append(
            f"{statistics.mean(views):.1f} | {statistics.median(off):.3f}, {rms:.3f} "
            f"| {statistics.mean(squares):.2f}"
        )
    return f"| {kind} | {words} | {' | '.join(cells)} |"


def main() -> None:
    """Prints the table and keeps it."""
    pairs = [(kind, *blur) for kind in ("checkerboard", "charuco") for blur in BLURS.items()]
    head = "| views | X off mm: median, rms | NEES "
    lines = [
        f"| board | blur {head}{head.replace('views', 'with --dense: views')}|",
        "| --- | --- |" + " ---: |" * 6,
        *(row(*pair) for pair in first(pairs)),
    ]
    text = (
        f"{SEEDS} cells a row of {VIEWS} views, 640 x 400 px, {SHARP} of them sharp; robots repeat "
        "as they do. NEES is the squared error of X over its covariance and six.\n\n"
        + "\n".join(lines)
        + "\n"
    )
    print(text)
    write_section("Dense corners", "PYTHONPATH=tests python tests/benchmarks/dense.py", text)


if __name__ == "__main__":
    main()
