"""corners.csv: image points of the targets' known points, found by another detector."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.core.documents.columns import Column, TableProblem, TableReader, problems_error
from visioncal.core.documents.tables import parse_table
from visioncal.core.errors import DataError
from visioncal.core.files import read_text_inside, sha256
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Corners, FloatArray, IntArray, Target, chosen_rows
from visioncal.session.document import Declaration
from visioncal.session.kinds import COLUMN, name_of
from visioncal.session.table import View
from visioncal.vision.targets import point_numbers

FILE = "corners.csv"
_NEEDED = ("view", "point", "u_px", "v_px")
_SIGMA = "sigma_px"
# Largest number of rows: 500 corners in 2000 views take a gigabyte of memory.
_MOST_CORNERS = 1_000_000
# Standard deviations of corners [px]: the finest templates reach a hundredth, and few images are
# larger than the upper limit. Squares of others overflow, or leave nothing of the other corners.
_LEAST_PX, _MOST_PX = 1e-4, 1e4


@dataclass(frozen=True, eq=False)
class CornerTable:
    """Rows of corners.csv, n in all."""

    views: IntArray  # (n,) view numbers.
    points: IntArray  # (n,) point numbers on the target.
    px: FloatArray  # (n, 2) image points [px].
    targets: tuple[str, ...]  # (n,) names of the targets; empty where not stated.
    # (n,) standard deviation per axis [px]; None where not stated.
    sigmas_px: FloatArray | None = None
    # Whether they are lines of a corners.csv; else they are arrays of a program.
    is_file: bool = True
    # (n,) line of each row in its file; None where rows follow the header.
    lines: IntArray | None = None

    @classmethod
    def of_lists(cls, by_view: Sequence[tuple[int, IntArray, FloatArray]]) -> "CornerTable":
        """The corners of arrays: for each view its number, (k,) points and (k, 2) px."""
        counts = [len(points) for _, points, _ in by_view]
        return cls(
            np.repeat([view for view, _, _ in by_view], counts).astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *(points for _, points, _ in by_view)]),
            np.concatenate([np.zeros((0, 2)), *(px for _, _, px in by_view)]),
            ("",) * sum(counts),
            is_file=False,
        )

    def __len__(self) -> int:
        return len(self.views)

    def place(self, row: int) -> str:
        """Place of a row, for messages."""
        if self.is_file:
            return f"{FILE}, line {row + 2 if self.lines is None else self.lines[row]}"
        view = int(self.views[row])
        return f"corners[{view}], ids[{int(np.sum(self.views[:row] == view))}]"

    def of_views(self, views: Sequence[int]) -> "CornerTable":
        """The corners of some views."""
        return chosen_rows(self, np.isin(self.views, views))

    def without_targets(self) -> "CornerTable":
        """The corners without names of targets."""
        return replace(self, targets=("",) * len(self))

    def fact(self) -> dict[str, object]:
        """Content for the session's digest, independent of the numbers' formatting."""
        sigmas = np.zeros(0) if self.sigmas_px is None else self.sigmas_px
        # Adding zero turns -0.0 into 0.0.
        numbers = np.concatenate([self.views, self.points, (self.px + 0.0).ravel(), sigmas])
        data = np.ascontiguousarray(numbers, dtype="<f8").tobytes()
        return {"rows": len(self), "targets": self.targets, "values": sha256(data)}


def read_corners(folder: Path) -> CornerTable | None:
    """Reads the corners of a session's folder; None where there are none; raises DataError."""
    return parse_corners(read_text_inside(folder, FILE)) if (folder / FILE).exists() else None


