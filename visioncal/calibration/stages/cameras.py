"""Corners, intrinsics and target poses of each camera."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import permutations
from typing import TypeVar

import numpy as np

from visioncal.calibration.stages.corner_numbers import are_exchanged, are_from_behind
from visioncal.calibration.stages.corner_sizes import rms_px, scaled_views
from visioncal.calibration.stages.detect import (
    Detections,
    detect,
    image_of,
    other_sizes,
    unshown_rows,
)
from visioncal.calibration.stages.error_sizes import solve_session
from visioncal.calibration.stages.observed import CameraObservations, Observed, nothing_seen
from visioncal.calibration.stages.repeats import with_stop_means, without_repeats
from visioncal.core.errors import ConvergenceError, DegenerateError, VisioncalError
from visioncal.core.limits import CLEAR_RATIO, CalibrationLimits
from visioncal.core.number_format import figure, listed, ranges, view_words
from visioncal.core.types import Camera, Corners, FloatArray, Rejection, Target
from visioncal.core.verdict import CALIBRATE, Finding, Option, Remedy, mending
from visioncal.results import CameraResult
from visioncal.results.compare import intrinsics_names
from visioncal.session import Session, View, frame_name
from visioncal.session.columns import MEASURED_CAM_POSE
from visioncal.session.document import CameraTable
from visioncal.session.frames import object_name
from visioncal.session.kinds import name_of
from visioncal.vision.camera import normalise, project
from visioncal.vision.intrinsics import Intrinsics, estimate_intrinsics
from visioncal.vision.pnp import Poses, ViewPoses, estimate_poses, measure_poses
from visioncal.vision.targets import first_numbers

T = TypeVar("T", bound=Observed)

# Shares by which matrices of one lens differ, for images of two sizes.
_SAME_RATIO = 0.03
NEW_LENS = mending(
    "the lens is estimated from these views (or calibrate the camera anew, and state its matrix "
    "and distortion)",
    Option("intrinsics", "estimate"),
)
# A part of a picture begins farther from its corner than any centre is wrong [px].
_CROPPED_PX = 10.0


def detect_targets(seen: T, given: Mapping[int, Corners] | None = None) -> T:
    """Finds the targets in the images of all cameras, and rows that repeat others.

    Args:
        seen: The run's observations.
        given: Corners found before, by view, in their own board's numbers; None to search images.

    Raises:
        DataError: See `detect`.
    """
    session = seen.session
    # A single camera need not be declared.
    for name, table in (session.cameras or {"": CameraTable()}).items():
        views = [
            view
            for view in session.views
            if (view.image or view.has_corners)
            and name_of(session.declaration, "camera", view) == name
        ]
        corners, resolution, frame = given or {}, table.resolution, frame_name("camera", name)
        if not views:
            continue
        if given is None:
            with _naming(seen, frame):
                found = detect(
                    session,
                    seen.progress,
                    among=views,
                    threads=seen.threads,
                    pictures=seen.pictures,
                )
            seen = replace(seen, searches={**seen.searches, **found.searches})
            seen = seen.noting((), (*other_sizes(found), *unshown_rows(session, found)))
            corners, resolution = found.corners, found.resolution
            if seen.dense:
                first = seen.with_camera(
                    frame, CameraObservations(table, _numbered(session, views, corners), resolution)
                )
                seen, found = _with_dense(seen, first, views, found)
                corners = found.corners
            seen = seen.noting(found.rejections)
        seen = seen.with_camera(
            frame, CameraObservations(table, _numbered(session, views, corners), resolution)
        )
    return with_stop_means(without_repeats(seen))


def _numbered(
    session: Session, views: Sequence[View], corners: Mapping[int, Corners]
) -> dict[int, Corners]:
    """Corners of some views, those of several boards numbered through."""
    starts = first_numbers(session.boards)
    return {
        view.number: replace(at, ids=at.ids + starts[session.board_of(view)])
        for view in views
        if (at := corners.get(view.number)) is not None
    }


def _with_dense(
    seen: T, first: Observed, views: Sequence[View], detections: Detections
) -> tuple[T, Detections]:
    """Brings in views whose images the template refuses, by all pixels of their boards.

    `first` has the corners of the others, which tell about where these boards are.
    """
    from visioncal.vision.dense import DenseCorners, find_densely

    session, rows = seen.session, {view.number: view for view in views}
    refused = [
        view
        for view in (rows[rejection.view] for rejection in detections.rejections)
        if not view.has_corners
        and detections.searches[view.number].size == detections.resolution
        and not session.boards[session.board_of(view)].is_rig
    ]
    found: dict[int, DenseCorners] = {}
    starts = _predicted(first, {view.number for view in refused})
    for count, view in enumerate(refused, start=1):
        image = image_of(session, view)
        if not isinstance(image, Rejection):
            board = session.boards[session.board_of(view)]
            dense = find_densely(image, board, starts.get(view.number))
            found |= {} if dense is None else {view.number: dense}
        if seen.progress is not None:
            seen.progress("dense", count, len(refused))
    if not found:
        return seen, detections
    # The noise of each view is estimated later.
    typical_px = float(np.nanmedian(np.concatenate([dense.sigma_px for dense in found.values()])))
    corners = dict(detections.corners) | {
        view: Corners(view, at.ids, at.px, at.width_px, typical_px / at.sigma_px)
        for view, at in found.items()
    }
    note = (
        f"The corners of view {ranges(found)} are by all pixels of their images (--dense), "
        "as these are blurred."
    )
    lost = [rejection for rejection in detections.rejections if rejection.view not in found]
    # Travel during an exposure from which on it matters when the robot's pose was read [m].
    moving = {view: at.motion_m for view, at in found.items() if at.motion_m > 2e-4}
    if moving:
        most_mm = figure(1e3 * max(moving.values()))
        note += f" The board moves by up to {most_mm} mm during an exposure"
        if {"clock", "clocks"} & session.document.keys():
            note += ": stamps and [clock] have to be those of mid-exposure."
        else:
            why = (
                "its board moves during the exposure, and of which moment the robot's pose is, is "
                "not known: it serves the lens alone"
            )
            lost += [Rejection(view, why) for view in moving]
            note += (
                f", so that view {ranges(moving)} serves the lens alone. Where the robot's poses "
                "are of mid-exposure, write [clock] into session.toml, and they count."
            )
    return replace(seen, notes=(*seen.notes, note)), replace(
        detections,
        corners={view.number: corners[view.number] for view in views if view.number in corners},
        rejections=tuple(lost),
    )


def _predicted(first: Observed, views: Collection[int]) -> dict[int, tuple[Camera, FloatArray]]:
    """Lenses and (4, 4) poses of boards in some views, by a fit of the others if it has them."""
    if not views:
        return {}
    try:
        fit = solve_session(first).fit
    except VisioncalError:
        return {}
    found, stops = {}, {station: at for at, station in enumerate(fit.cell.stations)}
    for row in first.timed.observations:
        if row.view.number in views and row.station in stops:
            moments = fit.cell.moments.take(np.array([stops[row.station]]))
            (pose,) = fit.predict(row.seer, row.seen, moments).poses
            if np.isfinite(pose).all():
                found[row.view.number] = fit.camera(row.seer), pose
    return found


def estimate_lenses(seen: T) -> T:
    """Takes the stated intrinsics of each camera, or estimates them from its images.

    Raises:
        DataError: There are too few views.
        DegenerateError: The views do not determine a focal length at all.
        ConvergenceError: No start converges.
    """
    targets = tuple(seen.session.boards.values())
    for frame, look in seen.cameras.items():
        fitted = {view: px for view, px in look.corners.items() if view not in seen.held_back}
        if not fitted or look.resolution is None:
            continue
        if look.table.stated is not None:
            lens = CameraResult(look.table.stated, estimated=False)
        else:
            with _naming(seen, frame):
                try:
                    fit = estimate_intrinsics(fitted, targets, look.resolution, look.table.model)
                    seen, alike = _of_one_size(seen, frame, fitted, fit)
                    if len(alike) < len(fitted):
                        fit = estimate_intrinsics(alike, targets, look.resolution, look.table.model)
                    lens = CameraResult(fit.camera, estimated=True, covariance=fit.covariance)
                    seen = seen.noting(fit.rejections)
                except (ConvergenceError, DegenerateError) as error:
                    # Far boards are flat in their images.
                    lens = _by_motion(seen, frame, error)
                    failure = f"By its views alone: {error.message} {error.next_step}"
                    words = f"The robot's motion determined the lens. {failure}"
                    seen = replace(seen, notes=(*seen.notes, words))
        seen = seen.with_camera(frame, replace(look, lens=lens))
    return seen


def _of_one_size(
    seen: T, frame: str, corners: Mapping[int, Corners], fit: Intrinsics | Poses
) -> tuple[T, Mapping[int, Corners]]:
    """The run and some of its corners, without those of corners.csv of pictures of another size.

    These are looked for where views scatter unequally about the lens of the fit, or the stated one.
    """
    look, targets = seen.cameras[frame], tuple(seen.session.boards.values())
    if seen.session.corner_table is None or look.resolution is None:
        return seen, corners
    by_all = fit.camera if isinstance(fit, Intrinsics) else look.table.stated
    if by_all is None:
        # They were found as the lens was estimated.
        return seen, corners
    given = [view.number for view in seen.session.views if view.has_corners]
    is_stated = not isinstance(fit, Intrinsics)
    scaled = scaled_views(corners, targets, look.resolution, by_all, given, is_stated=is_stated)
    if scaled is None:
        return seen, corners
    why = "its corners are those of a smaller picture"
    finding = scaled.finding.of(frame if len(seen.session.cameras) > 1 else "")
    seen = seen.noting((Rejection(view, why) for view in scaled.views), (finding,))
    seen = replace(seen, shares={**seen.shares, **dict.fromkeys(scaled.views, scaled.share)})
    return seen, {view: at for view, at in corners.items() if view not in scaled.views}


def shows_print(seen: Observed) -> bool:
    """Whether images are none of a mirror: the markers in them are as printed."""
    session, corners = seen.session, seen.corners
    views = [view for view in session.views if view.number in corners]
    pairs = [(corners[view.number], session.boards[session.board_of(view)]) for view in views]
    # Another program's corner numbers are no markers that were seen.
    are_detected = all(view.image and not view.has_corners for view in views)
    has_markers = are_detected and all(at.dictionary and not at.is_rig for _, at in pairs)
    return bool(pairs) and has_markers and not are_from_behind(pairs)


def exchanged_columns(seen: Observed) -> bool:
    """Whether u and v are exchanged in the corners.csv of one camera, as its lens shows.

    An estimated lens shows it by its centre, a stated one by the corners' misfit.
    """
    boards = seen.session.boards
    if seen.session.corner_table is None or len(seen.cameras) != 1:
        return False
    (look,) = seen.cameras.values()
    views = [view for view in seen.session.views if view.number in look.corners]
    pairs = [(look.corners[view.number], boards[seen.session.board_of(view)]) for view in views]
    if look.lens is None or look.resolution is None or len(boards) != 1:
        return False
    if look.lens.estimated:
        return are_exchanged(pairs, look.resolution, look.lens.camera.matrix[2:])
    if not pairs or not are_from_behind(pairs):
        return False
    as_given = {at.view: at for at, _ in pairs}
    turned = {view: replace(at, px=at.px[:, ::-1]) for view, at in as_given.items()}
    given_px, turned_px = (
        float(np.median(rms_px(some, tuple(boards.values()), look.lens.camera)))
        for some in (as_given, turned)
    )
    return CLEAR_RATIO * turned_px < given_px


def _by_motion(seen: Observed, frame: str, error: VisioncalError) -> CameraResult:
    """A lens by the robot's motion; raises the error of the views alone where that fails."""
    try:
        fit = solve_session(seen).fit
    except VisioncalError:
        raise error from None
    return CameraResult(
        fit.camera(frame), estimated=True, covariance=fit.covariance(("lens", frame))
    )


