"""Mends rows of a session: images of other rows, boards that were read turned, positions."""

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.calibration.pipeline.guess_inputs import numbers_in
from visioncal.calibration.pipeline.mended_images import with_turned_images
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed, ranges, some_of
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import FloatArray
from visioncal.session import Session
from visioncal.session.columns import (
    INSTRUMENT_POSITION,
    INSTRUMENT_QUATERNION,
    MEASURED_CAM_POSE,
    POSE,
    pose_row,
)
from visioncal.session.kinds import declared_targets, has_robot_state, name_of
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.camera import turned_back
from visioncal.vision.targets import corner_positions

# Columns of what a view shows; the rest of its row is the robot's pose.
_OBSERVED = ("image", *MEASURED_CAM_POSE, *INSTRUMENT_POSITION, *INSTRUMENT_QUATERNION)
# Keys by which a session states a lens.
_OF_LENS = ("matrix", "distortion", "intrinsics", "matrix_sigma_px")
# Columns that must agree between the two views.
_MUST_AGREE = ("camera", "target", "instrument", "point")
# Columns of the row itself, of whatever pose and image it is.
_OF_ROW = ("view", "role", "stop", "robot")


def noting(
    session: Session, document: Mapping[str, Any], changes: Sequence[str]
) -> Mapping[str, Any]:
    """A session's document that notes changes in `corrected`."""
    corrected = [*session.declaration.corrected, *changes]
    return {**document, "corrected": corrected} if changes else document


def exchange_views(session: Session, *views: int) -> Session:
    """Exchanges the images, corners and readings of pairs of views; notes it in `corrected`.

    Of a pair that is of two cameras or targets, one robot's poses are exchanged.

    Args:
        session: A session.
        views: Numbers of views: the first with the second, then the third with the fourth, and so
            on.

    Raises:
        DataError: There are no such views, or a pair is there twice.
    """
    cells = {
        view.number: {name: view.cell(name) for name in session.columns} for view in session.views
    }
    owners, pairs = {number: number for number in cells}, set[frozenset[int]]()
    named: dict[str, list[str]] = {"images": [], "robot's poses": []}
    for first, second in zip(views[::2], views[1::2], strict=True):
        first_cells, second_cells = cells.get(first, {}), cells.get(second, {})
        differing = [
            name
            for name in (*_MUST_AGREE, "robot")
            if first_cells.get(name, "") != second_cells.get(name, "")
        ]
        are_poses = {*differing} <= {"camera", "target"} and differing != []
        if {first, second} in pairs:
            words = f"Views {first} and {second} must be exchanged once, and are twice."
            raise DataError(words, culprits=["--exchange"])
        is_one_robot = not differing or (are_poses and is_whole_cell(session))
        if first == second or not (is_one_robot and first_cells and second_cells):
            raise DataError(
                f"Views {first} and {second} of session {session.name!r} are not two views that "
                f"see the same{': another ' * bool(differing)}{' and '.join(differing)}.",
                culprits=["--exchange"],
            )
        pairs.add(frozenset({first, second}))
        changed = {*_OBSERVED} & {*session.columns}
        if are_poses:
            changed = {*session.columns} - {*_OBSERVED, *_MUST_AGREE, *_OF_ROW}
        else:
            owners[first], owners[second] = owners[second], owners[first]
        for name in changed:
            first_cells[name], second_cells[name] = second_cells[name], first_cells[name]
        named["robot's poses" if are_poses else "images"].append(f"{first} and {second}")
    corners = session.corner_table
    if corners is not None:
        now = {before: view for view, before in owners.items()}
        moved = [now.get(view, view) for view in corners.views.tolist()]
        corners = replace(corners, views=np.array(moved, dtype=corners.views.dtype))
    of = listed([f"{what} of views {', '.join(some)}" for what, some in named.items() if some])
    note = f"the {of} were exchanged"
    return _with_cells(session, cells.values(), note, corners=corners)


