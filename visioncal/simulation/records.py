"""Simulated cells on disk: the session that calibration reads, and the truth beside it."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import decode_text, read_bytes, write_atomically
from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray, Target
from visioncal.session import MemoryImages, Session, View
from visioncal.session.corners import CornerTable
from visioncal.simulation.boards import corners_m
from visioncal.simulation.cell import Cell, Stream, stream
from visioncal.simulation.optics import project
from visioncal.simulation.options import BOARDS
from visioncal.simulation.render import encode, prepare_scene, render
from visioncal.simulation.sag import Payload
from visioncal.simulation.second import NAMES
from visioncal.simulation.sweep import POSE, Sweep

# An operator's pace: a stop every so many seconds [s].
_PACE_S = 4.0
# A step of a pose for differences, and it ahead and behind along each axis: (2, 6, 4, 4).
_STEP = 1e-6
_STEPS = exp(_STEP * np.stack([np.eye(6), -np.eye(6)]))


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated session should yield.

    Attributes:
        transforms: True edges by their contract names, each (4, 4).
        camera: The true intrinsics.
        base_from_flange: (m, 4, 4) where the flange really stood.
        cam_from_target: (m, 4, 4) where the board really stood.
        wrong_views: Views whose reported pose is wrong.
        arm: The arm as it was built, Denavit-Hartenberg tables by their names; a, d [m],
            alpha, beta, offset [rad], each (n,).
        options: The cell's options as plain numbers and words, noise levels among them.
    """

    transforms: Mapping[str, FloatArray]
    camera: Camera
    base_from_flange: FloatArray
    cam_from_target: FloatArray
    wrong_views: tuple[int, ...]
    arm: Mapping[str, FloatArray]
    options: Mapping[str, Any]


@typed
def write_session(
    cell: Cell,
    folder: Path | str,
    progress: Callable[[float], None] | None = None,
    *,
    images: bool = True,
) -> Path:
    """Writes a cell as a session's folder, and its truth as `<folder>.truth.json` beside it.

    Args:
        cell: The cell.
        folder: The session's folder; it must not hold anything yet.
        progress: Called with the share that is done, 0 to 1, after each view.
        images: Whether to render images. Without them the session holds pose pairs: cam_from_target
            as a PnP with `pixel_sigma_px` of noise would measure it, and neither camera nor target.

    Returns:
        The session's folder.

    Raises:
        DataError: The folder cannot be written, or the target cannot be drawn.
    """
    folder = Path(folder)
    session = (
        _image_session(cell, folder.name, progress) if images else pairs_session(cell, folder.name)
    )
    session.save(folder)
    write_truth(folder, truth_of(cell))
    if progress is not None:
        progress(1.0)
    return folder


def write_sweep(moved: Sweep, folder: Path | str) -> Path:
    """Writes a sweep as a session's folder, and its truth beside it.

    Each frame is a view with its time and `cam_from_target` as a PnP would measure it, or with its
    corners where the camera takes an image row by row; the robot's poses and joints are in
    `streams/robot.csv`, by another clock.

    Returns:
        The session's folder.

    Raises:
        DataError: The folder cannot be written.
    """
    folder = Path(folder)
    sweep_session(moved, folder.name).save(folder)
    how = moved.options
    clock = {"camera_minus_robot_s": how.camera_minus_robot_s, "readout_s": how.readout_s}
    write_truth(folder, truth_of(moved.cell) | clock)
    return folder


def sweep_session(moved: Sweep, name: str) -> Session:
    """The session of a sweep: frames with measured poses or corners, and the robot's stream."""
    if moved.options.readout_s:
        return _sweep_of_corners(moved, name)
    numbers = [
        {"stamp_s": stamp_s} | {f"cft_{key}": value for key, value in pose_row(pose).items()}
        for stamp_s, pose in zip(moved.frames_s.tolist(), measured_poses(moved.cell), strict=True)
    ]
    views = tuple(View(at, numbers=row) for at, row in enumerate(numbers))
    columns, document = ("view", *numbers[0]), _document(moved.cell, name)
    session = Session(document, columns, views, None, None, MemoryImages({}))
    return session.with_streams({"robot": moved.robot})


