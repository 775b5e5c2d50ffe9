"""Findings of the joint fit on lenses and boards."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.core.finding_kinds import NOTE
from visioncal.core.limits import CONTRADICTION
from visioncal.core.number_format import counted, figure
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.appearance import Compressed
from visioncal.estimation.joint import (
    ConvergedFit,
    FrameModel,
    MeasuredScale,
    measured_scale,
    moved_mahalanobis_sq,
    scale_by_stated_arms,
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
    for camera, compressed in zip(optics.problems, fitted.linearised.compressed, strict=True):
        noise = _noise_findings(optics.problems[camera], compressed)
        for finding in (*noise, *_lens_findings(fitted, camera)):
            yield finding.of("" if camera == ONLY_CAMERA else camera)
    scene = next(iter(optics.problems.values())).scene
    for board, target in enumerate(scene.targets):
        called = f"board {scene.names[board]}".strip()
        frame = frame_name("target", scene.names[board])
        measured = measured_scale(model, fitted, frame, board)
        if board not in optics.printed:
            if stated is not None:
                measured = scale_by_stated_arms(fitted, stated, frame) or measured
            yield from _point_findings(target, optics.values[optics.shape_of(board)])
            if measured.is_another and abs(measured.scale) >= _SAME_SIZE:
                yield scale_finding(f"target {target.name}", target, measured, measured)
            continue
        place = optics.shape_of(board)[0]
        if measured.is_another and place in fitted.linearised.moving:
            (at,) = fitted.columns_of(np.array([place]))
            sigma = float(covariance[at, at] ** 0.5)
            written = replace(measured, scale=float(optics.values[place]), sigma=sigma)
            yield scale_finding(called, target, measured, written)
        yield from _shape_findings(fitted, board, called)


def _noise_findings(problem: CornerProblem, compressed: Compressed) -> Iterator[Finding]:
    """Finding where corners scatter by more than corners.csv states."""
    stack, unknowns = problem.stack, problem.unknowns(compressed)
    stated, shown = stack.stated_px, stack.shown_px(compressed.residuals, unknowns)
    if stated is None or shown <= stated or not stack.contradicts(compressed.residuals, unknowns):
        return
    yield Finding(
        "corner_noise",
        f"The corners scatter by {figure(shown)} px, and corners.csv states {figure(stated)} px "
        "(sigma_px of a typical corner). The result goes by the scatter.",
        Remedy("Look for errors of the detector, the lens or the target that sigma_px leaves out."),
    )


def scale_finding(
    called: str, target: Target, measured: MeasuredScale, written: MeasuredScale
) -> Finding:
    """Finding on a board or rig of another size; a note where its stated sigma allows it.

    `measured` is the scale by the robot's motion, `written` that of the result, with its total
    sigma.
    """
    share = f"{figure(100 * measured.stated_sigma)} %"
    size = (
        f"By the robot's motion the {called} is {figure(100 * abs(written.scale))} % "
        f"{'larger' if written.scale > 0 else 'smaller'} than stated (sigma "
        f"{figure(100 * written.sigma)} %)"
    )
    if not measured.contradicts:
        allowed = f"{size}. The stated size allows this (to within {share})."
        return Finding(NOTE, f"{allowed} The result goes by both.")
    if target.is_rig:
        words = f"{size}. The result goes by the table of its points."
        do = (
            "Measure the distance of two points that are far apart. If the robot is right, "
            f"multiply the table's x_m, y_m and z_m by {1 + written.scale:.5g}; else check the arm."
        )
    else:
        kind, side = kind_of(target), 1e3 * target.square_m
        found = side * (1 + written.scale)
        words = (
            f"{size}: {kind.sides} of {found:.4g} mm, not of {side:.4g} mm (stated to within "
            f"{share}). The result takes the robot's scale; if the board is right, the arm's model "
            "is off by as much."
        )
        do = (
            f"Measure the board over its whole width. If the robot is right, write {kind.size_key} "
            f"= {1e-3 * found:.4g} in the board's .toml; else check the arm."
        )
    total = measured.sigma**2 + measured.stated_sigma**2
    square = measured.scale**2 / total
    return Finding("board_size", words, Remedy(do, CALIBRATE), mahalanobis_sq=square)


def _shape_findings(fitted: ConvergedFit, board: int, called: str) -> Iterator[Finding]:
    """Finding on a bent, stretched or sheared board, beyond the accuracy of printing."""
    optics = fitted.camera_parameters
    shape = optics.shape_of(board)[1:]
    aspect, *bends, shear = shape
    drawn = optics.with_values(shape, np.zeros(len(shape))).corners[board]
    off_m = np.linalg.norm(optics.corners[board] - drawn, axis=1).max()
    if not _has_changed(fitted, shape) or off_m < _LEAST_BEND_M:
        return
    parts = []
    if _has_changed(fitted, np.array([aspect])):
        longer = float(optics.values[aspect])
        far, near = ("y", "x") if longer > 0 else ("x", "y")
        parts.append(
            f"longer along its {far} than along its {near}, by {figure(100 * abs(longer))} %"
        )
    if _has_changed(fitted, np.array([shear])):
        corner_deg = 90.0 - np.rad2deg(float(optics.values[shear]))
        parts.append(f"sheared: its rows and columns meet at {corner_deg:.3f} deg")
    if _has_changed(fitted, np.array(bends)) or not parts:
        depth = figure(1e3 * float(np.ptp(optics.corners[board][:, 2])))
        parts.insert(0, f"not flat: its corners lie within {depth} mm of depth")
    words = f"The {called} is {', and '.join(parts)}. Its shape was estimated with the rest."
    flat = "Put the board on a stiff, flat plate, or print it on another printer, and record again."
    yield Finding("board_shape", words, Remedy(flat))


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


def _lens_findings(fitted: ConvergedFit, camera: str) -> Iterator[Finding]:
    optics = fitted.camera_parameters
    problem, lens = optics.problems[camera], optics.lens_of(camera)
    free = np.intersect1d(lens, fitted.linearised.moving)
    if problem.scene.mode == "refine" and not len(free):
        views = counted(len(problem.stack.views), "view", ("leaves", "leave"))
        yield Finding(
            "remark",
            f'intrinsics = "refine" was not done: {len(problem.stack.px)} corners in {views} too '
            "little to judge by.",
            Remedy(
                "Show a board with more corners, or more views, or state matrix_sigma_px, how well "
                "fx, fy, cx, cy are known."
            ),
        )
    if not problem.scene.estimated and len(free) and _has_changed(fitted, free):
        moves, stated_px = (optics.values - optics.stated)[lens[:4]], problem.stated_sigma[:4]
        moved = f"fx, fy, cx, cy moved by {_px(moves)} px."
        rays = normalise(problem.scene.camera, problem.stack.px)
        rays = np.column_stack([rays, np.ones(len(rays))])
        before, after = (project(at, rays) for at in (problem.scene.camera, optics.camera(camera)))
        moved_px = np.nanmax(np.linalg.norm(after - before, axis=1), initial=0.0)
        is_wrong = problem.scene.matrix_sigma_px is None
        is_wrong |= bool(np.any(np.abs(moves) > CONTRADICTION * stated_px))
        if is_wrong and moved_px > _LEAST_MOVE_PX:
            words = f"The given intrinsics do not fit these images and were refined: {moved}"
            yield Finding("lens", words, _NEW_LENS)
        else:
            allowed = "within what is stated, or by less than images show"
            yield Finding(NOTE, f"The given intrinsics were refined {allowed}: {moved}")
    seen = fitted.linearised
    if np.isin(lens, seen.free[seen.held]).any():
        at = fitted.columns_of(lens[:4])
        moves = held_shift(fitted.problem, fitted.fit)[at]
        covariance = covariance_of(fitted.problem, fitted.fit)[np.ix_(at, at)]
        squared = float(moves @ np.linalg.solve(covariance, moves))
        if np.abs(moves).max() > _LEAST_MOVE_PX and squared > chi2_limit(FALSE_ALARM, len(at)):
            yield Finding(
                "lens",
                "The given intrinsics do not fit these images: free, fx, fy, cx, cy would move by "
                f'{_px(moves)} px. But intrinsics = "hold" keeps them; what this does to the '
                "result counts in its sigmas.",
                _NEW_LENS,
                mahalanobis_sq=squared,
            )


def _has_changed(fitted: ConvergedFit, places: IntArray) -> bool:
    """Whether values differ significantly from the stated ones."""
    free = np.intersect1d(places, fitted.linearised.moving)
    if not len(free):
        return False
    return bool(moved_mahalanobis_sq(fitted, free) > chi2_limit(FALSE_ALARM, len(free)))


def _px(values: FloatArray) -> str:
    return ", ".join(f"{'-' if value < 0 else '+'}{figure(abs(value))}" for value in values)
