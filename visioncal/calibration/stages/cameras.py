"""What every camera saw: its corners, its lens, and the poses that each image allows."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

from visioncal.calibration.stages.dense import fit_densely
from visioncal.calibration.stages.detect import DetectOptions, detect
from visioncal.calibration.stages.intrinsics import estimate_intrinsics
from visioncal.calibration.stages.observed import CameraLook, Observed, nothing_seen
from visioncal.calibration.stages.pnp import estimate_poses, given_poses, measure_poses
from visioncal.core.errors import VisioncalError
from visioncal.core.types import Corners
from visioncal.results import CameraResult
from visioncal.session import Session, View, frame_name
from visioncal.session.kinds import name_of
from visioncal.session.tables import CameraTable
from visioncal.vision.targets import first_corners

T = TypeVar("T", bound=Observed)


def detect_targets(seen: T, given: Mapping[int, Corners] | None = None) -> T:
    """Finds the targets in the images of all cameras.

    Args:
        seen: What is known.
        given: What was found before, by view, each by its own board's numbers; None to look.

    Raises:
        DataError: See `detect`.
    """
    session, images = seen.session, _images(seen.session)
    # Nothing need be declared of an only camera.
    for name, table in (session.cameras or {"": CameraTable()}).items():
        frame = frame_name("camera", name)
        views, corners, resolution = images.get(frame, []), given or {}, table.size
        if not views:
            continue
        if given is None:
            with _naming(session, frame):
                options = DetectOptions(threads=seen.threads, keeps=seen.keeps_corners)
                found = detect(session, options, seen.progress, among=views)
            corners, resolution = found.corners, found.resolution
            seen = seen.noting(found.rejections)
            if seen.dense is not None:
                looked = fit_densely(session, views, corners, seen.dense, seen.progress)
                corners, seen = looked[0], replace(seen, dense=looked[1])
        mine = _numbered_through(session, views, corners)
        seen = seen.with_camera(frame, CameraLook(table, mine, resolution))
    return seen


def estimate_lenses(seen: T) -> T:
    """Takes the intrinsics of each camera as stated, or estimates them of its images.

    Raises:
        DataError: There are too few views.
        DegenerateError: The views do not determine a focal length at all.
        ConvergenceError: No start converges.
    """
    session, targets = seen.session, tuple(seen.session.boards.values())
    for frame, look in seen.cameras.items():
        fitted = {view: it for view, it in look.corners.items() if view not in seen.held_back}
        if not fitted or look.resolution is None:
            continue
        stated = look.table.stated
        if stated is not None:
            lens = CameraResult(stated, estimated=False)
        else:
            with _naming(session, frame):
                found = estimate_intrinsics(fitted, targets, look.resolution, look.table.model)
            lens = CameraResult(found.camera, estimated=True, covariance=found.covariance)
            of = frame if len(session.cameras) > 1 else ""
            seen = seen.noting(found.rejections, (it.of(of) for it in found.warnings))
        seen = seen.with_camera(frame, replace(look, lens=lens))
    return seen


def locate_targets(seen: T) -> T:
    """Estimates the target's pose in each view; those that the session gives are taken.

    What is held back neither sets the noise of the others nor is it left out for its own.

    Raises:
        DataError: No view shows a target, or a lens's distortion cannot be inverted at any view's
            corners.
    """
    session, targets = seen.session, tuple(seen.session.boards.values())
    poses = {**seen.poses, **given_poses(session)}
    for frame, look in seen.cameras.items():
        corners = {view: it for view, it in look.corners.items() if view not in seen.reasons}
        fitted = {view: it for view, it in corners.items() if view not in seen.held_back}
        if look.lens is None or not fitted:
            continue
        camera, covariance = look.lens.camera, look.lens.covariance
        with _naming(session, frame):
            found = estimate_poses(
                fitted, targets, camera, 0 if covariance is None else len(covariance)
            )
        rest = {view: it for view, it in corners.items() if view in seen.held_back}
        held = measure_poses(rest, targets, camera, found.sigma_px)
        poses |= {it.view: it for it in (*found.views, *held)}
        seen = seen.with_camera(frame, replace(look, pixel_px=found.sigma_px))
        seen = seen.noting(found.rejections)
    if not poses:
        raise nothing_seen(seen)
    return replace(seen, poses=poses)


def _images(session: Session) -> dict[str, list[View]]:
    """The views with images or corners, by the frame of the camera that took them."""
    found = defaultdict(list)
    for view in session.views:
        if view.image or view.has_corners:
            camera = name_of(session.declaration, "camera", view)
            found[frame_name("camera", camera)].append(view)
    return found


def _numbered_through(
    session: Session, views: Sequence[View], corners: Mapping[int, Corners]
) -> dict[int, Corners]:
    """The corners of some views, those of several boards numbered through."""
    starts = dict(
        zip(session.boards, first_corners(tuple(session.boards.values())).tolist(), strict=True)
    )
    mine = [it for it in views if it.number in corners]
    first = {it.number: starts[session.board_of(it)] for it in mine}
    return {it: replace(corners[it], ids=corners[it].ids + first[it]) for it in first}


@contextmanager
def _naming(session: Session, frame: str) -> Iterator[None]:
    """Names, of several cameras, the one that an error is of."""
    try:
        yield
    except VisioncalError as error:
        if len(session.cameras) < 2:
            raise
        raise error.within(frame) from error