def _sweep_of_corners(moved: Sweep, name: str) -> Session:
    """The session of a sweep whose frames have the corners that a detector found in them."""
    cell = moved.cell
    document = {**_document(cell, name), **_targets(cell), "camera": _camera_table(cell)}
    views = [
        View(at, numbers={"stamp_s": it}, has_corners=True)
        for at, it in enumerate(moved.frames_s.tolist())
    ]
    found = CornerTable(
        np.repeat([it.view for it in cell.corners], [len(it.ids) for it in cell.corners]),
        np.concatenate([it.ids for it in cell.corners]),
        np.concatenate([it.px for it in cell.corners]),
        ("",) * sum(len(it.ids) for it in cell.corners),
    )
    session = _session(cell, document, ("view", "stamp_s"), views, MemoryImages({}))
    return replace(session, corner_table=found).with_streams({"robot": moved.robot})


def truth_path(folder: Path | str) -> Path:
    """Where the truth of a simulated session lies: beside its folder, never inside."""
    folder = Path(folder)
    return folder.with_name(f"{folder.name}.truth.json")


def read_truth(path: Path | str) -> Truth:
    """Reads the truth of a simulated session.

    Args:
        path: The session's folder, or its `.truth.json`.

    Raises:
        DataError: The file is missing or is not such a truth.
    """
    path = Path(path)
    if path.suffix != ".json":
        path = truth_path(path)
    text = decode_text(read_bytes(path), str(path))
    try:
        content = json.loads(text)
        camera = content["camera"]
        width, height = camera["resolution"]
        return Truth(
            transforms={key: np.array(value) for key, value in content["transforms"].items()},
            camera=Camera(
                "fisheye" if camera["model"] == "fisheye" else "brown",
                (int(width), int(height)),
                np.array(camera["matrix"], dtype=float),
                np.array(camera["distortion"], dtype=float),
            ),
            base_from_flange=np.array(content["base_from_flange"]),
            cam_from_target=np.array(content["cam_from_target"]),
            wrong_views=tuple(content["wrong_views"]),
            arm={key: np.array(value) for key, value in content["arm"].items()},
            options=content["options"],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is not the truth of a simulated session: {error!r}.", culprits=[str(path)]
        ) from error


def measured_poses(cell: Cell) -> FloatArray:
    """(m, 4, 4) `cam_from_target` as a PnP on the noisy corners of each view would give it.

    It knows the board by its stated size: one that is larger is seen so much nearer.

    The error is drawn from the covariance of a least-squares fit of the pose to the corners that
    are seen, `pixel_sigma_px` squared times the inverse of their Gram matrix.

    Raises:
        DataError: A view shows too few corners for a pose.
    """
    rng = stream(cell.options, Stream.PAIRS)
    draws = rng.standard_normal((len(cell.corners), 6))
    measured = cell.cam_from_target.copy()
    for view, pose in enumerate(cell.cam_from_target):
        sheet = cell.sheets[cell.shown.boards[view]]
        points = corners_m(sheet)
        ids = cell.exact_corners[view].ids
        if ids.size < 4:
            raise DataError(f"simulation: view {view} shows {ids.size} corners, a pose needs 4.")
        camera, sigma_px = cell.options.camera, cell.options.pixel_sigma_px
        measured[view] = noisy_pose(camera, pose, points[ids], sigma_px, draws[view])
        measured[view, :3, 3] /= sheet.scale
    return measured


def noisy_pose(
    camera: Camera,
    cam_from_target: FloatArray,
    points: FloatArray,
    sigma_px: float,
    draws: FloatArray,
) -> FloatArray:
    """A pose (4, 4) with the error of a fit to (n, 3) points that are seen.

    Args:
        camera: The camera.
        cam_from_target: (4, 4) the true pose.
        points: In the target frame [m].
        sigma_px: Noise of the points in the image, per axis [px].
        draws: (6,) white noise.
    """
    # R^-1 maps white noise to noise with the covariance (R^T R)^-1.
    factor = np.linalg.qr(_pose_jacobian(camera, cam_from_target, points), mode="r")
    return cam_from_target @ exp(sigma_px * np.linalg.solve(factor, draws))


