"""What the joint fit found of lenses and boards, in sentences for the user."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.image_size import other_images
from visioncal.core.number_format import figure
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Target
from visioncal.core.verdict import CALIBRATE, NOTE, Finding, Remedy
from visioncal.estimation.appearance import MOST_LOOSE
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.joint import (
    ConvergedFit,
    MeasuredScale,
    Side,
    chance_limit,
    contradicted_lens,
    measured_rig,
    measured_scale,
    moved_mahalanobis_sq,
    rig_by_stated_arms,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.scene import ONLY_CAMERA, CornerProblem, Scene
from visioncal.estimation.solve import covariance_of, held_shift
from visioncal.session.frames import frame_name
from visioncal.vision.camera import normalise, project

# A rig that is as stated seems not to be in one session of ten thousand.
_FALSE_ALARM = 1e-4
# Rigs are measured and made to so much, as a share.
_SAME_SIZE = 5e-4
# Intrinsics that move by less, or corners by less, show in no image [px].
_LEAST_MOVE_PX = 0.1
# No printed board is as it was drawn to less [m].
_LEAST_BEND_M = 1e-5
_NEW_LENS = Remedy(
    "In session.toml, delete matrix and distortion, so that they are estimated, or calibrate "
    "the camera anew.",
    CALIBRATE,
)


def found_of_looks(
    side: Side, fitted: ConvergedFit, covariance: FloatArray, stated: Problem | None
) -> Iterator[Finding]:
    """Says what a joint fit found of lenses and boards; what is no reason for doubt is a note.

    Args:
        side: The frames' side of the fit.
        fitted: The answer.
        covariance: (p, p) of its unknowns, with all that counts beside the noise.
        stated: The same observations with arms as stated; None where none was calibrated.
    """
    looks = fitted.looks
    cameras = zip(looks.problems.items(), fitted.seen.compressed, strict=True)
    for (camera, problem), compressed in cameras:
        moving = np.flatnonzero(np.isin(looks.places(camera), fitted.moving))
        scattered = _noise_found(
            problem.stack, compressed.residuals, problem.unknowns(compressed, moving)
        )
        of = "" if camera == ONLY_CAMERA else camera
        yield from (finding.of(of) for finding in (*scattered, *_lens_found(fitted, camera)))
    scene = next(iter(looks.problems.values())).scene
    for board, target in enumerate(scene.targets):
        if board not in looks.printed:
            yield from _points_found(target, looks.moved_points(board))
            frame = frame_name("target", scene.names[board])
            measured = measured_rig(side, fitted, frame, board)
            if stated is not None:
                measured = rig_by_stated_arms(fitted, stated, frame, board) or measured
            yield from _rig_size_found(target, measured)
            continue
        called = f"board {scene.names[board]}".strip()
        if _moves(fitted, looks.scale_of(board)):
            (place,) = looks.scale_of(board)
            at = fitted.columns.start + int(np.searchsorted(fitted.seen.free, place))
            measured = measured_scale(side, fitted, board)
            written = replace(
                measured, scale=float(looks.values[place]), sigma=float(covariance[at, at] ** 0.5)
            )
            yield scale_found(called, target, measured, written)
        if _moved(fitted, looks.shape_of(board)):
            yield _shape_found(fitted, board, called)


def _noise_found(stack: CornerStack, residuals: FloatArray, unknowns: int) -> Iterator[Finding]:
    """Finds whether corners scatter otherwise than corners.csv states; less is no doubt."""
    stated, shown = stack.stated_px, stack.shown_px(residuals, unknowns)
    if stated is None or not stack.contradicts(residuals, unknowns):
        return
    more = shown > stated
    by, advice = (
        (
            "by the scatter.",
            "Look for errors of the detector, the lens or the target that sigma_px leaves out.",
        )
        if more
        else ("by what is stated.", "State what the detector errs by, or leave sigma_px out.")
    )
    yield Finding(
        "corner_noise" if more else NOTE,
        f"The corners scatter by {figure(shown)} px, and corners.csv states {figure(stated)} px "
        f"(sigma_px of a typical corner). The result goes {by}",
        Remedy(advice),
    )


# What square_m is of a target that has no squares, and its name in the target's file.
_SIDES = {
    "aprilgrid": ("tags", "size_m"),
    "marker": ("a side", "size_m"),
    "circles": ("a distance of rows", "square_m"),
}


def scale_found(
    board: str, target: Target, measured: MeasuredScale, written: MeasuredScale
) -> Finding:
    """Words another size than the file states; a note where that allows it.

    Args:
        board: What the board is called.
        target: It, as stated.
        measured: What the robot's motion says.
        written: What the result has, with all that counts beside the noise.
    """
    side, share = 1e3 * target.square_m, f"{figure(100 * measured.stated_sigma)} %"
    what, key = _SIDES.get(target.kind, ("squares", "square_m"))
    size = (
        f"By the robot's motion the {board} is "
        f"{figure(100 * abs(written.scale))} % "
        f"{'larger' if written.scale > 0 else 'smaller'} than stated (sigma "
        f"{figure(100 * written.sigma)} %)"
    )
    if not measured.contradicts:
        allowed = f"{size}. The stated size allows this (to within {share})."
        return Finding(NOTE, f"{allowed} The result goes by both.")
    side_found = side * (1 + written.scale)
    return Finding(
        "board_size",
        f"{size}: {what} of {side_found:.4g} mm, not of {side:.4g} mm (stated to within {share}). "
        "The result takes the robot's scale; if the board is right, the arm's model is off by as "
        "much.",
        Remedy(
            f"Measure the board over {'many squares' if what == 'squares' else 'its whole width'}. "
            f"If the robot is right, write {key} = {1e-3 * side_found:.4g} in the board's .toml; "
            "else check the arm.",
            CALIBRATE,
        ),
        mahalanobis_sq=measured.scale**2 / (measured.sigma**2 + measured.stated_sigma**2),
    )


def _shape_found(fitted: ConvergedFit, board: int, called: str) -> Finding:
    """Words a board that is bent, longer one way than the other, or sheared; a note of the least.

    Of these, what is more than chance is worded; all of them together are.
    """
    looks = fitted.looks
    shape = looks.shape_of(board)
    aspect, *bends, shear = shape
    drawn = looks.with_values(shape, np.zeros(len(shape))).corners[board]
    away = float(np.linalg.norm(looks.corners[board] - drawn, axis=1).max())
    if away < _LEAST_BEND_M:
        return Finding(
            NOTE, f"The {called} is within {figure(1e3 * away)} mm of its drawing, size aside."
        )
    parts, steps = [], []
    if _moved(fitted, np.array([aspect])):
        longer = float(looks.values[aspect])
        far, near = ("y", "x") if longer > 0 else ("x", "y")
        parts.append(
            f"longer along its {far} than along its {near}, by {figure(100 * abs(longer))} %"
        )
    if _moved(fitted, np.array([shear])):
        corner_deg = 90.0 - np.rad2deg(float(looks.values[shear]))
        parts.append(f"sheared: its rows and columns meet at {corner_deg:.3f} deg")
    if parts:
        steps.append("Print it anew on another printer.")
    if _moved(fitted, np.array(bends)) or not parts:
        depth = figure(1e3 * float(np.ptp(looks.corners[board][:, 2])))
        parts.insert(0, f"not flat: its corners lie within {depth} mm of depth")
        steps.insert(0, "Put the board on a stiff, flat plate, and record again.")
    return Finding(
        "board_shape",
        f"The {called} is {', and '.join(parts)}. Its shape was estimated with the rest.",
        Remedy(" ".join(steps)),
    )


def _points_found(target: Target, moved_m: FloatArray) -> Iterator[Finding]:
    """Whether a rig's points lie farther from where its table has them than it says."""
    if not target.point_sigmas_m:
        return
    if not len(moved_m):
        yield Finding(
            "remark",
            f"The {len(target.points_m)} points of target {target.name} were taken for exact: "
            f"their sigma_m counts for up to {MOST_LOOSE}.",
        )
        return
    sigmas = np.array(target.point_sigmas_m)
    away = np.linalg.norm(moved_m.reshape(-1, 3), axis=1)
    worst = int(np.argmax(away / sigmas))
    if (away[worst] / sigmas[worst]) ** 2 > chi2_limit(_FALSE_ALARM / len(sigmas), 3):
        yield Finding(
            "board_shape",
            f"Point {target.point_numbers[worst]} of target {target.name} lies "
            f"{figure(1e3 * float(away[worst]))} mm from where its table has it, which is stated "
            f"to {figure(1e3 * float(sigmas[worst]))} mm (sigma_m). The result goes by both.",
            Remedy("Measure the point again."),
        )


