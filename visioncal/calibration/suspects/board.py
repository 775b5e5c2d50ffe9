"""Boards and rigs whose size or shape is not as stated."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.distance_scale import distance_scale, other_size, scaling
from visioncal.calibration.stages.other_board import board_correction
from visioncal.calibration.suspects.lens import has_changed
from visioncal.calibration.suspects.suspect import SOURCES, Suspect
from visioncal.core.limits import CONTRADICTION
from visioncal.core.number_format import counted, figure, ranges
from visioncal.core.quantiles import FALSE_ALARM, SIGMA_PER_MAD, chi2_limit
from visioncal.core.transforms import invert
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import (
    MeasuredScale,
    estimated_scale,
    measured_scale,
    scale_by_stated_arms,
    size_of_measured,
)
from visioncal.estimation.unknowns import BOARD, LENS
from visioncal.vision.board_shape import ASPECT, BOARD_NAMES, SCALE, SHEAR, shaped_corners
from visioncal.vision.boards import kind_of
from visioncal.vision.targets import corner_positions

# Manufacturing accuracy of rigs, as a share of their size.
_SAME_SIZE = 5e-4
# Share by which arms go farther than they report, at most: 3 mm in 0.6 m. No view distinguishes it
# from a board of another size.
_ARM_SCALES = 5e-3
# Share by which ink and light widen printed circles, and fewest images that show them wider.
_INK, _FEWEST_DRAWN = 0.03, 3
# Accuracy of printed boards [m].
_LEAST_BEND_M = 1e-5


def _found(run: RunState) -> Iterator[Finding]:
    """Boards of another size by the robot's motion, or of another shape; notes where allowed."""
    cell_fit, fitted = run.cell_fit, run.assessment.fit
    if not fitted.unknowns.of(LENS):
        yield from _of_measured_poses(run)
        return
    stated = None
    if any(arm.model is not None for arm in cell_fit.arms.values()):
        stated = fitted.problem
        for arm in cell_fit.arms.values():
            stated = arm.without_errors(stated)
    for name, target in run.session.boards.items():
        called, frame = f"board {name}".strip(), run.session.board_frames[name]
        board = BOARD, name
        measured = measured_scale(cell_fit, fitted, frame, name, target)
        if target.is_rig:
            if stated is not None:
                measured = scale_by_stated_arms(fitted, stated, frame) or measured
            yield from _point_findings(target, fitted.values(board))
            if measured.is_another and abs(measured.scale) >= _SAME_SIZE:
                yield scale_finding(f"target {target.name}", target, measured, measured, name)
            continue
        written, is_named = estimated_scale(fitted, name, target), False
        if written is not None and (measured.is_another or written.leaves_stated):
            plain = scale_finding(called, target, measured, written, name)
            found = _stretched(plain, fitted, board, called)
            is_named = found is not plain
            yield found
        yield from _shape_findings(fitted, name, target, called, is_named=is_named)


def _of_prints(run: RunState) -> Iterator[Finding]:
    """Circles of another diameter than stated, which is a remark: their centres are the same."""
    for name, target in run.session.boards.items():
        views = [view.number for view in run.session.views if run.session.board_of(view) == name]
        seen = [run.corners[view] for view in views if view in run.corners]
        sizes = np.array([one.drawn_m or np.nan for one in seen])
        if len(sizes) < _FEWEST_DRAWN or not np.isfinite(sizes).all():
            continue
        size = float(np.median(sizes))
        sigma = float(SIGMA_PER_MAD * np.median(np.abs(sizes - size)) / len(sizes) ** 0.5)
        off = abs(size - target.diameter_m)
        least = _INK * target.diameter_m + float(np.median([_eroded_m(at, target) for at in seen]))
        if off > max(CONTRADICTION * sigma, least):
            write, command = board_correction(run.session, name, f"diameter_m = {size:.4g}")
            document = run.session.target_document
            is_usual = document is not None and "diameter_m" not in document
            source = "is usual" if is_usual else "stated"
            yield Finding(
                "print_size",
                f"The circles of {f'the board {name}'.strip()} are {1e3 * size:.4g} mm wide in the "
                f"images, by the distance of rows (sigma {figure(1e3 * sigma)} mm), not "
                f"{1e3 * target.diameter_m:g} mm as {source}. Their centres were fitted so; "
                f"{write}.",
                Remedy(f"{write[0].upper()}{write[1:]}.", command),
            )


def _eroded_m(corners: Corners, target: Target) -> float:
    """How much narrower blur draws circles of few pixels: their curved edge moves inwards [m]."""
    seen_px, printed_m = (
        float(np.linalg.norm(np.ptp(places, axis=0)))
        for places in (corners.px, corner_positions(target))
    )
    px_per_m = seen_px / printed_m
    # Renderings show twice blur^2 / radius.
    return 4.0 * corners.blur_px**2 / (px_per_m**2 * target.diameter_m)


