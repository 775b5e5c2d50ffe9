"""Source of a plan: a robot, a calibration or a session, and what options name of it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.cli.session_options import PlanOptions
from visioncal.core.conventions import PoseForm, controller_form
from visioncal.core.errors import DataError
from visioncal.core.parsing import numbers_in
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.interchange.outputs import CALIBRATION
from visioncal.interchange.result_files import content_of, load_stored
from visioncal.planning.cell import Box, Limits
from visioncal.results import Calibration
from visioncal.robot import Robot, load_robot
from visioncal.session import Session
from visioncal.session.selecting import Choice, must_select_one, select

# Limits of the arm and the camera, and obstacles.
Kept: TypeAlias = tuple[Limits, tuple[Box, ...]]


@dataclass(frozen=True, eq=False)
class Source:
    """Source of a plan: a robot, a calibration or a session; `words` describes it for people."""

    words: str
    robot: Robot | None = None
    calibration: Calibration | None = None
    session: Session | None = None

    @property
    def form(self) -> PoseForm | None:
        """The stated form of the robot's poses, or that of its maker; None where unknown."""
        if self.calibration is not None:
            return self.calibration.controller()
        robots = {} if self.session is None else self.session.robots
        model, stated = next(((each.model, each.form) for each in robots.values()), ("", None))
        return controller_form(model or "" if self.robot is None else self.robot.name, stated)


def robot_of(options: PlanOptions, source: Source, found: Calibration | None, lost: str) -> Robot:
    """The robot that is asked for, as calibrated, or as stated; raises DataError."""
    if options.robot is not None:
        return load_robot(options.robot)
    if found is not None and found.calibrated_robot is not None:
        return found.calibrated_robot
    if source.robot is not None:
        return source.robot
    if source.session is not None and source.session.robot_document is not None:
        return Robot.from_document(source.session.robot_document)
    raise DataError(
        f"{source.words} names no robot, and its {lost} without one.",
        culprits=["robot"],
        next_step="Name it with --robot.",
    )


def find_source(name: str) -> Source:
    """Loads a robot, a session or a calibration, whichever is named; raises DataError."""
    path = Path(name)
    if path.is_dir() and (path / "session.toml").is_file() and not (path / CALIBRATION).is_file():
        return Source(f"session {name}", session=Session.load(path))
    if path.suffix.lower() == ".rrd":
        # The codec takes half a second to import, which a robot need not wait for.
        from visioncal.present.recording import read_calibration

        calibration, session = read_calibration(path), Session.load(path)
        return Source(f"recording {name}", calibration=calibration, session=session)
    if (path / CALIBRATION).is_file() or "transforms" in content_of(path):
        stored = load_stored(path)
        return Source(f"calibration {name}", calibration=stored.calibration, session=stored.session)
    try:
        return Source(f"robot {name}", robot=load_robot(name))
    except DataError as error:
        begin = f"{name[:200]} is no session and no calibration, and as a robot"
        raise error.but(f"{begin}: {error.message}", culprits=[name[:200]]) from error


def chosen_part(source: Source, words: PlanOptions) -> tuple[Source, PlanOptions]:
    """Extracts one camera, robot and target from a cell's source, as the options name them.

    Raises:
        DataError: There is no such thing, or the choice is ambiguous.
    """
    session, result = source.session, source.calibration
    is_cell = result is not None and result.cell is not None
    choice = Choice(words.camera, words.robot, words.target)
    if not is_cell and (session is None or not must_select_one(session, choice)):
        return source, words
    if session is not None and must_select_one(session, choice):
        session = select(session, choice)
    if result is not None:
        result = result.chosen(choice)
    others = replace(words, camera=None, robot=None, target=None)
    return replace(source, session=session, calibration=result), others


def pose_of(words: str, option: str) -> FloatArray:
    """Parses a rough pose: x, y, z [mm] and angles about the fixed axes x, y, z [deg]; (4, 4) [m].

    Raises:
        DataError: It is not six numbers.
    """
    numbers = numbers_in(",".join(words.replace(",", " ").split()), option, "x,y,z,rx,ry,rz")
    turn = Rotation.from_euler("xyz", numbers[3:], degrees=True).as_matrix()
    return compose(turn, 1e-3 * np.array(numbers[:3]))
