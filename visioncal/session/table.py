"""views.csv: reading, checking and writing of its rows, one for each observation."""

import csv
import io
import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.documents.tables import separator_of, with_points, without_margin
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.core.verdict import READ_AGAIN
from visioncal.session import columns as cols
from visioncal.session.images import image_path
from visioncal.session.loads import SIDES, load_problems

# Largest numbers of rows and columns: two days of a stop every ten seconds.
_MOST_VIEWS, _MOST_COLUMNS = 20_000, 1_000
# Tolerance of a quaternion's norm, for four digits.
_NORM_TOLERANCE = 1e-3
# Smallest number of rows with wrong norms, and largest norm of them, from which they are taken for
# another form of rotation; norms beyond the last are of angles in degrees.
_FEWEST_ALIKE, _FAR_FROM_UNIT, _ANGLES_RAD = 3, 1.5, 7.0
_SHOWN_PROBLEMS = 10
# Stricter than float(), which also accepts 1_000, nan, and digits of other scripts.
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_THOUSANDS = re.compile(r"[+-]?[0-9]{1,3}(,[0-9]{3})+\.[0-9]*")
_INTEGER = re.compile(r"[+-]?[0-9]+")
_DECIMAL = re.compile(r"[+-]?[0-9]*\.[0-9]+([eE][+-]?[0-9]+)?")
# Quoted values and numbers, which differ between problems of one kind.
_VALUES = re.compile(r"'[^']*'|[0-9.]+")
_LINE = re.compile(r", line ([0-9]+)")

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class View:
    """One row of views.csv.

    Attributes:
        number: The view's number, unique in its session.
        image: Path of its image, with forward slashes; empty where it has none.
        holdout: Whether it is held out of all fits.
        stop: Number of the robot's stop, if stated.
        numbers: Filled known numeric columns, in their columns' units.
        text: Other filled columns.
        has_corners: Whether corners.csv has rows of it.
    """

    number: int
    image: str = ""
    holdout: bool = False
    stop: int | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    text: Mapping[str, str] = field(default_factory=dict)
    has_corners: bool = False

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


@dataclass(frozen=True)
class TextRow:
    """One row of text cells, and its place in messages (`views.csv, line 3`)."""

    where: str
    cells: tuple[str, ...]


@dataclass(frozen=True)
class TableProblem:
    """Problem of a table, with its place."""

    place: str
    words: str
    norm: float | None = None  # of a quaternion
    step: str = ""  # remedy other than correcting the table


def parse_csv(text: str, label: str) -> tuple[tuple[str, ...], tuple[TextRow, ...]]:
    """Splits a views.csv into its column names and its rows; blank lines are skipped.

    Where the header has semicolons or tabs and no comma, they separate the columns, and decimal
    commas are read as points, as many spreadsheets write them. Empty columns at the end are
    dropped.

    Raises:
        DataError: It is empty, has no rows, or its quotes do not close.
    """
    separator = separator_of(text.lstrip().partition("\n")[0])
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=separator)
    rows: list[TextRow] = []
    line = 1
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                read = tuple(cells) if separator == "," else with_points(cells)
                rows.append(TextRow(f"{label}, line {line}", read))
                _check_count(rows, label)
            line = reader.line_num + 1
    except csv.Error as error:
        raise DataError(
            f"{label}, line {line}: {error}.",
            culprits=[f"{label}, line {line}"],
            next_step='A field that holds a comma or a "quote" is put in quotes, "" inside.',
        ) from error
    if not rows:
        raise DataError(
            f"{label} is empty; a header row (view,image,...) and a row for each view are needed.",
            culprits=[label],
        )
    if len(rows) == 1:
        raise DataError(
            f"{label} has a header row and no views.",
            culprits=[label],
            next_step="Add one row for each view.",
        )
    header, *filled = without_margin([row.cells for row in rows])
    return tuple(name.strip() for name in header), tuple(
        replace(row, cells=cells) for row, cells in zip(rows[1:], filled, strict=True)
    )


