"""Findings of the joint fit on lenses and boards."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.image_size import other_images
from visioncal.core.finding_kinds import NOTE
from visioncal.core.number_format import counted, figure
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.appearance import MOST_LOOSE
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.joint import (
    ConvergedFit,
    FrameModel,
    MeasuredScale,
    chance_limit,
    contradicted_lens,
    measured_rig,
    measured_scale,
    moved_mahalanobis_sq,
    rig_by_stated_arms,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.scene import ONLY_CAMERA, CornerProblem
from visioncal.estimation.solve import (
    covariance_of,
    held_shift,
)
from visioncal.session.frames import frame_name
from visioncal.vision.boards import kind_of
from visioncal.vision.camera import normalise, project

# False-alarm probability of the test of a rig's points.
_FALSE_ALARM = 1e-4
# Manufacturing accuracy of rigs, as a share of their size.
_SAME_SIZE = 5e-4
# Changes of intrinsics or corners below this show in no image [px].
_LEAST_MOVE_PX = 0.1
# Accuracy of printed boards [m].
_LEAST_BEND_M = 1e-5
_NEW_LENS = Remedy(
    "In session.toml, delete matrix and distortion, so that they are estimated, or calibrate "
    "the camera anew.",
    CALIBRATE,
)


def lens_and_board_findings(
    model: FrameModel, fitted: ConvergedFit, covariance: FloatArray, stated: Problem | None
) -> Iterator[Finding]:
    """Findings of a joint fit on lenses and boards; those without reason for doubt are notes.

    Args:
        model: The frames' model of the fit.
        fitted: The converged fit.
        covariance: (p, p) covariance of its unknowns, including other errors than noise.
        stated: The same observations with nominal arms; None where none was calibrated.
    """
    optics = fitted.camera_parameters
    cameras = zip(optics.problems.items(), fitted.linearised.compressed, strict=True)
    for (camera, problem), compressed in cameras:
        noise = _noise_findings(problem.stack, compressed.residuals, problem.unknowns(compressed))
        of = "" if camera == ONLY_CAMERA else camera
        yield from (finding.of(of) for finding in (*noise, *_lens_findings(fitted, camera)))
    scene = next(iter(optics.problems.values())).scene
    for board, target in enumerate(scene.targets):
        if board not in optics.printed:
            yield from _point_findings(target, optics.moved_points(board))
            frame = frame_name("target", scene.names[board])
            measured = measured_rig(model, fitted, frame, board)
            if stated is not None:
                measured = rig_by_stated_arms(fitted, stated, frame, board) or measured
            yield from _rig_size_findings(target, measured)
            continue
        called = f"board {scene.names[board]}".strip()
        measured = measured_scale(model, fitted, board)
        (place,) = optics.scale_of(board)
        if measured.is_another and place in fitted.linearised.moving:
            (at,) = fitted.columns_of(np.array([place]))
            written = replace(
                measured, scale=float(optics.values[place]), sigma=float(covariance[at, at] ** 0.5)
            )
            yield scale_finding(called, target, measured, written)
        if _has_changed(fitted, optics.shape_of(board)):
            yield _shape_finding(fitted, board, called)


def _noise_findings(stack: CornerStack, residuals: FloatArray, unknowns: int) -> Iterator[Finding]:
    """Finding where the scatter of corners contradicts corners.csv; a note where it is less."""
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


def scale_finding(
    board: str, target: Target, measured: MeasuredScale, written: MeasuredScale
) -> Finding:
    """Finding on a board of another size than stated; a note where its stated sigma allows it.

    `measured` is the scale by the robot's motion, `written` that of the result, with its total
    sigma.
    """
    side, share = 1e3 * target.square_m, f"{figure(100 * measured.stated_sigma)} %"
    what, key = kind_of(target).sides, kind_of(target).size_key
    size = (
        f"By the robot's motion the {board} is {figure(100 * abs(written.scale))} % "
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


def _shape_finding(fitted: ConvergedFit, board: int, called: str) -> Finding:
    """Finding on a bent, stretched or sheared board; a note within the accuracy of printing."""
    optics = fitted.camera_parameters
    shape = optics.shape_of(board)
    aspect, *bends, shear = shape
    drawn = optics.with_values(shape, np.zeros(len(shape))).corners[board]
    largest_m = float(np.linalg.norm(optics.corners[board] - drawn, axis=1).max())
    if largest_m < _LEAST_BEND_M:
        return Finding(
            NOTE, f"The {called} is within {figure(1e3 * largest_m)} mm of its drawing, size aside."
        )
    parts, steps = [], []
    if _has_changed(fitted, np.array([aspect])):
        longer = float(optics.values[aspect])
        far, near = ("y", "x") if longer > 0 else ("x", "y")
        parts.append(
            f"longer along its {far} than along its {near}, by {figure(100 * abs(longer))} %"
        )
    if _has_changed(fitted, np.array([shear])):
        corner_deg = 90.0 - np.rad2deg(float(optics.values[shear]))
        parts.append(f"sheared: its rows and columns meet at {corner_deg:.3f} deg")
    if parts:
        steps.append("Print it anew on another printer.")
    if _has_changed(fitted, np.array(bends)) or not parts:
        depth = figure(1e3 * float(np.ptp(optics.corners[board][:, 2])))
        parts.insert(0, f"not flat: its corners lie within {depth} mm of depth")
        steps.insert(0, "Put the board on a stiff, flat plate, and record again.")
    return Finding(
        "board_shape",
        f"The {called} is {', and '.join(parts)}. Its shape was estimated with the rest.",
        Remedy(" ".join(steps)),
    )


def _point_findings(target: Target, moved_m: FloatArray) -> Iterator[Finding]:
    """Finding where a point of a rig contradicts the rig's table."""
    if not target.point_sigmas_m:
        return
    if not len(moved_m):
        yield Finding(
            "remark",
            f"The {len(target.points_m)} points of target {target.name} were taken for exact: "
            f"their sigma_m counts for up to {MOST_LOOSE}.",
            Remedy(f"Leave points out, down to {MOST_LOOSE}, so that their sigma_m counts."),
        )
        return
    sigmas = np.array(target.point_sigmas_m)
    distances = np.linalg.norm(moved_m.reshape(-1, 3), axis=1)
    worst = int(np.argmax(distances / sigmas))
    if (distances[worst] / sigmas[worst]) ** 2 > chi2_limit(_FALSE_ALARM / len(sigmas), 3):
        yield Finding(
            "board_shape",
            f"Point {target.point_numbers[worst]} of target {target.name} lies "
            f"{figure(1e3 * float(distances[worst]))} mm from where its table has it, which is "
            f"stated to {figure(1e3 * float(sigmas[worst]))} mm (sigma_m). The result goes by "
            "both.",
            Remedy("Measure the point again."),
        )


