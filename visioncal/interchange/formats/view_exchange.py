"""Exchanges the observations of two views of a session."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.session import Session
from visioncal.session.columns import INSTRUMENT_POSITION, INSTRUMENT_QUATERNION, MEASURED_CAM_POSE

# Columns of what a view shows; the rest of its row is the robot's pose.
_OBSERVED = ("image", *MEASURED_CAM_POSE, *INSTRUMENT_POSITION, *INSTRUMENT_QUATERNION)
# Columns that must agree between the two views.
_MUST_AGREE = ("camera", "target", "instrument", "point")


def exchange_views(session: Session, first: int, second: int) -> Session:
    """Exchanges the images, corners and readings of two views; the session notes it in `corrected`.

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
    first_cells, second_cells = cells[first], cells[second]
    differing = [
        name for name in _MUST_AGREE if first_cells.get(name, "") != second_cells.get(name, "")
    ]
    if first == second or differing:
        what = f"are of another {' and '.join(differing)}" if differing else "are the same view"
        raise DataError(
            f"Views {first} and {second} {what}: two views that see the same are exchanged.",
            culprits=["--exchange"],
        )
    for name in {*_OBSERVED} & {*session.columns}:
        first_cells[name], second_cells[name] = second_cells[name], first_cells[name]
    corners = session.corner_table
    if corners is not None:
        is_first, is_second = corners.views == first, corners.views == second
        views = np.where(is_first, second, np.where(is_second, first, corners.views))
        corners = replace(corners, views=views)
    note = f"the images of views {first} and {second} were exchanged"
    rows: Sequence[dict[str, str]] = [*cells.values()]
    return Session.assemble(
        {**session.document, "corrected": [*session.declaration.corrected, note]},
        session.columns,
        [[row[name] for name in session.columns] for row in rows],
        session.images,
        target_document=session.target_document,
        robot_document=session.robot_document,
        corners=corners,
    ).with_streams(session.streams)