def _pose_jacobian(camera: Camera, cam_from_target: FloatArray, points: FloatArray) -> FloatArray:
    """(2n, 6) derivative of the pixels by the pose's right perturbation, by differences."""
    poses = cam_from_target @ _STEPS
    turns, places = np.swapaxes(poses[..., :3, :3], -1, -2), poses[..., None, :3, 3]
    ahead, behind = project(camera, points @ turns + places).reshape(2, 6, -1)
    return np.asarray((ahead - behind).T / (2.0 * _STEP))


def _image_session(cell: Cell, name: str, progress: Callable[[float], None] | None) -> Session:
    suffix = "png" if cell.options.jpeg_quality is None else "jpg"
    scenes = [prepare_scene(cell, board) for board in range(len(cell.sheets))]
    files = {}
    for view, board in enumerate(cell.shown.boards):
        picture = encode(render(scenes[board], view), cell.options.jpeg_quality)
        files[f"images/{view:03d}.{suffix}"] = picture
        if progress is not None:
            progress((view + 1.0) / (len(cell.corners) + 1.0))
    document = {**_document(cell, name), **_targets(cell), "camera": _camera_table(cell)}
    numbers = list(_report_rows(cell))
    views = [
        View(at, image=path, numbers=numbers[at], text=approach_text(cell, at))
        for at, path in enumerate(files)
    ]
    columns = ("view", "image", *numbers[0], *approach_text(cell, 0))
    return _session(cell, document, columns, views, MemoryImages(files))


def pairs_session(cell: Cell, name: str) -> Session:
    """The session of a cell with `cam_from_target` as measured, and neither camera nor target."""
    numbers = [
        {**row, **{f"cft_{key}": value for key, value in pose_row(pose).items()}}
        for row, pose in zip(_report_rows(cell), measured_poses(cell), strict=True)
    ]
    views = [
        View(view, numbers=row, text=approach_text(cell, view)) for view, row in enumerate(numbers)
    ]
    columns = ("view", *numbers[0], *approach_text(cell, 0))
    document = _document(cell, name)
    if len(cell.sheets) > 1:
        return _session(cell, document | _targets(cell), columns, views, MemoryImages({}))
    return Session(document, columns, tuple(views), None, None, MemoryImages({}))


def _session(
    cell: Cell,
    document: Mapping[str, Any],
    columns: tuple[str, ...],
    views: Sequence[View],
    images: MemoryImages,
) -> Session:
    """The session of a cell with its board, or with both of them."""
    target = cell.sheets[0].target
    if len(cell.sheets) == 1:
        return Session(document, columns, tuple(views), target, target_document(target), images)
    targets = {name: it.target for name, it in zip(NAMES, cell.sheets, strict=True)}
    shown = zip(views, cell.shown.stops.tolist(), cell.shown.boards.tolist(), strict=True)
    return Session(
        document,
        ("view", "stop", "target", *columns[1:]),
        tuple(
            replace(view, stop=stop, text={**view.text, "target": NAMES[board]})
            for view, stop, board in shown
        ),
        target,
        {name: target_document(it) for name, it in targets.items()},
        images,
        targets=targets,
    )


def _targets(cell: Cell) -> dict[str, Any]:
    """What session.toml says of the boards."""
    if len(cell.sheets) == 1:
        return {"target": target_place(cell.sheets[0].target, "target.toml")}
    return {
        "targets": {
            name: {"target": target_place(it.target, f"target_{name}.toml")}
            for name, it in zip(NAMES, cell.sheets, strict=True)
        }
    }


def target_place(target: Target, path: str) -> str:
    """Names a board that comes with visioncal, or the file that is written."""
    return target.name if target in (BOARDS["charuco"], BOARDS["checkerboard"]) else path


def _document(cell: Cell, name: str) -> dict[str, Any]:
    return {
        "schema": 1,
        "name": name,
        "mount": cell.options.mount,
        "robot": {"model": cell.arm.name, "tip": "flange"},
    }


