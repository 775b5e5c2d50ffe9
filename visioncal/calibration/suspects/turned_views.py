"""Views of a symmetric board that corners.csv numbers from another of its corners than the rest."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.suspect import Suspect
from visioncal.core.number_format import view_words
from visioncal.core.transforms import invert
from visioncal.core.verdict import Finding, Option, mending
from visioncal.vision.targets import rotation_transforms


def _found(run: RunState) -> Iterator[Finding]:
    """Views whose pose is that of the board turned, which the fit took."""
    if not (run.session.has_one_pair and run.session.boards):
        return
    (board, *others) = run.session.boards.values()
    given = {view.number for view in run.session.views if view.has_corners}
    turns = {view.view: view.turns[0] for view in run.cell_fit.poses if view.view in given}
    # As many as not: either may be the right ones.
    (usual, _), *_ = Counter(turns.values()).most_common() or [(0, 0)]
    for turn in sorted({*turns.values()} - {usual}) if not others else ():
        symmetries = rotation_transforms(board)
        read = invert(symmetries[turn]) @ symmetries[usual]
        degrees = float(np.rad2deg(np.arctan2(read[1, 0], read[0, 0])))
        centre = 1e3 * np.linalg.solve(np.eye(2) - read[:2, :2], read[:2, 3])
        views = tuple(view for view, at in turns.items() if at == turn)
        about = ",".join(f"{value:g}" for value in np.round([degrees, *centre], 2).tolist())
        yield Finding(
            "turned_views",
            f"In {view_words(views)} corners.csv numbers the board's corners as if it was turned "
            f"by {abs(degrees):.0f} deg, which its pattern allows: the robot's motion shows it, "
            "and the fit turned them back.",
            mending("they are turned back", Option("turned", about, views)),
            views,
        )


TURNED_VIEWS = Suspect("turned_views", _found, is_doubt=False)
