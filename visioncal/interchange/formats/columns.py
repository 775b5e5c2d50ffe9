"""Tables, JSON and .npz by rows of views; lines of a pendant; a second file of camera poses."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.apart import several_recordings, tables_apart
from visioncal.interchange.formats.fields import (
    Fields,
    corners_in,
    named_by,
    stamp_name,
    unit_by_size,
    without_unit,
)
from visioncal.interchange.formats.file_search import FileGroup, groups_in, image_groups, images_of
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ForeignStream,
    ImportOptions,
    PoseImportOptions,
    Side,
    Unstated,
)
from visioncal.interchange.formats.joints import joint_names, joints_from
from visioncal.interchange.formats.keys import in_seconds
from visioncal.interchange.formats.pairing import (
    Pairing,
    UnpairedError,
    image_column,
    images_named,
    paired,
    with_depth,
)
from visioncal.interchange.formats.pose_forms import makers_of, poses_from
from visioncal.interchange.formats.poses import columns_named, pose_names, possible_poses
from visioncal.interchange.formats.reading import read_fields
from visioncal.interchange.formats.sources import (
    ASIDE,
    Source,
    describe,
    proposed,
    unknown,
)
from visioncal.interchange.formats.unread import (
    armless_note,
    check_pictures,
    check_points,
    of_most_images,
    points_beside,
    series_note,
    small_part,
)
from visioncal.robot import Robot
from visioncal.robot.files import read_robot_document
from visioncal.robot.trajectory import LONGEST_GAP_S, Samples
from visioncal.session.columns import INSTRUMENT_POSITION

# Most joints of a gripper that stand behind the arm's in one list.
_FINGERS = 2


def _read(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a file or folder of any layout, or one file and another with the camera's poses."""
    if requested.camera_file is not None:
        fields = read_fields(path, requested.robot.form)
        return with_camera_file(fields, read_fields(requested.camera_file), requested)
    source = describe(path, requested.robot.form)
    check_pictures(source, requested)
    if path.is_file() and source.parts[0].fault:
        raise source.parts[0].fault
    if several := several_recordings(source, requested):
        raise several
    is_beside = path.is_file() and requested.target and not requested.images
    images = images_of(path.parent) if is_beside else source.images
    lens, notes = (None, ()) if requested.intrinsics else source.lens()
    board = (None, ()) if requested.target else source.board()
    found: list[tuple[int, ForeignRecording]] = []
    faults: list[tuple[int, DataError]] = []
    readings = _proposed(source, requested)
    instead = image_groups(requested.images) if requested.images else None
    proposing = partial(unknown, source, requested, [each for _, each, _ in readings[:1]])
    for rank, fields, options in readings:
        try:
            for more, foreign in _recordings(fields, options, images, instead):
                target, of_board = board if foreign.images else (None, ())
                other_fields = [each for _, each, _ in readings if each is not fields]
                all_notes = (*foreign.notes, *notes, *of_board, *_arm_note(options, requested))
                all_notes += (*armless_note(foreign, options),)
                all_notes += series_note(fields, other_fields)
                lens_of = foreign.lens or lens
                whole = replace(foreign, lens=lens_of, target=target, notes=all_notes)
                found.append((rank + more, replace(whole, proposing=proposing)))
        except DataError as error:
            faults.append((rank, error))
    # A recording's fault is said, and no result beside it taken instead.
    if not found or (faults and faults[0][0] + ASIDE <= min(at for at, _ in found)):
        raise faults[0][1]
    (rank, first), *others = sorted(of_most_images(found), key=lambda each: each[0])
    first = replace(first, notes=(*small_part(first, source, instead), *first.notes))
    is_clear = not others or others[0][0] > rank
    if apart := _files_apart(first, source, readings[0][2], readings[0][1]):
        robot, camera = apart
        return _read(robot, replace(requested, camera_file=camera))
    if not is_clear:
        first = replace(first, doubt=proposing(()))
    return replace(first, rivals=tuple((at - rank, other) for at, other in others))


def _proposed(source: Source, requested: ImportOptions) -> list[tuple[int, Fields, ImportOptions]]:
    try:
        return proposed(source, requested)
    except DataError:
        check_points(source)
        raise


def _arm_note(options: ImportOptions, requested: ImportOptions) -> Iterator[str]:
    """A note on the robot whose description stands beside the rows, where the user names none."""
    if options.robot_model and not requested.robot_model:
        yield (
            f"{', '.join(options.joints)} are the joints of {Path(options.robot_model).name}, to "
            f"its {options.tip}; --robot-model and --tip name another."
        )


