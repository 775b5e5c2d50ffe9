"""Content of an unknown source: files by kind, rows of named values, images and lenses.

`describe` reads a source, and `proposed` ranks which of its rows may be a recording's.
"""

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.calibration.guess import FEWEST_ROWS
from visioncal.core.documents.structured import parse_yaml
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.documents import read_document
from visioncal.interchange.formats.fields import (
    Fields,
    appearance,
    fields_of_records,
    is_headerless,
    joined,
    named_by,
)
from visioncal.interchange.formats.file_search import DRAWN, FileGroup, groups_in, head, shut
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.intrinsics import (
    FAULT,
    LENS_KEYS,
    lenses_in,
    read_target_description,
)
from visioncal.interchange.formats.joints import joint_names
from visioncal.interchange.formats.keys import HOW
from visioncal.interchange.formats.point_files import with_point_sets
from visioncal.interchange.formats.pose_words import PoseFields, words_of
from visioncal.interchange.formats.poses import (
    column_groups,
    columns_named,
    pose_names,
    possible_poses,
    ranked_poses,
    without_copies,
)
from visioncal.interchange.formats.reading import is_document, read_record, read_rows
from visioncal.robot import Robot
from visioncal.robot.files import read_robot_document

# Files that describe boards, and the most bytes of one.
_OF_BOARDS, _MOST_OF_BOARD = (".toml", ".yaml", ".yml", ".json"), 10_000
# Files without poses that are listed one by one.
_LISTED = 6
# Lines of a camera_info's matrix and coefficients.
_CAMERA_INFO = re.compile(r"^[KkDd]: *\[.*$", re.MULTILINE)
# Readings of one source that are tested, the rank of rows that are no recording beside others, and
# names of rows that are a robot's.
_MOST_READINGS, ASIDE, _NAMED = 16, 8, re.compile("pose|robot|arm", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Part:
    """Files of one kind, and what they hold."""

    group: FileGroup
    rows: tuple[Fields, ...] = ()  # Rows of named values, one a file of several.
    fault: DataError | None = None  # Why they cannot be read.
    # Fields of `[camera]` by where they stand.
    lenses: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    kin: str = ""  # Label of files that are each a recording like this one; empty of others.


@dataclass(frozen=True, eq=False)
class Source:
    """Content of a file or folder."""

    path: Path
    parts: tuple[Part, ...]

    @property
    def images(self) -> tuple[FileGroup, ...]:
        """The groups of images, and those of clouds."""
        groups = (part.group for part in self.parts)
        return tuple(group for group in groups if group.is_images or group.is_clouds)

    @property
    def longest(self) -> int:
        """The most rows of a part."""
        return max((len(each) for part in self.parts for each in part.rows), default=0)

    def lens(self) -> tuple[Mapping[str, Any] | None, tuple[str, ...]]:
        """The only lens, or the colour camera's, and its origin; None without a lens."""
        every = {place: lens for part in self.parts for place, lens in part.lenses.items()}
        found = {place: lens for place, lens in every.items() if FAULT not in lens}
        if every and not found:
            words = "; ".join(str(lens[FAULT]).rstrip(".") for lens in every.values())
            return None, (f"The intrinsics are left aside: {words}; --intrinsics names a file.",)
        named = {p: lens for p, lens in found.items() if "rgb" in p.lower() or "colo" in p.lower()}
        different = {str(lens): place for place, lens in (named or found).items()}
        if len(different) == 1:
            place = next(iter(different.values()))
            return found[place], (f"The intrinsics are those of {place}.",)
        note = f"Several intrinsics are left aside: {some_of([*found])}; --intrinsics names a file."
        return None, (note,) * bool(found)

    def board(self) -> tuple[Mapping[str, Any] | None, tuple[str, ...]]:
        """The only board that a file beside describes, and its origin; None without a board."""
        found: dict[str, Mapping[str, Any]] = {}
        for file in (part.group.files[0] for part in self.parts if part.group.is_data):
            if file.suffix in _OF_BOARDS and file.stat().st_size < _MOST_OF_BOARD:
                with suppress(DataError):
                    found[file.name] = read_target_description(str(file))
        if len(found) != 1:
            return None, ()
        name, board = found.popitem()
        return board, (f"The board is that of {name}; --target says another.",)

    def words(self) -> str:
        """The text form: a line a kind of file, and one each for its fields."""
        lines = [f"{self.path} holds {counted(len(self.parts), 'kind')} of files:"]
        read = [part for part in self.parts if part.rows or part.lenses or part.group.is_images]
        others = [part for part in self.parts if part not in read]
        # Of a repository's own code a count suffices.
        listed = [part for part in others if part.fault is not None][:_LISTED]
        for part in [part for part in self.parts if part in read or part in listed]:
            lines.append(f"  {part.group.listed()}: {_kind(part)}")
            for fields in part.rows:
                lines += [f"    {line}" for line in _field_lines(fields)]
            lines += [
                f"    {place}: {lens.get(FAULT, 'looks like a lens')}"
                for place, lens in part.lenses.items()
            ]
        rest = [part.group.label for part in others if part not in listed]
        lines = lines[:60]
        if rest:
            lines.append(f"  {counted(len(rest), 'kind')} not read: {some_of(rest, 3)}")
        return "\n".join(lines)


def _kind(part: Part) -> str:
    image = part.group.image if part.group.is_images else None
    if image is not None:
        depth = ", looks like depth" * image.is_depth
        return f"images, {image.size[0]} x {image.size[1]}, {image.words}{depth}"
    if part.rows:
        return f"{' and '.join(counted(len(each), 'row') for each in part.rows)} of named values"
    return "" if part.fault is None else part.fault.message


def _field_lines(fields: Fields) -> Iterator[str]:
    """A line a field: its name, the shape of a row, the range, and what it looks like."""
    poses = {name: item for item in possible_poses(fields) for name in item.names}
    columns = [name for name, numbers in fields.numbers.items() if numbers.ndim == 1]
    for item in dict.fromkeys(item for name, item in poses.items() if name in columns):
        yield f"{some_of(item.names, 16)}: look like a pose"
    for name, numbers in fields.numbers.items():
        if name in columns:
            continue
        shape = " x ".join(map(str, numbers.shape[1:])) or "1"
        sized = {3: "a position or three angles", 6: "a pose, or six joints"}
        look = "a pose" if name in poses else appearance(numbers)
        look = look or sized.get(int(np.prod(numbers.shape[1:])), "")
        finite = numbers[np.isfinite(numbers)]
        span = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ", empty"
        yield f"{name}: {shape}{span}{f': looks like {look}' if look else ''}"
    if plain := [name for name in columns if name not in poses]:
        yield f"numbers {some_of(plain, 20)}"
    if texts := [name for name in fields.texts if name not in fields.numbers]:
        yield f"texts {some_of(texts, 20)}"
    if fields.shape_errors:
        yield f"irregular {some_of([*fields.shape_errors])}"


def describe(path: Path, form: str | None = None) -> Source:
    """Describes a file or a folder, and those in it; `form` is that of a pendant's lines.

    Reads all of what may hold numbers, and the first image of each kind.
    """
    parts = [_part(group, form) for group in groups_in(path)]
    # Names of a list's records are no view's.
    if not any(
        not re.search(r"\.[0-9]+\.", name)
        for part in parts
        for fields in part.rows
        for item in possible_poses(fields)
        for name in item.names
    ):
        parts = [each for part in parts for each in _one_by_one(part, path, form)]
    single = {part.group.files[0].stem: part for part in parts if len(part.group.files) == 1}
    arrays = {name: _array(part.rows[0]) for name, part in single.items() if part.rows}
    for place, lens in lenses_in({k: v for k, v in arrays.items() if v is not None}, path.name):
        # A matrix and coefficients in a file each.
        of_lens = [single[name] for name in arrays if name in LENS_KEYS]
        parts = [replace(part, lenses={place: lens}) if part in of_lens else part for part in parts]
    return Source(path, tuple(parts))


def _one_by_one(part: Part, source: Path, form: str | None) -> list[Part]:
    """Files whose names differ in numbers, each by itself, where each has rows of poses."""
    files = part.group.files if part.group.is_data else ()
    if not 1 < len(files) <= _MOST_READINGS:
        return [part]
    groups = (FileGroup(file.relative_to(source).as_posix(), (file,)) for file in files)
    each = [replace(_part(group, form), kin=part.group.label) for group in groups]
    are_whole = all(any(map(is_whole, one.rows)) for one in each)
    return each if are_whole else [part]


def is_whole(fields: Fields) -> bool:
    """Whether rows are enough, and their fields are such, that they may be a recording's."""
    return len(fields) >= FEWEST_ROWS and bool(possible_poses(fields))


def _array(fields: Fields) -> FloatArray | None:
    """The numbers of a file without names; None where they have some."""
    if [*fields.numbers] == ["matrix"]:
        return fields.numbers["matrix"]
    is_plain = is_headerless(fields) and len(fields.numbers) == len(fields.texts)
    return np.stack([*fields.numbers.values()], axis=1) if is_plain else None


def _part(group: FileGroup, form: str | None) -> Part:
    if fault := shut(group.label):
        return Part(group, fault=DataError(f"{fault}.", culprits=[group.label]))
    if not group.is_data:
        return Part(group)
    first, *others = group.files
    lenses: dict[str, Mapping[str, Any]] = {}
    try:
        document = read_document(first) if is_document(first) else None
        lenses = dict(lenses_in(document, group.label)) if document else _printed_lens(group)
        if not others:
            rows = joined(read_rows(first, form, document), first.stem, first.parent)
            return Part(group, tuple(rows), lenses=lenses)
        records = [read_record(first, document), *map(read_record, others)]
    except DataError as error:
        return Part(group, fault=error, lenses=lenses)
    places, folder = [file.name for file in group.files], first.parent
    fields = fields_of_records(records, places, group.name, folder, group.numbers)
    stems = tuple(map(str, group.keys.found[HOW[0]].get("", ())))
    return Part(group, (replace(fields, stems=stems),), lenses=lenses)


def _printed_lens(group: FileGroup) -> dict[str, Mapping[str, Any]]:
    """The lens of texts with a camera_info that ROS printed, the same in all; empty of others."""
    first, *others = group.files
    text = head(first)
    lines = _CAMERA_INFO.findall(text)
    # Others are read only where the first has one.
    if len(lines) == 2 and all(_CAMERA_INFO.findall(head(file)) == lines for file in others):
        with suppress(DataError):
            return dict(lenses_in(parse_yaml(text, group.label), group.label))
    return {}


def proposed(source: Source, requested: ImportOptions) -> list[tuple[int, Fields, ImportOptions]]:
    """Possible recordings in a source: how unlikely each is, its rows, and which fields are poses.

    Each is of one kind of file, or of several whose rows belong together. Raises DataError, with
    the description, where no rows have the robot's poses or joints.
    """
    given = (*requested.robot.names, *requested.camera.names, *requested.joints)
    is_seen = bool(source.images or requested.images)
    found: list[tuple[int, Fields, ImportOptions]] = []
    rows = rows_in(source)
    of_poses = [len(fields) for fields in rows if possible_poses(fields)]
    of_robot = [len(fields) for fields in rows if _is_of_robot(fields)] or of_poses
    for fields in [each for each in rows if _has(each, given)] or rows:
        # A robot's program beside a table has the same poses once more.
        later = 4 * bool(fields.form) + 2 * (len(rows) > 1 and not _NAMED.search(fields.name))
        # A result of another program has a row or two; a list of a few beside many is of checks.
        later += ASIDE * (len(fields) < FEWEST_ROWS)
        later += ASIDE * (2 * len(fields) < max(of_robot, default=0))
        options = _with_joints(fields, requested)
        joints = options.joints or joint_names(fields, ())
        is_given = bool(requested.robot.names) or not _has(fields, given)
        camera = () if is_given else pose_names(fields, requested.camera.names, "camera", joints)
        others = (*joints, *camera) if requested.camera.names else joints
        groups = [] if is_given else ranked_poses(fields, "robot", others)
        named = pose_names(fields, (), "robot", others) if is_seen or not joints else ()
        if is_given or named or requested.joints or (joints and (is_seen or not groups)):
            found.append((later + len(groups) * (not named), fields, options))
        for rank, item in ((rank, item) for rank, group in enumerate(groups) for item in group):
            # Beside joint angles the pose is what was seen.
            if joints and not is_seen and item.sides != ["robot"]:
                of_item = replace(options, camera=replace(requested.camera, names=item.names))
            else:
                of_item = replace(options, robot=replace(requested.robot, names=item.names))
            if item.names != named and not (named and rank == 0 and item.is_like(named, fields)):
                found.append((later + rank, fields, of_item))
    faults = [part.fault for part in source.parts if part.fault and not part.lenses]
    if all(len(fields) < FEWEST_ROWS <= source.longest for _, fields, _ in found):
        # A pose or two beside rows without a name are those of a frame.
        found = []
    if not rows and len(faults) == 1:
        raise faults[0]
    if not found:
        raise unknown(source, requested, rows)
    return sorted(found, key=lambda item: item[0])[:_MOST_READINGS]


def _is_of_robot(fields: Fields) -> bool:
    """Whether the names of poses, or that of their file, say that they are the robot's."""
    items = possible_poses(fields)
    file = PoseFields((), tuple(words_of(fields.name)))
    return bool(items) and any(item.sides == ["robot"] for item in (*items, file))


def _with_joints(fields: Fields, requested: ImportOptions) -> ImportOptions:
    """Options with the columns of joint angles that no usual name shows.

    They are called as the joints of the user's robot or of the only URDF beside the rows; else they
    are the only ones that are as many as the robot's.
    """
    if requested.joints or joint_names(fields, ()):
        return requested
    if requested.robot_model is None:
        return _of_urdf(fields, requested)
    robot = Robot.from_document(read_robot_document(requested.robot_model, tip=requested.tip))
    if called := joint_names(fields, (), robot.joint_names):
        return replace(requested, joints=called)
    count = robot.joint_count
    # Columns called x, y, z, or named by the user, are a pose.
    poses = pose_names(fields, requested.robot.names, "robot", (), by_shape=False)
    places = {*poses, *columns_named(fields, ("x", "y", "z"))}
    groups = [
        names
        for names in column_groups(fields).values()
        if len(names) == count and places.isdisjoint(names)
    ]
    return replace(requested, joints=groups[0]) if len(groups) == 1 else requested


def _of_urdf(fields: Fields, requested: ImportOptions) -> ImportOptions:
    """Options with the only URDF beside the rows, where columns are called as its joints.

    The angles are of the link at its end, unless it has a flange or the user names a tip.
    """
    # Links may lead out of a stranger's folder.
    files = [file for file in fields.folder.glob("*.urdf") if not file.is_symlink()]
    if len(files) != 1:
        return requested
    ends, robot_file = set[str](), str(files[0])
    with suppress(DataError):
        urdf = read_robot_document(robot_file)["urdf"]
        ends = {*re.findall(r"<link\s+name=\"([^\"]+)\"", urdf)}
        ends -= {*re.findall(r"<parent\s+link=\"([^\"]+)\"", urdf)}
    for tip in (requested.tip, *ends) if len(ends) == 1 else ():
        with suppress(DataError):
            robot = Robot.from_document(read_robot_document(robot_file, tip=tip))
            if called := joint_names(fields, (), robot.joint_names):
                return replace(requested, joints=called, robot_model=robot_file, tip=robot.tip)
    return requested


def _has(fields: Fields, given: Sequence[str]) -> bool:
    names = [*fields.numbers, *fields.texts]
    return all(any(f".{name}.".find(f".{each}.") >= 0 for name in names) for each in given)


def unknown(
    source: Source,
    requested: ImportOptions,
    rows: Sequence[Fields] = (),
    likely: Sequence[str] = (),
) -> DataError:
    """The error of poses that are not known, with a command; of the `likely` fields, if it may."""
    enough = [each for each in rows if len(each) >= FEWEST_ROWS or source.longest < FEWEST_ROWS]
    possible = [
        (fields, item)
        for fields in enough
        for item in without_copies(fields, possible_poses(fields))
    ]
    possible.sort(
        key=lambda of: (
            of[1].names != likely or of[1].is_of_target,
            of[1].is_seen,
            of[1].sides != ["robot"],
            bool(of[1].sides),
            # Another side's word, as of a tracker's sensor, may be the arm's.
            not {"camera", "cam"}.isdisjoint(of[1].words),
        ),
    )
    step, options = "", list[str]()
    if possible:
        fields, robot = possible[0]
        robot_names = {*robot.names}
        others = [
            each for of, each in possible[1:] if of is fields and not robot_names & {*each.names}
        ]
        others = [item for item in others if item.sides != ["robot"]]
        # Both sides of a recording have as many poses; a file with more is of other pictures.
        lengths = {each.name: len(each) for part in source.parts for each in part.rows}
        filled = _filled(fields, robot, {})
        uneven = [item for item in others if _filled(fields, item, lengths) != filled]
        others = [item for item in others if item not in uneven]
        others = [item for item in others if item.sides] or others * (not source.images)
        for side, item in zip(("robot", "camera"), (robot, *others[:1]), strict=False):
            options += [f"--{side}-{named_by(fields.places[0])}", ",".join(item.names)]
        step = _of_one_file(source, requested, robot.names)
        if robot.is_of_target and not others:
            step = f"By their names, {','.join(robot.names)} are the target's. Put the robot's "
            step += "poses beside them, a row each, or name them with --robot-key."
        elif not step and uneven and not (others or source.images):
            counts = [
                f"{','.join(item.names)} ({_filled(fields, item, lengths)})" for item in uneven
            ]
            step = (
                f"Both sides need a row each: {','.join(robot.names)} has {filled} poses, and "
                f"there are {some_of(counts)}. Name the files of one recording, the robot's as the "
                "source and the camera's with --camera-file."
            )
        elif not step:
            step = f"Say {' '.join(options)}, where these are its poses"
            step += f":\n{shlex.join([*requested.command, *options])}" if requested.command else "."
    elif rows:
        word = named_by(rows[0].places[0])
        step = f"Name them with --robot-{word}, or the joint angles with --joint-{word}."
    return DataError(
        f"{source.words()}\nAny of these may be the robot's poses.",
        culprits=[str(source.path)],
        next_step=step
        or next((part.fault.next_step for part in source.parts if part.fault), "")
        or "Write the poses into a CSV with a header, one row per view. Lists in a .py or .cpp "
        "program are read where it is named as the source.",
    )


def _filled(fields: Fields, item: PoseFields, lengths: Mapping[str, int]) -> int:
    """The number of rows that have all numbers of a pose, or of its file where these are more."""
    columns = np.hstack([fields.column(name) for name in item.names])
    length = lengths.get(item.names[0].partition(".")[0], 0)
    return max(int(np.isfinite(columns).all(axis=1).sum()), length * (length > len(fields)))


def _of_one_file(source: Source, requested: ImportOptions, names: Sequence[str]) -> str:
    """Next step where several files have the same columns: the file of as many rows as pictures.

    Empty where these columns are those of one file.
    """
    files = {
        part.group.files[0]: len(fields)
        for part in source.parts
        for fields in part.rows
        if len(part.group.files) == 1 and {*names} <= {*fields.numbers}
    }
    if len(files) < 2:
        return ""
    groups = [group for group in source.images if not DRAWN.search(group.label)]
    fits = [
        (file, group)
        for group in sorted(groups, key=lambda each: each.is_depth)
        for file, count in files.items()
        if count == len(group.files)
    ]
    longest = max(files, key=lambda file: files[file])
    file, images = fits[0] if fits else (longest, None)
    listed = some_of([f"{each.name} ({counted(count, 'row')})" for each, count in files.items()])
    step = f"{len(files)} files have the columns {','.join(names)}: {listed}. Name the one that is "
    step += "the recording"
    options = list[str]()
    if images is not None:
        same_folder = [group for group in groups if group.files[0].parent == images.files[0].parent]
        pictures = images.files[0] if len(same_folder) > 1 else images.files[0].parent
        step += f", as {file.name}, of as many rows as there are images in {images.label}"
        options = [] if requested.images else ["--images", str(pictures)]
    if not requested.command:
        return f"{step}."
    words = [str(file) if word == str(source.path) else word for word in requested.command]
    return f"{step}:\n{shlex.join([*words, *options])}"


def rows_in(source: Source) -> list[Fields]:
    """Rows of the parts, those joined that belong together; those of poses where there are any."""
    found = joined(
        [
            fields
            for part in source.parts
            for fields in part.rows
            if not part.lenses or len(part.group.files) > 1 or possible_poses(fields)
        ],
        source.path.resolve().name,
        source.path,
        prefixed=True,
    )
    named = [replace(f, name=source.path.resolve().name) if f.stems else f for f in found]
    if not source.images:
        named = [with_point_sets(f, [other for other in named if other is not f]) for f in named]
    # Joint angles of as many rows or more say where the arm stood, too, where there are pictures.
    most = max((len(fields) for fields in named if possible_poses(fields)), default=0)
    return [
        fields
        for fields in named
        if possible_poses(fields)
        or (source.images and len(fields) >= most and joint_names(fields, ()))
    ] or named
