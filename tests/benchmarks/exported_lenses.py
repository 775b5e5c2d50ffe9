"""Lenses with a field: as programs see with them that know coefficients alone, and later stops.

    PYTHONPATH=tests python tests/benchmarks/exported_lenses.py [SEEDS]

Cells are those of `elsewhere.py`. Rays of all corners' pixels, turned into the flange by the
camera's transform, are compared with the true ones: by the fit's own matrix and coefficients, by
those that an export has, and by lens and field together. Then eight later stops of a cell in which
nothing has changed are verified, with the field of the calibration and without.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import elsewhere
import numpy as np
from results import first, wished, write_section

import visioncal
from visioncal.core.types import Camera
from visioncal.results.lens import fit_coefficients
from visioncal.vision.camera import normalise

SEEDS = 6
ROWS = [
    (world, given)
    for world in ("field 0.1 px", "clean", "field 0.03 px", "field 0.2 px")
    for given in (True, False)
]

LATER = [
    (world, mount, given)
    for world in ("field 0.1 px", "clean", "field 0.2 px", "breathing 0.3 %")
    for mount in ("eye-in-hand", "eye-to-hand")
    for given in (True, False)
]


def true_rays(case: elsewhere.Case, px: np.ndarray) -> np.ndarray:
    """(n, 2) rays at unit depth that the world's lens shows at (n, 2) pixels."""
    focal = elsewhere.MATRIX[[0, 1], [0, 1]]
    rays = (px - elsewhere.MATRIX[:2, 2]) / focal
    for _ in range(10):
        shown = elsewhere.seen(np.column_stack([rays, np.ones(len(rays))]), case.shift)
        rays = rays + (px - shown) / focal
    return rays


def tried(world: str, given: bool, seed: int, folder: Path) -> list[float]:
    """RMS of rays [px] by the fit's lens, the export's, and lens and field; and what is said."""
    case = elsewhere.cell(elsewhere.WORLDS[world], "eye-in-hand", given, seed, folder)
    result = visioncal.calibrate(visioncal.Session.load(folder))
    px, lens = np.concatenate(case.pixels), result.camera
    rays = true_rays(case, px)
    turn = case.x[:3, :3].T @ result.edges["flange_from_cam"].matrix[:3, :3]

    def off_px(camera: Camera, shown: np.ndarray) -> float:
        found = np.column_stack([normalise(camera, shown), np.ones(len(shown))]) @ turn.T
        away = (found[:, :2] / found[:, 2:] - rays) * elsewhere.MATRIX[[0, 1], [0, 1]]
        return float(np.sqrt(np.mean(away**2)))

    plain = fit_coefficients(lens)
    return [
        off_px(lens.camera, px),
        off_px(plain.camera, px),
        off_px(lens.camera, lens.in_model(px)),
        plain.rms_px,
    ]


def row(world: str, given: bool, seeds: int) -> str:
    """One line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        found = [tried(world, given, index, Path(folder) / str(index)) for index in range(seeds)]
    figures = " | ".join(f"{value:.3f}" for value in np.median(found, axis=0))
    return f"| {world} | {'given' if given else 'estimated'} | {figures} |"


def verified(world: str, given: bool, mount: str, seed: int, folder: Path) -> list[float]:
    """Misfit over its mean of later stops, and whether they fail; without the field, and with."""
    cell = replace(elsewhere.WORLDS[world], views=30)
    case = elsewhere.cell(cell, mount, given, seed, folder / "all")
    lens = case.given if given else None
    for name, rows in (("first", slice(22)), ("later", slice(22, None))):
        elsewhere.write(folder / name, mount, lens, case.robot[rows], case.pixels[rows])
    result = visioncal.calibrate(visioncal.Session.load(folder / "first"))
    later = visioncal.Session.load(folder / "later")
    bare = replace(result, camera=replace(result.camera, field=None))
    found = [visioncal.verify(later, calibration) for calibration in (bare, result)]
    return [value for check in found for value in (check.misfit / check.freedom, not check.passed)]


def later_row(world: str, mount: str, given: bool, seeds: int) -> str:
    """One line of the second table."""
    with tempfile.TemporaryDirectory() as folder:
        found = [
            verified(world, given, mount, index, Path(folder) / str(index))
            for index in range(seeds)
        ]
    before, failed_before, now, failed = np.sum(found, axis=0)
    return (
        f"| {world} | {mount} | {'given' if given else 'estimated'} | {before / seeds:.2f} "
        f"| {failed_before:.0f} of {seeds} | {now / seeds:.2f} | {failed:.0f} of {seeds} |"
    )


def main(seeds: int) -> None:
    """Prints the table and keeps it."""
    text = "\n".join(
        [
            f"RMS of rays [px], medians of {seeds}: with matrix and coefficients of the fit,",
            "with those of exports, with lens and field; and the remaining error that an",
            "export states.",
            "",
            "| world | lens | fit | exported | lens and field | said |",
            "| --- | --- | ---: | ---: | ---: | ---: |",
            *(row(*pair, seeds) for pair in first(ROWS)),
            "",
            "Eight later stops without a change: squared distance from the prediction over its",
            "mean, and how often `verify` fails, without and with the field.",
            "",
            "| world | mount | lens | without | fails | with | fails |",
            "| --- | --- | --- | ---: | ---: | ---: | ---: |",
            *(later_row(*pair, seeds) for pair in first(LATER)),
        ]
    )
    command = f"PYTHONPATH=tests python tests/benchmarks/exported_lenses.py {seeds}"
    write_section("Lenses exported", command, text)


if __name__ == "__main__":
    main(wished(SEEDS))