def _with_cells(
    session: Session, cells: Iterable[Mapping[str, str]], note: str, **changes: object
) -> Session:
    """The session with other rows, which notes why in `corrected`."""
    return session.with_content(
        document=noting(session, session.document, [note]),
        cells=[[row[name] for name in session.columns] for row in cells],
        **changes,
    )


def _chosen_views(session: Session, views: Sequence[int], option: str) -> list[int]:
    """The session's views among some numbers; raises DataError where there are none."""
    numbers = {view.number for view in session.views}
    chosen = [view for view in dict.fromkeys(views) if view in numbers]
    if not chosen:
        words = f"Session {session.name!r} has none of the views {ranges(views)}."
        raise DataError(words, culprits=[option], next_step="Name views of its views.csv.")
    return chosen


def shift_views(
    session: Session, views: Sequence[int], by: int, of_images: bool = False
) -> Session:
    """Gives some views the robot's columns of so many rows later, or earlier where negative.

    Of a whole cell, these are rows of one robot, and are counted by its stops; where their images
    are apart, and not its poses, they go to the other stop. Views whose row there is none, or
    another view's that stays, are dropped, and `corrected` names them. Raises DataError.
    """
    moved, rows = set(_chosen_views(session, views, "--shift")), session.views
    kept, of_robot = {*_OBSERVED, *_MUST_AGREE, "view", "role"}, [*range(len(rows))]
    stops = [(-1, at) for at in of_robot]
    counted_by, of_images = "row", of_images and is_whole_cell(session)
    if is_whole_cell(session):
        # A row without a number of its stop is a stop of its own.
        stops = [(-1, at) if view.stop is None else (view.stop, -1) for at, view in enumerate(rows)]
        of_robot = _rows_of_one_robot(session, _posed(session, moved) if of_images else moved)
        counted_by = "stop of this robot"
        if not of_images:
            kept |= {*_OF_ROW}
            # Other rows of these stops have no pose of their own to be given another one.
            moved &= {rows[at].number for at in of_robot}
    order = [*dict.fromkeys(stops[at] for at in of_robot)]
    place_of = {stop: place for place, stop in enumerate(order)}
    first = {stops[at]: at for at in reversed(of_robot)}
    changed = {stops[at] for at, view in enumerate(rows) if view.number in moved}
    cells, dropped = list[dict[str, str]](), list[int]()
    for at, view in enumerate(rows):
        source = at
        if view.number in moved:
            place = place_of.get(stops[at], -len(rows)) + by
            stop = order[place] if 0 <= place < len(order) else None
            if stop not in changed:
                dropped.append(view.number)
                continue
            source = first[stop]
        cells.append(
            {name: (view if name in kept else rows[source]).cell(name) for name in session.columns}
        )
    lost = f"; {ranges(dropped)} had none there and were dropped" if dropped else ""
    verb = "are" if of_images else "have the robot's poses"
    note = f"views {ranges(moved)} {verb} of the {counted_by} {by:+d}{lost}"
    corners = session.corner_table
    if corners is not None:
        corners = corners.of_views([view.number for view in rows if view.number not in dropped])
    return _with_cells(session, cells, note, corners=corners)


def _posed(session: Session, views: AbstractSet[int]) -> AbstractSet[int]:
    """Some views, or all of their stops where none of them has a robot's state."""
    every = {view.number: view.stop for view in session.views}
    stops = {every[view] for view in views}
    if any(has_robot_state(view) for view in session.views if view.number in views):
        return views
    return {view for view, stop in every.items() if stop in stops}


def _rows_of_one_robot(session: Session, views: AbstractSet[int]) -> list[int]:
    """The places of all rows with the state of the robot that some views of a whole cell are of.

    Raises:
        DataError: They are of several robots, or of none.
    """
    names = {
        at: name_of(session.declaration, "robot", view)
        for at, view in enumerate(session.views)
        if has_robot_state(view)
    }
    robots = {name for at, name in names.items() if session.views[at].number in views}
    if len(robots) != 1:
        raise DataError(
            f"Views {ranges(views)} of session {session.name!r} are not all of one robot: the rows "
            f"of {some_of(sorted(robots)) or 'no robot'} cannot be shifted together.",
            culprits=["--shift"],
            next_step="Name views of one robot's rows with poses (column robot of views.csv).",
        )
    return [at for at, name in names.items() if name in robots]


