"""Content of a source beside poses: pictures in arrays, other series, points."""

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from glob import escape
from itertools import combinations
from pathlib import Path

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.documents.jsons import pictures_in
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.core.procrustes import align, spreads
from visioncal.core.transforms import apply, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import Fields, appearance, unit_by_size, without_unit
from visioncal.interchange.formats.file_search import DRAWN, FileGroup
from visioncal.interchange.formats.foreign import ForeignRecording, ImportOptions
from visioncal.interchange.formats.pose_words import PoseFields
from visioncal.interchange.formats.poses import columns_named, points_in, possible_poses
from visioncal.interchange.formats.sources import Source, rows_in

# Fewest pairs of points, and the largest residual of a rigid motion that maps one side's to the
# other's, as a share of their least extents in a plane (rms): numbers of poses leave about all.
_FEWEST_POINTS, _MOST_RESIDUAL = 4, 0.1

_ROTATION = re.compile("rot|orient|quat", re.IGNORECASE)

# Writes the pictures of .npz files to a folder, and beside them what else they hold.
_UNPACK = """\
import os, pathlib, cv2, numpy
os.makedirs({folder})
for file in pathlib.Path({parent}).glob({pattern}):
    arrays = dict(numpy.load(file))
    pictures = arrays.pop({array}, [])
    for at, picture in enumerate({pictures}):
        cv2.imwrite({folder} + f"/{{{name}}}.png", picture)
    numpy.savez({folder} + f"/{{file.stem}}.npz", **arrays)"""


def check_pictures(source: Source, requested: ImportOptions) -> None:
    """Raises DataError where what a camera saw are pictures in arrays, with how to write them."""
    rows = (fields for part in source.parts for fields in part.rows)
    has_both = not requested.target and any(len([*possible_poses(each)]) > 1 for each in rows)
    if source.images or requested.images or has_both:
        return
    for group in (part.group for part in source.parts if part.group.label.endswith(".npz")):
        found = _of_camera(group.files[0])
        if not found:
            continue
        (array, shape), is_single = next(iter(found.items())), len(group.files) == 1
        is_series = len(shape) - (shape[-1] == 3) == 3
        listed = (f"{name!r} ({' x '.join(map(str, each))})" for name, each in found.items())
        named = source.path if source.path.name else source.path.resolve()
        folder = f"{named if named.is_dir() else named.with_suffix('')}-pictures"
        script = _UNPACK.format(
            folder=json.dumps(folder),
            parent=json.dumps(str(group.files[0].parent)),
            pattern=json.dumps(escape(group.files[0].name) if is_single else "*.npz"),
            array=json.dumps(array),
            pictures="pictures" if is_series else "[pictures] * (len(pictures) > 0)",
            name="at:04d" if is_series else "file.stem",
        )
        command = [folder if Path(word) == source.path else word for word in requested.command]
        raise DataError(
            f"{group.label} has pictures in {some_of([*listed])}, but pictures must be files.",
            culprits=[group.label],
            next_step="Convert the files one by one: each has a series of its own."
            if is_series and not is_single
            else f"Write {array!r} into a folder, with what else there is, and convert that:\n"
            f"python -c {shlex.quote(script)} && {shlex.join(command)}",
        )