def parse_corners(text: str) -> CornerTable:
    """Reads the text of a corners.csv; raises DataError."""
    table = parse_table(text, FILE)
    if len(table.rows) > _MOST_CORNERS:
        raise DataError(
            f"{FILE} has more than {_MOST_CORNERS:,} rows.",
            culprits=[FILE],
            next_step="Take fewer views, or fewer points of each.",
        )
    columns = table.columns
    known = (*_NEEDED, COLUMN, _SIGMA)
    missing = [name for name in _NEEDED if name not in columns]
    other = [column for column in columns if column not in known or columns.count(column) > 1]
    if missing or other:
        hints = [word for word in (did_you_mean(name, known) for name in other) if word]
        header_words = f"its columns are {', '.join(columns)}" if any(columns) else "it is empty"
        raise DataError(
            f"{FILE}, header: {header_words}; {', '.join(_NEEDED)} are "
            f"needed, {COLUMN} and {_SIGMA} are optional, and others are not read.",
            culprits=[f"{FILE}: {name}" for name in (*missing, *other)],
            next_step=hints[0] if hints else f"Begin {FILE} with the line {','.join(_NEEDED)}.",
        )
    reader = TableReader(table)
    views, points = (reader.whole(name) for name in _NEEDED[:2])
    px = reader.numbers(*(Column(name, is_needed=True) for name in _NEEDED[2:]))
    sigmas = None
    if any(reader.texts(_SIGMA)):
        words = (
            "{:g} px must be the standard deviation of a corner, between "
            f"{_LEAST_PX:g} and {_MOST_PX:g} px; leave out the rows of corners that do not count"
        )
        sigmas = reader.numbers(Column(_SIGMA, _LEAST_PX, _MOST_PX, words.format))[:, 0]
        empty = np.flatnonzero(np.isnan(sigmas)).tolist()
        if empty and reader.is_sound(empty[0]):
            reader.report(empty[0], _SIGMA, "it is empty; all rows state it, or none")
    reader.check()
    lines = np.array(table.lines, dtype=np.int64)
    return CornerTable(views, points, px, tuple(reader.texts(COLUMN)), sigmas, lines=lines)


def write_corners(table: CornerTable) -> str:
    """Text of a corners.csv that reads back to the same numbers."""
    columns = [*_NEEDED, *([COLUMN] if any(table.targets) else [])]
    rows = [
        [str(view), str(point), repr(u_px), repr(v_px), *([target] if len(columns) > 4 else [])]
        for view, point, (u_px, v_px), target in zip(
            table.views.tolist(),
            table.points.tolist(),
            table.px.tolist(),
            table.targets,
            strict=True,
        )
    ]
    if table.sigmas_px is not None:
        columns.append(_SIGMA)
        for row, sigma_px in zip(rows, table.sigmas_px.tolist(), strict=True):
            row.append(repr(sigma_px))
    return "".join(",".join(row) + "\n" for row in (columns, *rows))


def with_corners(
    columns: tuple[str, ...], views: Sequence[View], table: CornerTable, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[View, ...], CornerTable]:
    """Marks the views that have corners; splits those that show several targets, with names.

    Returns:
        Columns, rows with those for further targets appended, and the corners with their view
        numbers. The rows of a split view share its stop. Corners of deleted rows are dropped.

    Raises:
        DataError: A view is unknown, or the target of a row is unknown, missing, or contradicts its
            view.
    """
    rows = {view.number: view for view in views}
    table = _without_deleted(table, rows)
    named = [
        rows[view].text.get(COLUMN, "").strip() if view in rows else "" for view in table.views
    ]
    problems = list(_target_problems(table, rows, named, names))
    if problems:
        raise problems_error(problems)
    if not names:
        has = set(table.views.tolist())
        marked = tuple(replace(view, has_corners=view.number in has) for view in views)
        return columns, marked, table
    shown = [stated or by_view for stated, by_view in zip(table.targets, named, strict=True)]
    numbers = table.views.copy()
    added: list[View] = []
    new, stop = (1 + max([0, *mapping]) for mapping in (rows, (view.stop or 0 for view in views)))
    for number in list(rows):
        view_rows = np.flatnonzero(table.views == number)
        boards = list(dict.fromkeys(shown[at] for at in view_rows))
        if not boards:
            continue
        if len(boards) > 1 and rows[number].stop is None:
            rows[number], stop = replace(rows[number], stop=stop), stop + 1
        rows[number] = _with_board(rows[number], boards[0])
        for board in boards[1:]:
            added.append(replace(_with_board(rows[number], board), number=new))
            numbers[[at for at in view_rows if shown[at] == board]] = new
            new += 1
    more = [name for name in ("stop", COLUMN) if name not in columns]
    wanted = {"stop": any(row.stop is not None for row in rows.values()), COLUMN: True}
    return (
        (*columns, *(name for name in more if wanted[name])),
        (*rows.values(), *added),
        replace(table, views=numbers, targets=tuple(shown)),
    )


def _with_board(view: View, board: str) -> View:
    return replace(view, has_corners=True, text={**view.text, COLUMN: board})


