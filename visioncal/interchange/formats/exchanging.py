"""Two views of a session that were exchanged, put right."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.session import Session
from visioncal.session.columns import INSTRUMENT_POSITION, INSTRUMENT_QUATERNION, MEASURED_CAM_POSE

# What a view shows; the rest of its row says where the robot stood.
_SHOWN = ("image", *MEASURED_CAM_POSE, *INSTRUMENT_POSITION, *INSTRUMENT_QUATERNION)
# Whose it is.
_BY_WHOM = ("camera", "target", "instrument", "point")


def exchange_views(session: Session, first: int, second: int) -> Session:
    """Gives each of two views the image, corners and readings of the other.

    The session says so in `corrected`.

    Args:
        session: The session.
        first: A view's number.
        second: Another's, of the same camera and target.

    Raises:
        DataError: There are no two such views.
    """
    cells = {
        view.number: {name: view.cell(name) for name in session.columns} for view in session.views
    }
    for view in (first, second):
        if view not in cells:
            raise DataError(
                f"There is no view {view} in session {session.name!r}; it has views "
                f"{min(cells, default=0)} to {max(cells, default=0)}.",
                culprits=["--exchange"],
            )
    one, other = cells[first], cells[second]
    apart = [name for name in _BY_WHOM if one.get(name, "") != other.get(name, "")]
    if first == second or apart:
        what = f"are of another {' and '.join(apart)}" if apart else "are the same view"
        raise DataError(
            f"Views {first} and {second} {what}: two views that see the same are exchanged.",
            culprits=["--exchange"],
        )
    for name in {*_SHOWN} & {*session.columns}:
        one[name], other[name] = other[name], one[name]
    corners = session.corner_table
    if corners is not None:
        is_first, is_second = corners.views == first, corners.views == second
        views = np.where(is_first, second, np.where(is_second, first, corners.views))
        corners = replace(corners, views=views)
    said = f"the images of views {first} and {second} were exchanged"
    rows: Sequence[dict[str, str]] = [*cells.values()]
    return Session.assemble(
        {**session.document, "corrected": [*session.declaration.corrected, said]},
        session.columns,
        [[row[name] for name in session.columns] for row in rows],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=corners,
    ).with_streams(session.streams)