def _of_camera(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of an .npz that are pictures, drawn ones only where there are no others.

    Their names say that they were drawn, or all their values are equal, as those of an empty mask.
    """
    found = pictures_in(path)
    kept = {name: shape for name, shape in found.items() if not DRAWN.search(name)}
    if len(kept) > 1:
        with np.load(path) as arrays:
            kept = {name: kept[name] for name in kept if np.ptp(arrays[name])}
    return kept or found


def series_note(fields: Fields, others: Sequence[Fields]) -> tuple[str, ...]:
    """A note on other series of the same fields in the same file, which are not read."""
    chosen, keys = _series(fields)
    named = ((each, *_series(each)) for each in others)
    alike = {
        series: f"{series} ({counted(len(each), 'row')})"
        for each, series, names in named
        if chosen and series not in ("", chosen) and names == keys
    }
    if not alike:
        return ()
    note = (
        f"Of several series {chosen} is read; left aside: {some_of([*alike.values()])}, for files"
    )
    return (f"{note} of their own.",)


def of_most_images(
    found: Sequence[tuple[int, ForeignRecording]],
) -> list[tuple[int, ForeignRecording]]:
    """The readings without those of few of the images, as of frames beside rows of them all."""
    used = [len({*foreign.images} - {None}) for _, foreign in found]
    kept, left = list[tuple[int, ForeignRecording]](), dict[str, int]()
    for item, count in zip(found, used, strict=True):
        if 2 * count >= max(used):
            kept.append(item)
        else:
            left[item[1].robot.places[0]] = len(item[1].robot)
    if not left:
        return kept
    rows = some_of([f"{place} ({counted(count, 'row')})" for place, count in left.items()])
    note = f"Left aside, as {max(used)} images have other rows: {rows} and on."
    return [(rank, replace(each, notes=(*each.notes, note))) for rank, each in kept]


def small_part(
    first: ForeignRecording, source: Source, instead: Sequence[FileGroup] | None
) -> Iterator[str]:
    """A note on a recording of less than half of the images of a kind, with what else there is."""
    used = {*first.images} - {None}
    groups = source.images if instead is None else instead
    kinds = [group for group in groups if used & {*group.files}]
    count = sum(len(group.files) for group in kinds)
    if not used or 2 * len(used) >= count:
        return
    longer = [
        f"{part.group.files[0].name} ({counted(len(fields), 'row')})"
        for part in source.parts
        for fields in part.rows
        if len(fields) > len(first.robot) and len(part.group.files) == 1
    ]
    others = f"; rows of other files are more: {some_of(longer)}" if longer else ""
    yield (
        f"ATTENTION: only {len(used)} of {count} images are views, as {first.name} has "
        f"{counted(len(first.robot), 'row')} of the robot{others}."
    )


def armless_note(foreign: ForeignRecording, requested: ImportOptions) -> Iterator[str]:
    """A note on joint angles of an arm that nobody names."""
    is_armless = requested.robot_model is None and foreign.arm is None
    is_armless &= foreign.robot_document is None
    if is_armless and foreign.joints_rad is not None and not foreign.robot.present.any():
        yield (
            "There are joint angles and no poses of the robot: calibrate needs the arm, as by "
            "--robot-model with a built-in robot, its .urdf or a DH table."
        )


def _series(fields: Fields) -> tuple[str, set[str]]:
    """The name that stands before those of all fields, empty without one, and these."""
    parts = [name.partition(".")[::2] for name in fields.numbers]
    before = {series for series, name in parts if name}
    return before.pop() if len(before) == 1 else "", {name or series for series, name in parts}


@dataclass(frozen=True, eq=False)
class PointPairs:
    """The same n points by a robot and by a camera, without rotations."""

    names: tuple[str, str]  # Of the robot's field, and of the camera's.
    places: tuple[str, ...]  # (n,) lines.
    points: FloatArray  # (2, n, 3) in the robot's base, and in the camera [m].
    rms_m: float  # Residual of the rigid motion between both.
    agree: bool  # Whether this is small.


def point_pairs(source: Source) -> PointPairs | None:
    """The two fields of points that a rigid motion maps best, or whose names say it; else None."""
    found: list[PointPairs] = []
    rows = (each for part in source.parts for each in part.rows)
    for fields in (*rows_in(source), *rows):
        items = [(item, _metres(fields, item)) for item in points_in(fields)]
        for (one, first), (other, second) in combinations(items, 2):
            points = np.stack([first, second])
            present = np.flatnonzero(np.isfinite(points).all(axis=(0, 2)))
            points = points[:, present]
            if one.sides == other.sides != [] or points.shape[1] < _FEWEST_POINTS:
                continue
            motion = align(*points)
            rms_m = float(np.sqrt(3.0) * (points[0] - apply(motion, points[1])).std())
            extent_m = min(spreads(side)[0][1] for side in points)
            # Points of one frame, as commanded and as reached, are no pairs.
            is_one = rotation_angle(motion[:3, :3]) < _MOST_RESIDUAL
            agree = rms_m < _MOST_RESIDUAL * extent_m and not is_one
            if agree or (len(items) == 2 and ["camera"] in (one.sides, other.sides)):
                ordered = [one, other] if _is_robot(one, other) else [other, one]
                sides = points if _is_robot(one, other) else points[::-1]
                names = (_named(ordered[0]), _named(ordered[1]))
                places = tuple(fields.places[at] for at in present)
                found.append(PointPairs(names, places, sides, rms_m, agree))
    return min(found, key=lambda pairs: pairs.rms_m, default=None)


def _metres(fields: Fields, item: PoseFields) -> FloatArray:
    """Points (n, 3) of fields [m]."""
    numbers = np.hstack([fields.column(name)[:, :3] for name in item.names])
    stated = {without_unit(name)[1] for name in item.names} - {""}
    return UNITS_M[stated.pop() if len(stated) == 1 else unit_by_size(numbers)] * numbers


def _is_robot(one: PoseFields, other: PoseFields) -> bool:
    return one.sides == ["robot"] or other.sides == ["camera"]


def _named(item: PoseFields) -> str:
    return ", ".join(item.names)


def points_beside(fields: Fields, robot: tuple[str, ...]) -> tuple[str, ...]:
    """The only points of another file than the robot's poses, or of a camera by their words."""
    robot_file = robot[0].partition(".")[0]
    poses = {name for item in possible_poses(fields, robot) for name in item.names}
    found = [
        item.names
        for item in points_in(fields)
        for file in [item.names[0].partition(".")[0]]
        if item.sides == ["camera"] or (file != robot_file and f"{file}." in fields.places[0])
        if {*item.names}.isdisjoint({*robot, *poses})
    ]
    return found[0] if len(found) == 1 else ()


def _broken_rotations(source: Source) -> list[str]:
    """Fields whose names say rotations, of as many numbers as these, that are none."""
    return [
        name
        for fields in rows_in(source)
        for name, numbers in fields.numbers.items()
        if len(numbers) and numbers[0].size in (4, 9) and _ROTATION.search(name)
        if not appearance(numbers)
    ]


def check_points(source: Source) -> None:
    """Raises DataError where a source has pairs of points, or pixels and points, alone."""
    for fields in rows_in(source):
        px, places = (columns_named(fields, axes) for axes in (("u", "v"), (*"xyz",)))
        if px and places and not possible_poses(fields):
            raise DataError(
                f"{source.path.name}: {', '.join(px)} and {', '.join(places)} are pixels and "
                f"places of {len(fields)} points, as of touched ones, without a pose of the robot. "
                "One picture places a camera, and says nothing of how the arm errs.",
                culprits=[fields.places[0]],
                next_step="Before a fixed camera screw a board to the flange, and give pictures "
                "with the pose of each: visioncal record --page takes both.",
            )
    if pairs := point_pairs(source):
        if broken := _broken_rotations(source):
            raise DataError(
                f"{source.path.name}: {some_of(broken)} are called rotations, and are none: their "
                "numbers are no orthonormal matrix and no unit quaternion. A calibration takes the "
                "rotations of both sides.",
                culprits=broken,
                next_step="Correct the program that writes them: a matrix by rows, whose rows have "
                "length 1 and are perpendicular, or qx, qy, qz, qw of length 1; then record again.",
            )
        robot, camera = pairs.names
        where = shlex.quote(str(source.path))
        fit = f"maps one to the other but for {1e3 * pairs.rms_m:.3g} mm (rms)"
        raise DataError(
            f"{source.path.name}: {robot} and {camera} are {len(pairs.points[0])} pairs of points "
            f"without rotations{': a rigid motion' if pairs.agree else ', and no rigid motion'} "
            f"{fit}. A calibration takes the robot's poses.",
            culprits=[pairs.places[0]],
            next_step="Record the robot's rotations, too."
            if not pairs.agree
            else f"Where {robot} are places of the robot's tip at what the camera saw, this "
            f"fits the camera's frame to them:\nvisioncal fixture {where} --cad {where} --tool "
            "none --name camera -o frames.json",
        )
