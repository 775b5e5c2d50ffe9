"""The history of a site's cells: one SQLite file to which every act is appended."""

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from visioncal.core.choices import SITE_FILE, ActKind
from visioncal.core.codec import REST, Key, read, reading, write
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError
from visioncal.core.files import check_journal, one_line, sha256
from visioncal.core.types import Need
from visioncal.core.verdict import VerdictStatus
from visioncal.core.version import __version__
from visioncal.results.edge import StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.result import Calibration
from visioncal.session.frames import frames_of_kind

# Millions of SQLite's instructions that an act may take.
_MOST_ROUNDS = 1000
# Seconds that an entry waits for others that are being written.
_PATIENCE_S = 20.0
# "vcal", by which our files are known among SQLite's.
_APPLICATION = 0x7663616C
# The form of the file, the statements of each version in turn: old files are brought forward.
# REPLACE would delete without the trigger on DELETE, hence the one on INSERT, which also makes a
# repeated entry harmless.
_FORMS = (
    (
        "CREATE TABLE entry (id TEXT PRIMARY KEY NOT NULL, at TEXT NOT NULL, cell TEXT NOT NULL, "
        "kind TEXT NOT NULL, sha256 TEXT NOT NULL, document TEXT NOT NULL)",
        "CREATE TRIGGER entry_once BEFORE INSERT ON entry "
        "WHEN EXISTS (SELECT 1 FROM entry WHERE id = NEW.id) BEGIN SELECT RAISE(IGNORE); END",
        "CREATE TRIGGER entry_stays BEFORE UPDATE ON entry "
        "BEGIN SELECT RAISE(ABORT, 'a history is only appended to'); END",
        "CREATE TRIGGER entry_remains BEFORE DELETE ON entry "
        "BEGIN SELECT RAISE(ABORT, 'a history is only appended to'); END",
    ),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """An act on a cell: a calibration, a check, a tool or fixture that was placed, a touch test."""

    cell: str  # Name of the cell, the same for all its acts.
    at: str  # Time of the act, ISO 8601, in UTC.
    kind: ActKind  # Kind of the act.
    status: VerdictStatus  # Its verdict.
    reason: str  # The verdict's first reason.
    visioncal: str = __version__  # Version of the program.
    session: str = ""  # Name of the session, or of the file of touches.
    sha256: str = ""  # Digest of the input; empty where a result does not keep it.
    source: str = ""  # Absolute path of the input; empty where unknown.
    out: str = ""  # Absolute path of the result; empty where none was written.
    against: str = ""  # Digest of the calibrated session that a later act is about.
    # Estimates, by name.
    edges: Annotated[Mapping[str, StoredEdge], Key("transforms")] = field(default_factory=dict)
    # Transforms of boards, which are put elsewhere on purpose.
    boards: tuple[str, ...] = ()
    need: Need | None = None  # Required accuracy of picks.
    good_for_mm: float | None = None  # The least need for which it is good [mm].
    conditions: tuple[str, ...] = ()  # Conditions of the result, in sentences.
    robot: str = ""  # Model of the robot.
    # Numbers of the result by name, with their units: `views`, `noise_mm`, `radius95_mm` ...
    figures: Mapping[str, float] = field(default_factory=dict)
    # Notes of a newer version, unchanged.
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict, repr=False)

    @property
    def id(self) -> str:
        """Identifier of the entry, by its result and time, whatever its path and cell.

        A result that is added once more, from wherever, is thus the same entry.
        """
        found = {name: edge.matrix.tolist() for name, edge in self.edges.items()}
        inputs = [self.session, self.sha256, self.against]
        content = [self.kind, self.at, self.status, self.reason, inputs, found]
        return sha256(json.dumps(content, sort_keys=True).encode())[:16]

    @property
    def time(self) -> datetime:
        """Time of the act."""
        return datetime.fromisoformat(self.at)

    @property
    def columns(self) -> dict[str, str | float]:
        """The entry as a row of a table; a transform as translation [m], rotation vector [rad]."""
        facts = write(Entry, self).items()
        row: dict[str, str | float] = {"id": self.id}
        row |= {name: value for name, value in facts if isinstance(value, str | float)}
        need = {} if self.need is None else vars(self.need)
        row |= {f"need_{unit}": need[unit] for unit in ("mm", "deg") if need.get(unit) is not None}
        row |= {"conditions": " ".join(self.conditions), **self.figures}
        for name, edge in self.edges.items():
            twist = [*edge.matrix[:3, 3], *edge.transform.rotation.as_rotvec()]
            labels = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
            row |= {f"{name} {label}": float(x) for label, x in zip(labels, twist, strict=True)}
            row |= {f"{name} sigma_mm": edge.sigma_mm, f"{name} sigma_deg": edge.sigma_deg}
        return row


