"""streams/NAME.csv: time series beside the views."""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.documents.columns import Column, NumberChecks, TableReader
from visioncal.core.documents.tables import parse_table
from visioncal.core.errors import DataError
from visioncal.core.files import named_errors, read_text_inside, sha256, write_atomically
from visioncal.core.number_format import counted
from visioncal.core.types import FloatArray, IntArray
from visioncal.session import columns as cols

FOLDER, STAMP = "streams", "stamp_s"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*", re.ASCII)


@dataclass(frozen=True, eq=False)
class Stream:
    """Time series with named columns."""

    columns: tuple[str, ...]  # Names of the columns; `stamp_s` is one of them.
    values: FloatArray  # (n, c) numbers in the columns' units; NaN where a cell is empty.
    # (n,) line of each row in its file; None where rows follow the header.
    lines: IntArray | None = None

    def __len__(self) -> int:
        return len(self.values)

    def __contains__(self, column: object) -> bool:
        return column in self.columns

    def __getitem__(self, column: str) -> FloatArray:
        """(n,) numbers of a column; NaN where a cell is empty."""
        return np.asarray(self.values[:, self.columns.index(column)])

    @property
    def stamps_s(self) -> FloatArray:
        """(n,) the times [s], ascending."""
        return self[STAMP]

    def group(self, columns: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """(m,) times [s] and (m, k) numbers of the rows in which all given columns are filled."""
        if not columns or any(name not in self for name in columns):
            return np.zeros(0), np.zeros((0, len(columns)))
        numbers = np.stack([self[name] for name in columns], axis=1)
        filled = np.isfinite(numbers).all(axis=1)
        return self.stamps_s[filled], numbers[filled]

    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Reported flange poses: (m,) times [s] and (m, 4, 4) [m]."""
        stamps_s, numbers = self.group(cols.POSE)
        if not len(numbers):
            return stamps_s, np.zeros((0, 4, 4))
        rotations = Rotation.from_quat(numbers[:, 3:])
        poses = RigidTransform.from_components(numbers[:, :3], rotations)
        return stamps_s, np.asarray(poses.as_matrix())

    @property
    def has_robot_state(self) -> bool:
        """Whether the stream has poses or joints of a robot."""
        return cols.POSE[0] in self or "q1_rad" in self

    def joints(self) -> tuple[FloatArray, FloatArray]:
        """Joint angles: (m,) times [s] and (m, n) [rad]."""
        return self.group(cols.joint_columns(self.columns))

    def gaps(self) -> IntArray:
        """Rows after which samples are missing: steps beyond 2.5 medians, and 20 ms."""
        steps = np.diff(self.stamps_s)
        if not len(steps):
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(steps > max(2.5 * float(np.median(steps)), 0.02))

    def fact(self) -> dict[str, object]:
        """Content for the session's digest, independent of the numbers' formatting."""
        # Adding zero turns -0.0 into 0.0; every NaN gets the same bits.
        values = np.where(np.isnan(self.values), np.nan, self.values + 0.0)
        data = np.ascontiguousarray(values, dtype="<f8").tobytes()
        return {"columns": self.columns, "rows": len(self), "values": sha256(data)}


def read_streams(folder: Path) -> dict[str, Stream]:
    """Reads the streams of a session's folder, by name; raises DataError."""
    paths = sorted((folder / FOLDER).glob("*.csv"))
    # Of all streams together: half an hour of twenty columns at 500 Hz.
    streams, bytes_left = {}, 300_000_000
    for path in paths:
        text = read_text_inside(folder, f"{FOLDER}/{path.name}", bytes_left)
        bytes_left -= len(text)
        stream = streams[path.stem] = parse_stream(text, f"{FOLDER}/{path.name}")
        checks = _checks(stream, f"{FOLDER}/{path.name}")
        for name in dict.fromkeys(stream.columns):
            checks.within(cols.column_of(name))
        checks.check()
    return streams


def parse_stream(text: str, label: str) -> Stream:
    """Reads the text of a stream: a header row, and a row of numbers for each sample.

    Raises:
        DataError: A cell is not a number.
    """
    head, _, body = text.partition("\n")
    columns = parse_table(head, label).columns
    values: FloatArray | None = None
    lines, body = None, body.replace("\r\n", "\n").strip("\n")
    if body.strip() and "\n\n" not in body and not {*";\t"} & {*head}:
        # Rows without empty cells are read at once.
        with suppress(ValueError):
            values = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2, comments=None)
    if values is None or values.shape[1] != len(columns) or not np.isfinite(values).all():
        table = parse_table(text, label)
        columns, reader = table.columns, TableReader(table)
        values, lines = reader.numbers(*map(Column, columns)), np.array(table.lines, np.int64)
        reader.check(
            "A stream holds numbers alone: leave a cell empty where there is none, and other "
            "columns out."
        )
    values.setflags(write=False)
    return Stream(columns, values, lines)


