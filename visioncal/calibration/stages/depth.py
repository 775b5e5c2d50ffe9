"""Whether a camera's depth is true: its distances against the board's plane by its own images.

Distances of the board's white in small cells are compared with the plane of the board's pose by the
view's own corners, in which there is no noise of the robot. By generalised least squares the
deviations give the model of `DepthResult`; the noise of a view's corners and the errors of lens and
board have their covariance, and the offset and tilt of each view by the sensor are random effects,
whose variances are estimated by REML (Patterson and Thompson 1971). Only what a calibration says of
itself is used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares, nnls

from visioncal.calibration.stages.depth_cells import FEWEST_CELLS, GATE, Cells, Sensor
from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import counted, figure, view_words
from visioncal.core.quantiles import FALSE_ALARM, SIGMA_PER_MAD, chi2_limit
from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import DEPTH_CHANGED, NOTE, Finding, Remedy
from visioncal.fit.mixed import Estimate, Mixed, Term, prior_term
from visioncal.fit.sizes import most_likely
from visioncal.results import Calibration
from visioncal.results.depth import DepthResult, bending
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session, View
from visioncal.session.selecting import Choice
from visioncal.vision.camera import project


def fit_mixed(
    excess: FloatArray, fixed: FloatArray, known: FloatArray, views: FloatArray, noise: FloatArray
) -> Estimate:
    """Fits fixed effects beside random ones, of which some variances are estimated by REML.

    Args:
        excess: (n,) observations.
        fixed: (n, p) columns of fixed effects.
        known: (n, q) columns of random effects with unit variance.
        views: (n, 3 v) columns of each view's own offset and two tilts.
        noise: (n,) relative standard deviations of the observations.

    Returns:
        The estimate of all columns, by sizes of the noise and of the views' offset and tilt.
    """
    table = np.column_stack([fixed, known, views, excess]) / noise[:, None]
    count = table.shape[1] - 1
    _, randoms, view_columns = np.split(
        np.arange(count), np.cumsum([fixed.shape[1], known.shape[1]])
    )
    groups = ((-1, randoms), (1, view_columns[::3]), (2, np.delete(view_columns, np.s_[::3])))
    terms = [prior_term(size, of, np.zeros(len(of)), 1.0) for size, of in groups]
    every = Term(0, len(table), np.arange(count), table.T @ table)
    mixed = Mixed((every, *terms), (), count, 3)
    # From a tenth of a millimetre on; less than a micrometre is none.
    logs, low, high = np.log([[0.3, 1e-4, 1e-4], [1e-3, 1e-6, 1e-6], [30.0, 0.1, 0.1]])
    for _ in range(3):
        logs = (found := most_likely(mixed, logs, low, high).estimate).logs
    return found


def with_depth(
    calibration: Calibration, evidence: Sequence[ViewEvidence], session: Session
) -> tuple[Calibration, tuple[ViewEvidence, ...]]:
    """The result with the depth of its cameras and what is to be said of it, and its evidence."""
    seen = {view.view: view for view in evidence}
    used = {view.view for view in calibration.views if view.used}
    views: dict[tuple[str, str], list[View]] = {}
    for view in session.views:
        if view.depth and view.number in used:
            key = view.text.get("camera", "").strip(), session.board_of(view)
            views.setdefault(key, []).append(view)
    findings, found = list[Finding](), dict[str, DepthResult]()
    for camera in dict.fromkeys(camera for camera, _ in views):
        # Of several boards, the one that is seen most.
        board = max((key for key in views if key[0] == camera), key=lambda key: len(views[key]))[1]
        try:
            pair = calibration.chosen(Choice(camera or None, None, board or None))
            sensor = Sensor.of(pair, session, camera, board)
            result, cells, said = _depth_of(sensor, views[camera, board], seen)
        except DataError as error:
            findings.append(Finding("depth_unread", f"Depth was not compared: {error}").of(camera))
            continue
        findings += [finding.of(camera) for finding in said]
        if result is not None:
            found[camera] = result
        for part in cells:
            seen[part.view] = replace(seen[part.view], depth=_shown(part, result, sensor))
    verdict = calibration.verdict
    verdict = replace(verdict, findings=(*verdict.findings[:1], *findings, *verdict.findings[1:]))
    calibration = replace(calibration, verdict=verdict)
    if calibration.cell is not None:
        # The pairs' transforms are others than the cell's.
        depths = {name: replace(one, with_calibration=None) for name, one in found.items()}
        cameras = {
            name: replace(one, depth=depths.get(name))
            for name, one in calibration.cell.cameras.items()
        }
        calibration = replace(calibration, cell=replace(calibration.cell, cameras=cameras))
    elif found and calibration.camera is not None:
        camera_result = replace(calibration.camera, depth=next(iter(found.values())))
        calibration = replace(calibration, camera=camera_result)
    return calibration, tuple(seen[view.view] for view in evidence)


def _shown(cells: Cells, result: DepthResult | None, sensor: Sensor) -> FloatArray:
    """(n, 5) a view's cells, as its evidence has them."""
    px, left, true = cells.px, cells.excess_m, cells.true_m
    if result is not None:
        left = result.true_m(true + left, px, sensor.lens.resolution) - true
    if sensor.by is not None:
        rays = sensor.rays(px)
        points = (true / sensor.lengths(rays))[:, None] * rays
        px = project(sensor.camera.camera, apply(sensor.by.cam_from_depth, points))
    return np.column_stack([px, true, cells.excess_m, left])