_OF_ZEROS = "its measured position of the target is zero, as where nothing was seen"


def locate_targets(seen: T) -> T:
    """Estimates the target's pose in each view, or takes it from the session where given.

    Views that are held back do not affect the noise level, nor are they rejected for their own.

    Raises:
        DataError: No view shows a target, or a lens's distortion cannot be inverted at any view's
            corners.
    """
    session, targets = seen.session, tuple(seen.session.boards.values())
    stated = stated_poses(session)
    # Programs write zeros where they saw nothing: no target is at the camera's own origin.
    zeros = [view for view, at in stated.items() if not at.cam_from_target[0, :3, 3].any()]
    seen = seen.noting(Rejection(view, _OF_ZEROS) for view in zeros)
    given = {view: at for view, at in stated.items() if view not in {*seen.repeats, *zeros}}
    poses = {**seen.poses, **given}
    for frame, look in seen.cameras.items():
        corners = {view: px for view, px in look.corners.items() if view not in seen.reasons}
        fitted = {view: px for view, px in corners.items() if view not in seen.held_back}
        lens, of = look.lens, frame if len(session.cameras) > 1 else ""
        if lens is None or not fitted:
            continue
        with _naming(seen, frame):
            free = 0 if lens.covariance is None else len(lens.covariance)
            fit = estimate_poses(fitted, targets, lens.camera, free)
            seen, alike = _of_one_size(seen, frame, fitted, fit)
            if len(alike) < len(fitted):
                fit = estimate_poses(alike, targets, lens.camera, free)
        if fit.sigma_px > CalibrationLimits().pixel_px[0] and not lens.estimated:
            other = _other_lens(look, targets, alike, fit.sigma_px)
            if other is not None:
                lens, fit, finding = other
                seen = seen.noting((), (finding.of(of),))
        holdout = {view: px for view, px in corners.items() if view in seen.held_back}
        held = measure_poses(holdout, targets, lens.camera, fit.sigma_px)
        poses |= {view.view: view for view in (*fit.views, *held)}
        seen = seen.with_camera(frame, replace(look, lens=lens, pixel_px=fit.sigma_px))
        seen = seen.noting(fit.rejections)
    if not poses:
        raise nothing_seen(seen)
    return _with_misnamed(replace(seen, poses=poses))