def write_stream(stream: Stream) -> str:
    """Text of a stream that reads back to the same numbers."""
    rows = (
        ",".join("" if value != value else repr(value) for value in row)
        for row in stream.values.tolist()
    )
    return "\n".join([",".join(stream.columns), *rows]) + "\n"


def save_stream(folder: Path, name: str, stream: Stream) -> None:
    """Writes a stream into a session's folder; raises DataError."""
    path = folder / FOLDER / f"{name}.csv"
    with named_errors(path):
        path.parent.mkdir(exist_ok=True)
    write_atomically(path, write_stream(stream))


def check_stream(name: str, stream: Stream) -> None:
    """Checks a stream's name, columns and values; raises DataError."""
    label = f"{FOLDER}/{name}.csv"
    # A stream needs no `view`, and may have it.
    header = stream.columns if "view" in stream else ("view", *stream.columns)
    cols.check_header(header, f"{label}, header")
    fault = "it has a header row and no samples" if not len(stream) else ""
    fault = fault if STAMP in stream else f"the column {STAMP}, the time of each row, is missing"
    fault = fault if _NAME.fullmatch(name) else "its name has other than letters, digits, - and _"
    if fault:
        raise DataError(f"{label}: {fault}.", culprits=[label])
    checks = _checks(stream, label)
    for row in np.flatnonzero(~np.isfinite(stream.stamps_s)).tolist():
        checks.report(row, STAMP, "it is empty; each row needs its time")
    for row in (np.flatnonzero(np.diff(stream.stamps_s) <= 0) + 1).tolist():
        words = "it does not ascend from the row before"
        step = f"Sort the rows by {STAMP}, and leave out what was recorded twice."
        checks.report(row, STAMP, words, step)
    checks.complete(*cols.WHOLE_GROUPS, cols.joint_columns(stream.columns))
    for name in stream.columns:
        if name.endswith("_c") and cols.is_number(name):
            checks.within(cols.column_of(name))
    for group in cols.QUATERNION_GROUPS:
        checks.unit(group)
    checks.check()


def _checks(stream: Stream, label: str) -> NumberChecks:
    lines = range(2, len(stream) + 2) if stream.lines is None else stream.lines.tolist()
    values = {name: stream[name] for name in stream.columns}
    return NumberChecks(len(stream), lambda row: f"{label}, line {lines[row]}", values)


def too_far_apart(label: str, usual_s: float, slowest_s: float) -> DataError:
    """Error for samples whose typical step `usual_s` exceeds the accepted `slowest_s` [s]."""
    return DataError(
        f"{label}: by stamp_s its samples are {usual_s:.4g} s apart; over {slowest_s:g} s they "
        "show no motion.",
        culprits=[f"{label}, stamp_s"],
        next_step="stamp_s is in seconds: divide by 1000 where it is in milliseconds.",
    )


def gap_warnings(streams: Mapping[str, Stream]) -> Iterator[tuple[str, str]]:
    """Warnings of gaps in streams, and their files."""
    for name, stream in streams.items():
        behind, stamps_s = stream.gaps(), stream.stamps_s
        if len(behind):
            steps = np.diff(stamps_s)
            worst = int(behind[np.argmax(steps[behind])])
            file = f"{FOLDER}/{name}.csv"
            words = (
                f"{file}: samples are missing in {counted(len(behind), 'place')}; the "
                f"widest gap is {steps[worst]:.3g} s, {stamps_s[worst] - stamps_s[0]:.6g} s from "
                f"the start, where samples are usually {np.median(steps):.3g} s apart. Nothing is "
                "interpolated across them."
            )
            yield words, file