def _rig_size_findings(target: Target, measured: MeasuredScale) -> Iterator[Finding]:
    """Finding on a rig of another size than its table states, by the robot's motion."""
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


def _lens_findings(fitted: ConvergedFit, camera: str) -> Iterator[Finding]:
    optics = fitted.camera_parameters
    problem, lens = optics.problems[camera], optics.lens_of(camera)
    free = np.intersect1d(lens, fitted.linearised.moving)
    if problem.scene.mode == "refine" and not len(free):
        words = (
            f'intrinsics = "refine" was not done: {len(problem.stack.px)} corners in '
            f"{counted(len(problem.stack.views), 'view', ('leaves', 'leave'))} too little to judge "
            "by."
        )
        step = (
            "Show a board with more corners, or more views, or state matrix_sigma_px, how well fx, "
            "fy, cx, cy are known."
        )
        yield Finding("remark", words, Remedy(step))
    if not problem.scene.estimated and len(free) and _has_changed(fitted, free):
        is_exact = problem.scene.matrix_sigma_px is None
        steps = (optics.values - optics.stated)[lens[:4]]
        words, do = other_images(problem.scene.camera, optics.values[lens[:4]])
        if words:
            yield Finding("lens", f"{words} It was refined.", Remedy(do, CALIBRATE))
        else:
            is_wrong = is_exact or contradicted_lens(optics, camera)
            moved_px = _largest_shift_px(problem, optics.camera(camera))
            yield _refined_lens_finding(steps, is_doubtful=is_wrong and moved_px > _LEAST_MOVE_PX)
    if fitted.linearised.holds_lens(camera):
        at = fitted.columns_of(lens[:4])
        moves = held_shift(fitted.problem, fitted.fit)[at]
        if np.abs(moves).max() > _LEAST_MOVE_PX:
            covariance = covariance_of(fitted.problem, fitted.fit)[np.ix_(at, at)]
            squared = float(moves @ np.linalg.solve(covariance, moves))
            if squared > chance_limit(len(at)):
                yield replace(_held_lens_finding(moves), mahalanobis_sq=squared)


def _largest_shift_px(problem: CornerProblem, refined: Camera) -> float:
    """Largest shift of a corner by a refined lens, with its ray held [px]."""
    stated = problem.scene.camera
    plane = normalise(stated, problem.stack.px)
    rays = np.column_stack([plane, np.ones(len(plane))])
    shifts = np.linalg.norm(project(refined, rays) - project(stated, rays), axis=1)
    return float(np.nanmax(shifts, initial=0.0))


def _refined_lens_finding(steps_px: FloatArray, *, is_doubtful: bool) -> Finding:
    """Finding on refined intrinsics, by the steps (4,) of fx, fy, cx, cy [px]; a note if sound."""
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


def _held_lens_finding(moves_px: FloatArray) -> Finding:
    """Finding on intrinsics that are held although the corners contradict them."""
    return Finding(
        "lens",
        "The given intrinsics do not fit these images: free, fx, fy, cx, cy would move by "
        f'{_px(moves_px)} px. But intrinsics = "hold" keeps them; what this does to the result '
        "counts in its sigmas.",
        _NEW_LENS,
    )


def _has_changed(fitted: ConvergedFit, places: IntArray) -> bool:
    """Whether values differ significantly from the stated ones."""
    free = np.intersect1d(places, fitted.linearised.moving)
    return len(free) > 0 and moved_mahalanobis_sq(fitted, free) > chance_limit(len(free))


def _px(values: FloatArray) -> str:
    return ", ".join(f"{'-' if value < 0 else '+'}{figure(abs(value))}" for value in values)