def depth_now(
    calibration: Calibration, session: Session, seen: Mapping[int, ViewEvidence]
) -> tuple[Finding, ...]:
    """Whether the depth of one camera and board still is what it was.

    Args:
        calibration: Theirs, with the depth.
        session: New views.
        seen: The board in each.
    """
    views = [view for view in session.views if view.depth]
    if not views or calibration.camera is None or calibration.camera.depth is None:
        return ()
    camera, board = next(iter(session.cameras), ""), next(iter(session.boards), "")
    try:
        sensor, before = Sensor.of(calibration, session, camera, board), calibration.camera.depth
        return tuple(_depth_of(sensor, views, seen, before)[2])
    except DataError as error:
        return (Finding("depth_unread", f"Depth was not compared: {error}"),)


def _depth_of(
    sensor: Sensor,
    views: Sequence[View],
    seen: Mapping[int, ViewEvidence],
    before: DepthResult | None = None,
) -> tuple[DepthResult | None, list[Cells], list[Finding]]:
    """The depth of one camera, the cells that it is from, and what is to be said of it.

    Where it was something else before, whether it still is.
    """
    size, found, lost = sensor.lens.resolution, list[Cells](), dict[str, list[int]]()
    for view in views:
        try:
            found.append(sensor.cells(view, seen.get(view.number)))
        except DataError as error:
            lost.setdefault(str(error).replace(view.depth, "depth"), []).append(view.number)
    said = [
        Finding("depth_unread", f"No depth of {view_words(of)}: {words}", views=tuple(of))
        for words, of in lost.items()
    ]
    if len(found) < CheckLimits.stops:
        words = f"Depth was not compared: it is of {counted(len(found), 'view')} of the board, "
        words += f"but must be of {CheckLimits.stops}."
        return None, found, [*said, Finding("depth_unread", words)]
    ratios = np.array([np.median(at.excess_m / at.true_m) for at in found])
    ratio = 1.0 + float(np.median(ratios))
    if not 0.67 < ratio < 1.5:
        return None, found, [*said, _another_unit(ratio, sensor.unit_m)]
    # Views that something hides whole.
    off = np.abs(ratios - np.median(ratios))
    within = off < max(GATE * SIGMA_PER_MAD * float(np.median(off)), 0.03)
    found = [cells for cells, is_kept in zip(found, within, strict=True) if is_kept]
    kept, shift = agreeing(found, size)
    if shift.any():
        return None, found, [*said, _shifted(shift)]
    found = [cells for cells, is_kept in zip(found, kept, strict=True) if is_kept]
    result, further = estimated(found, sensor, {view.number: view.stamp_s for view in views})
    return result, found, [*said, _judged(result, found, size, further, before)]