def _camera_table(cell: Cell) -> dict[str, Any]:
    stated = camera_table(cell.stated_camera, with_intrinsics=cell.options.state_intrinsics)
    return {"name": "simulated", **stated}


def camera_table(camera: Camera, *, with_intrinsics: bool) -> dict[str, Any]:
    """What session.toml says of a camera."""
    table: dict[str, Any] = {"resolution": list(camera.resolution), "model": camera.model}
    if with_intrinsics:
        table |= {"matrix": camera.matrix.tolist(), "distortion": camera.distortion.tolist()}
    return table


def target_document(target: Target) -> dict[str, Any]:
    """What the file of a board says."""
    if target.kind == "points":
        x_m, y_m, z_m = map(list, zip(*target.points_m, strict=True))
        tags, corners = map(list, zip(*target.point_tags, strict=True))
        points = {"point": list(target.point_numbers), "x_m": x_m, "y_m": y_m, "z_m": z_m}
        points |= {"tag": tags, "corner": corners}
        return {"kind": "points", "dictionary": target.dictionary, "points": points}
    document: dict[str, Any] = {"kind": target.kind}
    if target.kind != "marker":
        document |= {"columns": target.columns, "rows": target.rows}
    document["size_m" if target.kind in ("marker", "aprilgrid") else "square_m"] = target.square_m
    document["square_sigma_m"] = target.square_sigma_m
    if target.dictionary:
        document["dictionary"] = target.dictionary
    if target.marker_id >= 0:
        document["id"] = target.marker_id
    if target.kind == "charuco":
        document |= {"marker_m": target.marker_m, "legacy": target.legacy}
    if target.kind == "circles":
        document |= {"diameter_m": target.diameter_m, "asymmetric": target.asymmetric}
    if target.kind == "aprilgrid":
        document |= {"spacing": target.spacing, "border": target.border}
    return document


def _report_rows(cell: Cell) -> Iterator[dict[str, float]]:
    """The numeric columns of each view: when, with which joints, at which reported pose."""
    for view in range(len(cell.corners)):
        joints = {f"q{i + 1}_rad": float(q) for i, q in enumerate(cell.joints[view])}
        load = load_row(cell.payloads[view]) if cell.payloads else {}
        yield {"stamp_s": _PACE_S * view} | pose_row(cell.base_from_flange[view]) | joints | load


def load_row(load: Payload) -> dict[str, float]:
    """The columns of what the flange carries and is pushed by."""
    centre = {f"payload_{it}_m": at for it, at in zip("xyz", load.centre_m, strict=True)}
    force = {f"force_{it}_n": at for it, at in zip("xyz", load.force_n, strict=True)}
    return {"payload_kg": load.kg} | centre | force


def approach_text(cell: Cell, view: int) -> dict[str, str]:
    """The column of the side from which a stop was approached, where that is recorded."""
    return {} if cell.approach is None else {"approach": "+" if cell.approach[view] > 0 else "-"}


def pose_row(pose: FloatArray) -> dict[str, float]:
    """Seven columns of a pose (4, 4)."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return dict(zip(POSE, map(float, [*pose[:3, 3], *quaternion]), strict=True))


def truth_of(cell: Cell) -> dict[str, Any]:
    """What a truth's file says of a cell."""
    options = asdict(cell.options)
    camera = options.pop("camera")
    arm = asdict(cell.true_arm)
    del arm["name"]
    return {
        "schema": 1,
        "transforms": dict(cell.transforms),
        "camera": camera,
        "wrong_views": cell.wrong_views,
        "options": options,
        "arm": arm,
        "base_from_flange": cell.true_base_from_flange,
        "cam_from_target": cell.cam_from_target,
    }


def write_truth(folder: Path, content: Mapping[str, Any]) -> None:
    """Writes the truth of a session beside its folder; arrays as lists."""
    text = json.dumps(content, indent=1, default=np.ndarray.tolist)
    write_atomically(truth_path(folder), text + "\n")