def _with_misnamed(seen: T) -> T:
    """Notes views that no pose fits by the lens of their camera, and one does by another's."""
    targets, edits, views = tuple(seen.session.boards.values()), list[str](), list[int]()
    located = {frame: look for frame, look in seen.cameras.items() if look.pixel_px is not None}
    for (frame, look), (other, rival) in permutations(located.items(), 2):
        lost = {view: at for view, at in look.corners.items() if view not in seen.poses}
        if not lost or look.lens is None or rival.lens is None or rival.pixel_px is None:
            continue
        lenses = look.lens.camera, rival.lens.camera
        by_own, by_other = (rms_px(lost, targets, lens) for lens in lenses)
        fits = (by_other < CLEAR_RATIO * rival.pixel_px) & (CLEAR_RATIO * by_other < by_own)
        if found := [view for view, is_of_other in zip(lost, fits, strict=True) if is_of_other]:
            names = [object_name(name, "cam") for name in (other, frame)]
            edits.append(f"{' for '.join(names)} in column camera of {view_words(found)}")
            views += found
    if not views:
        return seen
    fit, rows, its = "fits a", "this row has", "its"
    if len(views) > 1:
        fit, rows, its = "fit a", "these rows have", "their"
    words = f"{view_words(sorted(views))} {fit} pose of {its} target by the lens of another camera "
    words += f"alone: {rows} the name of that camera in place of {its} own."
    do = Remedy(f"In views.csv, write {listed(edits)}, and calibrate again.", CALIBRATE)
    words = f"{words[0].upper()}{words[1:]}"
    return seen.noting((), (Finding("misnamed_rows", words, do, tuple(sorted(views))),))


