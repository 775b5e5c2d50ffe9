"""Checks of a session's rows, images and board before any fit, and what to type."""

from pathlib import PurePath

from visioncal.calibration.stages.detect import image_of
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.other_board import other_board, spread
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import row_words, some_of
from visioncal.core.types import Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.images import IMAGE_ENDINGS, MISSING, FolderImages
from visioncal.session.kinds import is_camera_observation, is_instrument_reading
from visioncal.session.selecting import is_whole_cell


def missing_images(session: Session) -> Finding | None:
    """Finding on images that rows name and that do not exist."""
    searched = [view for view in session.views if view.image and not view.has_corners]
    missing = [view for view in searched if session.images.absence(view.image) == MISSING]
    if not missing:
        return None
    images = some_of([view.image for view in missing])
    views = tuple(view.number for view in missing)
    do = f"Copy them there; or in views.csv, delete {row_words(views)}."
    if len(missing) == len(searched):
        do = "Copy them there; or in views.csv, correct their folder and names."
        if other := _namesake(session, missing[0]):
            do = f"In views.csv, write {other} for {missing[0].image}, and the others alike."
    return Finding(
        "missing_images",
        f"{len(missing)} of {len(searched)} images are missing: {images}.",
        Remedy(do),
        views,
        until_mm=0.0,
    )


def _namesake(session: Session, view: View) -> str:
    """Path of the only image named as a missing one, in another folder or format, if any."""
    if not isinstance(session.images, FolderImages):
        return ""
    folder, stem = session.images.folder, PurePath(view.image).stem.lower()
    found = {
        file.relative_to(folder).as_posix()
        for file in (*folder.glob("*"), *folder.glob("*/*"))
        if file.stem.lower() == stem and file.suffix.lower() in IMAGE_ENDINGS
    } - {view.text.get("depth")}
    return found.pop() if len(found) == 1 else ""


def empty_rows(session: Session) -> Finding | None:
    """Finding on rows of one camera and one robot that observe nothing, where these are many."""
    views = tuple(
        view.number
        for view in session.views
        if not (is_camera_observation(view) or is_instrument_reading(view))
    )
    count = len(session.views)
    # In a whole cell, a row may state only where a robot was.
    is_many = CalibrationLimits().lost_share[0] * count < len(views) < count
    if is_whole_cell(session) or not is_many:
        return None
    return Finding(
        "lost_views",
        f"{len(views)} of {count} rows of views.csv have neither an image nor rows in corners.csv: "
        f"view {some_of([*map(str, views)])}.",
        Remedy(
            "Write corners.csv again, as a whole; or in views.csv, fill in column image of these "
            "rows, or delete them."
        ),
        views,
        until_mm=0.0,
    )


def unseen_cause(observed: Observed) -> Finding | None:
    """Finds why most images show nothing after the search, if known: files or another board."""
    with_target = observed.poses.keys() | observed.corners.keys()
    searched = [view for view in observed.session.views if view.image and not view.has_corners]
    unseen = [view for view in searched if view.number not in with_target]
    if not searched or 3 * len(unseen) < len(searched):
        return None
    missing = missing_images(observed.session)
    if missing is not None and 2 * len(missing.views) > len(unseen):
        return missing
    session = observed.session
    if session.target is None or session.targets:
        return None
    looked = [(view, image_of(session, view)) for view in spread(unseen)]
    shown = [(view, image) for view, image in looked if not isinstance(image, Rejection)]
    return other_board(session, "", shown) if shown else None