def _files_apart(
    first: ForeignRecording, source: Source, requested: ImportOptions, fields: Fields
) -> tuple[Path, Path] | None:
    """The robot's file and the camera's where a recording saw nothing; None of others.

    Raises DataError where several of its fields may be the poses of the target.
    """
    if (
        first.images
        or first.corners
        or first.camera is not None
        or {"meas_x_m", "point"} & first.columns.keys()
    ):
        return None
    check_points(source)
    if apart := tables_apart(source, requested):
        return apart
    robot_names = pose_names(fields, requested.robot.names, "robot", ())
    others = possible_poses(fields, robot_names) if first.robot.present.any() else ()
    if any(item.is_of_target for item in others):
        raise unknown(source, requested, [fields])
    return None


def foreign_from(
    fields: Fields,
    requested: ImportOptions,
    *,
    images: Sequence[FileGroup] = (),
) -> ForeignRecording:
    """Builds a recording from rows of named values, by their names or the user's options.

    `images` are those of the source. Raises DataError.
    """
    instead = image_groups(requested.images) if requested.images else None
    return _recordings(fields, requested, images, instead)[0][1]


def _recordings(
    fields: Fields,
    requested: ImportOptions,
    found: Sequence[FileGroup],
    instead: Sequence[FileGroup] | None,
) -> list[tuple[int, ForeignRecording]]:
    """The recording of `foreign_from`, and less likely ones with images in other orders.

    Images are those `found` in the source, unless the user names others `instead`.
    """
    names = _pose_fields(fields, requested)
    used = {name for of_side in names.values() for name in of_side}
    joint_fields = requested.joints or joint_names(fields, used)
    used.update(map(fields.find, joint_fields))
    if not names["robot"] and not joint_fields:
        raise _unnamed(fields, "robot", ", or the joint angles with --joint-{}")
    # Three numbers of what the camera saw are a point, as of a ball.
    points = names["camera"]
    if not points or sum(fields.column(name).shape[1] for name in points) != 3:
        points = ()
    if names["robot"] and not (names["camera"] or joint_fields or found or instead):
        points = points_beside(fields, names["robot"])
    names["camera"] = () if points else names["camera"]
    poses: dict[Side, PoseNumbers] = {"robot": PoseNumbers.empty(fields.places)}
    unstated: dict[Side, Unstated] = {}
    joints, notes = _joint_angles(fields, joint_fields, requested, bool(names["robot"]))
    notes += fields.notes
    for side, of_side in names.items():
        if of_side:
            side_options = requested.robot if side == "robot" else requested.camera
            poses[side], more, unstated[side] = poses_from(fields, of_side, side_options, side)
            notes += more
    if irregular := [name for name in fields.shape_errors if name not in used]:
        notes.append(f"Left aside, as rows differ in their shape: {some_of(irregular)}.")
    columns = dict[str, tuple[str, ...]]()
    if points or not unstated:
        columns, more = _readings(fields, used, points)
        notes += more
    # Components of a field that is used.
    used |= {text for text in fields.texts if text.rpartition(".")[0] in used}
    stamps = stamp_name(fields, used)
    if stamps.isdecimal():
        notes.append(f"Column {stamps} is taken for times, as the source does not say.")
    used |= {stamps, "view"} if view_numbers(fields) else {stamps}
    pairing, image_name = _images(fields, requested, found, instead, used, bool(names["camera"]))
    used.add(image_name)
    corner_name, px = ("", None) if pairing.images else corners_in(fields)
    used.add(corner_name)
    if pairing.is_open and names["robot"]:
        unstated["robot"] |= {"images"}
    columns = _further(fields, columns, used, pairing)
    foreign = ForeignRecording(
        # Files that are called by numbers alone are those of their folder.
        name=fields.name or fields.folder.resolve().name,
        robot=poses["robot"],
        camera=poses.get("camera"),
        mount="instrument" if "meas_x_m" in columns and not (points or pairing.images) else None,
        images=pairing.images,
        corners=() if px is None else tuple(row if np.isfinite(row).all() else None for row in px),
        lens={"model": "points"} if points else None,
        arm=requested.arm,
        joints_rad=joints,
        stamps_s=in_seconds(fields.column(stamps)[:, 0]) if stamps else None,
        form=fields.form,
        makers=makers_of(names["robot"]),
        fields=names["robot"],
        views=fields.views or view_numbers(fields),
        columns=columns,
        notes=(*notes, *pairing.notes),
        unstated=unstated,
        doubt=pairing.doubt,
    )
    others = [
        replace(foreign, images=other, notes=(*notes, f"The images are taken {words}."))
        for words, other in pairing.others
    ]
    return [(0, foreign), *((1, other) for other in others)]