def turn_boards(session: Session, views: Sequence[int], turn: Sequence[float]) -> Session:
    """Turns the board back that was read turned in some views, or these views' pictures.

    Args:
        session: A session of measured poses or corners; where pictures are turned, of images, too.
        views: Numbers of the views.
        turn: Angle in the board's plane [deg], and the point about which it turns [mm]; of no
            angle, the shift in that plane [mm]. An angle alone, 90, 180 or 270 deg, is that by
            which pictures are turned clockwise.

    Raises:
        DataError: There are no such views, corners are none of the board's once turned, or the
            pictures cannot be turned back so.
    """
    chosen = _chosen_views(session, views, "--turned")
    degrees, *centre = turn
    if not centre:
        return _turn_pictures(session, chosen, degrees)
    rotation = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    middle = 1e-3 * np.array([*centre, 0.0])
    right_from_read = compose(rotation, middle - (rotation @ middle if degrees else 0.0))
    poses = numbers_in(session, MEASURED_CAM_POSE).poses() @ invert(right_from_read)
    cells, corners, boards = (
        _with_poses(session, chosen, poses),
        session.corner_table,
        session.boards,
    )
    if corners is not None:
        ids = corners.points.copy()
        for view in (view for view in session.views if view.number in chosen):
            in_view = corners.views == view.number
            points = corner_positions(boards[session.board_of(view)])
            turned = apply(right_from_read, points)[ids[in_view]]
            away = np.linalg.norm(turned[:, None] - points, axis=-1)
            ids[in_view] = away.argmin(axis=1)
        corners = replace(corners, points=ids)
    by = f"{degrees:g} deg" if degrees else "({:g}, {:g}) mm".format(*centre)
    note = f"the board was turned back by {by} in views {ranges(chosen)}"
    return _with_cells(session, cells, note, corners=corners)


def _with_poses(
    session: Session, chosen: Sequence[int], poses: FloatArray, prefix: str = "cft_"
) -> list[dict[str, str]]:
    """Cells of a session's rows, with (n, 4, 4) other poses in some views: the measured ones.

    With an empty prefix, the robot's.
    """
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    for view, row, pose in zip(session.views, cells, poses, strict=True):
        if view.number in chosen and np.isfinite(pose).all():
            row.update({f"{prefix}{name}": repr(value) for name, value in pose_row(pose).items()})
    return cells


def _turn_pictures(session: Session, chosen: Sequence[int], degrees: float) -> Session:
    """Turns images, corners and measured poses of some views back about the line of sight."""
    if degrees not in (90.0, 180.0, 270.0):
        words = f"pictures are turned by {degrees:g} deg, but must be by 90, 180 or 270 deg."
        raise DataError(
            words,
            culprits=["--turned"],
            next_step="State it so, or add a point of the board about which it was read turned.",
        )
    quarters, note = round(degrees / 90.0), f"turned back by {degrees:g} deg"
    corners, rows = session.corner_table, [view for view in session.views if view.number in chosen]
    if corners is None and "cft_qw" not in session.columns and not any(at.image for at in rows):
        raise DataError(
            f"Views {ranges(chosen)} have neither pictures nor corners or poses of the target, "
            "which could be turned back.",
            culprits=["--turned"],
            next_step="Name views that have.",
        )
    if corners is not None:
        px = corners.px.copy()
        for view in (view for view in rows if view.has_corners):
            size = session.cameras[name_of(session.declaration, "camera", view)].resolution
            if size is None:
                raise DataError(
                    f"session {session.name!r} states no resolution, within which corners turn.",
                    culprits=["resolution"],
                    next_step="Write resolution = [width, height] of upright pictures in [camera].",
                )
            in_view = corners.views == view.number
            px[in_view] = turned_back(px[in_view], size, quarters)
        corners = replace(corners, px=px)
    back_turn = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()
    poses = compose(back_turn, np.zeros(3)) @ numbers_in(session, MEASURED_CAM_POSE).poses()
    session = with_turned_images(session, [view for view in rows if not view.has_corners], quarters)
    if corners is None and "cft_qw" not in session.columns:
        return session
    note = f"corners and poses of the pictures of views {ranges(chosen)} were {note}"
    return _with_cells(session, _with_poses(session, chosen, poses), note, corners=corners)


