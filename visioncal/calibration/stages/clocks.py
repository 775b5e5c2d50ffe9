"""Rows that have a time and no pose of a robot: its stream gives them the pose.

Every pair of a camera and a robot has clocks of its own, whose offset is estimated from the motion
that both have seen.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.calibration.stages.clock_offset import ClockOffset
from visioncal.calibration.stages.clock_sweep import (
    CameraSweep,
    Clocked,
    ClockPair,
    misread_joints,
    set_clock,
)
from visioncal.calibration.stages.motion import is_open, motion_of, stream_of
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.types import Rejection
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.parts import Effect
from visioncal.robot import Robot
from visioncal.session import Session, View, frame_name
from visioncal.session.kinds import is_seen
from visioncal.session.tables import ClockTable
from visioncal.vision.targets import numbered_positions

T = TypeVar("T", bound=Observed)


def waits_for_clock(session: Session) -> bool:
    """Tells whether rows have a time, and the pose of the robot that they need in a stream."""
    return bool(_waiting(session))


def set_clocks(seen: T) -> T:
    """Gives rows the poses of robots at their times.

    Raises:
        DataError: The stream of an only robot has no poses, and no joints that its model knows, or
            no view of its only camera lies within it.
        DegenerateError: The motion of an only pair does not determine the offset, it is not stated,
            and too few views were taken at rest.
    """
    for pair, rows in _waiting(seen.session).items():
        seen = _with_pair(seen, pair, rows)
    return seen


def _waiting(session: Session) -> dict[ClockPair, list[View]]:
    """The rows that lack the pose of one robot that has a stream, where any of them has a time."""
    if not session.streams or not any(is_open(view) for view in session.views):
        return {}
    found: dict[ClockPair, list[View]] = {}
    for observation in session.observations:
        if (
            len(observation.lacks) == 1
            and is_seen(observation.view)
            and stream_of(session, observation.lacks[0])
        ):
            found.setdefault(ClockPair(observation.seer, observation.lacks[0]), []).append(
                observation.view
            )
    return {pair: rows for pair, rows in found.items() if any(map(is_open, rows))}


def _with_pair(seen: T, pair: ClockPair, rows: list[View]) -> T:
    session, lens = seen.session, seen.lenses.get(pair.camera)
    document = session.robot_documents.get(pair.robot)
    # An only pair needs no name, and there is nothing to go on with where it has no clock.
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
        clocked = _set(sweep, seen.poses, model)
    except VisioncalError as error:
        if is_only:
            raise
        lost = [Rejection(row.number, f"no pose: {error.message}") for row in rows]
        found = Finding(
            "clock", error.message, Remedy(error.next_step) if error.next_step else None
        )
        return seen.noting(lost, (found.of(of),))
    named = {"robot": pair.robot} if pair.robot else {}
    views = tuple(replace(view, text={**view.text, **named}) for view in clocked.views)
    seen = replace(
        seen,
        clocks={**seen.clocks, pair: replace(clocked, views=views)},
        poses={**seen.poses, **clocked.poses},
        notes=(*seen.notes, *(f"{of}: {note}" if of else note for note in clocked.notes)),
    )
    return seen.noting(clocked.rejections, (warning.of(of) for warning in clocked.warnings))


def _set(sweep: CameraSweep, poses: Mapping[int, ViewPoses], model: Robot | None) -> Clocked:
    try:
        return set_clock(sweep, poses)
    except (DataError, DegenerateError) as error:
        misread = None if model is None else misread_joints(sweep, poses, model)
        if misread is None:
            raise
        raise misread from error


def _stated_s(session: Session, camera: str) -> float | None:
    """What the session states of a camera's clock, or of all of them."""
    declared = session.declaration
    tables: dict[str, ClockTable] = {
        frame_name("camera", name): clock for name, clock in declared.clocks.items()
    }
    clock = tables.get(camera, declared.clock)
    return clock.camera_minus_robot_s if clock.model_fields_set else None


def clock_effects(
    cell: Cell, clocks: Mapping[ClockPair, Clocked], erring: Collection[str] = ()
) -> tuple[Effect, ...]:
    """The errors of offsets and times within images [s], as effects on the cell's rows.

    Args:
        cell: The cell.
        clocks: What was found of clocks.
        erring: The robots, as the problem has them, whose arms' errors are unknowns of the fit.
    """
    views = [row.view for row in cell.rows]
    found: list[Effect] = []
    for pair, clocked in clocks.items():
        if clocked.clock.speeds and robot_key(pair.robot) in cell.poses:
            errs = robot_key(pair.robot) in erring
            found.append(_effect(cell, pair, clocked.clock, clocked.clock.known_s(erring=errs)))
            found += [
                delay.effect(views, pair.delay(delay.of))
                for delay in clocked.clock.delays
                if delay.is_clear
            ]
    return tuple(found)


def _effect(cell: Cell, pair: ClockPair, clock: ClockOffset, sigma_s: float) -> Effect:
    speeds = clock.speeds
    concerned = np.array([row.view in speeds for row in cell.rows], dtype=bool)
    robot = robot_key(pair.robot)
    moving = np.zeros((len(cell.poses[robot]), 6))
    for row in cell.rows:
        if row.view in speeds:
            moving[row.station] = speeds[row.view]
    found = clock_effect(moving, sigma_s, pair.effect, robot)
    return replace(found, concerned=concerned)
