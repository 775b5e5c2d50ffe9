"""Builds a session from a foreign recording."""

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.conventions import POSE_FORMS, PoseNumbers, Reading
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, absence, read_bytes
from visioncal.core.number_format import some_of
from visioncal.core.types import MOUNTS, Mount, Searched
from visioncal.interchange.formats.fields import named_by
from visioncal.interchange.formats.foreign import ForeignRecording, ImportOptions, rows_of
from visioncal.interchange.formats.intrinsics import read_intrinsics, read_target_description
from visioncal.robot import Robot
from visioncal.robot.files import ROBOT_SUFFIXES, read_robot_document
from visioncal.session import ImageStore, Session, Stream
from visioncal.session import columns as session_columns
from visioncal.session.corners import CornerTable
from visioncal.session.images import CLOUD_ENDINGS, ListedImages
from visioncal.session.table import check_two_sides
from visioncal.vision.boards import kind_of
from visioncal.vision.boards.identify import LOOKED_AT, identify, with_article
from visioncal.vision.boards.imaging import image_size, looks_like_image, read_image
from visioncal.vision.targets import target_name

_TARGET = (
    "--target with a name in targets/, a .toml, or a description such as checkerboard_9x6_23.6mm."
)
_SIDES = (
    "Name the poses of each with --robot-{0} and --camera-{0}, or the robot's file, and that of "
    "the camera with --camera-file."
)


@dataclass(frozen=True, eq=False)
class FileImages(ListedImages[Path]):
    """Image files anywhere on the disk, by their paths in the session."""

    # Corners of the only board that were found in some files before.
    searches: Mapping[Path, Searched] = field(default_factory=dict)

    def search_of(self, path: str, board: str) -> Searched | None:
        """Corners of the board found in an image before; None where it is to be searched."""
        del board
        return self.searches.get(self.files[path]) if path in self.files else None

    def load(self, place: Path) -> bytes:
        """Reads the bytes of one image file."""
        data = read_bytes(place, MOST_IMAGE_BYTES)
        # A failed camera leaves empty files, which are kept; else what is no image is refused.
        is_cloud = place.suffix.lower() in CLOUD_ENDINGS
        if data and not is_cloud and not looks_like_image(data):
            raise DataError(
                f"{place} must be an image (png, jpg, tif, bmp, webp).",
                culprits=[str(place)],
                next_step="Name each row's image with --image-column, or the folder with --images.",
            )
        return data

    def absence(self, path: str) -> str:
        """Says why there is no such image; empty where there is one."""
        return super().absence(path) or absence(self.files[path])


def with_user_options(foreign: ForeignRecording, requested: ImportOptions) -> ForeignRecording:
    """Adds the user's options to a recording, other than those of its poses; raises DataError."""
    if requested.mount is not None:
        foreign = replace(foreign, mount=requested.mount)
    if requested.target is not None:
        foreign = replace(foreign, target=read_target_description(requested.target))
    stated = POSE_FORMS.get(requested.robot.form or foreign.form)
    # Forms of libraries are no controller's.
    foreign = replace(foreign, form=stated.name if stated and stated.models else "")
    if requested.tip is not None and not (requested.robot_model or foreign.arm):
        raise DataError("--tip needs the robot that it is of; name it with --robot-model.")
    foreign = replace(foreign, arm=requested.arm or foreign.arm)
    lens, lenses, notes = dict(foreign.lens or {}), foreign.lenses, foreign.notes
    is_of_one = requested.intrinsics not in (None, "estimate") or requested.resolution is not None
    if lenses and is_of_one:
        raise DataError(
            f"{foreign.name} has several cameras ({', '.join(lenses)}), and --intrinsics FILE and "
            "--resolution are of one.",
            culprits=["--intrinsics", "--resolution"],
            next_step="Name one camera with --image-key, or convert without these options and "
            "write them into [cameras] of session.toml.",
        )
    if requested.intrinsics == "estimate":
        lens = _to_estimate(lens)
        lenses = {name: _to_estimate(one) for name, one in lenses.items()}
    elif requested.intrinsics is not None:
        lens, lens_notes = read_intrinsics(Path(requested.intrinsics))
        notes = (*notes, *lens_notes)
    if requested.resolution is not None:
        lens["resolution"] = list(requested.resolution)
    return replace(foreign, lens=lens or None, lenses=lenses, notes=notes)


