"""Builds the cell of a plan, from a robot and options, a session, or a calibration."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.cli.parsing import numbers_in, refuse_given, size_in
from visioncal.cli.plan_options import PlanCellOptions
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.transforms import compose
from visioncal.core.types import Camera, FloatArray, Progress
from visioncal.estimation.problem_parts import Noise
from visioncal.interchange.formats.boards import target_named
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.interchange.outputs import CALIBRATION
from visioncal.interchange.result_files import content_of, load_calibration, load_stored
from visioncal.live.planning.cell import (
    TYPICAL_NOISE,
    TYPICAL_PX,
    Box,
    Limits,
    PlanCell,
    cell_of_calibration,
)
from visioncal.live.planning.recorded import (
    RoughEdges,
    SessionStart,
    calibrate_partially,
    start_from_session,
)
from visioncal.results import Calibration
from visioncal.robot import Robot, load_robot
from visioncal.session import Session
from visioncal.session.selecting import ANY, LENS, Choice, must_select_one, select
from visioncal.vision.targets import target_from_document

_SESSION = "session.toml"

# Limits of the arm and the camera, and obstacles.
Kept: TypeAlias = tuple[Limits, tuple[Box, ...]]


@dataclass(frozen=True, eq=False)
class Source:
    """Source of a plan: a robot, a calibration or a session; `words` describes it for people."""

    words: str
    robot: Robot | None = None
    calibration: Calibration | None = None
    session: Session | None = None


def find_source(name: str) -> Source:
    """Loads a robot, a session or a calibration, whichever is named.

    Raises:
        DataError: It cannot be read.
    """
    path = Path(name)
    if path.is_dir() and (path / _SESSION).is_file() and not (path / CALIBRATION).is_file():
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
        raise DataError(
            f"{name[:200]} is no session and no calibration, and as a robot: {error.message}",
            culprits=[name[:200]],
            next_step=error.next_step,
        ) from error


def chosen_part(source: Source, words: PlanCellOptions) -> tuple[Source, PlanCellOptions]:
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


def begun_session(
    source: Source, words: PlanCellOptions, kept: Kept, progress: Progress
) -> SessionStart:
    """The session to which stops are added.

    Raises:
        DataError: There is none, or it has too few views to start from.
    """
    session = source.session
    if session is None:
        raise DataError(
            f"--add: {source.words} holds no recorded session to which stops could be added.",
            culprits=["--add"],
            next_step="Name the session, or ask for a plan of its own with --stops.",
        )
    refuse_given(
        words.options("target", "camera", "resolution", "mount"), "the session has its own"
    )
    if words.robot is not None:
        session = _with_robot(session, words.robot)
    guess = _guess(words) if words.cam or words.board else None
    recorded = calibrate_partially(session, progress=progress)
    begun = start_from_session(recorded, guess=guess, limits=kept[0], boxes=kept[1])
    return replace(begun, cell=_with_noise(begun.cell, words))


def cell_of(source: Source, words: PlanCellOptions, kept: Kept) -> PlanCell:
    """The cell of a new plan, from a calibration or from options.

    Raises:
        DataError: Something is missing or cannot be read.
    """
    if source.calibration is not None:
        refuse_given(words.options("camera", "resolution", "mount"), "the calibration has its own")
        return _with_noise(_calibrated(source.calibration, source.session, words, kept), words)
    # Malformed options are reported before missing ones.
    numbers = _camera_numbers(words.camera)
    for option, pose in (("--cam", words.cam), ("--board", words.board)):
        if pose is not None:
            pose_of(pose, option)
    needed = ("target", "camera", "cam", "board", *(() if numbers is None else ("resolution",)))
    missing = [f"--{value}" for value in needed if getattr(words, value) is None]
    if missing or source.robot is None:
        raise DataError(
            f"{source.words}: {some_of(missing)} {'is' if len(missing) == 1 else 'are'} needed to "
            "know the cell.",
            culprits=missing,
            next_step="Give them, or plan from a session or a calibration of the cell.",
        )
    refuse_given(words.options("robot"), f"{source.words} is named already")
    camera = _camera(str(words.camera), words.resolution)
    guess = _guess(words)
    cell = PlanCell(
        words.mount or "eye-in-hand",
        source.robot,
        camera,
        target_named(str(words.target)),
        guess.x,
        guess.z,
        guess.sigma_rad,
        guess.sigma_m,
        TYPICAL_NOISE,
        TYPICAL_PX,
        *kept,
    )
    return _with_noise(cell, words)


def pose_of(words: str, option: str) -> FloatArray:
    """Parses a rough pose: x, y, z [mm] and angles about the fixed axes x, y, z [deg]; (4, 4) [m].

    Raises:
        DataError: It is not six numbers.
    """
    numbers = numbers_in(",".join(words.replace(",", " ").split()), option, "x,y,z,rx,ry,rz")
    turn = Rotation.from_euler("xyz", numbers[3:], degrees=True).as_matrix()
    return compose(turn, 1e-3 * np.array(numbers[:3]))


def _with_robot(session: Session, name: str) -> Session:
    document = {**session.document, "robot": {**session.document.get("robot", {}), "model": name}}
    return Session.assemble(
        document,
        session.columns,
        [[view.cell(column) for column in session.columns] for view in session.views],
        session.images,
        target_document=session.target_document,
        robot_document=load_robot(name).document,
    )


def _calibrated(
    calibration: Calibration, session: Session | None, words: PlanCellOptions, kept: Kept
) -> PlanCell:
    if words.target is not None:
        target = target_named(words.target)
    elif session is not None and session.target is not None:
        target = session.target
    elif calibration.joint_fit is not None and "" in calibration.joint_fit.targets:
        target = target_from_document(calibration.joint_fit.targets[""], "target")
    else:
        raise DataError(
            f"calibration {calibration.session_name!r} does not say which board it was made with, "
            "and its recording is not there.",
            culprits=["--target"],
            next_step="Name the board with --target.",
        )
    robot = None if words.robot is None else load_robot(words.robot)
    cell = cell_of_calibration(calibration, target, *kept, robot=robot)
    if words.cam is not None:
        cell = replace(cell, x=pose_of(words.cam, "--cam"))
    if words.board is not None:
        cell = replace(cell, z=pose_of(words.board, "--board"))
    if words.cam is None and words.board is None:
        return cell
    return replace(
        cell, sigma_m=1e-3 * words.guess_mm, sigma_rad=float(np.deg2rad(words.guess_deg))
    )


def _guess(words: PlanCellOptions) -> RoughEdges:
    missing = [f"--{name}" for name in ("cam", "board") if getattr(words, name) is None]
    if missing:
        raise DataError(
            f"{missing[0]} is needed too: a guess is one of both, the camera and the board.",
            culprits=missing,
        )
    return RoughEdges(
        pose_of(str(words.cam), "--cam"),
        pose_of(str(words.board), "--board"),
        float(np.deg2rad(words.guess_deg)),
        1e-3 * words.guess_mm,
    )


def _with_noise(cell: PlanCell, words: PlanCellOptions) -> PlanCell:
    for name in ("noise_px", "noise_mm", "noise_deg"):
        value = getattr(words, name)
        option = f"--{name.replace('_', '-')}"
        if value is not None and not 0.0 <= value < np.inf:
            raise DataError(f"{option} is {value}; zero or more is needed.", culprits=[option])
    sigma_rad, sigma_m = cell.noise.robots[0].tolist()
    sigma_m = sigma_m if words.noise_mm is None else 1e-3 * words.noise_mm
    sigma_rad = sigma_rad if words.noise_deg is None else float(np.deg2rad(words.noise_deg))
    pixel_px = cell.pixel_px if words.noise_px is None else words.noise_px
    return replace(cell, noise=Noise.of_robot(sigma_rad, sigma_m), pixel_px=pixel_px)


def _camera(words: str, resolution: str | None) -> Camera:
    matrix = _camera_numbers(words)
    if matrix is not None:
        return Camera("brown", _size(resolution), np.array(matrix), np.zeros(5))
    path = Path(words)
    if path.is_dir() or path.suffix.lower() == ".rrd" or "transforms" in content_of(path):
        calibrated = load_calibration(path, ANY, LENS).camera
        if calibrated is None:
            raise DataError(
                f"--camera: {words} was made from measured poses and knows no camera.",
                culprits=["--camera"],
            )
        return calibrated.camera
    lens, _ = read_intrinsics(path)
    width, height = lens["resolution"] if "resolution" in lens else _size(resolution)
    distortion = np.array(lens.get("distortion") or np.zeros(5), dtype=float)
    return Camera(lens["model"], (int(width), int(height)), np.array(lens["matrix"]), distortion)


def _camera_numbers(words: str | None) -> tuple[float, ...] | None:
    """The numbers of the camera matrix, where they were given."""
    if words is None or "," not in words or Path(words).exists():
        return None
    return numbers_in(words, "--camera", "fx,fy,cx,cy")


def _size(words: str | None) -> tuple[int, int]:
    if words is None:
        raise DataError(
            "--resolution is needed beside this --camera: width and height of the images [px].",
            culprits=["--resolution"],
        )
    return size_in(words)
