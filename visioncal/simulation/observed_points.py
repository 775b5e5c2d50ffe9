"""What was seen in a simulated cell of several robots, and the faults of images."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.simulation.arms import Arm
from visioncal.simulation.boards import Sheet
from visioncal.simulation.layout import BoardAt, CameraAt, NetworkOptions
from visioncal.simulation.standing import Stream, sheet_of, stream


@dataclass(frozen=True, eq=False)
class Sight:
    """A camera's image of a board at a stop.

    Attributes:
        view: The number of its row.
        stop: When it was taken; -1 for an image of the camera's lens alone.
        camera: The camera's name.
        board: The board's.
        cam_from_target: (4, 4) where the board is in the image that the row has.
        exact: Where its corners are in that image.
        corners: The same as a detector would report them; which end of a board that looks alike
            from both it takes for the first, hangs on how it lies in the image.
        stamp_s: When it was taken in a sweep, by the camera's clock [s]; None at a stop.
    """

    view: int
    stop: int
    camera: str
    board: str
    cam_from_target: FloatArray
    exact: Corners
    corners: Corners
    stamp_s: float | None = None


@dataclass(frozen=True, eq=False)
class Reading:
    """What an instrument read of a point at a stop: (4, 4) in the instrument's frame.

    The rotation counts where the instrument reads any.
    """

    view: int
    stop: int
    instrument: str
    point: str
    instrument_from_point: FloatArray


@dataclass(frozen=True, eq=False)
class Network:
    """A simulated cell of several robots, and what was seen in it.

    Attributes:
        options: What was asked for.
        parents: What each frame but the flanges hangs on, by its name in a session.
        transforms: (4, 4) where each of them hangs in it, before anything is pushed.
        arms: The nominal arms by the robots' names.
        true_arms: The arms as they were built.
        joints: (s, n) what each robot reports [rad].
        base_from_flange: (s, 4, 4) the poses that it reports.
        true_base_from_flange: (s, 4, 4) where its flange really stood.
        sights: What cameras saw, by ascending view, and last the images of lenses alone.
        readings: What instruments read.
        pose_rows: The row with a robot's pose, for those of which no other row of their stop
            has it: (view, stop, robot).
        wrong_views: Rows with another row's image, ascending.
        streams: Robots' states in sweeps, by the robots' names, and temperatures.
    """

    options: NetworkOptions
    parents: Mapping[str, str]
    transforms: Mapping[str, FloatArray]
    arms: Mapping[str, Arm]
    true_arms: Mapping[str, Arm]
    joints: Mapping[str, FloatArray]
    base_from_flange: Mapping[str, FloatArray]
    true_base_from_flange: Mapping[str, FloatArray]
    sights: tuple[Sight, ...]
    readings: tuple[Reading, ...]
    pose_rows: tuple[tuple[int, int, str], ...]
    wrong_views: tuple[int, ...]
    streams: Mapping[str, Recorded] = field(default_factory=dict)

    @property
    def corners(self) -> tuple[Corners, ...]:
        """What was detected in all images, by ascending view."""
        return tuple(it.corners for it in self.sights)

    def between(self, first: str, second: str) -> FloatArray:
        """(4, 4) `first_from_second` of two frames of the cell, none of which a robot moves."""
        return invert(self._in_cell(first)) @ self._in_cell(second)

    def _in_cell(self, frame: str) -> FloatArray:
        parent = self.parents.get(frame, "")
        if frame == "cell":
            return np.eye(4)
        if parent != "cell":
            raise DataError(f"simulation: {frame} does not stand in the cell.")
        return self.transforms[frame]

    def robot_of(self, frame: str) -> str | None:
        """The robot whose pose the rows of a camera, board or point have; None for none."""
        on = self.parents[frame]
        return on.removeprefix("flange_") if on.startswith("flange_") else None


def camera_named(options: NetworkOptions, name: str) -> CameraAt:
    """The camera of that name."""
    return next(it for it in options.cameras if it.name == name)


def board_named(options: NetworkOptions, name: str) -> BoardAt:
    """The board of that name."""
    return next(it for it in options.boards if it.name == name)


def sheet_named(options: NetworkOptions, name: str) -> Sheet:
    """The board of that name, as it was printed."""
    return sheet_of(board_named(options, name))


def with_faults(cell: Network) -> Network:
    """Exchanges images of rows, and takes some from other stops."""
    options, rng = cell.options, stream(cell.options, Stream.FAULTS)
    sights = list(cell.sights)
    groups: dict[tuple[str, str], list[int]] = {}
    for at, sight in enumerate(sights):
        if sight.stop >= 0 and _moves(cell, sight):
            groups.setdefault((sight.camera, sight.board), []).append(at)
    pools = [rng.permutation(it).tolist() for it in groups.values() if len(it) > 1]
    wrong: list[int] = []
    for _ in range(options.swapped_rows):
        pool = _pool(pools, 2)
        first, second = pool.pop(), pool.pop()
        sights[first], sights[second] = (
            _showing(cell.sights[first], cell.sights[second]),
            _showing(cell.sights[second], cell.sights[first]),
        )
        wrong += [first, second]
    for _ in range(options.stray_images):
        rng.shuffle(pools)
        pool = _pool(pools, 2)
        row = pool.pop()
        sights[row] = _showing(cell.sights[row], cell.sights[pool[0]])
        wrong.append(row)
    views = sorted(cell.sights[it].view for it in wrong)
    return replace(cell, sights=tuple(sights), wrong_views=tuple(views))


def _moves(cell: Network, sight: Sight) -> bool:
    """Whether a board moves before a camera."""
    carriers = [
        cell.parents[frame_name("camera", sight.camera)],
        cell.parents[frame_name("target", sight.board)],
    ]
    return carriers[0] != carriers[1]


def _pool(pools: list[list[int]], least: int) -> list[int]:
    for pool in pools:
        if len(pool) >= least:
            return pool
    raise DataError("simulation: there are too few rows of one camera and board for such faults.")


def _showing(row: Sight, image: Sight) -> Sight:
    """A row with the image of another."""
    return replace(
        row,
        cam_from_target=image.cam_from_target,
        exact=replace(image.exact, view=row.view),
        corners=replace(image.corners, view=row.view),
    )