def _rig_size_found(target: Target, measured: MeasuredScale) -> Iterator[Finding]:
    """Whether a rig is larger or smaller than its table, by the robot's motion."""
    if not measured.is_another or abs(measured.scale) < _SAME_SIZE:
        return
    word = "larger" if measured.scale > 0 else "smaller"
    yield Finding(
        "board_size",
        f"By the robot's motion target {target.name} is {figure(100 * abs(measured.scale))} % "
        f"{word} than the table of its points has it (sigma {figure(100 * measured.sigma)} %). The "
        "result goes by the table.",
        Remedy(
            "Measure the distance of two points that are far apart. Where they are as the robot "
            f"says, multiply the table's x_m, y_m and z_m by {1 + measured.scale:.5g}; otherwise "
            "see to the arm.",
            CALIBRATE,
        ),
        mahalanobis_sq=(measured.scale / measured.sigma) ** 2,
    )


def _lens_found(fitted: ConvergedFit, camera: str) -> Iterator[Finding]:
    looks = fitted.looks
    problem, lens = looks.problems[camera], looks.lens_of(camera)
    if problem.scene.mode == "refine" and not problem.has_spare_corners:
        words = (
            f'intrinsics = "refine" was not done: {len(problem.stack.px)} corners in '
            f"{len(problem.stack.views)} views leave too little to judge by."
        )
        yield Finding("remark", words, Remedy("Show a board with more corners, or more views."))
    moved = np.intersect1d(lens, fitted.moving)
    if not problem.scene.estimated and len(moved) and _moved(fitted, moved):
        is_exact = problem.scene.matrix_sigma_px is None
        steps = (looks.values - looks.stated)[lens[:4]]
        words, do = other_images(problem.scene.camera, looks.values[lens[:4]])
        if words:
            yield Finding("lens", f"{words} It was refined.", Remedy(do, CALIBRATE))
        else:
            is_wrong = is_exact or contradicted_lens(fitted, camera)
            moved_px = _corners_moved_px(problem, looks.camera(camera))
            yield lens_found(steps, is_doubtful=is_wrong and moved_px > _LEAST_MOVE_PX)
    if problem.contested:
        at = np.arange(fitted.problem.size)[fitted.columns]
        at = at[np.searchsorted(fitted.seen.free, lens[:4])]
        moves = held_shift(fitted.problem, fitted.fit)[at]
        if np.abs(moves).max() > _LEAST_MOVE_PX:
            known = covariance_of(fitted.problem, fitted.fit)[np.ix_(at, at)]
            squared = float(moves @ np.linalg.solve(known, moves))
            yield replace(_contest_found(problem.scene, moves), mahalanobis_sq=squared)