def table_of(entries: Iterable[Entry]) -> str:
    """Entries as CSV, a row an entry; see `Entry.columns`."""
    rows = [entry.columns for entry in entries]
    names = dict.fromkeys(name for row in rows for name in row)
    return csv_text([names, *([row.get(name, "") for name in names] for row in rows)], inert=True)


def entries_of(calibration: Calibration) -> Iterator[Entry]:
    """The entries of a result: itself, the frames that joined it, and its touch test."""
    # Of a cell without a camera, the first transform.
    names = sorted(calibration.edges, key=lambda name: "_from_cam" not in name)
    is_known = calibration.verdict.has_accuracy
    edge = calibration.edges[names[0]] if names and is_known else None
    camera, noise = calibration.camera, calibration.noise
    budget = calibration.budget if is_known else None
    figures = {
        "views": len(calibration.views),
        "used": sum(view.used for view in calibration.views),
        "residual_mm": calibration.rms.mm,
        "residual_deg": calibration.rms.deg,
        "residual_px": calibration.rms.px,
        "noise_mm": noise.get("robot_translation_mm", noise.get("combined_translation_mm")),
        "noise_deg": noise.get("robot_rotation_deg", noise.get("combined_rotation_deg")),
        "noise_px": noise.get("pixel_px"),
        "sigma_mm": None if edge is None else edge.sigma_mm,
        "sigma_deg": edge.sigma_deg if edge is not None and edge.oriented else None,
        "radius95_mm": None if budget is None else budget.radius95_mm,
        "focal_px": None if camera is None else float(np.mean(camera.camera.matrix[:2])),
        **calibration.means,
    }
    children = {name: name.partition("_from_")[2] for name in calibration.edges}
    targets = frames_of_kind(children.values(), "target")
    calibrated = Entry(
        cell=calibration.session_name,
        at=_utc(calibration.created),
        kind="calibrated",
        status=calibration.verdict.status,
        reason=calibration.verdict.first_reason,
        session=calibration.session_name,
        sha256=calibration.session_sha256,
        edges=calibration.edges,
        boards=tuple(name for name, child in children.items() if child in targets),
        need=None if calibration.need is None else calibration.need.need,
        good_for_mm=calibration.verdict.good_for_mm,
        conditions=tuple(condition.words for condition in calibration.conditions),
        robot="" if calibration.robot is None else calibration.robot.name,
        figures={
            name: float(value)
            for name, value in figures.items()
            if value is not None and math.isfinite(value)
        },
    )
    yield calibrated
    for name, frame in calibration.frames.items():
        yield entry_of_frame(name, frame, calibration)
    if (test := calibration.touch_test) is not None:
        gaps = [point.gap_mm for point in test.points]
        outcome = "as" if test.passed else "larger than"
        yield Entry(
            cell=calibrated.cell,
            at=_utc(test.created),
            kind="touched",
            status="good" if test.passed else "bad",
            reason=f"Touched with {test.named_tool}: the largest gap is {max(gaps):.2f} mm, "
            f"{outcome} predicted.",
            session=calibrated.session,
            against=calibrated.sha256,
        )


def entry_of_frame(name: str, frame: Frame, calibration: Calibration | None) -> Entry:
    """The entry of a tool or a fixture, by its transform's name; without a calibration, None."""
    return Entry(
        cell=one_line(frame.source) if calibration is None else calibration.session_name,
        at=_utc(frame.created),
        kind="tool" if name.startswith("flange") else "fixture",
        status=frame.verdict.status,
        reason=frame.verdict.first_reason,
        session=one_line(frame.source),
        edges={name: frame.edge},
        against="" if calibration is None else calibration.session_sha256,
        figures={"residual_mm": frame.rms_mm, "noise_mm": frame.noise_mm},
    )