def write_positions(
    session: Session, views: Sequence[int], axes: Sequence[Sequence[tuple[float, str]]]
) -> Session:
    """Writes the robot's positions in some views as sums of columns.

    Args:
        session: A session.
        views: Numbers of the views.
        axes: Factors and names of columns, for x, y and z each; positions are in metres.

    Raises:
        DataError: There are no such views or columns, or a cell has no number.
    """
    chosen = _chosen_views(session, views, "--positions")
    named = {name for axis in axes for _, name in axis}
    if missing := sorted(named - {*session.columns}):
        raise DataError(
            f"Session {session.name!r} has no column {missing[0]} in its views.csv.",
            culprits=["--positions"],
            next_step=f"Name columns among {some_of(session.columns)}.",
        )
    cells = [{name: view.cell(name) for name in session.columns} for view in session.views]
    for view, row in zip(session.views, cells, strict=True):
        if view.number not in chosen:
            continue
        empty = next((name for name in named if not is_number(row[name])), None)
        if empty is not None:
            words = f"views.csv: view {view.number} has no number in column {empty}."
            raise DataError(words, culprits=[empty], next_step="Fill it in, or name other views.")
        sums = [sum(factor * float(row[name]) for factor, name in axis) for axis in axes]
        row |= dict(zip(POSE, map(repr, sums), strict=False))
    sums_of = ("".join(f"{factor:+g} {name} " for factor, name in axis).strip() for axis in axes)
    note = f"the positions of views {ranges(chosen)} are {', '.join(sums_of)}"
    return _with_cells(session, cells, note)


def remove_tool(session: Session, views: Sequence[int], tool: Sequence[float]) -> Session:
    """Takes a tool off the robot's poses in some views, in which it was active.

    Args:
        session: A session.
        views: Numbers of the views.
        tool: The tool's x, y, z [mm] and rotation vector [deg] in the flange of the other views.

    Raises:
        DataError: There are no such views, or one has no pose of the robot.
    """
    chosen = _chosen_views(session, views, "--without-tool")
    turn = Rotation.from_rotvec(tool[3:], degrees=True).as_matrix()
    flange_from_tool = compose(turn, 1e-3 * np.array(tool[:3]))
    poses = numbers_in(session, POSE).poses() @ invert(flange_from_tool)
    for view, pose in zip(session.views, poses, strict=True):
        if view.number in chosen and not np.isfinite(pose).all():
            words = f"views.csv: view {view.number} has no pose of the robot."
            raise DataError(words, culprits=["--without-tool"], next_step="Name other views.")
    at = "({:g}, {:g}, {:g}) mm, turned by ({:g}, {:g}, {:g}) deg".format(*tool)
    note = f"a tool at {at} was taken off the poses of views {ranges(chosen)}"
    return _with_cells(session, _with_poses(session, chosen, poses, ""), note)