def _of_measured_poses(run: RunState) -> Iterator[Finding]:
    """Measured poses whose scale differs from the robot's."""
    usable = run.poses.keys() - run.reasons.keys()
    views = [view for view in run.base_from_flange if view in usable]
    if run.mount in (None, "instrument") or run.cameras or not views:
        return
    poses = np.array([run.base_from_flange[view] for view in views])
    seen = np.array([run.poses[view].cam_from_target[0] for view in views])
    parent = poses if run.mount == "eye-in-hand" else invert(poses)
    if (measured := size_of_measured(run.cell_fit, run.assessment.fit)) is not None:
        if measured.is_another and measured.contradicts:
            words = " The result takes the robot's scale, beside errors of the arm's lengths."
            further = words if run.cell_fit.has_links else " The result takes the robot's scale."
            # Slopes are those at predicted poses.
            share = measured.scale / (1.0 - measured.scale)
            yield other_size(share, measured.sigma**2, further)
        return
    # The camera may have a name.
    (edge,) = (edge for name, edge in run.assessment.last_edges.items() if name.startswith("cam"))
    if (finding := distance_scale(parent, seen, edge.matrix)) is not None:
        yield finding


def scale_finding(
    called: str,
    target: Target,
    measured: MeasuredScale,
    written: MeasuredScale,
    name: str = "",
) -> Finding:
    """Finding on a board or rig of another size; a note where its stated sigma allows it.

    `measured` is the scale by the robot's motion, `written` that of the result, with its total
    sigma; `name` is its name in the session, empty of the only one.
    """
    # Errors that last from stop to stop count in the total alone.
    measured = replace(measured, sigma=max(measured.sigma, written.sigma))
    share, rivals = f"{figure(100 * measured.stated_sigma)} %", tuple[str, ...]()
    size = (
        f"By the robot's motion the {called} is {figure(100 * abs(written.scale))} % "
        f"{'larger' if written.scale > 0 else 'smaller'} than stated (sigma "
        f"{figure(100 * written.sigma)} %)"
    )
    if not (measured.contradicts or written.leaves_stated):
        allowed = f"{size}, which does not contradict the stated size (to within {share})."
        return Finding(NOTE, f"{allowed} The result goes by both.")
    if target.is_rig:
        words = f"{size}. The result goes by the table of its points."
        first = "Measure the distance of two points that are far apart."
    else:
        kind, side = kind_of(target), 1e3 * target.square_m
        found = side * (1 + written.scale)
        words = (
            f"{size}: {kind.sides} of {found:.4g} mm, not of {side:.4g} mm (stated to within "
            f"{share}). The result takes the robot's scale"
        )
        if abs(written.scale) <= _ARM_SCALES:
            percent = f"{figure(100 * abs(written.scale))} %"
            far = "farther" if written.scale < 0 else "less far"
            words += "."
            rivals = (f"the board is as stated, and the arm goes {percent} {far} than it reports",)
        else:
            words += "; if the board is right, the arm's model is off by as much."
        first = "Measure the board over its whole width."
    total = measured.sigma**2 + measured.stated_sigma**2
    square = measured.scale**2 / total
    do = scaling(f"{first} If the robot is right, ", 1 + written.scale, name)
    return Finding("board_size", words, do, mahalanobis_sq=square, rivals=rivals)


def _stretched(found: Finding, fitted: Fit, board: tuple[str, str], called: str) -> Finding:
    """The finding on a board's size, of one that is stretched by as much: of both axes."""
    columns = fitted.unknowns.columns(board)[fitted.unknowns.values_of(board) == ASPECT]
    scale, aspect = (float(fitted.values(board)[at]) for at in (SCALE, ASPECT))
    is_even = abs(aspect) < 0.5 * abs(scale) or not has_changed(fitted, columns)
    if found.kind != "board_size" or is_even:
        return found
    by = (
        f"{figure(100 * abs(share))} % {'longer' if share > 0 else 'shorter'} along its {axis}"
        for axis, share in (("x", scale - aspect / 2), ("y", scale + aspect / 2))
    )
    return replace(
        found,
        words=f"By the robot's motion the {called} is {' and '.join(by)} than stated, as where a "
        "printer stretches one axis. The result goes by both.",
        do=Remedy(
            "Print it on another printer, and measure it along both axes; one square_m does "
            "not describe this one, of which the result has both sizes."
        ),
        rivals=(),
    )


