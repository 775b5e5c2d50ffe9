"""views.csv: reading, checking and writing of its rows, one for each observation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.documents.columns import Column, TableReader, as_whole
from visioncal.core.documents.tables import TextTable, parse_table
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.session import columns as cols
from visioncal.session.images import image_path
from visioncal.session.loads import load_problems

# Largest numbers of rows and columns: two days of a stop every ten seconds.
_MOST_VIEWS, _MOST_COLUMNS = 20_000, 1_000
# Columns that observe without an image.
_OBSERVED = ("cft_x_m", "meas_x_m")


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

    def instrument_from_probe(self) -> RigidTransform | None:
        """Pose of a probe measured by an instrument (meas_*), if its rotation was measured, too."""
        names = (*cols.INSTRUMENT_POSITION, *cols.INSTRUMENT_QUATERNION)
        complete = names[0] in self.numbers and names[-1] in self.numbers
        return self._transform(names) if complete else None

    def _transform(self, names: Sequence[str]) -> RigidTransform | None:
        if names[0] not in self.numbers:
            return None
        values = [self.numbers[name] for name in names]
        return RigidTransform.from_components(values[:3], Rotation.from_quat(values[3:]))

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


def parse_csv(text: str, label: str) -> TextTable:
    """Splits a views.csv into its column names and its rows; see `parse_table`.

    Raises:
        DataError: It is empty, has no rows or too many, or its quotes do not close.
    """
    table = parse_table(
        text,
        label,
        _MOST_VIEWS,
        _MOST_COLUMNS,
        "A row is one observation at a stop. Samples of a running motion belong into "
        "streams/NAME.csv; write the stops alone here.",
    )
    if not table.columns:
        raise DataError(
            f"{label} is empty; a header row (view,image,...) and a row for each view are needed.",
            culprits=[label],
        )
    if not table.rows:
        raise DataError(
            f"{label} has a header row and no views.",
            culprits=[label],
            next_step="Add one row for each view.",
        )
    return table


def write_csv(columns: Sequence[str], views: Sequence[View]) -> str:
    """Text of a views.csv with the columns in the given order."""
    rows = [columns, *([view.cell(column) for column in columns] for view in views)]
    return "".join(",".join(map(_quoted, row)) + "\n" for row in rows)


def _quoted(cell: str) -> str:
    """Quotes a cell where needed; csv.writer does not quote a lone carriage return."""
    needs_quotes = any(character in cell for character in ',"\r\n')
    return '"' + cell.replace('"', '""') + '"' if needs_quotes else cell


def read_views(table: TextTable, *, with_corners: bool = False) -> tuple[View, ...]:
    """Reads and checks views.

    Args:
        table: The columns and rows.
        with_corners: Whether there is a corners.csv.

    Raises:
        DataError: Rows are wrong; it lists up to ten problems.
    """
    columns = table.columns
    cols.check_header(columns, f"{table.label or 'views.csv'}, header")
    if table.rows and not any(name.isdigit() for cell in table.rows[0] for name in cell):
        raise DataError(
            f"{table.place(0)} has no number, but {', '.join(table.rows[0])[:80]!r}: units or "
            "names below the header?",
            culprits=[table.place(0)],
            next_step=f"Delete {table.place(0)}; the header is one line.",
        )
    reader = TableReader(table)
    numbers = reader.read("view", as_whole, "a whole number")
    stops = reader.read("stop", as_whole)
    images, roles = reader.read("image", image_path), reader.read("role", _role)
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
        for column, words in load_problems(view.numbers, view.text.get("approach", "").strip()):
            reader.report(row, column, words)
    joints = cols.joint_columns(columns)
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
    if view.is_of_lens:
        if not state and (view.image or with_corners):
            return "", "", ""
        words = f"{state[0]}; leave that empty" if state else "no image"
        return (
            "role",
            "intrinsics is for an image that serves the camera's lens alone, but the row has "
            f"{words}",
            "",
        )
    # A row of a stop may have only the pose of one of several robots.
    is_of_robot = state and view.stop is not None and "robot" in view.text
    if view.image or with_corners or {*state} & {*_OBSERVED} or "point" in view.text or is_of_robot:
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
        raise DataError(f'{cell!r} is no role; "fit", "holdout", "intrinsics" or nothing is needed')
    return cell
