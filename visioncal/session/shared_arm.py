"""Joining of several sessions of one arm into one of a whole cell, which share only the arm.

More sessions cover more of the arm's joint ranges, with any camera and board. Each session keeps
its own camera, board and frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import Searched
from visioncal.session.corners import CornerTable
from visioncal.session.images import ImageStore
from visioncal.session.kinds import COLUMN as TARGET
from visioncal.session.selecting import has_several
from visioncal.session.session import Session
from visioncal.session.table import View

# Fields of session.toml that differ between the sessions and are not copied.
_OWN = ("camera", "target", "mount", "frames", "clock", "clocks", "prior", "name")
# Time between two sessions whose clocks overlap [s]: the robot cools down completely.
_BETWEEN_S = 86_400.0


@dataclass(frozen=True, eq=False)
class JoinedImages(ImageStore):
    """Images of several sessions, each in a folder with its session's name."""

    stores: Mapping[str, ImageStore]

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        store, name = self._locate(path)
        return store.read(name)

    def sha256(self, path: str) -> str:
        """Digest of an image file; empty where there is none."""
        store, name = self._locate(path)
        return store.sha256(name)

    def absence(self, path: str) -> str:
        """Why there is no such image; empty where there is one."""
        store, name = self._locate(path)
        return store.absence(name)

    def search_of(self, path: str, board: str) -> Searched | None:
        """What was found in an image that is elsewhere, of the only board of its session."""
        del board
        store, name = self._locate(path)
        return store.search_of(name, "")

    def shown(self, path: str) -> bytes | None:
        """A faint copy of an image that is elsewhere; None where there is none."""
        store, name = self._locate(path)
        return store.shown(name)

    def _locate(self, path: str) -> tuple[ImageStore, str]:
        first, _, rest = path.partition("/")
        return self.stores[first], rest


@typed
def join_sessions(sessions: Sequence[Session]) -> Session:
    """Joins sessions of one arm.

    Args:
        sessions: Of one camera and one board each, with the same robot; their cameras and boards
            are named s1, s2, ... in this order.

    Returns:
        The session of a cell with that robot, and a camera and a board of each session. Stops and
        views are renumbered, one session after the other; overlapping times are shifted.

    Raises:
        DataError: One is a whole cell, has streams or no robot, or the robots differ.
    """
    if len(sessions) == 1:
        return sessions[0]
    for at, session in enumerate(sessions):
        _check(session, sessions[0], sessions[:at])
    names = [f"s{at}" for at in range(1, len(sessions) + 1)]
    by_name = dict(zip(names, sessions, strict=True))
    document = {name: value for name, value in sessions[0].document.items() if name not in _OWN}
    document |= {
        "name": " + ".join(session.name for session in sessions),
        "cameras": {name: session.document.get("camera", {}) for name, session in by_name.items()},
        "targets": {name: session.document["target"] for name, session in by_name.items()},
    }
    document["frames"] = frames = {}
    priors = {}
    for name, session in by_name.items():
        in_hand = session.mount == "eye-in-hand"
        frames[f"cam_{name}"] = "flange" if in_hand else "base"
        frames[f"target_{name}"] = "base" if in_hand else "flange"
        for edge, prior in session.document.get("prior", {}).items():
            ends = [
                f"{part}_{name}" if part in ("cam", "target") else part
                for part in edge.split("_from_")
            ]
            priors["_from_".join(ends)] = prior
    clocks = {
        name: session.document["clock"]
        for name, session in by_name.items()
        if "clock" in session.document
    }
    document |= {name: own for name, own in (("clocks", clocks), ("prior", priors)) if own}
    columns = list(dict.fromkeys(name for session in sessions for name in session.columns))
    columns += [name for name in ("stop", "camera", TARGET) if name not in columns]
    rows: list[list[str]] = []
    tables: list[CornerTable] = []
    views, stops, until_s = 0, 0, -np.inf
    for name, session in by_name.items():
        stamps = _stamps(session.views)
        shift_s = until_s + _BETWEEN_S - min(stamps) if stamps and min(stamps) <= until_s else 0.0
        for view in session.views:
            changed = {
                "view": str(views + view.number),
                "stop": "" if view.stop is None else str(stops + view.stop),
                "image": view.image and f"{name}/{view.image}",
                "camera": name,
                TARGET: name,
            }
            if view.stamp_s is not None:
                changed["stamp_s"] = repr(view.stamp_s + shift_s)
            rows.append([changed.get(column, view.cell(column)) for column in columns])
        if session.corner_table is not None:
            table = session.corner_table
            target_names = (name,) * len(table)
            tables.append(replace(table, views=table.views + views, targets=target_names))
        views += 1 + max((view.number for view in session.views), default=0)
        stops += 1 + max((view.stop or 0 for view in session.views), default=0)
        until_s = max([until_s, *(stamp + shift_s for stamp in _stamps(session.views))])
    return Session.assemble(
        document,
        columns,
        rows,
        JoinedImages({name: session.images for name, session in by_name.items()}),
        target_document={name: session.target_document for name, session in by_name.items()},
        robot_document=sessions[0].robot_document,
        corners=_joined_corners(tables) if tables else None,
    )


def _check(session: Session, first: Session, earlier: Sequence[Session]) -> None:
    label = f"session {session.name!r}"
    if session.target is None and not has_several(session):
        raise DataError(
            f"{label} has no board: sessions are joined by their arm where a camera's images, or "
            "corners, of a board are there; measured poses of a target are not taken.",
            culprits=[session.name],
            next_step="Record images, or calibrate it by itself.",
        )
    if has_several(session) or session.declaration.frames:
        raise DataError(
            f"{label}: only sessions of one camera and one board each are joined by their arm.",
            culprits=[session.name],
            next_step="Calibrate a whole cell by itself.",
        )
    if session.streams:
        raise DataError(
            f"{label} has streams ({some_of(list(session.streams))}), and sessions are joined "
            "without.",
            culprits=[session.name],
            next_step="Take still views alone, or calibrate it by itself.",
        )
    if session.robot_document is None:
        raise DataError(
            f"{label} names no known robot, and the arm is what the sessions share.",
            culprits=["session.toml: robot.model"],
            next_step='Add model = "ur10e", or a path, to [robot], and record its joint angles.',
        )
    if session.robot_document != first.robot_document:
        raise DataError(
            f"the robots of {first.name!r} and {session.name!r} differ.",
            culprits=[session.name],
            next_step="Join sessions of one arm alone; visioncal batch calibrates each by itself.",
        )
    if any(session.digest() == one.digest() for one in earlier):
        raise DataError(
            f"session {session.name!r} is there twice, and would count as twice the data.",
            culprits=[session.name],
            next_step="Name each session once.",
        )


def _joined_corners(tables: Sequence[CornerTable]) -> CornerTable:
    """All corners in one table; sigmas are kept where all tables have them."""
    sigmas = [table.sigmas_px for table in tables if table.sigmas_px is not None]
    return CornerTable(
        np.concatenate([table.views for table in tables]),
        np.concatenate([table.points for table in tables]),
        np.concatenate([table.px for table in tables]),
        tuple(name for table in tables for name in table.targets),
        np.concatenate(sigmas) if len(sigmas) == len(tables) else None,
    )


def _stamps(views: Sequence[View]) -> list[float]:
    return [view.stamp_s for view in views if view.stamp_s is not None]