def agreeing(found: Sequence[Cells], size: tuple[int, int]) -> tuple[Mask, FloatArray]:
    """(v,) which views are not hidden whole by something, and (2,) the shift of the pictures [px].

    By least absolute deviations of the views' medians; the shift is zero where it is none.
    """
    middles = np.array([np.median(cells.excess_m) for cells in found])
    columns = np.array(
        [
            [np.median(at.true_m), *bending(at.px, size).mean(axis=0)[[0, 3]], *-at.by_px.mean(0)]
            for at in found
        ]
    )

    def fitted(count: int) -> tuple[FloatArray, FloatArray]:
        def misfit(values: FloatArray) -> FloatArray:
            return np.asarray(columns[:, :count] @ values - middles)

        start = np.zeros(count)
        fit = least_squares(misfit, start, x_scale="jac", loss="soft_l1", f_scale=1e-5)
        return np.abs(misfit(fit.x)), fit.x

    (off, _), (left, values) = fitted(3), fitted(5)
    # Views that something hides are few: a shift moves most of them.
    usual = float(np.median(off))
    explains = len(found) > 7 and max(3.0 * np.median(left), 0.003 * columns[0, 0]) < usual
    shift = values[3:] * (explains and np.linalg.norm(values[3:]) > 2.0)
    return off < max(GATE * SIGMA_PER_MAD * usual, 0.01 * columns[0, 0]), shift


def _shifted(shift: FloatArray) -> Finding:
    return Finding(
        "depth_shifted",
        "The depth pictures are not aligned to the images: they are shifted by about "
        f"({shift[0]:.0f}, {shift[1]:.0f}) px, and so were not compared with the board.",
        Remedy("Record depth aligned to the image (rs.align, setDepthAlign), at its size."),
    )


def estimated(
    found: Sequence[Cells], sensor: Sensor, stamps: Mapping[int, float | None]
) -> tuple[DepthResult, str]:
    """The model of some views' cells, and a sentence on what else they show."""
    px, true, excess, noise, by_common, inks = (
        np.concatenate([getattr(cells, name) for cells in found])
        for name in ("px", "true_m", "excess_m", "noise_m", "by_common", "inks_m")
    )
    powers = np.column_stack([np.ones_like(true), true**4])
    of_pixel = nnls(powers * 1e6, noise**2 * 1e6)[0]
    noise = np.sqrt(np.maximum(powers @ of_pixel, 1e-10))
    bent = bending(px, sensor.lens.resolution)
    rows = np.split(bent[:, :3], np.cumsum([len(cells.px) for cells in found])[:-1])
    known = np.column_stack([by_common, block_diag(*(cells.by_corners for cells in found))])
    times = np.concatenate([np.full(len(at.px), stamps.get(at.view) or 0.0) for at in found])
    fixed, further, views = np.column_stack([true, bent]), "", block_diag(*rows)
    if np.ptp(times) > 60.0:
        drifting = np.column_stack([fixed, (times - times.mean()) / 3600.0])
        mixed = fit_mixed(excess, drifting, known, views, noise)
        if abs(mixed.values[5]) > GATE * np.sqrt(mixed.covariance[5, 5]):
            further = f" It drifts by {1e3 * mixed.values[5]:.2g} mm an hour."
            fixed = drifting
    mixed = fit_mixed(excess, fixed, known, views, noise)
    scale, offset, u, v, bowl = mixed.values[:5].tolist()
    # Of edges, lens and field, which come first.
    root = sensor.root[: -6 - sensor.shape.shape[2]]
    errors = fixed.shape[1] + np.arange(root.shape[1])
    return (
        DepthResult(
            scale=1.0 + scale,
            offset_m=offset,
            tilt_m=(u, v),
            bowl_m=bowl,
            covariance=mixed.covariance[:5, :5],
            with_calibration=mixed.covariance[:5, errors] @ root.T,
            noise_m=(float(np.sqrt(of_pixel[0])), float(np.sqrt(of_pixel[1]))),
            view_m=float(np.exp(mixed.logs[1])),
            ink_m=float(np.nanmedian(inks)) if np.isfinite(inks).sum() >= FEWEST_CELLS else 0.0,
            distances_m=(float(true.min()), float(true.max())),
            of="ray" if sensor.is_ray else "z",
            unit_m=sensor.unit_m,
            by=sensor.by,
        ),
        further,
    )


