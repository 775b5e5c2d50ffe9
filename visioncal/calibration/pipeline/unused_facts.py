"""What is said of a session's facts that no stage can use."""

from collections.abc import Iterator

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import pair_edges
from visioncal.core.verdict import Finding


def not_used(known: RunState) -> Iterator[Finding]:
    """Says what the session declares and this version leaves aside."""
    session = known.session
    if known.mount is None:
        return
    names = pair_edges(session)
    for edge in session.declaration.prior:
        is_used = edge in names or session.declaration.has_names
        if is_used and known.solver == "joint":
            continue
        reason = f"what is unknown of this session is {' and '.join(names)}"
        if known.solver != "joint":
            reason = f"the closed form {known.solver} cannot"
        yield Finding("unused", f"[prior.{edge}] was not used: {reason}.")
    readings = sum(view.reading_m is not None for view in session.views)
    if readings and session.mount != "instrument":
        yield Finding(
            "unused",
            f"{readings} rows have an instrument's readings (meas_ columns), which were not used: "
            "where images or measured poses (cft_ columns) are there, these are. A session with "
            "the readings alone calibrates the arm by the instrument.",
        )
