"""The way of a session in order: one entry a step, of one camera and one robot or of a whole cell.

A step is one file in `calibration.stages`, or a few lines here that hand it what it needs.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from visioncal.calibration.pipeline.answer import answer_of
from visioncal.calibration.pipeline.judging import check_answer, findings_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.solving import solve
from visioncal.calibration.stages.cameras import detect_targets, estimate_lenses, locate_targets
from visioncal.calibration.stages.cell import pair_edges, read_cell
from visioncal.calibration.stages.clocks import set_clocks, waits_for_clock
from visioncal.calibration.stages.judge import judge
from visioncal.calibration.stages.kinematics import check_asked
from visioncal.calibration.stages.loads import check_stops
from visioncal.calibration.stages.motion import stream_of
from visioncal.calibration.stages.observed import all_held_back
from visioncal.calibration.stages.pictures import pairing, searched_images
from visioncal.calibration.stages.readings import (
    exchanged_points,
    probe_poses,
    read_instrument,
    read_instruments,
)
from visioncal.calibration.stages.robots import check_joints, check_read_joints, read_robots
from visioncal.core.errors import DataError
from visioncal.core.types import Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.session import STREAMS, Session


@dataclass(frozen=True)
class Stage:
    """One step of the way, by the name that progress shows."""

    name: str
    run: Callable[[RunState], RunState]


# How warnings about the robot's model begin, and how those about unknown names are told.
_OF_MODEL, _UNKNOWN_NAMES = "session.toml: robot.model:", ("is ignored", "was not read")
_MODEL_STEP = "Correct [robot] model in session.toml, or the file that it names."


def _read_robot(known: RunState) -> RunState:
    session = known.session
    if not session.views:
        what = "streams and no views" if session.streams else "no views"
        raise DataError(
            " ".join([f"session {session.name!r} has {what}.", *session.warnings]),
            culprits=[f"{STREAMS}/{stream}.csv" for stream in session.streams] or [session.name],
            next_step="Calibration needs views.csv; streams of torques alone are for visioncal "
            "dynamics identify.",
        )
    said = map(_suspicious, session.warnings)
    known = known.noting((), (*pairing(session), *said, *_not_used(known)))
    notes = (*session.declaration.corrected, *searched_images(session))
    known = replace(known, notes=(*known.notes, *notes))
    if len(known.held_back) == len(session.views):
        raise all_held_back(known)
    # Views that have a time alone get their poses once the camera's are known.
    return known if waits_for_clock(session) else _reported(known)


def _not_used(known: RunState) -> Iterator[Finding]:
    """Says what of a session no stage can use."""
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


def _suspicious(warning: str) -> Finding:
    """What is suspicious about a session; a robot that nobody knows costs its joint angles."""
    if warning.startswith(_OF_MODEL):
        return Finding("misread_joints", warning, Remedy(_MODEL_STEP))
    file, _, rest = warning.partition(": ")
    is_unknown = any(words in warning for words in _UNKNOWN_NAMES)
    step = Remedy(f"In {file}, correct or delete {rest.partition(' ')[0]}.") if is_unknown else None
    return Finding("remark", warning, step)


def _without_times(session: Session) -> str:
    """Asks for the times of views whose poses are in a stream; empty where that is not it."""
    stream = stream_of(session, "")
    if not stream or any(view.stamp_s is not None for view in session.views):
        return ""
    return (
        f"Fill in stamp_s, when each image was taken, and {STREAMS}/{stream}.csv gives the poses; "
        "or x_m to qw."
    )


def _reported(known: RunState) -> RunState:
    """Takes up what is reported of the robots."""
    known = read_robots(known)
    if known.mount is None:
        return known
    matched = known.reported.matched
    if matched is not None and matched.misread:
        check_asked(known.level, can=False, misread=matched.misread)
    if not known.base_from_flange:
        said = known.session.warnings
        of_model = [warning for warning in said if warning.startswith(_OF_MODEL)]
        raise DataError(
            " ".join(
                [*of_model, f"session {known.session.name!r}: no view has a pose of the robot."]
            ),
            culprits=known.lost_views,
            next_step=_without_times(known.session)
            or (_MODEL_STEP if of_model else " ".join(said))
            or "Fill in x_m to qw, or joint angles and [robot] model.",
        )
    views = tuple(known.base_from_flange)
    declared = {view.number: view.stop for view in known.session.views}
    check_stops(known.loads(views), views, [declared[view] for view in views])
    return known


def _readings(known: RunState) -> RunState:
    """Takes up what instruments read."""
    if known.mount == "instrument":
        readings = read_instrument(known.session)
        known = replace(known, readings=readings).noting(readings.rejections)
        check_read_joints(known, probe_poses(known.session, readings))
        if not readings.are_poses:
            if known.solver != "joint":
                raise DataError(
                    f"solver {known.solver!r} needs poses, and the instrument reads places alone.",
                    next_step="Leave --solver out.",
                )
            known = known.noting(exchanged_points(known, readings))
    poses = {
        view: instrument
        for view, instrument in read_instruments(known.session).items()
        if view not in known.reasons
    }
    return replace(known, poses={**known.poses, **poses})


def _clock(known: RunState) -> RunState:
    """Gives views that have a time alone the robot's poses out of its stream."""
    return _reported(set_clocks(known)) if waits_for_clock(known.session) else known


def _joints(known: RunState) -> RunState:
    """Refuses joints that only fit what the camera sees where they are read otherwise."""
    drops = known.level != "hand-eye"
    return check_joints(known, drops=drops, takes=drops and known.solver == "joint")


def _solve(known: RunState) -> RunState:
    cell = read_cell(known)
    return replace(known, read=cell, fit=solve(cell, known, known.level, known.solver))


def _examine(known: RunState) -> RunState:
    check_answer(known)
    answer = answer_of(known.cell, known, known.fitted, known.convention)
    out = (view for view in answer.views if not view.used and view.view not in known.held_back)
    known = replace(known, fit=answer.solved, answer=answer)
    return known.noting(Rejection(view.view, view.reason) for view in out)


def _judge(known: RunState) -> RunState:
    findings = findings_of(known)
    known = replace(known, warnings=tuple(findings.warnings), notes=tuple(findings.notes))
    return replace(known, findings=findings, verdict=judge(findings))


STAGES: tuple[Stage, ...] = (
    Stage("robot", _read_robot),
    Stage("readings", _readings),
    Stage("detect", lambda known: detect_targets(known, known.found_before)),
    Stage("intrinsics", estimate_lenses),
    Stage("pnp", locate_targets),
    Stage("clock", _clock),
    Stage("joints", _joints),
    Stage("solve", _solve),
    Stage("examine", _examine),
    Stage("judge", _judge),
)


def stages_before(name: str) -> tuple[Stage, ...]:
    """The steps that come before one."""
    return STAGES[: [stage.name for stage in STAGES].index(name)]