def _check_count(rows: Sequence[TextRow], label: str) -> None:
    if len(rows) > _MOST_VIEWS + 1 or len(rows[0].cells) > _MOST_COLUMNS:
        raise DataError(
            f"{label} has more than {_MOST_VIEWS:,} rows or {_MOST_COLUMNS:,} columns; a row is "
            "one observation at a stop.",
            culprits=[label],
            next_step="Samples of a running motion belong into streams/NAME.csv; write the stops "
            "alone here.",
        )


def write_csv(columns: Sequence[str], views: Sequence[View]) -> str:
    """Text of a views.csv with the columns in the given order."""
    rows = [columns, *([view.cell(column) for column in columns] for view in views)]
    return "".join(",".join(map(_quoted, row)) + "\n" for row in rows)


def _quoted(cell: str) -> str:
    """Quotes a cell where needed; csv.writer does not quote a lone carriage return."""
    needs_quotes = any(character in cell for character in ',"\r\n')
    return '"' + cell.replace('"', '""') + '"' if needs_quotes else cell


def read_views(
    columns: Sequence[str], rows: Sequence[TextRow], label: str, *, with_corners: bool = False
) -> tuple[View, ...]:
    """Reads and checks views.

    Args:
        columns: The column names.
        rows: The rows' cells, as text.
        label: The file's name, for messages.
        with_corners: Whether there is a corners.csv.

    Raises:
        DataError: Rows are wrong; it lists up to ten problems.
    """
    cols.check_header(columns, f"{label}, header")
    views: list[View] = []
    problems: list[TableProblem] = []
    first_seen: dict[int, str] = {}
    if rows and not any(name.isdigit() for cell in rows[0].cells for name in cell):
        raise DataError(
            f"{rows[0].where} has no number, but {', '.join(rows[0].cells)[:80]!r}: units or names "
            "below the header?",
            culprits=[rows[0].where],
            next_step=f"Delete {rows[0].where}; the header is one line.",
        )
    for row in rows:
        reader = _RowReader(row, columns, [], with_corners)
        view = reader.view()
        if view is not None:
            views.append(view)
            earlier = first_seen.setdefault(view.number, row.where)
            if earlier != row.where:
                reader.report("view", f"{view.number} is already the view of {earlier}")
        problems += reader.problems
    if problems:
        raise problems_error(problems)
    return tuple(views)


def problems_error(problems: Sequence[TableProblem]) -> DataError:
    """Error that lists the first ten problems of a table."""
    norms = [problem.norm for problem in problems if problem.norm is not None]
    if len(norms) == len(problems) >= _FEWEST_ALIKE and max(norms) > _FAR_FROM_UNIT:
        degrees = max(norms) > _ANGLES_RAD
        return DataError(
            f"{problems[0].place} and {len(norms) - 1} more: these are no quaternions but, as it "
            f"seems, {'Euler angles in degrees' if degrees else 'rotation vectors or Euler angles'}"
            f": their norms are {min(norms):.3g} to {max(norms):.3g}, and 1 is needed.",
            culprits=[problems[0].place],
            next_step=f"The images show which. {READ_AGAIN}",
        )
    where = ", ".join(problems[0].place.split(", ")[:2])
    step = f"Correct it, or delete {where}."
    if len(problems) > 1:
        columns = dict.fromkeys(problem.place.partition(", column ")[2] for problem in problems)
        step = ""
        if len(columns) == 1 and "" not in columns:
            step = f"Correct column {', '.join(columns)} of {where.partition(',')[0]}."
    steps = {problem.step for problem in problems}
    if len(steps) == 1:
        step = steps.pop() or step
    if len(problems) <= _SHOWN_PROBLEMS:
        lines = [f"{problem.place}: {problem.words}." for problem in problems]
        return DataError(
            "\n".join(lines), culprits=[problem.place for problem in problems], next_step=step
        )
    kinds: dict[tuple[str, str], list[TableProblem]] = defaultdict(list)
    for problem in problems:
        column = problem.place.partition(", column ")[2]
        kinds[column, _VALUES.sub("", problem.words)].append(problem)
    shown = list(kinds.values())[:_SHOWN_PROBLEMS]
    lines = [_kind_message(alike) for alike in shown]
    if len(kinds) > len(shown):
        lines.append(f"And {len(kinds) - len(shown)} more of other kinds.")
    named = [alike[0] for alike in shown] if all(map(_are_consecutive, shown)) else problems
    culprits = [problem.place for problem in named[:_SHOWN_PROBLEMS]]
    return DataError("\n".join(lines), culprits=culprits, next_step=step)