def _unnamed(fields: Fields, side: Side, others: str = "") -> DataError:
    word = named_by(fields.places[0])
    return DataError(
        f"{fields.name}: which of its fields are the {side}'s poses is not known; it has "
        f"{fields.listing()}.",
        culprits=[fields.name],
        next_step=f"Name them with --{side}-{word}{others.format(word)}.",
    )


def _pose_fields(fields: Fields, requested: ImportOptions) -> dict[Side, tuple[str, ...]]:
    """The fields of each side's poses, the robot's first."""
    used = {fields.find(name) for name in requested.joints}
    sides: list[tuple[Side, PoseImportOptions]] = [
        ("robot", requested.robot),
        ("camera", requested.camera),
    ]
    names: dict[Side, tuple[str, ...]] = {"robot": (), "camera": ()}
    # Columns that the user names of one side are not the other's.
    for side_name, side_options in sorted(sides, key=lambda side: not side[1].names):
        names[side_name] = pose_names(fields, side_options.names, side_name, used)
        used.update(names[side_name])
    return names


def _further(
    fields: Fields, columns: Mapping[str, tuple[str, ...]], used: Collection[str], pairing: Pairing
) -> dict[str, tuple[str, ...]]:
    """All columns of views.csv beside poses, joints and images."""
    found = {**columns, **{name: cells for name, cells in fields.texts.items() if name not in used}}
    if len({*found.get("point", ())}) == len(fields) and (pairing.images or "meas_x_m" in columns):
        # Names of the stops or readings, and not of points that are read again and again.
        found["reading"] = found.pop("point")
    if pairing.depths:
        found["source_depth"] = tuple(str(file or "") for file in pairing.depths)
    return found


def _joint_angles(
    fields: Fields, names: Sequence[str], requested: ImportOptions, has_poses: bool
) -> tuple[FloatArray | None, list[str]]:
    """Joint angles [rad] and notes; beside poses, angles that nobody asked for may be faulty."""
    if not names:
        return None, []
    try:
        joints, notes = joints_from(fields, names, degrees=requested.joints_deg)
    except DataError as error:
        if requested.joints or not has_poses:
            raise
        return None, [f"The joint angles are left aside: {error.message}"]
    if requested.robot_model is None or len(names) > 1:
        return joints, [*notes]
    robot = Robot.from_document(read_robot_document(requested.robot_model, tip=requested.tip))
    count, arm = joints.shape[1], robot.joint_count
    if arm < count <= arm + _FINGERS:
        note = f"Of {count} joint angles a row the first {arm} are taken: {robot.name} has {arm}, "
        return joints[:, :arm], [*notes, f"{note}and others may be those of a gripper."]
    return joints, [*notes]


def _readings(
    fields: Fields, used: set[str], points: tuple[str, ...]
) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """Columns of a camera's points, or of readings beside joint angles, and a note; else empty."""
    arrays = [
        (name,)
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 1
        and numbers[0].size == 3
        and name not in used
        # The same numbers in all rows, as the shape of images, are no readings.
        and bool((numbers != numbers[0]).any())
    ]
    names = columns_named(fields, ("x", "y", "z")) or (arrays[0] if len(arrays) == 1 else ())
    if not (names := points or names):
        return {}, ()
    used.update(names)
    places = np.hstack([fields.column(name)[:, :3] for name in names])
    stated = {unit for name in names if (unit := without_unit(name)[1])}
    unit = stated.pop() if len(stated) == 1 else unit_by_size(places)
    cells = [
        ["" if np.isnan(v) else repr(v) for v in row] for row in (UNITS_M[unit] * places.T).tolist()
    ]
    kind = "points that the camera measured," if points else "an instrument's readings"
    note = f"{', '.join(names)} are taken for {kind} in {unit}."
    return dict(zip(INSTRUMENT_POSITION, map(tuple, cells), strict=True)), (note,)


def view_numbers(fields: Fields) -> tuple[int, ...]:
    """Numbers in a column `view`, where they are whole and unique; else empty."""
    cells = fields.texts.get("view", ())
    whole = all(cell.isascii() and cell.isdecimal() and len(cell) < 10 for cell in cells)
    return tuple(int(cell) for cell in cells) if whole and len(set(cells)) == len(cells) else ()


def _images(
    fields: Fields,
    requested: ImportOptions,
    found: Sequence[FileGroup],
    given: Sequence[FileGroup] | None,
    taken: Collection[str],
    has_camera_poses: bool,
) -> tuple[Pairing, str]:
    """Pairs the rows with images, and names the field that names them."""
    column = requested.image
    every = found if given is None else given
    groups = [group for group in every if group.is_images]
    name = fields.find(column) if column else image_column(fields, groups, taken)
    if name in fields.texts:
        cells = _with_folders(fields, name, groups)
        named = None if given is None else groups
        pairing = Pairing(images_named(cells, fields.folder, groups, named))
        return with_depth(pairing, every), name
    try:
        return with_depth(paired(fields, groups), every) if groups else Pairing(()), ""
    except UnpairedError as error:
        # Pictures of a page are no views', where poses of the target say what these saw.
        if given is not None or requested.target or not has_camera_poses:
            raise
        return Pairing((), (f"The images are left aside: {error.message}",)), ""