def _without_deleted(table: CornerTable, rows: Mapping[int, View]) -> CornerTable:
    """The corners without those of deleted rows; unchanged where view numbers seem wrong."""
    # A row with neither corners nor an image means that views are numbered differently; a view
    # number with fewer corners than determine a pose is mistyped.
    seen, counts = np.unique(table.views, return_counts=True)
    lost = {value for value in seen.tolist() if value not in rows}
    # A pose takes four.
    few = {*seen[counts < 4].tolist()}
    if not lost or lost & few or any(row not in seen and not rows[row].image for row in rows):
        return table
    return table.of_views(list(rows))


def _target_problems(
    table: CornerTable, rows: Mapping[int, View], named: Sequence[str], names: Sequence[str]
) -> Iterator[TableProblem]:
    """Problems of the rows' views and targets."""
    first = next((target for target in table.targets if target), "")
    for view in dict.fromkeys(view for view in table.views.tolist() if view not in rows):
        place = table.place(int(np.argmax(table.views == view)))
        yield TableProblem(f"{place}, column view", f"views.csv has no view {view}")
    for at, (view, target) in enumerate(zip(table.views.tolist(), table.targets, strict=True)):
        words = ""
        if view not in rows:
            continue
        if not names and target not in ("", first):
            words = f"{target!r} beside {first!r}, but session.toml declares one target"
        elif names and (target or named[at]) not in names:
            words = f"{target!r}, but must be one of {', '.join(names)}, here or in views.csv"
        elif names and target and named[at] not in ("", target):
            words = (
                f"{target!r}, but views.csv says that view {view} shows {named[at]!r}; a "
                "view that shows both has a row for each there, or names none"
            )
        if words:
            yield TableProblem(f"{table.place(at)}, column {COLUMN}", words)


def check_points(table: CornerTable, names: Sequence[str], targets: Mapping[str, Target]) -> None:
    """Checks that points exist on their targets, with (n,) `names`, and are unique in each view.

    Raises:
        DataError: A point is unknown or duplicate.
    """
    numbers = {name: point_numbers(targets[name]) for name in dict.fromkeys(names)}
    known = {name: frozenset(points) for name, points in numbers.items()}
    problems: list[TableProblem] = []
    seen: dict[tuple[int, int], int] = {}
    for at, key in enumerate(zip(table.views.tolist(), table.points.tolist(), strict=True)):
        earlier = seen.setdefault(key, at)
        if key[1] not in known[names[at]]:
            points = numbers[names[at]]
            words = (
                f"target {targets[names[at]].name} has no point {key[1]}; its {len(points)} points "
                f"have the numbers {min(points)} to {max(points)}"
            )
        elif earlier != at:
            words = (
                f"point {key[1]} of view {key[0]} is there twice, first in {table.place(earlier)}"
            )
        else:
            continue
        place = table.place(at) + (", column point" if table.is_file else "")
        problems.append(TableProblem(place, words))
    if problems:
        raise problems_error(problems)


def corners_by_view(
    table: CornerTable,
    views: Sequence[View],
    declaration: Declaration,
    board_of: Mapping[int, Target],
) -> dict[int, Corners]:
    """Corners of views, numbered by index on the target.

    Weights are the ratio of the camera's median stated sigma to each corner's. `board_of` has the
    target of each view, by view number.
    """
    order = np.argsort(table.views, kind="stable")
    cuts = np.flatnonzero(np.diff(table.views[order])) + 1
    rows_of = {int(table.views[part[0]]): part for part in np.split(order, cuts) if len(part)}
    camera_of = {view.number: name_of(declaration, "camera", view) for view in views}
    sigmas, by_camera = table.sigmas_px, dict[str, list[FloatArray]]()
    for view, camera in camera_of.items():
        if sigmas is not None and view in rows_of:
            by_camera.setdefault(camera, []).append(sigmas[rows_of[view]])
    medians_px = {name: float(np.median(np.concatenate(px))) for name, px in by_camera.items()}
    index_of = {
        target: {number: at for at, number in enumerate(point_numbers(target))}
        for target in dict.fromkeys(board_of.values())
    }
    corners = {}
    for view in (view.number for view in views if view.number in rows_of):
        # A rig's hash is one of all its points: once a view.
        rows, index = rows_of[view], index_of[board_of[view]]
        ids = np.array([index[point] for point in table.points[rows].tolist()], np.int64)
        order = np.argsort(ids)
        rows, stated_px = rows[order], medians_px.get(camera_of[view])
        weights = None if sigmas is None or stated_px is None else stated_px / sigmas[rows]
        corners[view] = Corners(view, ids[order], table.px[rows], 0.0, weights, stated_px)
    return corners
