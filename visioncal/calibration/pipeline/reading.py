"""Reads what a session has of robots, instruments and clocks: the stages before the fit."""

from collections.abc import Iterator
from dataclasses import replace

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import pair_edges
from visioncal.calibration.stages.clocks import set_clocks, waits_for_clock
from visioncal.calibration.stages.image_checks import empty_rows, missing_images
from visioncal.calibration.stages.kinematics import check_level_is_possible
from visioncal.calibration.stages.observed import all_held_back
from visioncal.calibration.stages.readings import (
    check_readings,
    probe_poses,
    read_instrument,
    read_instruments,
)
from visioncal.calibration.stages.robots import (
    check_joints,
    check_loads,
    check_read_joints,
    read_robots,
)
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.session import STREAMS, Session
from visioncal.session.columns import column_warnings
from visioncal.session.table import check_two_sides

_OF_ONE = (
    "Write the robot's own poses into x_m to qw of views.csv, or the camera's into cft_x_m to "
    "cft_qw; or convert the source again, with the fields or the file of each named."
)
_MODEL_STEP = "Correct the robot's model in session.toml, or the file that it names."


def read_cell_inputs(run: RunState) -> RunState:
    """Reads the robots' reported poses, and notes what of the session is not used.

    Raises:
        DataError: The session has no views, none that the fit may use, or no pose of the robot; or
            its poses are those of the camera once more.
    """
    session = run.session
    if not session.views:
        what = "streams and no views" if session.streams else "no views"
        raise DataError(
            " ".join([f"session {session.name!r} has {what}.", *session.warnings]),
            culprits=[f"{STREAMS}/{stream}.csv" for stream in session.streams] or [session.name],
            next_step="Calibration needs views.csv; streams of torques alone are for visioncal "
            "dynamics identify.",
        )
    lost = [found for found in (missing_images(session), empty_rows(session)) if found is not None]
    run = run.noting((), (*lost, *_suspicious(session), *_not_used(run)))
    run = replace(run, notes=(*run.notes, *session.declaration.corrected, *session.notes))
    if len(run.held_back) == len(session.views):
        raise all_held_back(run)
    check_two_sides(f"session {session.name!r}", session.views, _OF_ONE)
    # Views with only a time get their poses once the camera's are known.
    return run if waits_for_clock(session) else _reported(run)


def _not_used(run: RunState) -> Iterator[Finding]:
    """Reports declarations and columns that no stage can use."""
    session = run.session
    if not session.has_one_pair:
        return
    names = pair_edges(session)
    for edge in session.declaration.prior:
        if run.solver != "joint":
            reason = f"the closed form {run.solver} cannot"
            step = "Calibrate without --solver, which solves jointly."
        elif edge not in names and not session.declaration.has_names:
            reason = f"what is unknown of this session is {' and '.join(names)}"
            step = f"State the prior of one of these, or delete [prior.{edge}] from session.toml."
        else:
            continue
        yield Finding("unused", f"[prior.{edge}] was not used: {reason}.", Remedy(step))
    readings = sum(view.reading_m is not None for view in session.views)
    if readings and session.mount != "instrument":
        yield Finding(
            "unused",
            f"{counted(readings, 'row', ('has', 'have'))} an instrument's readings (meas_ "
            "columns), which were not used: images or measured poses (cft_ columns) precede "
            "them.",
            Remedy("Calibrate the arm by the instrument with a session of the readings alone."),
        )


def _suspicious(session: Session) -> Iterator[Finding]:
    """Findings on what was suspicious in the session's files, with remedies where known."""
    # A column that may be misspelt, or the user's own.
    of_columns = [*column_warnings(session.columns)]
    for warning in session.warnings:
        file = session.warned_files.get(warning)
        if warning in session.unread_models:
            yield Finding("misread_joints", warning, Remedy(_MODEL_STEP))
        elif file is None or warning in of_columns:
            yield Finding(NOTE, warning)
        else:
            step = Remedy(f"In {file}, correct or delete what this names.")
            yield Finding("remark", warning, step)


def _reported(run: RunState) -> RunState:
    """Reads the robots' reported poses."""
    run, session = read_robots(run), run.session
    if not session.has_one_pair:
        return run
    matched = run.reported.matched
    if matched is not None and matched.misread:
        check_level_is_possible(run.level, can=False, misread=matched.misread)
    if not run.base_from_flange:
        of_model = session.unread_models
        step = _MODEL_STEP if of_model else " ".join(session.warnings)
        raise DataError(
            " ".join([*of_model, f"session {session.name!r}: no view has a pose of the robot."]),
            culprits=run.lost_views,
            next_step=step
            or "Fill in x_m to qw, or joint angles and [robot] model; or, where a "
            "stream has the poses, stamp_s, when each image was taken.",
        )
    check_loads([view for view in session.views if view.number in run.base_from_flange])
    return run


def read_readings(run: RunState) -> RunState:
    """Reads the instruments' readings."""
    if run.mount == "instrument":
        readings = read_instrument(run.session)
        kept = {view: one for view, one in readings.views.items() if view not in run.repeats}
        readings = replace(readings, views=kept)
        run = replace(run, readings=readings).noting(readings.rejections)
        check_read_joints(run, probe_poses(run.session, readings))
        if not readings.are_poses:
            if run.solver != "joint":
                raise DataError(
                    f"solver {run.solver!r} needs poses, and the instrument reads positions only.",
                    next_step="Leave --solver out.",
                )
            check_readings(run, readings)
    read = read_instruments(run.session).items()
    not_used = run.reasons.keys() | run.repeats.keys()
    poses = {view: pose for view, pose in read if view not in not_used}
    return replace(run, poses={**run.poses, **poses})


def put_on_one_clock(run: RunState) -> RunState:
    """Interpolates the robot's poses in its stream for views with only a time."""
    return _reported(set_clocks(run)) if waits_for_clock(run.session) else run


def check_joint_angles(run: RunState) -> RunState:
    """Refuses joint angles that fit the camera's poses only if they are read differently."""
    return check_joints(run, drops=run.level != "hand-eye")