def _with_folders(fields: Fields, name: str, groups: Sequence[FileGroup]) -> tuple[str, ...]:
    """Names of images, those of the same name with the folder that another column names."""
    cells = fields.texts[name]
    filled = [cell for cell in cells if cell]
    if len({*filled}) == len(filled):
        return cells
    folders = {file.parent.name for group in groups for file in group.files}
    named = next((each for each in fields.texts.values() if {*each} <= folders), None)
    return tuple(map("{}/{}".format, named, cells)) if named else cells


VIEWS = ForeignFormat(
    "views",
    "a folder with one or more files a view (pose_01.json, .txt, .npz)",
    lambda path: any(len(group.files) > 1 for group in groups_in(path) if group.is_data),
    _read,
)
TABLE = ForeignFormat(
    "table",
    "a table, JSON, YAML or .npz with one row per view, alone or in the folder of its images",
    # Describes whatever it cannot read.
    Path.exists,
    _read,
)


def with_camera_file(
    robot_fields: Fields, camera_fields: Fields, requested: ImportOptions
) -> ForeignRecording:
    """Joins robot and camera poses of two files: where both have times as a stream, else by row.

    Raises:
        DataError: Either holds no poses, or their numbers differ.
    """
    robot, robot_names, first, of_robot = _poses(robot_fields, requested.robot, "robot")
    camera, camera_names, second, of_camera = _poses(camera_fields, requested.camera, "camera")
    notes, name = (*first, *second), robot_fields.name
    robot_stamp = stamp_name(robot_fields, robot_names)
    camera_stamp = stamp_name(camera_fields, camera_names)
    if robot_stamp and camera_stamp:
        robot_s, robot = _timed(robot_fields, robot_stamp, robot)
        camera_s, camera = _timed(camera_fields, camera_stamp, camera)
        is_of_stops = Samples(robot_s).step_s > LONGEST_GAP_S
        # Of stops that one program wrote the times do not determine the offset of two clocks.
        if not (is_of_stops and np.array_equal(robot_s, camera_s)):
            return ForeignRecording(
                name=name,
                robot=PoseNumbers.empty(camera.places),
                camera=camera,
                stamps_s=camera_s,
                stream=ForeignStream(robot_s, robot),
                notes=(
                    *notes,
                    f"All {len(camera)} samples of the camera are views, and the robot's are a "
                    "stream beside them: calibrate finds how far their clocks differ.",
                ),
            )
        notes = (*notes, "Both files have the same times: their rows belong together.")
    if len(robot) != len(camera):
        raise DataError(
            f"There are {len(robot)} poses of the robot and {len(camera)} of the camera, without "
            "times, but must be as many of both.",
            culprits=[robot.places[-1], camera.places[-1]],
        )
    return ForeignRecording(
        name=name,
        robot=robot,
        camera=camera,
        makers=makers_of(robot_names),
        notes=notes,
        unstated={"robot": of_robot, "camera": of_camera},
    )


def _poses(
    fields: Fields, requested: PoseImportOptions, side: Side
) -> tuple[PoseNumbers, tuple[str, ...], tuple[str, ...], Unstated]:
    """Reads the poses of one file: (poses, their fields, notes on assumptions, what is assumed)."""
    # A file of camera poses alone may use the names of a robot's file.
    candidates = (pose_names(fields, requested.names, name, ()) for name in (side, "robot"))
    names = next(filter(None, candidates), ())
    if not names:
        raise _unnamed(fields, side)
    poses, notes, unstated = poses_from(fields, names, requested, side)
    return poses, names, notes, unstated


def _timed(fields: Fields, stamp: str, numbers: PoseNumbers) -> tuple[FloatArray, PoseNumbers]:
    """Times [s] and poses of the samples that have a pose."""
    stamps, rows = fields.column(stamp)[:, 0], np.flatnonzero(numbers.present)
    bad = ~np.isfinite(stamps)
    bad[1:] |= np.diff(stamps) <= 0
    if bad.any() or len(rows) < 3:
        place = fields.places[int(np.argmax(bad))]
        fault = "the time is missing, or does not increase" if bad.any() else "under three poses"
        raise DataError(
            f"{place}: {fault}.",
            culprits=[place],
            next_step="Sort the rows by time and remove doubled ones.",
        )
    return in_seconds(stamps)[rows], numbers.rows(rows)
