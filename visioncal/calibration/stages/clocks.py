"""Robot poses, from streams, for rows with a time and no pose.

Every pair of a camera and a robot has its own clock offset, estimated from the motion that both
observed.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.calibration.stages.clock_offset import ClockOffset
from visioncal.calibration.stages.clock_sweep import (
    CameraSweep,
    ClockedViews,
    ClockPair,
    misread_joints,
    set_clock,
)
from visioncal.calibration.stages.motion import lacks_robot_state, motion_of, stream_of
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.types import Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.problem_parts import Effect
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.document import ClockTable
from visioncal.session.kinds import is_camera_observation
from visioncal.vision.targets import numbered_positions

T = TypeVar("T", bound=Observed)


def waits_for_clock(session: Session) -> bool:
    """Tells whether rows have a time, and need a robot's pose that its stream may give."""
    return bool(_waiting(session))


def set_clocks(seen: T) -> T:
    """Gives rows the poses of robots at their times.

    Raises:
        DataError: The stream of a single robot has no poses and no usable joints, or no view of the
            single camera lies within it.
        DegenerateError: The motion of a single pair does not determine the offset, it is not
            stated, and too few views were taken at rest.
    """
    for pair, rows in _waiting(seen.session).items():
        seen = _with_clock(seen, pair, rows)
    return seen


def _waiting(session: Session) -> dict[ClockPair, list[View]]:
    """Rows that lack the pose of one robot with a stream, by pair; at least one has a time."""
    if not session.streams or not any(lacks_robot_state(view) for view in session.views):
        return {}
    waiting: dict[ClockPair, list[View]] = {}
    for observation in session.observations:
        view, lacks = observation.view, observation.missing_robots
        if len(lacks) == 1 and is_camera_observation(view) and stream_of(session, lacks[0]):
            waiting.setdefault(ClockPair(observation.seer, lacks[0]), []).append(view)
    return {pair: rows for pair, rows in waiting.items() if any(map(lacks_robot_state, rows))}


def _with_clock(seen: T, pair: ClockPair, rows: list[View]) -> T:
    """Adds the clock of a pair; one of several without a clock is only reported."""
    session, lens = seen.session, seen.lenses.get(pair.camera)
    document = session.robot_documents.get(pair.robot)
    # A single pair needs no name, and cannot do without its clock.
    is_only = max(len(session.cameras), len(session.robots)) < 2
    of = "" if is_only else pair.words
    on_flange = session.frames[pair.camera] == frame_name("flange", pair.robot)
    model = None if document is None else Robot.from_document(document)
    try:
        motion = motion_of(session, model, stream_of(session, pair.robot))
        sweep = CameraSweep(
            motion,
            "eye-in-hand" if on_flange else "eye-to-hand",
            tuple(rows),
            _stated_s(session, pair.camera),
            None if lens is None else lens.camera,
            numbered_positions(tuple(session.boards.values())),
        )
        clocked = _set_clock(sweep, seen.poses, model)
    except VisioncalError as error:
        if is_only:
            raise
        lost = [Rejection(row.number, f"no pose: {error.message}") for row in rows]
        step = Remedy(error.next_step) if error.next_step else None
        return seen.noting(lost, (Finding("clock", error.message, step).of(of),))
    robot_text = {"robot": pair.robot} if pair.robot else {}
    views = tuple(replace(view, text={**view.text, **robot_text}) for view in clocked.views)
    seen = replace(
        seen,
        clocks={**seen.clocks, pair: replace(clocked, views=views)},
        poses={**seen.poses, **clocked.poses},
        notes=(*seen.notes, *(f"{of}: {note}" if of else note for note in clocked.notes)),
    )
    return seen.noting(clocked.rejections, (warning.of(of) for warning in clocked.warnings))


def _set_clock(
    sweep: CameraSweep, poses: Mapping[int, ViewPoses], model: Robot | None
) -> ClockedViews:
    try:
        return set_clock(sweep, poses)
    except (DataError, DegenerateError) as error:
        misread = None if model is None else misread_joints(sweep, poses, model)
        if misread is None:
            raise
        raise misread from error


def _stated_s(session: Session, camera: str) -> float | None:
    """Stated clock offset of a camera [s], its own or that of all; None without one."""
    declared = session.declaration
    tables: dict[str, ClockTable] = {
        frame_name("camera", name): clock for name, clock in declared.clocks.items()
    }
    clock = tables.get(camera, declared.clock)
    return clock.camera_minus_robot_s if clock.model_fields_set else None


def clock_effects(
    cell: Cell, clocks: Mapping[ClockPair, ClockedViews], erring: Collection[str] = ()
) -> tuple[Effect, ...]:
    """Errors of clock offsets and delays [s], as effects on the cell's rows.

    Args:
        cell: The cell.
        clocks: The clocks of pairs.
        erring: Names in the problem of robots whose arm errors are unknowns of the fit.
    """
    views = [row.view for row in cell.rows]
    effects: list[Effect] = []
    for pair, clocked in clocks.items():
        clock, robot = clocked.clock, robot_key(pair.robot)
        if clock.speeds and robot in cell.poses:
            sigma_s = clock.prior_sigma_s(erring=robot in erring)
            effects.append(_offset_effect(cell, pair, clock, sigma_s))
            clear = (delay for delay in clock.delays if delay.is_clear)
            effects += [delay.effect(views, pair.delay(delay.of)) for delay in clear]
    return tuple(effects)


def _offset_effect(cell: Cell, pair: ClockPair, clock: ClockOffset, sigma_s: float) -> Effect:
    speeds, robot = clock.speeds, robot_key(pair.robot)
    concerned = np.array([row.view in speeds for row in cell.rows], dtype=bool)
    twists = np.zeros((len(cell.poses[robot]), 6))
    for row in cell.rows:
        if row.view in speeds:
            twists[row.station] = speeds[row.view]
    return replace(clock_effect(twists, sigma_s, pair.effect, robot), rows_concerned=concerned)
