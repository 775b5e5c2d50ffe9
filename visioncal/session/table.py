"""views.csv: reading, checking and writing of its rows, one for each observation, and loads."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.documents.columns import Column, TableReader, as_whole
from visioncal.core.documents.tables import TextTable, csv_text, parse_table
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.robot import Loads
from visioncal.session import columns as cols
from visioncal.session.images import depth_path, image_path, inside_path

# Largest number of rows: two days of a stop every ten seconds.
MOST_VIEWS = 20_000
# Columns that observe without an image.
_OBSERVED = ("cft_x_m", "meas_x_m")
_CENTRE, _FORCE = cols.LOAD[1:4], cols.LOAD[4:]
# Approach direction of the joints to a stop, by the cells of column approach.
SIDES = {"+": 1.0, "-": -1.0, "": 0.0}


@dataclass(frozen=True, eq=False)
class View:
    """One row of views.csv."""

    number: int  # The view's number, unique in its session.
    image: str = ""  # Path of its image, with forward slashes; empty where it has none.
    holdout: bool = False  # Whether it is held out of all fits.
    stop: int | None = None  # Number of the robot's stop, if stated.
    # Filled known numeric columns, in their columns' units.
    numbers: Mapping[str, float] = field(default_factory=dict)
    text: Mapping[str, str] = field(default_factory=dict)  # Other filled columns.
    has_corners: bool = False  # Whether corners.csv has rows of it.

    @property
    def stamp_s(self) -> float | None:
        """Time of the observation [s], if recorded."""
        return self.numbers.get("stamp_s")

    @property
    def is_of_lens(self) -> bool:
        """Whether it is used for the lens only, with the board held by hand."""
        return self.text.get("role", "").strip() == "intrinsics"

    @property
    def point(self) -> str:
        """Name of the point that an instrument measured; empty where it has none."""
        return self.text.get("point", "").strip()

    @property
    def depth(self) -> str:
        """Path of its depth picture or cloud, with forward slashes; empty where it has none."""
        path = self.text.get("depth", "").strip()
        return inside_path(path) if path else ""

    @property
    def files(self) -> tuple[str, ...]:
        """Paths of the view's image and depth, where it has them."""
        return tuple(filter(None, (self.image, self.depth)))

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) joint angles [rad], if recorded."""
        names = cols.joint_columns(tuple(self.numbers))
        return np.array([self.numbers[name] for name in names]) if names else None

    def base_from_flange(self) -> RigidTransform | None:
        """The reported pose of the flange, if recorded."""
        return self._transform(cols.POSE)

    def cam_from_target(self) -> RigidTransform | None:
        """The measured pose of the target (cft_*), if there is one."""
        return self._transform(cols.MEASURED_CAM_POSE)

    @property
    def reading_m(self) -> FloatArray | None:
        """(3,) position measured by an instrument (meas_*), in its frame [m], if there is one."""
        names = cols.INSTRUMENT_POSITION
        return (
            np.array([self.numbers[name] for name in names]) if names[0] in self.numbers else None
        )

    def instrument_from_probe(self) -> FloatArray | None:
        """(4, 4) of a probe measured by an instrument (meas_*), if its rotation was, too."""
        names = (*cols.INSTRUMENT_POSITION, *cols.INSTRUMENT_QUATERNION)
        complete = names[0] in self.numbers and names[-1] in self.numbers
        return self.matrix(names) if complete else None

    def matrix(self, names: Sequence[str]) -> FloatArray | None:
        """(4, 4) pose in some columns, if recorded: a transform takes ten times as long."""
        if names[0] not in self.numbers:
            return None
        values = np.array([self.numbers[name] for name in names])
        return compose(Rotation.from_quat(values[3:]).as_matrix(), values[:3])

    def _transform(self, names: Sequence[str]) -> RigidTransform | None:
        matrix = self.matrix(names)
        return None if matrix is None else RigidTransform.from_matrix(matrix)

    @cached_property
    def robot_cells(self) -> tuple[float | None, ...]:
        """Pose and joints as they were read, for exact comparison."""
        names = (*cols.POSE, *cols.joint_columns(tuple(self.numbers)))
        return tuple(self.numbers.get(name) for name in names)

    def cell(self, column: str) -> str:
        """Text of a column in views.csv, empty where not filled; numbers read back the same."""
        if column == "view":
            return str(self.number)
        if column == "stop":
            return "" if self.stop is None else str(self.stop)
        if column == "image":
            return self.image
        if column in self.numbers:
            return repr(float(self.numbers[column]))
        return self.text.get(column, "")


def reported_matrices(views: Sequence[View]) -> dict[int, FloatArray]:
    """(4, 4) reported `base_from_flange` by view number, where there is one.

    Vectorised: one pose alone takes as long as a hundred together.
    """
    reported = [view for view in views if cols.POSE[0] in view.numbers]
    if not reported:
        return {}
    values = np.array([[view.numbers[name] for name in cols.POSE] for view in reported])
    poses = RigidTransform.from_components(values[:, :3], Rotation.from_quat(values[:, 3:]))
    return dict(zip((view.number for view in reported), poses.as_matrix(), strict=True))


def check_two_sides(name: str, views: Sequence[View], next_step: str) -> None:
    """Checks that poses of robot and camera are not the same numbers, nor inverse to each other.

    Two devices never agree to a micrometre: they would calibrate to an identity without an error.

    Args:
        name: Name of the session, for the message.
        views: Rows of the session.
        next_step: The remedy.

    Raises:
        DataError: All rows with both poses are the same.
    """
    seen_poses = {view.number: view.matrix(cols.MEASURED_CAM_POSE) for view in views}
    given = {number: pose for number, pose in seen_poses.items() if pose is not None}
    reported = reported_matrices(views) if given else {}
    paired_numbers = [number for number in given if number in reported]
    if len(paired_numbers) < FEWEST_VIEWS:
        return
    robot, camera = (
        np.array([poses[number] for number in paired_numbers]) for poses in (reported, given)
    )
    if np.ptp(robot[:, :3, 3], axis=0).max() < 1e-3:
        return
    places, inverse = robot[:, :3, 3], invert(robot)[:, :3, 3]
    seen, turned = camera[:, :3, 3], invert(camera)[:, :3, 3]
    # The rotations may be the same numbers in another form.
    pairs = ("the same", places - seen), ("inverse", places - turned), ("inverse", inverse - seen)
    for how, away in pairs:
        # Poses of robot and camera that agree so are one's; a robot moves by more.
        if np.abs(away).max() < 1e-6:
            raise DataError(
                f"{name}: the poses of the robot and those of the camera are {how} in all "
                f"{len(robot)} rows: the numbers of one serve as both, and say nothing of the "
                "other.",
                culprits=[name],
                next_step=next_step,
            )


def parse_csv(text: str, label: str) -> TextTable:
    """Splits a views.csv into its column names and its rows; see `parse_table`.

    Raises:
        DataError: It is empty, has no rows or too many, or its quotes do not close.
    """
    table = parse_table(text, label)
    if len(table.rows) > MOST_VIEWS:
        raise DataError(
            f"{label} has more than {MOST_VIEWS:,} rows.",
            culprits=[label],
            next_step="A row is one observation at a stop. Samples of a running motion belong into "
            "streams/NAME.csv; write the stops alone here.",
        )
    if not table.rows:
        raise DataError(
            f"{label} has no views; a header row (view,image,...) and a row for each view are "
            "needed.",
            culprits=[label],
        )
    return table


def write_csv(columns: Sequence[str], views: Sequence[View]) -> str:
    """Text of a views.csv with the columns in the given order."""
    return csv_text([columns, *([view.cell(column) for column in columns] for view in views)])


def read_views(table: TextTable, *, with_corners: bool = False) -> tuple[View, ...]:
    """Reads and checks views; `with_corners` says whether there is a corners.csv.

    Raises:
        DataError: Rows are wrong; it lists up to ten problems.
    """
    columns = table.columns
    cols.check_header(columns, f"{table.label or 'views.csv'}, header")
    reader = TableReader(table)
    numbers = reader.read("view", as_whole, "a whole number")
    stops = reader.read("stop", as_whole)
    images, roles = reader.read("image", image_path), reader.read("role", _role)
    reader.read("depth", depth_path)
    known = [name for name in columns if cols.is_number(name)]
    for name in known:
        # Recordings of earlier versions may have any time; see `check_times`.
        reader.numbers(Column(name) if name == "stamp_s" else cols.column_of(name))
    other = [name for name in columns if name not in {"view", "stop", "image", *known}]
    views = tuple(
        View(
            numbers[row] or 0,
            images[row] or "",
            roles[row] == "holdout",
            stops[row],
            {name: float(reader.values[name][row]) for name in known if reader.filled(row, name)},
            {name: reader.cells[name][row] for name in other if reader.cells[name][row]},
        )
        for row in range(reader.count)
    )
    for row, view in enumerate(views):
        for column, words in _load_problems(view):
            reader.report(row, column, words)
    joints = cols.joint_columns(tuple(columns))
    # Robots may have different numbers of joints.
    several = "robot" in columns
    reader.complete(
        *cols.WHOLE_GROUPS, () if several else joints, first_only=joints if several else ()
    )
    for group in cols.QUATERNION_GROUPS:
        reader.unit(group)
    first: dict[int, int] = {}
    for row, view in enumerate(views):
        if reader.is_sound(row):
            column, words, step = _observation_problem(view, columns, with_corners=with_corners)
            if words:
                reader.report(row, column, words, step)
        if numbers[row] is not None and first.setdefault(view.number, row) != row:
            earlier = reader.place(first[view.number])
            reader.report(row, "view", f"{view.number} is already the view of {earlier}")
    reader.check()
    return views


def _observation_problem(
    view: View, columns: Sequence[str], *, with_corners: bool
) -> tuple[str, str, str]:
    """Column, message and remedy of a view that observes nothing; empty texts for others."""
    state = [name for name in ("x_m", "q1_rad", *_OBSERVED) if name in view.numbers]
    pictured = bool(view.image) or with_corners
    if view.is_of_lens and (state or not pictured):
        has = f"{state[0]}, to be left empty" if state else "no image"
        return "role", f"intrinsics is for an image of the lens alone, and the row has {has}", ""
    # A row of a stop may have only the pose of one of several robots.
    is_of_robot = state and view.stop is not None and "robot" in view.text
    if pictured or {*state} & {*_OBSERVED} or "point" in view.text or is_of_robot:
        return "", "", ""
    absent = "it is empty" if "image" in columns else "there is no such column"
    return (
        "image",
        f"{absent}, and the row has neither cft_* nor meas_* nor point",
        "Write the path of each row's image into column image, or the corners of another detector "
        "into corners.csv.",
    )


def _role(cell: str) -> str:
    if cell not in ("fit", "holdout", "intrinsics"):
        raise DataError(f'{cell!r} must be a role: "fit", "holdout", "intrinsics" or nothing')
    return cell


def loads_of(rows: Sequence[Mapping[str, float]], approaches: Sequence[str] | None = None) -> Loads:
    """Loads of views by their numbers, zero where not stated, and by their cells of approach."""
    sides = [SIDES.get(approach.strip(), 0.0) for approach in approaches or [""] * len(rows)]

    def read(*names: str) -> FloatArray:
        return np.array([[row.get(name, 0.0) for name in names] for row in rows])

    return Loads(
        read("payload_kg").reshape(-1),
        read(*_CENTRE).reshape(-1, 3),
        read(*_FORCE).reshape(-1, 3),
        np.array(sides),
    )


def _load_problems(view: View) -> Iterator[tuple[str, str]]:
    """Columns of a row with an invalid load or approach, with messages."""
    approach = view.text.get("approach", "").strip()
    if approach not in SIDES:
        yield "approach", f'{approach!r} must be a side: "+", "-" or nothing'
    placed = [name for name in _CENTRE if name in view.numbers]
    if placed and "payload_kg" not in view.numbers:
        yield (
            placed[0],
            "it gives a payload's centre, and payload_kg, its mass, is missing; a row "
            "without a payload has payload_kg = 0 or leaves all of them empty",
        )


def check_times(views: Sequence[View]) -> None:
    """Checks that stamps resolve microseconds; raises DataError."""
    for view in views:
        wrong = "" if view.stamp_s is None else cols.column_of("stamp_s").fault(view.stamp_s)
        if wrong:
            place = f"views.csv, view {view.number}, column stamp_s"
            raise DataError(f"{place}: {wrong}.", culprits=[place])
