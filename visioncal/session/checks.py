"""What a session's parts say about each other: contradictions, and what looks like a mistake."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.session import columns as known
from visioncal.session.document import Declaration
from visioncal.session.table import View

# No arm reaches this far [m], and no joint of one turns this far [rad].
_FAR_M, _WIDE_RAD = 20.0, 7.0
# Positions in inches or centimetres are under this number, those in millimetres mostly beyond.
_SURELY_MM = 200.0


def check_images_can_be_used(declaration: Declaration, views: Sequence[View]) -> None:
    """An image says nothing without the target that it shows and the camera that took it.

    Raises:
        DataError: One of these is not declared, and a view has an image, or corners of one.
    """
    with_image = [view for view in views if view.image or view.has_corners]
    for field, declared, example in (
        (
            "target",
            declaration.target or declaration.targets or None,
            'target = "charuco_9x6_30mm", or the name or .toml of your board',
        ),
        ("camera", declaration.camera or declaration.cameras or None, "[camera]"),
    ):
        if with_image and declared is None:
            for key, value in (declaration.model_extra or {}).items():
                if key.lower()[:3] == field[:3] or did_you_mean(key, (field,)):
                    raise DataError(
                        f"session.toml: {key} is no known name; {field} is needed.",
                        culprits=[f"session.toml: {key}"],
                        next_step=f"In session.toml, replace {_as_written(key, value)} by "
                        f"{_as_written(field, value)}.",
                    )
            raise DataError(
                f"session.toml: {field} is missing, but view {with_image[0].number} has "
                f"{'an image' if with_image[0].image else 'rows in corners.csv'}.",
                culprits=[f"session.toml: {field}"],
                next_step=f"Add {example}.",
            )


def _as_written(key: str, value: object) -> str:
    """How session.toml has a key: that of a table in brackets."""
    return f"[{key}]" if isinstance(value, Mapping) else key


def check_times(views: Sequence[View]) -> None:
    """No time of a recording is beyond what its stamps can resolve.

    Raises:
        DataError: One is; it names the view.
    """
    for view in views:
        wrong = "" if view.stamp_s is None else known.no_size("stamp_s", np.array([view.stamp_s]))
        if wrong:
            place = f"views.csv, view {view.number}, column stamp_s"
            raise DataError(f"{place}: {wrong}.", culprits=[place])


def unit_warning(views: Sequence[View], names: Sequence[str]) -> str:
    """What looks like another unit than metres in most rows; empty where nothing does.

    Args:
        views: The rows.
        names: The columns of a position.
    """
    norms = [
        float(np.linalg.norm([view.numbers[name] for name in names]))
        for view in views
        if names[0] in view.numbers
    ]
    far = [norm for norm in norms if norm > _FAR_M]
    if 2 * len(far) <= len(norms):
        return ""
    away, some = float(np.median(far)), ""
    if len(far) < len(norms):
        some = f" in {len(far)} of {len(norms)} rows"
    unit = (
        f"It looks like millimetres: multiply these columns by 0.001{some and ' there'}."
        if away > _SURELY_MM
        else "Metres are needed, and these are inches, centimetres or millimetres."
    )
    return f"views.csv: the median length of ({', '.join(names)}) is {away:.4g} m{some}. {unit}"


def view_warnings(views: Sequence[View]) -> Iterator[str]:
    """Words what looks like another unit, or like a row that was copied."""
    for names in (known.POSITION, known.MEASURED_CAM_POSE[:3]):
        if words := unit_warning(views, names):
            yield words
    angles = [float(np.abs(q).max()) for view in views if (q := view.joints_rad) is not None]
    if angles and float(np.median(angles)) > _WIDE_RAD:
        yield (
            f"views.csv: the largest joint angle of a row is {np.median(angles):.4g} rad in the "
            "median. It looks like degrees: multiply q1_rad ... by pi / 180."
        )