def _to_estimate(lens: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a camera whose intrinsics are estimated."""
    return {name: lens[name] for name in ("name", "model", "resolution") if name in lens}


def assemble(foreign: ForeignRecording, *, mount: Mount | None = None) -> Session:
    """Builds the session of a recording, as its poses are read.

    Args:
        foreign: The recording; `replace` it to try another reading, mount or order of rows.
        mount: Used where the recording states none.

    Returns:
        The session; assumptions are among its warnings.

    Raises:
        DataError: No mount is known, no row has an observation, or a number is wrong.
    """
    mount = foreign.mount or mount
    if mount is None:
        raise DataError(
            f"{foreign.name}: how the camera is mounted is not known.",
            culprits=["mount"],
            next_step="Give --mount eye-in-hand or --mount eye-to-hand"
            + (f", and {_TARGET}" if lacks_target(foreign) else "."),
        )
    foreign = with_observations_only(foreign)
    document: dict[str, Any] = {"schema": 1, "name": foreign.title or foreign.name}
    document |= {} if mount == "instrument" else {"mount": mount}
    document |= _instrument(foreign, mount)
    notes = list(foreign.notes)
    store = foreign.store
    if store is None:
        paths = _image_paths(foreign.images, foreign.name, notes)
        foreign, files = _with_depth(foreign, notes)
        files += zip(paths, foreign.images, strict=True)
        store = FileImages({path: file for path, file in files if file})
    else:
        paths = ["" if path is None else path.as_posix() for path in foreign.images]
    images = [path for path in dict.fromkeys(paths) if path]
    rows = _view_rows(foreign, paths)
    if foreign.lenses:
        document["cameras"] = {name: dict(lens) for name, lens in foreign.lenses.items()}
    elif images or foreign.corners:
        document["camera"] = _of_size(_camera(foreign, store, images), store, images, notes)
    elif (foreign.lens or {}).get("model") == "points":
        document["camera"] = {"model": "points"}
    target = foreign.target if images or foreign.corners else None
    if target is not None:
        document["target"] = target_name(target) or "target.toml"
    robot = _robot(foreign, document)
    if foreign.form:
        document["robot"] = {**document.get("robot", {}), "form": foreign.form}
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[row.get(name, "") for name in names] for row in rows]
    session = Session.assemble(
        document,
        names,
        cells,
        store,
        target_document=target,
        robot_document=robot,
        corners=_corner_table(foreign),
    )
    named = named_by(foreign.robot.places[0])
    check_two_sides(foreign.name, session.views, _SIDES.format(named))
    stream = foreign.stream
    if stream is not None:
        rows = pose_cells(stream.poses, session_columns.POSE)
        numbers = [[float(row.get(name, "nan")) for name in session_columns.POSE] for row in rows]
        q = np.zeros((len(rows), 0)) if stream.joints_rad is None else stream.joints_rad
        values = np.hstack([stream.stamps_s[:, None], np.array(numbers), q])
        values.setflags(write=False)
        joints = (f"q{at + 1}_rad" for at in range(q.shape[1]))
        columns = ("stamp_s", *session_columns.POSE, *joints)
        session = session.with_streams({"robot": Stream(columns, values)})
    elif foreign.joints_rad is None and not foreign.robot.present.all():
        missing = [foreign.robot.places[index] for index in np.flatnonzero(~foreign.robot.present)]
        notes.append(
            f"{len(missing)} of {len(rows)} rows have no pose of the robot: {some_of(missing)}."
        )
    notes += _beside_axis(session)
    return replace(session, warnings=(*notes, *session.warnings))


def _beside_axis(session: Session) -> Iterator[str]:
    """The note that measured targets stand beside the axis of a camera, or behind it."""
    seen = (view.cam_from_target() for view in session.views)
    places = np.array([pose.translation for pose in seen if pose is not None]).reshape(-1, 3)
    middle = places.mean(axis=0) if len(places) else np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(middle).argmax())
    sign = np.sign(middle[axis])
    name = f"{'-' if sign < 0 else ''}{'xyz'[axis]}"
    # No lens sees farther from its axis than half a right angle to another one.
    is_along = sign * places[:, axis] > np.sqrt(0.5) * np.linalg.norm(places, axis=1)
    if session.mount in MOUNTS and (axis, sign) != (2, 1.0) and is_along.all():
        # Behind a lens stands what OpenGL's camera sees, and the camera before its target.
        which = (
            "in the frame of OpenGL, Blender or a simulator (y up, -z forward), or are inverse, "
            "those of the camera in the target (--camera-inverse)"
            if name == "-z"
            else "in the frame of the camera's body (camera_link has x forward), or of a tracker"
        )
        yield (
            f"The targets stand along the camera's {name}, and before a lens they stand along its "
            f"z: their poses are {which}. The result is that frame's, too."
        )


def _corner_table(foreign: ForeignRecording) -> CornerTable | None:
    """The corners of a recording by its views' numbers; None if it has none."""
    views = foreign.views or range(len(foreign.robot))
    found = [(n, px) for n, px in zip(views, foreign.corners, strict=False) if px is not None]
    return CornerTable.of_lists([(n, np.arange(len(px)), px) for n, px in found]) if found else None


def _with_depth(
    foreign: ForeignRecording, notes: list[str]
) -> tuple[ForeignRecording, list[tuple[str, Path | None]]]:
    """The recording with paths of depth pictures in the session, and the files that they are of."""
    columns = dict(foreign.columns)
    files = [Path(cell) if cell else None for cell in columns.pop("source_depth", ())]
    paths = _image_paths(files, foreign.name, notes) if any(files) else []
    paths = [path.replace("images/", "depth/", 1) for path in paths]
    columns |= {"depth": tuple(paths)} if paths else {}
    return replace(foreign, columns=columns), [*zip(paths, files, strict=False)]


def with_observations_only(foreign: ForeignRecording) -> ForeignRecording:
    """Drops rows without an observation, and stored poses or images that are not used.

    Raises:
        DataError: No row has an observation, or images show an unknown target.
    """
    notes: list[str] = []
    foreign = _images_or_poses(foreign, notes)
    readings = map(foreign.columns.get, ("point", "meas_x_m"))
    saw = np.zeros(len(foreign.robot), dtype=bool)
    for cells in (foreign.images, *filter(None, readings)):
        saw |= np.array([bool(cell) for cell in cells] or [False])
    saw |= np.array([px is not None for px in foreign.corners] or [False])
    if foreign.camera is not None:
        saw |= foreign.camera.present
    dropped = [foreign.robot.places[index] for index in np.flatnonzero(~saw)]
    if len(dropped) == len(saw):
        states = "poses" if foreign.robot.present.any() else "joint angles"
        raise DataError(
            f"{foreign.name} has {len(saw)} {states} of the robot, but neither images nor poses "
            "of the target: nothing says what a camera saw.",
            culprits=[foreign.robot.places[0]],
            next_step="Name the images with --images, or the target's poses with --camera-"
            f"{named_by(foreign.robot.places[0])} or --camera-file. Touches of a point need a "
            "column `point`.",
        )
    if dropped:
        notes.append(
            f"{len(dropped)} of {len(saw)} rows are left out, as they have neither an image nor a "
            f"pose of the target: {some_of(dropped)}."
        )
    return replace(rows_of(foreign, np.flatnonzero(saw)), notes=(*foreign.notes, *notes))


def lacks_target(foreign: ForeignRecording) -> bool:
    """Whether there are images or corners alone, and nothing says what they show."""
    is_of_points = (foreign.lens or {}).get("model") == "points"
    is_seen = bool(foreign.images or foreign.corners) and not is_of_points
    return is_seen and foreign.target is None and foreign.camera is None


def unknown_target(foreign: ForeignRecording, culprit: str, then: str = "") -> DataError:
    """The error of images of which nothing says what they show, and what `then` follows."""
    seen, step = _seen_board([image for image in foreign.images if image is not None])
    return DataError(
        f"{foreign.name}: there are {'images' if foreign.images else 'corners'}, but their target "
        f"is not {seen}.",
        culprits=[culprit],
        next_step=f"{step} {_TARGET}{then}",
    )


def _seen_board(images: Sequence[Path]) -> tuple[str, str]:
    """Words on the board that a few images show, and how it becomes a target."""
    some = images[:: max(len(images) // LOOKED_AT, 1)][:LOOKED_AT]
    with suppress(DataError):
        seen = identify([read_image(image) for image in some]) if some else None
        if seen is None:
            return "known", "Give"
        is_sure = not seen.is_single or len(seen.marker_ids) < 2
        is_sure &= seen.shown >= min(2, len(some))
        if is_sure and seen.is_shown:
            return (
                f"stated: {with_article(seen)}",
                f"Measure the {kind_of(seen.board).side}, write it [mm] in place of 30, and give "
                "--target board.toml, which this makes:\nvisioncal target check "
                f"{shlex.join(map(str, some))} --square-mm 30 -o board.toml\nElse give",
            )
    return "known", "Give"


def _images_or_poses(foreign: ForeignRecording, notes: list[str]) -> ForeignRecording:
    """Chooses between images or corners and stored target poses where there are both."""
    if not (foreign.images or foreign.corners):
        return foreign
    if foreign.target is not None:
        if foreign.camera is not None:
            notes.append(
                "The stored poses of the target are left aside: the "
                f"{'images' if foreign.images else 'corners'} determine them better."
            )
        return replace(foreign, camera=None)
    if lacks_target(foreign):
        raise unknown_target(foreign, "target")
    seen = "images" if foreign.images else "corners"
    notes.append(f"The {seen} are left aside: no --target says what they show.")
    return replace(foreign, images=(), corners=())


def _view_rows(foreign: ForeignRecording, paths: Sequence[str]) -> list[dict[str, str]]:
    """Cells of views.csv by column; `paths` are those of the images in the session."""
    robot = pose_cells(foreign.robot, session_columns.POSE)
    camera: list[dict[str, str]] = [{}] * len(foreign.robot)
    if foreign.camera is not None:
        camera = pose_cells(foreign.camera, session_columns.MEASURED_CAM_POSE)
    extra, stamps_s, joints_rad = _extra_columns(foreign), foreign.stamps_s, foreign.joints_rad
    rows = []
    for at in range(len(foreign.robot)):
        cells = {"view": str(foreign.views[at] if foreign.views else at)}
        if paths:
            cells["image"] = paths[at]
        if stamps_s is not None and np.isfinite(stamps_s[at]):
            cells["stamp_s"] = repr(float(stamps_s[at]))
        for number, angle in enumerate([] if joints_rad is None else joints_rad[at].tolist(), 1):
            cells[f"q{number}_rad"] = "" if np.isnan(angle) else repr(angle)
        further = {name: column[at] for name, column in extra.items()}
        rows.append(cells | robot[at] | camera[at] | further)
    return rows


def _image_paths(images: Sequence[Path | None], name: str, notes: list[str]) -> list[str]:
    """Paths of images in the session, empty for none; a name already in use gets a number."""
    paths: dict[Path, str] = {}
    taken: set[str] = set()
    for at, file in enumerate(images):
        if file is None or file in paths:
            continue
        # Archives of other systems leave names in their own encoding.
        file_name = os.fsencode(file.name).decode("utf-8" if file.name.isprintable() else "latin-1")
        names = chain([file_name], (f"{number}_{file_name}" for number in count(at)))
        # Some file systems do not distinguish upper and lower case.
        paths[file] = next(name for name in names if name.casefold() not in taken)
        taken.add(paths[file].casefold())
    missing = [file for file in paths if not file.is_file()]
    listed = some_of([*map(str, missing)], 3)
    summary = f"{len(missing)} of {len(paths)} images are missing: {listed}"
    if missing and len(missing) == len(paths):
        raise DataError(
            f"{name}: {summary}.",
            culprits=[str(missing[0])],
            next_step="Name the folder that holds them with --images.",
        )
    if missing:
        notes.append(f"{summary}. --images names the folder that holds them.")
    return ["" if image is None else f"images/{paths[image]}" for image in images]


def pose_cells(numbers: PoseNumbers, names: Sequence[str]) -> list[dict[str, str]]:
    """Cells of poses that read back as the same numbers; empty for a row without a pose."""
    poses = numbers.poses()
    values = np.hstack([numbers.positions, numbers.rotations])
    present = numbers.present
    # Numbers already in our own convention are copied without computation.
    if numbers.reading != Reading() and present.any():
        values = np.full((len(numbers), 7), np.nan)
        transforms = RigidTransform.from_matrix(poses[present])
        values[present] = np.hstack([transforms.translation, transforms.rotation.as_quat()])
    return [
        dict(zip(names, map(repr, row), strict=True)) if has_pose else {}
        for row, has_pose in zip(values.tolist(), present, strict=True)
    ]


def _extra_columns(foreign: ForeignRecording) -> dict[str, tuple[str, ...]]:
    """Further columns, renamed where a session would take their names for something else."""
    reserved = {"view", "image", "stamp_s", *session_columns.POSE}
    reserved |= {*session_columns.MEASURED_CAM_POSE}
    reserved |= {*session_columns.joint_columns(tuple(foreign.columns))}
    columns: dict[str, tuple[str, ...]] = {}
    for name, cells in foreign.columns.items():
        is_meant = (name == "camera" and foreign.lenses) or _is_meant(name, cells)
        unique = name if is_meant else f"source_{name}"
        while unique in reserved or unique in columns:
            unique = f"source_{unique}"
        columns[unique] = cells
    return columns


def _is_meant(name: str, cells: Sequence[str]) -> bool:
    """Whether a column with a name known to sessions holds what sessions mean by it."""
    filled = {cell for cell in cells if cell}
    if name == "role":
        return filled <= {"fit", "holdout"}
    if name == "stop":
        return all(word.isascii() and word.isdecimal() and len(word) < 10 for word in filled)
    if name in session_columns.SELECTORS:
        return len(filled) < 2
    finite = (is_number(word) and np.isfinite(float(word)) for word in filled)
    return not session_columns.is_number(name) or all(finite)


def _camera(foreign: ForeignRecording, store: ImageStore, paths: Sequence[str]) -> dict[str, Any]:
    lens = {name: value for name, value in (foreign.lens or {}).items() if value is not None}
    if "resolution" not in lens:
        sizes = (image_size(store.read(path)) for path in paths if store.exists(path))
        size = next(filter(None, sizes), None)
        if size is not None:
            lens["resolution"] = list(size)
        elif "matrix" in lens or not paths:
            source = "the intrinsics do not say" if "matrix" in lens else "the corners do not say"
            raise DataError(
                f"{foreign.name}: {source} for which size of image they hold, and no image can be "
                "read.",
                culprits=["resolution"],
                next_step="Give --resolution WIDTH,HEIGHT.",
            )
    return lens


def _instrument(foreign: ForeignRecording, mount: Mount) -> dict[str, Any]:
    """`[instrument]`, which also without a sigma says that what was read is an instrument's."""
    if mount != "instrument" and not foreign.instrument:
        return {}
    return {"instrument": {"name": "instrument"} | dict(foreign.instrument or {})}


# Images whose size is compared with that of the intrinsics.
_SIZED = 3


def _of_size(
    lens: dict[str, Any], store: ImageStore, paths: Sequence[str], notes: list[str]
) -> dict[str, Any]:
    """A lens of images of this size, where the stated one is of larger or smaller ones, and a note.

    Images of another shape are part of others: those keep the lens as it is, and are refused later.
    """
    existing = [path for path in paths if store.exists(path)] if "matrix" in lens else []
    sizes = set[tuple[int, int] | None]()
    # Pictures that cannot be read are refused later, with what else is wrong.
    with suppress(DataError):
        sizes = {image_size(store.read(path)) for path in existing[:_SIZED]} - {None}
    stated = tuple(lens.get("resolution", ()))
    if len(sizes) != 1 or stated in sizes or not stated:
        return lens
    size = next(filter(None, sizes))
    fx, fy, cx, cy = (float(value) for value in lens["matrix"])
    if stated == size[::-1] and abs(2.0 * cx - size[0]) < abs(2.0 * cx - stated[0]):
        # MATLAB's `ImageSize` has the rows first.
        return lens | {"resolution": list(size)}
    share = np.array(size) / np.array(stated)
    # A side may be rounded to whole pixels.
    if abs(share[0] * stated[1] - size[1]) > 1.0:
        return lens
    scaled = [fx * share[0], fy * share[1], *((np.array([cx, cy]) + 0.5) * share - 0.5)]
    notes.append(
        f"The intrinsics are of images of {stated[0]} x {stated[1]} pixels, and these have "
        f"{size[0]} x {size[1]}: the matrix is scaled by {share[0]:.4g}. Where these are a part "
        "of those, --intrinsics estimate leaves it out."
    )
    return lens | {"matrix": [float(value) for value in scaled], "resolution": list(size)}


def _robot(foreign: ForeignRecording, document: dict[str, Any]) -> dict[str, Any] | None:
    """Reads and checks the robot's model, and names it in the document."""
    if foreign.arm is None and foreign.robot_document is not None:
        document["robot"] = {"model": "robot.urdf", "tip": foreign.robot_document["tip"]}
        return dict(foreign.robot_document)
    if foreign.arm is None:
        return None
    arm = {name: str(value) for name, value in foreign.arm.items()}
    robot = read_robot_document(arm["model"], tip=arm.get("tip"))
    Robot.from_document(robot)
    file = Path(arm["model"])
    suffix = file.suffix.lower()
    # Results are in the form of the maker that a URDF's file names.
    name = file.name if suffix == ".urdf" else f"robot{suffix}"
    document["robot"] = arm | ({"model": name} if suffix in ROBOT_SUFFIXES else {})
    return robot