def scaled_board(document: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """The content of a target's `.toml`, and of its table, with all lengths times a factor."""
    found = dict(document)
    for name, value in document.items():
        if isinstance(value, Mapping):
            found[name] = scaled_board(value, factor)
        elif name.endswith("_m") and not isinstance(value, str):
            found[name] = (factor * np.asarray(value, float)).tolist()
    return found


def scale_board(session: Session, name: str, factor: float) -> Session:
    """Multiplies all lengths of a board, and the distances of poses that were measured by it.

    Args:
        session: A session.
        name: The board's name; empty for the only one.
        factor: True over stated size.

    Raises:
        DataError: There is no such board, and no measured pose.
    """
    stated = declared_targets(session.declaration)
    only = name or (next(iter(stated)) if len(stated) == 1 else "")
    poses = numbers_in(session, MEASURED_CAM_POSE).poses()
    is_measured = not stated and not name and np.isfinite(poses).any()
    if only not in stated and not is_measured:
        step = "Declare it as target in session.toml."
        if stated:
            # The only board has no name.
            first = next(iter(stated))
            step = f"Name one of {some_of([*stated])}, as {first}:1.01."
            step = step if first else "Give the factor alone, as 1.01."
        raise DataError(
            f"Session {session.name!r} needs a board {name or 'or measured poses'} to scale.",
            culprits=["--board-scale"],
            next_step=step,
        )
    shown = [at.number for at in session.views if session.board_of(at) in ("", only)]
    poses[:, :3, 3] *= factor
    note = f"the {f'board {only}'.strip()} is {factor:g} times as large as was stated"
    document, boards = {**session.document}, session.target_document
    if boards is not None and stated:
        file = f"target_{only}.toml" if only else "target.toml"
        if only:
            tables = document["targets"]
            # A table of the target, or its file alone.
            table = {} if isinstance(tables[only], str) else tables[only]
            document["targets"] = {**tables, only: {**table, "target": file} if table else file}
        else:
            document["target"] = file
        is_one = len(stated) == 1
        scaled = scaled_board(boards if is_one else boards[only], factor)
        boards = scaled if is_one else {**boards, only: scaled}
    return session.with_content(
        document=noting(session, document, [note]),
        cells=[[row[at] for at in session.columns] for row in _with_poses(session, shown, poses)],
        target_document=boards,
    )


def without_reported_poses(session: Session) -> Session:
    """Empties the reported poses of views with joint angles, which then give the poses.

    Raises:
        DataError: No view has joint angles, or a robot has no model.
    """
    rows = [view for view in session.views if view.joints_rad is not None]
    unmodelled = sorted({*session.robots} - session.robot_documents.keys())
    if not rows or unmodelled:
        missing = f"a model of the robot {' and '.join(filter(None, unmodelled))}".rstrip()
        missing = missing if rows else "joint angles (q1_rad, q2_rad ...) in views.csv"
        raise DataError(
            f"Session {session.name!r} needs {missing} for poses by its joints.",
            culprits=["--by-joints"],
            next_step="Name [robot] model in session.toml." if rows else "Record them.",
        )
    cells = {
        view.number: {name: view.cell(name) for name in session.columns} for view in session.views
    }
    for view in rows:
        cells[view.number] |= dict.fromkeys({*POSE} & {*session.columns}, "")
    views = ranges([view.number for view in rows])
    note = f"the poses of views {views} are those of the joint angles, not the reported ones"
    return _with_cells(session, cells.values(), note)


def without_stated_lenses(session: Session) -> Session:
    """Drops matrix and distortion of all cameras, so that they are estimated.

    Raises:
        DataError: No lens is stated.
    """
    document, freed = {**session.document}, list[str]()
    tables = {"camera": document.get("camera")}
    tables |= {
        f"cameras.{name}": camera_table
        for name, camera_table in document.get("cameras", {}).items()
    }
    for name, table in tables.items():
        if table is not None and "matrix" in table:
            rest = {key: value for key, value in table.items() if key not in _OF_LENS}
            group, _, camera = name.partition(".")
            document[group] = {**document[group], camera: rest} if camera else rest
            freed.append(camera or name)
    if not freed:
        words = f"Session {session.name!r} states no lens."
        raise DataError(words, culprits=["--intrinsics"], next_step="It is estimated already.")
    note = f"matrix and distortion of {' and '.join(freed)} were dropped: they are estimated"
    return session.with_content(document=noting(session, document, [note]))
