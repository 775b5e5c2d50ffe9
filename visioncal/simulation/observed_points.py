"""What was seen in a simulated cell of several robots, and the faults of images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Camera, Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.simulation.arms import Arm
from visioncal.simulation.cell import Cell
from visioncal.simulation.draws import DrawOptions, Stream
from visioncal.simulation.layout import CELL, BoardAt, CameraAt, NetworkOptions, RobotAt
from visioncal.simulation.options import CameraOptions
from visioncal.simulation.sag import Payload
from visioncal.simulation.second import NAMES
from visioncal.simulation.standing import parents_of

# An operator's pace: a stop every so many seconds [s].
_PACE_S = 4.0


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
        draws: (6,) white noise of the board's pose, where that is measured.
        stamp_s: When it was taken in a sweep, by the camera's clock [s]; None at a stop.
    """

    view: int
    stop: int
    camera: str
    board: str
    cam_from_target: FloatArray
    exact: Corners
    corners: Corners
    draws: FloatArray
    stamp_s: float | None = None

    @property
    def is_of_lens(self) -> bool:
        """Whether it serves the camera's lens alone."""
        return self.stop < 0 and self.stamp_s is None


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
    """A simulated cell of robots, cameras and boards, and what was seen in it.

    Attributes:
        options: What was asked for.
        parents: What each frame but the flanges hangs on, by its name in a session.
        transforms: (4, 4) where each of them hangs in it, before anything is pushed.
        arms: The nominal arms by the robots' names.
        true_arms: The arms as they were built.
        stated: The cameras' intrinsics as the session states them, by the cameras' names.
        joints: (s, n) what each robot reports [rad].
        base_from_flange: (s, 4, 4) the poses that it reports.
        true_base_from_flange: (s, 4, 4) where its flange really stood.
        sights: What cameras saw, by ascending view, and last the images of lenses alone.
        readings: What instruments read.
        pose_rows: The row with a robot's pose, for those of which no other row of their stop
            has it: (view, stop, robot).
        wrong_views: Rows with another row's image or a wrong report, ascending.
        wrong_stops: Stops at which each robot's report is wrong.
        stamps_s: (s,) when each stop was made [s]; None where rows have no time.
        loads: What robots carried, stop by stop; of those alone that carried something.
        approach: (s,) the sides from which robots with play came to each stop, +1 or -1.
        streams: Robots' states in sweeps, by the robots' names, and temperatures.
    """

    options: NetworkOptions
    parents: Mapping[str, str]
    transforms: Mapping[str, FloatArray]
    arms: Mapping[str, Arm]
    true_arms: Mapping[str, Arm]
    stated: Mapping[str, Camera]
    joints: Mapping[str, FloatArray]
    base_from_flange: Mapping[str, FloatArray]
    true_base_from_flange: Mapping[str, FloatArray]
    sights: tuple[Sight, ...]
    readings: tuple[Reading, ...]
    pose_rows: tuple[tuple[int, int, str], ...]
    wrong_views: tuple[int, ...]
    wrong_stops: Mapping[str, tuple[int, ...]]
    stamps_s: FloatArray | None = None
    loads: Mapping[str, Sequence[Payload]] = field(default_factory=dict)
    approach: Mapping[str, FloatArray] = field(default_factory=dict)
    streams: Mapping[str, Recorded] = field(default_factory=dict)

    @property
    def corners(self) -> tuple[Corners, ...]:
        """What was detected in all images, by ascending view."""
        return tuple(sight.corners for sight in self.sights)

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
        return next((arm for arm in self.arms if frame_name("flange", arm) == on), None)

    @property
    def is_named(self) -> bool:
        """Whether its things have names: else there is one of each kind."""
        options = self.options
        return any(
            [*(robot.name for robot in options.robots), *(board.name for board in options.boards)]
        )