def _another_unit(ratio: float, unit_m: float | None) -> Finding:
    """The finding on depth in another unit than is stated."""
    # Left out, it is a millimetre of whole numbers, and a metre of others.
    taken = (0.001, 1.0) if unit_m is None else (unit_m,)
    _, nearest = min(
        (abs(float(np.log(one * ratio / unit))), one)
        for unit in taken
        for one in (1e-4, 1e-3, 2.5e-4, 1e-2, 1.0, 1.25e-4)
    )
    return Finding(
        "depth_unit",
        f"Depth is {figure(ratio)} times what the chain predicts: its unit is another one.",
        Remedy(f"Write depth_unit_m = {nearest:g} in [camera] of session.toml."),
    )


def _judged(
    result: DepthResult,
    found: Sequence[Cells],
    size: tuple[int, int],
    further: str,
    before: DepthResult | None,
) -> Finding:
    """The finding on the error of depth, in mm at the distances of the views."""
    true = np.concatenate([cells.true_m for cells in found])
    known = before or DepthResult.exact()
    away = result.values - known.values
    statistic = float(away @ np.linalg.solve(result.covariance + known.covariance, away))
    middle, sigma = float(np.median(true)), np.sqrt(np.diag(result.covariance))
    px = np.concatenate([cells.px for cells in found])
    off = 1e3 * np.column_stack([true, bending(px, size)]) @ away
    is_true = statistic < float(chi2_limit(FALSE_ALARM, 5))
    centre = 1e3 * (away[0] * middle + away[1])
    figures = (
        f"scale {result.scale:.5f} +- {sigma[0]:.5f}, offset {1e3 * result.offset_m:.2f} +- "
        f"{1e3 * sigma[1]:.2f} mm, bowl {1e3 * result.bowl_m:.2f} +- {1e3 * sigma[4]:.2f} mm."
    )
    if result.ink_m:
        figures += f" Black reads {1e3 * result.ink_m:.1f} mm deeper than white."
    span = f"{off.min():.1f} to {off.max():.1f} mm"
    if is_true:
        what = "true" if before is None else "what it was"
        words = f"The camera's depth is {what} at {middle:.2f} m"
        return Finding(NOTE, f"{words}: {figures}{further}")
    if before is None:
        words = (
            f"The camera's depth is {abs(centre):.1f} mm too {'long' if centre > 0 else 'short'} "
            f"at {middle:.2f} m in the image's middle, and over the board from {span}"
        )
        step = "Correct it: visioncal locate applies camera.depth of calibration.json."
        return Finding("depth_scale", f"{words}: {figures}{further}", Remedy(step))
    words = (
        f"The camera's depth is not what it was: at {middle:.2f} m it reads {centre:+.1f} mm in "
        f"the image's middle beside what it did, and over the board {span}"
    )
    step = "Look at the sensor's window, warmth and settings, or calibrate again."
    return Finding(DEPTH_CHANGED, f"{words}: {figures}{further}", Remedy(step))