def _shape_findings(
    fitted: Fit, name: str, target: Target, called: str, *, is_named: bool
) -> Iterator[Finding]:
    """Finding on a bent, stretched or sheared board, beyond the accuracy of printing.

    `is_named` is whether the finding on its size has the stretch.
    """
    board = (BOARD, name)
    shape = fitted.values(board)
    columns, values = fitted.unknowns.columns(board), fitted.unknowns.values_of(board)

    def has_moved(*chosen: int) -> bool:
        return has_changed(fitted, columns[np.isin(values, chosen)])

    stretch, named = [] if is_named else [ASPECT], len(BOARD_NAMES)
    drawn = np.where(np.isin(np.arange(len(shape)), [SCALE, *[ASPECT] * is_named]), shape, 0.0)
    corners, even = (shaped_corners(target, at) for at in (shape, drawn))
    off_m = np.linalg.norm(corners - even, axis=1).max()
    bends = np.setdiff1d(np.arange(named), [SCALE, ASPECT, SHEAR])
    points = np.arange(named, len(shape))
    if not has_moved(*stretch, *bends, SHEAR, *points) or off_m < _LEAST_BEND_M:
        return
    flat = "Put the board on a stiff, flat plate, or print it on another printer, and record again."
    if len(points) and has_moved(*points):
        words = f"The {called} has {_elsewhere(corner_positions(target), corners)}."
        do = Remedy(f"Measure the print there with a caliper. {flat}")
        yield Finding("board_shape", f"{words} The result counts it.", do)
        return
    parts = []
    if has_moved(*stretch):
        longer = float(shape[ASPECT])
        far, near = ("y", "x") if longer > 0 else ("x", "y")
        parts.append(
            f"longer along its {far} than along its {near}, by {figure(100 * abs(longer))} %"
        )
    if has_moved(SHEAR):
        corner_deg = 90.0 - np.rad2deg(float(shape[SHEAR]))
        parts.append(f"sheared: its rows and columns meet at {corner_deg:.3f} deg")
    if has_moved(*bends) or not parts:
        depth = figure(1e3 * float(np.ptp(corners[:, 2])))
        parts.insert(0, f"not flat: its corners lie within {depth} mm of depth")
    words = f"The {called} is {', and '.join(parts)}. Its shape was estimated with the rest."
    yield Finding("board_shape", words, Remedy(flat))


def _elsewhere(positions: FloatArray, corners: FloatArray) -> str:
    """How far (c, 3) corners in a board's plane are from their stated positions, in words.

    Both are compared by the affine map that fits most of them (least absolute deviations).
    """
    plane = np.column_stack([positions[:, :2], np.ones(len(positions))])
    off = corners[:, :2] - positions[:, :2]
    lengths = np.ones(len(off))
    for _ in range(50):
        root = 1.0 / np.sqrt(np.maximum(lengths, 1e-3 * lengths.max()))[:, None]
        left = off - plane @ np.linalg.lstsq(plane * root, off * root, rcond=None)[0]
        lengths = np.linalg.norm(left, axis=1) + 1e-12
    far = lengths > lengths.max() / 2
    if far.sum() > len(far) / 3:
        rms = figure(1e3 * float(np.sqrt(np.mean(lengths**2))))
        return f"its corners {rms} mm (rms) from where its file has them, in all views alike"
    shift = figure(1e3 * float(np.median(lengths[far])))
    which = f"its {counted(int(far.sum()), 'corner')} {ranges(np.flatnonzero(far).tolist())}"
    for axis, line in ((1, "row"), (0, "column")):
        lines = np.unique(positions[:, axis].round(6), return_inverse=True)[1]
        whole = [at for at in np.unique(lines) if np.mean(far[lines == at]) > 0.6]
        if np.isin(lines[far], whole).mean() > 0.8:
            which = f"{line} {ranges([at + 1 for at in whole])} of its corners"
            break
    return f"{which} {shift} mm from where the others have them, in all views alike"


def _point_findings(target: Target, moved_m: FloatArray) -> Iterator[Finding]:
    """Finding where a point of a rig contradicts the rig's table; `moved_m` is empty if exact."""
    if not len(moved_m):
        return
    sigmas = np.array(target.point_sigmas_m)
    distances = np.linalg.norm(moved_m.reshape(-1, 3), axis=1)
    worst = int(np.argmax(distances / sigmas))
    if (distances[worst] / sigmas[worst]) ** 2 > chi2_limit(FALSE_ALARM / len(sigmas), 3):
        yield Finding(
            "board_shape",
            f"Point {target.point_numbers[worst]} of target {target.name} lies "
            f"{figure(1e3 * float(distances[worst]))} mm from where its table has it, which is "
            f"stated to {figure(1e3 * float(sigmas[worst]))} mm (sigma_m). The result goes by "
            "both.",
            Remedy("Measure the point again."),
        )


PRINT = Suspect("print_size", _of_prints, is_doubt=False)
# Where its size is held, the noise of the robot has what it makes of the residuals.
SIZE = Suspect("board_size", _found, 2.7e-3, True, inflates=SOURCES[1:4])
SHAPE = Suspect("board_shape", None, 1e-4, True)
