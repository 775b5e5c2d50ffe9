"""What is said of a session's facts that no stage can use."""

from collections.abc import Iterator

from visioncal.errors import DataError
from visioncal.estimation.chain import edge_names
from visioncal.pipeline.known import Known


def not_used(known: Known) -> Iterator[str]:
    """Says what the session declares and this version leaves aside."""
    session = known.session
    names = edge_names(session.mount)
    used = [it.name for it in known.priors]
    for edge in session.declaration.prior:
        if edge in used:
            continue
        reason = f"what is unknown of this session is {' and '.join(names)}"
        if known.solver != "joint":
            reason = f"the closed form {known.solver} cannot"
        elif edge in names:
            reason = "the session has several targets"
        yield f"[prior.{edge}] was not used: {reason}."
    readings = sum(view.reading_m is not None for view in session.views)
    if readings and session.mount != "instrument":
        yield (
            f"{readings} rows have an instrument's readings (meas_ columns), which were not used: "
            "where images or measured poses (cft_ columns) are there, these are. A session with "
            "the readings alone calibrates the arm by the instrument."
        )


def all_held_back(known: Known) -> DataError:
    """What to raise where the session keeps every usable view from the fit."""
    return DataError(
        f"session {known.session.name!r}: all views that could be used are held back (role = "
        "holdout), and none is left to fit.",
        next_step="Clear role in the rows that the fit may use.",
    )


def nothing_seen(known: Known) -> DataError:
    """What to raise where no view shows anything to calibrate by."""
    if known.corners and known.corners.keys() <= known.held_back:
        return all_held_back(known)
    if not any(view.image or view.has_corners for view in known.session.views):
        return DataError(
            f"session {known.session.name!r}: there are neither images nor measured poses.",
            next_step="Give the views images, rows in corners.csv, or cft_ or meas_ columns.",
        )
    few = [it for it in known.lost_views if "too few corners" in it]
    if few:
        return DataError(
            f"session {known.session.name!r}: no view shows enough of the target.",
            next_step="Bring more of the board into the images; one of 4 x 4 squares or more has "
            "corners enough.",
        )
    return DataError(
        f"session {known.session.name!r}: no view shows the target.",
        next_step="Look at an image: is the board in it, and is it the one that the session "
        "declares?",
    )