def _kind_message(alike: Sequence[TableProblem]) -> str:
    """Message for problems of one kind in one column: the first, and the number of others."""
    words = f"{alike[0].place}: {alike[0].words}."
    if len(alike) == 1:
        return words
    last = alike[-1].place.partition(", column ")[0]
    return f"{words} And {len(alike) - 1} more alike, up to {last}."


def _are_consecutive(alike: Sequence[TableProblem]) -> bool:
    """Whether problems are in all lines from the first to the last."""
    lines = [match for problem in alike if (match := _LINE.search(problem.place))]
    numbers = [int(match[1]) for match in lines]
    return len(numbers) == len(alike) and numbers[-1] - numbers[0] == len(alike) - 1


@dataclass(frozen=True)
class _RowReader:
    """Reader of one row, which collects its problems in `problems`."""

    row: TextRow
    columns: Sequence[str]
    problems: list[TableProblem]
    with_corners: bool

    def report(self, column: str, words: str, norm: float | None = None, step: str = "") -> None:
        place = f"{self.row.where}, column {column}" if column else self.row.where
        self.problems.append(TableProblem(place, words, norm, step))

    def view(self) -> View | None:
        """Reads the row; None where it has no valid number or a wrong number of fields."""
        if len(self.row.cells) != len(self.columns):
            words = (
                f"it has {len(self.row.cells)} fields, but the header has {len(self.columns)} "
                "columns"
            )
            step = ""
            if len(self.row.cells) > len(self.columns) and not any(
                _DECIMAL.fullmatch(cell.strip()) for cell in self.row.cells
            ):
                words += "; decimal commas may be the cause"
                step = (
                    "Write decimal points; or separate the cells of all lines by semicolons, and "
                    "decimal commas are read, too."
                )
            self.report("", words, step=step)
            return None
        cells = dict(zip(self.columns, self.row.cells, strict=True))
        if not cells["view"].strip():
            self.report("view", "it is empty; a whole number is needed")
        number = self._take(cells, "view", read_integer)
        stop = self._take(cells, "stop", read_integer)
        image = self._take(cells, "image", image_path)
        role = self._take(cells, "role", _role, keep=True)
        numbers = self._numbers(cells)
        text = {name: cell for name, cell in cells.items() if cell}
        if text.get("approach", "").strip() not in SIDES:
            self.report(
                "approach", f'{text["approach"]!r} is no side; "+", "-" or nothing is needed'
            )
        self._check_sizes(numbers)
        self._check_groups(numbers)
        # A row of a stop may have only the pose of one of several robots.
        is_robot_row = {"x_m", "q1_rad"} & numbers.keys() and stop is not None and "robot" in text
        observed = {"cft_x_m", "meas_x_m"} & numbers.keys() or "point" in text or is_robot_row
        if not image and not observed and not self.with_corners and not self.problems:
            absent = "it is empty" if "image" in self.columns else "there is no such column"
            self.report(
                "image",
                f"{absent}, and the row has neither cft_* nor meas_* nor point",
                step="Write the path of each row's image into column image, or the corners of "
                "another detector into corners.csv.",
            )
        if role == "intrinsics" and not self.problems:
            self._check_lens_only(image or "", numbers)
        if number is None:
            return None
        return View(number, image or "", role == "holdout", stop, numbers, text)

    def _take(
        self, cells: dict[str, str], column: str, read: Callable[[str], _T], *, keep: bool = False
    ) -> _T | None:
        """Pops a column of the cells and reads it; None where it is empty or wrong."""
        cell = (cells.get(column, "") if keep else cells.pop(column, "")).strip()
        if not cell:
            return None
        try:
            return read(cell)
        except DataError as error:
            self.report(column, error.message.rstrip("."), step=error.next_step)
            return None

    def _numbers(self, cells: dict[str, str]) -> dict[str, float]:
        numbers = {}
        for column in self.columns:
            if cols.is_number(column):
                value = self._take(cells, column, read_number)
                if value is not None:
                    numbers[column] = value
        return numbers

    def _check_sizes(self, numbers: Mapping[str, float]) -> None:
        for column, value in numbers.items():
            # Recordings of earlier versions may have any time; see `check_times`.
            wrong = cols.size_error(column, np.array([value])) if column != "stamp_s" else ""
            if wrong:
                self.report(column, wrong)
            wrong = cols.temperature_error(np.array([value])) if column.endswith("_c") else ""
            if wrong:
                self.report(column, wrong)

        for column, words in load_problems(numbers):
            self.report(column, words)

    def _check_lens_only(self, image: str, numbers: Mapping[str, float]) -> None:
        poses = [name for name in ("x_m", "q1_rad", "cft_x_m", "meas_x_m") if name in numbers]
        if not (image or self.with_corners) or poses:
            self.report(
                "role",
                "intrinsics is for an image that serves the camera's lens alone, but the row has "
                + (f"{poses[0]}; leave that empty" if poses else "no image"),
            )

    def _check_groups(self, numbers: Mapping[str, float]) -> None:
        joints = cols.joint_columns(self.columns)
        if "robot" in self.columns:
            # Robots may have different numbers of joints.
            filled = [name for name in joints if name in numbers]
            joints = tuple(dict.fromkeys((*joints[: len(filled)], *filled)))
        # A rejected cell would be reported again as missing from its group.
        groups = () if self.problems else (*cols.WHOLE_GROUPS, joints)
        for group in groups:
            missing = [name for name in group if name not in numbers]
            if 0 < len(missing) < len(group):
                self.report(
                    missing[0],
                    f"it is empty while {group[0] if group[0] in numbers else group[-1]} is "
                    f"filled; a row fills all of {group[0]} ... {group[-1]} or none",
                )
        for group in cols.QUATERNION_GROUPS:
            if all(name in numbers for name in group):
                norm = math.hypot(*(numbers[name] for name in group))
                if abs(norm - 1.0) > _NORM_TOLERANCE:
                    self.report(
                        f"{group[0]} ... {group[-1]}",
                        f"the quaternion's norm is {norm:.6g}, but must be 1 to within "
                        f"{_NORM_TOLERANCE:g}",
                        norm,
                    )


def read_number(cell: str) -> float:
    """Reads a finite number.

    Raises:
        DataError: It is not one.
    """
    value = float(cell) if NUMBER.fullmatch(cell) else math.nan
    if not math.isfinite(value):
        why = " (the decimal sign is a point)" if "," in cell else ""
        if _THOUSANDS.fullmatch(cell):
            why = " (write it without commas between thousands)"
        elif "\u2212" in cell:
            why = " (its minus sign is a typographic one; write -)"
        raise DataError(f"{cell!r} is no finite number{why}")
    return value


def read_integer(cell: str) -> int:
    """Reads a whole number, also as `3.0`, which some programs write.

    Raises:
        DataError: It is not one.
    """
    cell = cell.removesuffix(".0")
    if not _INTEGER.fullmatch(cell) or len(cell) > 18:
        raise DataError(f"{cell!r} is no whole number")
    return int(cell)


def _role(cell: str) -> str:
    if cell not in ("fit", "holdout", "intrinsics"):
        raise DataError(f'{cell!r} is no role; "fit", "holdout", "intrinsics" or nothing is needed')
    return cell
