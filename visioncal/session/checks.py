"""Checks of a session's parts against each other: contradictions, and probable mistakes."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.session import columns as cols
from visioncal.session.document import Declaration
from visioncal.session.table import View

# Plausible limits: an arm's reach [m] and a joint's range [rad].
_FAR_M, _WIDE_RAD = 20.0, 7.0
# Median position above which the unit is millimetres, not inches or centimetres.
_SURELY_MM = 200.0


def check_images_can_be_used(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks that target and camera are declared where there are images.

    Raises:
        DataError: One is not declared, and a view has an image or corners.
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
    """A key as written in session.toml: that of a table in brackets."""
    return f"[{key}]" if isinstance(value, Mapping) else key


def check_times(views: Sequence[View]) -> None:
    """Checks that times are plausible, so that their stamps resolve microseconds.

    Raises:
        DataError: One is not; it names the view.
    """
    for view in views:
        wrong = "" if view.stamp_s is None else cols.column_of("stamp_s").fault(view.stamp_s)
        if wrong:
            place = f"views.csv, view {view.number}, column stamp_s"
            raise DataError(f"{place}: {wrong}.", culprits=[place])


def unit_warning(views: Sequence[View], names: Sequence[str]) -> str:
    """Warning that most positions, in columns `names`, seem to be in another unit than metres."""
    norms = [
        float(np.linalg.norm([view.numbers[name] for name in names]))
        for view in views
        if names[0] in view.numbers
    ]
    far = [norm for norm in norms if norm > _FAR_M]
    if 2 * len(far) <= len(norms):
        return ""
    size, share = float(np.median(far)), ""
    if len(far) < len(norms):
        share = f" in {len(far)} of {len(norms)} rows"
    unit = (
        f"It looks like millimetres: multiply these columns by 0.001{share and ' there'}."
        if size > _SURELY_MM
        else "Metres are needed, and these are inches, centimetres or millimetres."
    )
    return f"views.csv: the median length of ({', '.join(names)}) is {size:.4g} m{share}. {unit}"


def view_warnings(views: Sequence[View]) -> Iterator[str]:
    """Warnings of positions and angles in another unit."""
    for names in (cols.POSITION, cols.MEASURED_CAM_POSE[:3]):
        if words := unit_warning(views, names):
            yield words
    angles = [float(np.abs(q).max()) for view in views if (q := view.joints_rad) is not None]
    if angles and float(np.median(angles)) > _WIDE_RAD:
        yield (
            f"views.csv: the largest joint angle of a row is {np.median(angles):.4g} rad in the "
            "median. It looks like degrees: multiply q1_rad ... by pi / 180."
        )