def whole(
    cell: Cell, *, stamps_s: FloatArray | None = None, taken_s: FloatArray | None = None
) -> Network:
    """A cell of one robot and one camera as one whose robot and camera have no names.

    Args:
        cell: The cell.
        stamps_s: (s,) when its stops were made [s]; None for an operator's pace.
        taken_s: (m,) when its views were taken in a sweep, by the camera's clock [s]; None for
            views of stops.
    """
    options, shown = cell.options, cell.shown
    names = NAMES if len(cell.sheets) > 1 else ("",)
    camera_on, board_on = ("", CELL) if options.mount == "eye-in-hand" else (CELL, "")
    optics = {entry.name: getattr(options, entry.name) for entry in fields(CameraOptions)}
    described = NetworkOptions(
        robots=(RobotAt("", (0.0, 0.0, 0.0), **options.of_arm),),
        cameras=(CameraAt("", camera_on, **optics),),
        boards=tuple(
            BoardAt(name, board_on, target=sheet.target, scale=sheet.scale, bow_m=sheet.bow_m)
            for name, sheet in zip(names, cell.sheets, strict=True)
        ),
        stops=int(shown.stops.max()) + 1,
        **{entry.name: getattr(options, entry.name) for entry in fields(DrawOptions)},
    )
    # The first view of each stop has what is the same for all of them.
    stops, first = np.unique(shown.stops, return_index=True)

    def by_stop(of_views: FloatArray) -> Mapping[str, FloatArray]:
        found = np.zeros((described.stops, *of_views.shape[1:]))
        found[stops] = of_views[first]
        return {"": found}

    draws = options.stream(Stream.PAIRS).standard_normal((len(cell.corners), 6))
    loads = dict(zip(shown.stops.tolist(), cell.payloads, strict=False))
    parents = parents_of(described)
    return Network(
        options=described,
        parents=parents,
        transforms=dict(zip(parents, (np.eye(4), *cell.transforms.values()), strict=True)),
        arms={"": cell.arm},
        true_arms={"": cell.true_arm},
        stated={"": cell.stated_camera},
        joints=by_stop(cell.joints),
        base_from_flange=by_stop(cell.base_from_flange),
        true_base_from_flange=by_stop(cell.true_base_from_flange),
        sights=tuple(
            Sight(
                view=exact.view,
                stop=int(shown.stops[at]) if taken_s is None else -1,
                camera="",
                board=names[shown.boards[at]],
                cam_from_target=cell.cam_from_target[at],
                exact=exact,
                corners=cell.corners[at],
                draws=draws[at],
                stamp_s=None if taken_s is None else float(taken_s[at]),
            )
            for at, exact in enumerate(cell.exact_corners)
        ),
        readings=(),
        pose_rows=(),
        wrong_views=cell.wrong_views,
        wrong_stops={},
        stamps_s=_PACE_S * np.arange(float(described.stops)) if stamps_s is None else stamps_s,
        loads={"": [loads.get(index, Payload()) for index in range(described.stops)]}
        if loads
        else {},
        approach={} if cell.approach is None else by_stop(cell.approach),
    )


def camera_named(options: NetworkOptions, name: str) -> CameraAt:
    """The camera of that name."""
    return next(camera for camera in options.cameras if camera.name == name)


def board_named(options: NetworkOptions, name: str) -> BoardAt:
    """The board of that name."""
    return next(board for board in options.boards if board.name == name)


def with_faults(cell: Network) -> Network:
    """Exchanges images of rows, and takes some from other stops."""
    options, rng = cell.options, cell.options.stream(Stream.FAULTS)
    sights = list(cell.sights)
    groups: dict[tuple[str, str], list[int]] = {}
    for at, sight in enumerate(sights):
        if sight.stop >= 0 and _moves(cell, sight):
            groups.setdefault((sight.camera, sight.board), []).append(at)
    pools = [rng.permutation(group).tolist() for group in groups.values() if len(group) > 1]
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
    views = sorted(cell.sights[index].view for index in wrong)
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