def entry_of_check(document: Mapping[str, Any], label: str = "verify.json") -> Entry:
    """The entry of a check by its verify.json; raises DataError for one of an older version."""
    with reading(label, "a check", "Verify once more, by this version."):
        facts = {
            "cell": one_line(document["calibration"]["session"]),
            "at": _utc(document["created"]),
            "kind": "verified",
            "status": document["status"],
            "reason": next(iter(document["sentences"]), ""),
            "session": one_line(document["session"]["name"]),
            "sha256": document["session"]["sha256"],
            "against": document["calibration"]["sha256"],
            "figures": {"misfit": document["misfit"], "p_value": document["p_value"]},
        }
        # An entry that cannot be read again stays in a history for ever.
        return read(Entry, facts, "")


def _utc(created: str) -> str:
    """Formats a time for entries, so that they sort as texts in the order of the acts."""
    with reading(f"the time {created!r}", "a time", "Take the result as it was written."):
        then = datetime.fromisoformat(created)
        return (then if then.tzinfo else then.replace(tzinfo=UTC)).astimezone(UTC).isoformat()


@dataclass(frozen=True)
class History:
    """A history's file; created by the first entry.

    Each call opens and closes it, so that processes share it. An entry that `append` has returned
    from is on the disk, once, however often it is repeated.
    """

    path: Path

    @classmethod
    def of_site(cls, near: Path) -> Self | None:
        """The history of the site to which a path belongs: the nearest in its folder or above.

        One within a session's folder came with the session, and is nobody's site.
        """
        folders = (near.absolute(), *near.absolute().parents)
        sessions = [at for at, folder in enumerate(folders) if (folder / "session.toml").is_file()]
        above = folders[max(sessions, default=-1) + 1 :]
        found = (folder / SITE_FILE for folder in above if (folder / SITE_FILE).is_file())
        return next(map(cls, found), None)

    def append(self, *entries: Entry) -> int:
        """Appends entries, all of them or none, and returns how many were not there yet.

        Raises:
            DataError: The file cannot be written, is locked, or is no history.
        """
        rows = [
            (one.id, one.at, one.cell, one.kind, one.sha256, json.dumps(write(Entry, one)))
            for one in entries
        ]
        with self._opened(creating=True) as file:
            file.execute("BEGIN IMMEDIATE")
            before = file.total_changes
            file.executemany("INSERT INTO entry VALUES (?, ?, ?, ?, ?, ?)", rows)
            new = file.total_changes - before
            file.execute("COMMIT")
        return new

    def entries(
        self,
        cell: str | None = None,
        kind: ActKind | None = None,
        sha256: str | None = None,
        begin: str = "",
    ) -> tuple[Entry, ...]:
        """The entries in the order of their times.

        Args:
            cell: Those of a cell alone.
            kind: Those of a kind alone.
            sha256: Those of an input alone, by its digest.
            begin: Those whose identity begins so.

        Raises:
            DataError: The file is missing, cannot be read, is locked, or is no history.
        """
        if not self.path.exists():
            raise DataError(
                f"{self.path} does not exist.",
                culprits=[str(self.path)],
                next_step="Name a history's file, or begin one: visioncal calibrate SESSION -o OUT "
                f"--history {self.path}",
            )
        query = (
            "SELECT document FROM entry WHERE cell = ifnull(?, cell) AND kind = ifnull(?, kind) "
            "AND sha256 = ifnull(?, sha256) AND substr(id, 1, length(?)) = ? ORDER BY at, rowid"
        )
        with self._opened() as file:
            rows = file.execute(query, (cell, kind, sha256, begin, begin)).fetchall()
        with reading(str(self.path), "a history", "Take an earlier copy of it."):
            documents = (parse_stored(text.encode(), "an entry") for (text,) in rows)
            return tuple(read(Entry, document, "") for document in documents)

    @contextmanager
    def _opened(self, *, creating: bool = False) -> Iterator[sqlite3.Connection]:
        """The open file in the present form, with errors in plain words."""
        try:
            with closing(self._connected("rwc" if creating else "rw")) as file:
                self._bring_forward(file)
                if creating:
                    # While another process has it open, the next entry tries again.
                    with suppress(sqlite3.OperationalError):
                        file.execute("PRAGMA journal_mode = WAL")
                yield file
        except (sqlite3.Error, UnicodeError) as error:
            # Names in a damaged file may be no text: then SQLite's message cannot be read, either.
            code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
            why, do = _FAULTS.get(code, (f"cannot be used: {error}", "Take an earlier copy of it."))
            if self.path.is_dir():
                why, do = "is a folder", f"Name a file, such as {SITE_FILE}, and --add the folder."
            elif not self.path.parent.is_dir():
                why, do = "cannot be created: its folder does not exist", "Create the folder first."
            raise self._refusal(why, do) from error

    def _connected(self, mode: str) -> sqlite3.Connection:
        address, log_path = self.path.absolute().as_uri(), Path(f"{self.path}-wal")
        check_journal(self.path)
        try:
            return _connection(f"{address}?mode={mode}")
        except sqlite3.OperationalError as error:
            # A read-only place has no room for files beside the history; nobody writes there.
            is_closed = not log_path.exists() or not log_path.stat().st_size
            read_only = (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
            if mode != "rw" or error.sqlite_errorcode & 0xFF not in read_only or not is_closed:
                raise
            return _connection(f"{address}?mode=ro&immutable=1")

    def _bring_forward(self, file: sqlite3.Connection) -> None:
        """Brings a new file, or one of an older version, into the present form."""
        # One state of the file, which others may be creating.
        file.execute("BEGIN")
        version = self._version(file)
        file.execute("COMMIT")
        if version < len(_FORMS):
            file.execute("BEGIN IMMEDIATE")
            # Another process may have been quicker.
            for statements in _FORMS[self._version(file) :]:
                for statement in statements:
                    file.execute(statement)
            file.execute(f"PRAGMA application_id = {_APPLICATION}")
            file.execute(f"PRAGMA user_version = {len(_FORMS)}")
            file.execute("COMMIT")

    def _version(self, file: sqlite3.Connection) -> int:
        names = ("schema_version", "user_version", "application_id")
        tables, version, application = (
            int(file.execute(f"PRAGMA {name}").fetchone()[0]) for name in names
        )
        if application != _APPLICATION and (application or version or tables):
            raise self._refusal("is a file of another program", "Name a history's file.")
        if version > len(_FORMS):
            why = f"is of form {version}, and this version of visioncal knows {len(_FORMS)}"
            raise self._refusal(why, "Use the newer version that wrote it.")
        # A view in the place of the table, or another's trigger, would run when it is read.
        with closing(sqlite3.connect(":memory:")) as genuine:
            for statement in chain.from_iterable(_FORMS[:version]):
                genuine.execute(statement)
            made, stored = (
                data.execute("SELECT sql FROM sqlite_master ORDER BY rowid").fetchall()
                for data in (genuine, file)
            )
        if made != stored:
            why = "has other tables, views or triggers than a history"
            raise self._refusal(why, "Name a history's file, and do not open this one elsewhere.")
        return version

    def _refusal(self, why: str, do: str) -> DataError:
        return DataError(f"{self.path} {why}.", culprits=[str(self.path)], next_step=do)


def _connection(address: str) -> sqlite3.Connection:
    file = sqlite3.connect(address, uri=True, timeout=_PATIENCE_S, isolation_level=None)
    try:
        file.execute("PRAGMA synchronous = FULL")
        file.execute("PRAGMA trusted_schema = OFF")
        # A damaged index may go round; a million entries take a hundredth of this.
        rounds = iter(range(_MOST_ROUNDS))
        file.set_progress_handler(lambda: next(rounds, None) is None, 1_000_000)
        # The file is opened by the first statement that reads.
        file.execute("PRAGMA user_version").fetchone()
    except (sqlite3.Error, UnicodeError):
        file.close()
        raise
    return file


# Why a file cannot be used, by SQLite's code, and what to do.
_FAULTS = {
    sqlite3.SQLITE_BUSY: (
        f"is locked: another program has been writing it for {_PATIENCE_S:.0f} s",
        "Close the program that has it open, such as a viewer of SQLite files.",
    ),
    sqlite3.SQLITE_READONLY: (
        "cannot be written: it or its folder is read-only",
        "Ask for the right to write there, or copy it to where you may.",
    ),
    sqlite3.SQLITE_CANTOPEN: (
        "cannot be opened: you may not read it, or not write into its folder",
        "Ask for the right to, or copy it to where you may.",
    ),
    sqlite3.SQLITE_INTERRUPT: ("takes without end to read", "Take an earlier copy of it."),
    sqlite3.SQLITE_FULL: ("cannot be written: the disk is full", "Make room on that disk."),
    sqlite3.SQLITE_IOERR: (
        "cannot be read or written: the disk is full, or fails",
        "Make room on that disk; a file on a network drive belongs onto a disk of this machine.",
    ),
    sqlite3.SQLITE_CORRUPT: ("is damaged", "Take an earlier copy of it."),
    sqlite3.SQLITE_NOTADB: (
        "must be a history, but is not even a file of SQLite",
        "Name a history's file.",
    ),
}