def _other_lens(
    look: CameraObservations,
    targets: Sequence[Target],
    corners: Mapping[int, Corners],
    stated_px: float,
) -> tuple[CameraResult, Poses, Finding] | None:
    """The lens estimated from the images, where the stated one cannot be this camera's."""
    stated = look.table.stated
    if look.resolution is None or stated is None:
        return None
    try:
        lens = estimate_intrinsics(corners, targets, look.resolution, look.table.model)
    except VisioncalError:
        # The images do not determine a lens, or show another board than the stated one.
        return None
    change = np.abs(lens.camera.matrix[:2] / stated.matrix[:2] - 1.0)
    # Stated intrinsics belong to another camera where estimated ones fit clearly better, and either
    # a focal length differs by more than any focusing [share] or the stated ones fit badly.
    is_other = change.max() > 0.1 or stated_px > CalibrationLimits().pixel_px[1]
    if not is_other or CLEAR_RATIO * lens.sigma_px > stated_px:
        return None
    poses = estimate_poses(corners, targets, lens.camera, len(lens.covariance))
    words = (
        "The stated matrix and distortion are not this camera's, or of images of another size: by "
        f"them corners deviate by {figure(stated_px)} px from any pose of the target, by a lens "
        f"estimated of these images by {figure(poses.sigma_px)} px. The estimated one was taken: "
        f"fx, fy, cx, cy = {', '.join(f'{value:.1f}' for value in lens.camera.matrix)} px."
    )
    ratios = stated.matrix / lens.camera.matrix
    px = np.concatenate([at.px for at in corners.values()])
    moved_px, _ = most_moved_px(stated, lens.camera, px)
    if misread := misread_lens(stated, lens.camera, px, moved_px):
        words += misread
    elif np.abs(ratios - 1.0).max() < _SAME_RATIO:
        order = ", ".join(intrinsics_names(stated)[4:])
        words += " The matrix is about as stated: the distortion is another one, or another "
        words += f"program's order of it (OpenCV's is {order})."
    elif np.ptp(ratios) < _SAME_RATIO * ratios.mean():
        width, height = (round(ratios.mean() * side, -1) for side in look.resolution)
        words += f" Those stated are all {figure(ratios.mean())} times as large, as of images of "
        words += f"about {width:.0f} x {height:.0f} px."
    result = CameraResult(lens.camera, estimated=True, covariance=lens.covariance)
    return result, poses, Finding("other_lens", words, NEW_LENS)


