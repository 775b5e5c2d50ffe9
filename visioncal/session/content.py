"""Content of a session, and what is derived of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from visioncal.core.documents.tables import TextTable
from visioncal.core.files import one_line
from visioncal.core.types import Camera, Corners, Mount, Need, Target
from visioncal.session import columns as cols
from visioncal.session.corners import CornerTable, check_points, corners_by_view, with_corners
from visioncal.session.document import (
    CameraTable,
    Declaration,
    InstrumentTable,
    RobotTable,
    declaration_warnings,
    read_declaration,
)
from visioncal.session.frames import check_frames, frame_name, resolve_frames, robots_of
from visioncal.session.images import ImageStore
from visioncal.session.kinds import (
    COLUMN,
    check_images_can_be_used,
    check_kinds_named,
    is_camera_observation,
    outside_notes,
    read_robots,
    read_targets,
    target_warnings,
)
from visioncal.session.observations import (
    Observation,
    observations_of,
    robot_rows_at_stops,
    stop_warnings,
)
from visioncal.session.streams import Stream, check_stream, gap_warnings
from visioncal.session.table import View, read_views


@dataclass(frozen=True, eq=False)
class SessionContent:
    """Content of a session as it was read, and what is derived of it."""

    document: Mapping[str, Any]  # Content of session.toml.
    columns: tuple[str, ...]  # Columns of views.csv, in its order.
    views: tuple[View, ...]  # Rows of views.csv, in its order.
    target: Target | None  # The printed target, where the session names one; of several, the first.
    # Content of the target's `.toml`; of several, the contents by name.
    target_document: Mapping[str, Any] | None
    images: ImageStore  # Source of the images.
    warnings: tuple[str, ...] = ()  # Suspicious content, in sentences.
    # The robot's model for `Robot.from_document`; of several, the models by name. None where the
    # session names no robot or, with a warning, an unknown one.
    robot_document: Mapping[str, Any] | None = None
    # Several printed targets by name, in the session's order; empty for one or none.
    targets: Mapping[str, Target] = field(default_factory=dict)
    # Time series beside the views, by name.
    streams: Mapping[str, Stream] = field(default_factory=dict)
    # Corners by another detector; None where there are none.
    corner_table: CornerTable | None = None
    notes: tuple[str, ...] = ()  # Remarks that are no reason for doubt.
    unread_models: tuple[str, ...] = ()  # The warnings that are of robots' models.
    # The files of other warnings, but those of what the session was converted from.
    warned_files: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def assemble(
        cls,
        document: Mapping[str, Any],
        columns: Sequence[str],
        cells: Sequence[Sequence[str]],
        images: ImageStore,
        *,
        target_document: Mapping[str, Any] | None = None,
        robot_document: Mapping[str, Any] | None = None,
        corners: CornerTable | None = None,
    ) -> Self:
        """Builds a session from content in memory, with the checks of `load`.

        Args:
            document: Content of session.toml.
            columns: Columns of views.csv.
            cells: Its rows, one text for each column, as `View.cell` gives them.
            images: Source of the images.
            target_document: Content of the target's `.toml`, of several the contents by name;
                needed where `document` names a file rather than a built-in target.
            robot_document: The robot's model, of several the models by name; needed where
                `document` names a file rather than a built-in model.
            corners: Corners by another detector.

        Raises:
            DataError: A field, row or column is wrong.
        """
        rows = tuple(map(tuple, cells))
        return cls.build(
            document,
            TextTable("", tuple(columns), rows, range(1, len(rows) + 1)),
            images,
            target_document=target_document,
            robot_document=robot_document,
            corners=corners,
        )

    @classmethod
    def build(
        cls,
        document: Mapping[str, Any],
        table: TextTable,
        images: ImageStore,
        *,
        folder: Path | None = None,
        target_document: Mapping[str, Any] | None = None,
        robot_document: Mapping[str, Any] | None = None,
        corners: CornerTable | None = None,
    ) -> Self:
        """Builds a session from its content, with all checks."""
        declaration = read_declaration(document, observed=bool(table.rows))
        columns, views = table.columns, read_views(table, with_corners=corners is not None)
        targets, target_document = read_targets(declaration, folder, target_document)
        several = targets if len(targets) > 1 else {}
        if corners is not None:
            columns, views, corners = with_corners(columns, views, corners, tuple(several))
        check_images_can_be_used(declaration, views)
        warned = {
            **dict.fromkeys(declaration_warnings(declaration), "session.toml"),
            **dict.fromkeys(cols.column_warnings(columns), "views.csv"),
            **dict(target_warnings(declaration, target_document)),
        }
        check_kinds_named(declaration, views)
        check_frames(declaration, views)
        if declaration.is_network:
            warned |= dict.fromkeys(stop_warnings(declaration, views), "views.csv")
        robot_document, problems = read_robots(declaration, folder, robot_document)
        session = cls(
            document,
            columns,
            views,
            next(iter(targets.values()), None),
            target_document,
            images,
            (*warned, *problems),
            robot_document,
            several,
            corner_table=corners,
            notes=tuple(outside_notes(declaration, folder)),
            unread_models=tuple(problems),
            warned_files=warned,
        )
        if corners is not None:
            seen = (view for view in views if view.has_corners)
            named = {view.number: session.board_of(view) for view in seen}
            check_points(
                corners, [named[index] for index in corners.views.tolist()], session.boards
            )
        return session

    def with_content(self, **changes: object) -> Self:
        """The session with other arguments of `assemble`, and its streams; raises DataError."""
        content: dict[str, Any] = {
            "document": self.document,
            "columns": self.columns,
            "cells": [[view.cell(column) for column in self.columns] for view in self.views],
            "images": self.images,
            "target_document": self.target_document,
            "robot_document": self.robot_document,
            "corners": self.corner_table,
        }
        content.update(changes)
        return self.assemble(**content).with_streams(self.streams)

    def with_streams(self, streams: Mapping[str, Stream]) -> Self:
        """The session with streams, in the order of their names.

        Raises:
            DataError: A stream is wrong; see `check_stream`.
        """
        for name, stream in streams.items():
            check_stream(name, stream)
        ordered = dict(sorted(streams.items()))
        gaps = dict(gap_warnings(ordered))
        warned, warnings = {**self.warned_files, **gaps}, (*self.warnings, *gaps)
        return replace(self, streams=ordered, warnings=warnings, warned_files=warned)

    @property
    def need(self) -> Need | None:
        """Required accuracy of the task; None where not declared."""
        table = self.declaration.need
        is_stated = table is not None and (table.mm is not None or table.deg is not None)
        return table.need if table is not None and is_stated else None

    @property
    def corrects_targets(self) -> bool:
        """Whether targets are corrected for a calibrated arm before they are sent."""
        return self.declaration.need is not None and self.declaration.need.corrected

    @cached_property
    def corners(self) -> Mapping[int, Corners]:
        """Corners by another detector, by view, numbered by index on the target."""
        if self.corner_table is None:
            return {}
        shown = [view for view in self.views if view.has_corners]
        board_of = {view.number: self.boards[self.board_of(view)] for view in shown}
        return corners_by_view(self.corner_table, shown, self.declaration, board_of)

    @cached_property
    def declaration(self) -> Declaration:
        """Typed content of session.toml: the clock, the priors, the instrument."""
        return read_declaration(self.document, observed=bool(self.views))

    @property
    def name(self) -> str:
        """The session's name, on one line: nothing in it may steer a terminal."""
        return one_line(self.declaration.name)

    @cached_property
    def mount(self) -> Mount:
        """`eye-in-hand`, `eye-to-hand`, or `instrument` where an instrument observes the robot.

        Several cameras without declaration are `eye-in-hand` only if all are on flanges.
        """
        declared = self.declaration.mount
        # All observations are an instrument's; otherwise the camera's are used.
        is_read = any(view.reading_m is not None for view in self.views)
        is_read = is_read and not any(map(is_camera_observation, self.views))
        if is_read or (declared is None and not self.cameras):
            return "instrument"
        if declared is not None:
            return declared
        on = [self.frames[frame_name("camera", camera)] for camera in self.cameras]
        return "eye-in-hand" if all(name.startswith("flange") for name in on) else "eye-to-hand"

    @property
    def is_network(self) -> bool:
        """Whether it has several cameras, robots or instruments, or `[frames]`."""
        return self.declaration.is_network

    @cached_property
    def cameras(self) -> Mapping[str, CameraTable]:
        """Cameras by their names in rows; that of `[camera]` is empty."""
        tables = self.declaration.named("camera").items()
        return {name: table for name, table in tables if isinstance(table, CameraTable)}

    @cached_property
    def robots(self) -> Mapping[str, RobotTable]:
        """Robots by name; that of `[robot]`, and of poses without a robot, is empty."""
        in_streams = any(stream.has_robot_state for stream in self.streams.values())
        return robots_of(self.declaration, self.views, in_streams=in_streams)

    @cached_property
    def instruments(self) -> Mapping[str, InstrumentTable]:
        """Instruments by name; that of `[instrument]` is empty."""
        tables = self.declaration.named("instrument").items()
        return {name: table for name, table in tables if isinstance(table, InstrumentTable)}

    @cached_property
    def plates(self) -> Mapping[str, Target]:
        """Targets by their names in session.toml, also for the only one."""
        # A session that was built without a document's table has its only one without a name.
        names = [*self.declaration.named("target")] or [*self.boards]
        return dict(zip(names, self.boards.values(), strict=False))

    @property
    def robot_documents(self) -> Mapping[str, Mapping[str, Any]]:
        """Models of the robots by name, where known."""
        if self.robot_document is None:
            return {}
        if len(self.robots) > 1:
            return self.robot_document
        return dict.fromkeys(self.robots, self.robot_document)

    @cached_property
    def robot_rows(self) -> Mapping[int, Mapping[str, View]]:
        """Rows with the robots' poses at each row's stop: by view number, then by robot."""
        return robot_rows_at_stops(self.declaration, self.views)

    @cached_property
    def frames(self) -> Mapping[str, str]:
        """Parent of each frame by name: bases, flanges, cameras, targets, instruments, points.

        Raises:
            DataError: The declaration contradicts itself, or a parent is neither declared nor
                inferred.
        """
        return resolve_frames(self.declaration, self.views, self.robots)

    @cached_property
    def observations(self) -> tuple[Observation, ...]:
        """Observations with observer, observed object and robot poses.

        Raises:
            DataError: See `frames`.
        """
        return observations_of(self.declaration, self.views, self.frames)

    @property
    def boards(self) -> Mapping[str, Target]:
        """Printed targets by name, which is empty for the only one."""
        if self.targets or self.target is None:
            return self.targets
        return {"": self.target}

    @cached_property
    def board_frames(self) -> Mapping[str, str]:
        """Frames of the printed targets, by their names in `boards`."""
        pairs = zip(self.boards, self.plates, strict=True)
        return {name: frame_name("target", plate) for name, plate in pairs}

    def board_of(self, view: View) -> str:
        """Name in `boards` of the target that a view shows."""
        return view.text.get(COLUMN, "").strip() if self.targets else ""

    @property
    def camera(self) -> Camera | None:
        """The stated intrinsics; None where they are to be estimated."""
        table = self.declaration.only_camera
        return None if table is None else table.stated

    @property
    def camera_name(self) -> str:
        """The camera's name; `camera` where the session gives none."""
        return (
            "camera" if self.declaration.only_camera is None else self.declaration.only_camera.name
        )

    @property
    def resolution(self) -> tuple[int, int] | None:
        """(width, height) of the images [px], if declared."""
        table = self.declaration.only_camera
        return None if table is None else table.resolution

    @property
    def robot_name(self) -> str | None:
        """The robot's model in the session: a built-in name or a path."""
        return None if self.declaration.only_robot is None else self.declaration.only_robot.model