def _corners_moved_px(problem: CornerProblem, refined: Camera) -> float:
    """By how much a refined lens moves any corner that was seen, its ray being what it was [px]."""
    stated = problem.scene.camera
    plane = normalise(stated, problem.stack.px)
    rays = np.column_stack([plane, np.ones(len(plane))])
    moved = np.linalg.norm(project(refined, rays) - project(stated, rays), axis=1)
    return float(np.nanmax(moved, initial=0.0))


def lens_found(steps_px: FloatArray, *, is_doubtful: bool) -> Finding:
    """Words given intrinsics that were refined; a note where they are no reason for doubt.

    Args:
        steps_px: (4,) by how much fx, fy, cx, cy moved [px].
        is_doubtful: Whether they were taken for exact, or for better than they are, and corners
            show it.
    """
    if is_doubtful:
        return Finding(
            "lens",
            "The given intrinsics do not fit these images and were refined: fx, fy, cx, cy moved "
            f"by {_px(steps_px)} px.",
            _NEW_LENS,
        )
    return Finding(
        NOTE,
        "The given intrinsics were refined within what is stated, or by less than images show: "
        f"fx, fy, cx, cy moved by {_px(steps_px)} px.",
    )


def _contest_found(scene: Scene, moves_px: FloatArray) -> Finding:
    """Words intrinsics that stay although the corners speak against them."""
    why = (
        'intrinsics = "hold" keeps them'
        if scene.mode == "hold"
        else "they were kept, because views left out are predicted no better with others"
    )
    return Finding(
        "lens",
        "The given intrinsics do not fit these images: free, fx, fy, cx, cy would move by "
        f"{_px(moves_px)} px. But {why}; what this does to the result counts in its sigmas.",
        _NEW_LENS,
    )


def _moves(fitted: ConvergedFit, places: IntArray) -> bool:
    return bool(np.isin(places, fitted.moving).all())


def _moved(fitted: ConvergedFit, places: IntArray) -> bool:
    """Whether values were moved from what is stated by more than chance."""
    return _moves(fitted, places) and moved_mahalanobis_sq(fitted, places) > chance_limit(
        len(places)
    )


def _px(values: FloatArray) -> str:
    return ", ".join(f"{'-' if value < 0 else '+'}{figure(abs(value))}" for value in values)