def misread_lens(stated: Camera, refined: Camera, px: FloatArray, moved_px: float) -> str:
    """How stated intrinsics fit after all, as a sentence; empty where no way is known.

    Another order of the matrix or of five coefficients, pictures that are rectified, or a part of
    them.
    """
    ways, moves = dict[str, Camera](), refined.matrix[2:] - stated.matrix[2:]
    by_rows = stated.matrix[[0, 2, 1, 3]]
    listed = ", ".join(f"{value:.6g}" for value in by_rows)
    words = "The stated matrix is in the order fx, cx, fy, cy: write "
    words += f"matrix = [{listed}], which is fx, fy, cx, cy."
    ways[words] = replace(stated, matrix=by_rows)
    if stated.model == "brown" and stated.distortion.any():
        flat = np.zeros(len(stated.distortion))
        words = "The pictures are rectified: write distortion = [0, 0, 0, 0, 0]."
        ways[words] = replace(stated, distortion=flat)
    if stated.model == "brown" and len(stated.distortion) == 5:
        other = stated.distortion[[0, 1, 3, 4, 2]]
        words = "They are in the order k1, k2, k3, p1, p2, and OpenCV's is k1, k2, p1, p2, k3: "
        words += f"write distortion = [{', '.join(f'{value:.6g}' for value in other)}]."
        ways[words] = replace(stated, distortion=other)
    # A part begins within the picture, and no centre is known to the pixel.
    if max(-moves) > _CROPPED_PX and min(-moves) > -_CROPPED_PX:
        right, below = (max(round(-move), 0) for move in moves.tolist())
        words = (
            f"The pictures are a part of this lens's, which begins {right} px to the right and "
            f"{below} px below: subtract these from the centre in matrix."
        )
        ways[words] = replace(stated, matrix=np.append(stated.matrix[:2], refined.matrix[2:]))
    left = {words: most_moved_px(lens, refined, px)[0] for words, lens in ways.items()}
    best = min(left, key=left.__getitem__, default="")
    # So little of the move is left where stated intrinsics were misread.
    return f" {best}" if best and left[best] < 0.1 * moved_px else ""


def most_moved_px(stated: Camera, other: Camera, px: FloatArray) -> tuple[float, float]:
    """Most that corners move from one lens to another, in all and by its distortion [px]."""
    rays = normalise(stated, px)
    rays = np.column_stack([rays, np.ones(len(rays))])
    # By the matrix alone, the rest is the distortion's.
    unbent = replace(other, distortion=stated.distortion)
    after = project(other, rays)
    moved_px, bent_px = (
        float(np.nanmax(np.linalg.norm(after - project(at, rays), axis=1), initial=0.0))
        for at in (stated, unbent)
    )
    return moved_px, bent_px


@contextmanager
def _naming(seen: Observed, frame: str) -> Iterator[None]:
    """Adds the camera's frame, where there are several, to errors."""
    try:
        yield
    except VisioncalError as error:
        if len(seen.session.cameras) < 2:
            raise
        raise error.within(frame) from error


def stated_poses(session: Session) -> dict[int, ViewPoses]:
    """Collects the poses that the session states itself (`cft_` columns), by view."""
    boards = {name: at for at, name in enumerate(session.boards)}
    given = ((view, view.matrix(MEASURED_CAM_POSE)) for view in session.views)
    return {
        view.number: ViewPoses(
            view.number,
            None,
            pose[None],
            (0,),
            np.zeros((1, 6, 6)),
            np.zeros((1, 6, 0)),
            boards.get(session.board_of(view), 0),
        )
        for view, pose in given
        if pose is not None
    }
