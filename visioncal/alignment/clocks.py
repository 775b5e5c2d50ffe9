"""Rows of a whole cell that have a time and no pose of a robot: its stream tells them where it was.

Every pair of a camera and a robot has clocks of its own, whose offset is estimated from the motion
that both have seen, as `calibrate` does; its error is an effect of the joint fit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.alignment.cell import Cell, robot_key
from visioncal.errors import VisioncalError
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.effects.delays import Delay
from visioncal.estimation.problem import Effect
from visioncal.robot import Robot
from visioncal.session import Observation, Session, View, frame_name
from visioncal.session.tables import ClockTable
from visioncal.stages.clock import Clocked, Sweep, set_clock
from visioncal.stages.motion import has_motion, is_open, motion_of
from visioncal.stages.observed import Observed
from visioncal.stages.offset import Clock
from visioncal.stages.pnp import ViewPoses
from visioncal.targets import numbered_positions


@dataclass(frozen=True)
class Pair:
    """A camera's frame and the name of a robot that parts it from what it sees."""

    camera: str
    robot: str

    @property
    def words(self) -> str:
        """Both, as messages and results name them."""
        return f"{self.camera} and robot {self.robot or 'robot'}"

    @property
    def effect(self) -> str:
        """The effect of their clocks' offset, by its name."""
        return f"clock of {self.words}"

    def delay(self, of: Delay) -> str:
        """The effect of a time within the camera's images, by its name."""
        return f"{of.name} of {self.words}"


@dataclass(frozen=True, eq=False)
class Clocks:
    """The session with the robots' poses at the times of its rows, and what that rests on.

    Attributes:
        session: The session; rows that waited for a stream have poses now.
        found: The clock of each pair.
        reasons: Why rows have no pose, by view.
        poses: Poses that were made anew of corners taken before or after their stamp.
        warnings: Reasons for doubt, in words.
        notes: What is good to know.
    """

    session: Session
    found: Mapping[Pair, Clocked]
    reasons: Mapping[int, str]
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def effects(self, cell: Cell) -> tuple[Effect, ...]:
        """The errors of offsets and times within images [s], as effects on the cell's rows."""
        views = [it.view for it in cell.rows]
        found: list[Effect] = []
        for pair, clocked in self.found.items():
            if clocked.clock.speeds and robot_key(pair.robot) in cell.poses:
                found.append(_effect(cell, pair, clocked.clock))
                found += [
                    it.effect(views, pair.delay(it.of))
                    for it in clocked.clock.delays
                    if it.is_clear
                ]
        return tuple(found)

    def looked(self, before: Observed) -> Observed:
        """What the cameras saw, with poses that were made anew."""
        return replace(before, poses={**before.poses, **self.poses})


def set_clocks(session: Session, looked: Observed) -> Clocks:
    """Gives rows the poses of robots at their times.

    Args:
        session: A whole cell.
        looked: What its cameras saw.

    Raises:
        DataError: A stream has no poses, and no joints that its robot's model knows.
    """
    waiting: dict[Pair, list[Observation]] = {}
    for it in session.observations:
        if len(it.lacks) == 1 and is_open(it.view) and stream_of(session, it.lacks[0]):
            waiting.setdefault(Pair(it.seer, it.lacks[0]), []).append(it)
    clocks = Clocks(session, {}, {})
    for pair, rows in waiting.items():
        clocks = _with_pair(clocks, pair, rows, looked)
    return clocks


def stream_of(session: Session, robot: str) -> str:
    """The name of a robot's stream, its own; empty where it has none."""
    name = robot or "robot"
    return name if name in session.streams and has_motion(session.streams[name]) else ""


def _with_pair(clocks: Clocks, pair: Pair, rows: list[Observation], looked: Observed) -> Clocks:
    session = clocks.session
    document = session.robot_documents.get(pair.robot)
    model = None if document is None else Robot.from_document(document)
    flange = frame_name("flange", pair.robot)
    sweep = Sweep(
        motion_of(session, model, stream_of(session, pair.robot)),
        "eye-in-hand" if session.frames[pair.camera] == flange else "eye-to-hand",
        tuple(it.view for it in rows),
        _stated_s(session, pair.camera),
        looked.lenses[pair.camera].camera if pair.camera in looked.lenses else None,
        numbered_positions(tuple(session.boards.values())),
    )
    try:
        clocked = set_clock(sweep, looked.poses)
    except VisioncalError as error:
        words = f"{pair.words}: {error.message} {error.next_step}".strip()
        lost = dict.fromkeys((it.view.number for it in rows), f"no pose: {error.message}")
        return replace(
            clocks, reasons={**clocks.reasons, **lost}, warnings=(*clocks.warnings, words)
        )
    named = {it.number: _of_robot(it, pair.robot) for it in clocked.views}
    views = tuple(named.get(it.number, it) for it in session.views)
    lost = {it.view: it.reason for it in clocked.rejections} | dict(clocked.spared)
    return Clocks(
        replace(session, views=views),
        {**clocks.found, pair: clocked},
        {**clocks.reasons, **lost},
        {**clocks.poses, **clocked.poses},
        (*clocks.warnings, *(f"{pair.words}: {it}" for it in clocked.warnings)),
        (*clocks.notes, *(f"{pair.words}: {it}" for it in clocked.notes)),
    )


def _of_robot(view: View, robot: str) -> View:
    return replace(view, text={**view.text, "robot": robot}) if robot else view


def _stated_s(session: Session, camera: str) -> float | None:
    """What the session states of a camera's clock, or of all of them."""
    declared = session.declaration
    tables: dict[str, ClockTable] = {
        frame_name("camera", name): it for name, it in declared.clocks.items()
    }
    clock = tables.get(camera, declared.clock)
    return clock.camera_minus_robot_s if clock.model_fields_set else None


def _effect(cell: Cell, pair: Pair, clock: Clock) -> Effect:
    speeds = clock.speeds
    concerned = np.array([it.view in speeds for it in cell.rows], dtype=bool)
    robot = robot_key(pair.robot)
    moving = np.zeros((len(cell.poses[robot]), 6))
    for row in cell.rows:
        if row.view in speeds:
            moving[row.station] = speeds[row.view]
    found = clock_effect(moving, clock.sigma_s, pair.effect, robot)
    return replace(found, concerned=concerned)
