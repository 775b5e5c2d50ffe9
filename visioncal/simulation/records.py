"""Simulated cells on disk: the session that calibration reads, and the ground truth beside it.

A single robot with one camera has no names; its session has singular tables.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.codec import Array, WrittenForm, read
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_atomically
from visioncal.core.transforms import apply, exp
from visioncal.core.types import Camera, CameraKind, FloatArray
from visioncal.session import MemoryImages, Session, View, frame_name, target_document
from visioncal.session.columns import POSE, pose_row
from visioncal.session.corners import CornerTable
from visioncal.simulation.boards import BOARDS, corners_m
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.depth import DepthOptions, depth_picture
from visioncal.simulation.layout import CellOptions, RandomStream
from visioncal.simulation.optics import project
from visioncal.simulation.render import RenderScene, encode, prepare_scene, render
from visioncal.simulation.touching import Touching, write_touches

# Content of rows: rendered images, names of images that do not exist, detected corners, or measured
# board poses.
Seen: TypeAlias = Literal["images", "names", "corners", "poses"]
Progress: TypeAlias = Callable[[float], None]

# Sigma of a height that is measured by hand, on arms that leave it open [m].
CALIPER_M = 5e-4
# Step of finite differences, and perturbations forwards and backwards along each axis: (2, 6, 4,
# 4).
_STEP = 1e-6
_STEPS = exp(_STEP * np.stack([np.eye(6), -np.eye(6)]))
# Arrays of an arm, of any shape.
_OF_ARM = WrittenForm(np.ndarray.tolist, lambda value, _: np.array(value, float))


def _camera(stored: Mapping[str, Any], _: str) -> Camera:
    model: CameraKind = "fisheye" if stored["model"] == "fisheye" else "brown"
    (width, height), values = stored["resolution"], (stored["matrix"], stored["distortion"])
    return Camera(model, (int(width), int(height)), *(np.array(at, float) for at in values))


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a simulated session."""

    # True edges by their names in results, each (4, 4).
    transforms: Mapping[str, Annotated[FloatArray, Array((4, 4))]]
    camera: Annotated[Camera, WrittenForm(asdict, _camera)]  # True intrinsics.
    base_from_flange: Annotated[FloatArray, Array((-1, 4, 4))]  # (m, 4, 4) true flange poses.
    cam_from_target: Annotated[FloatArray, Array((-1, 4, 4))]  # (m, 4, 4) true board poses.
    wrong_views: tuple[int, ...]  # Views with a wrong report.
    # Real arm: Denavit-Hartenberg parameters by name; a, d [m], alpha, beta, offset [rad], each
    # (n,), and what bends and waves.
    arm: Mapping[str, Annotated[FloatArray, _OF_ARM]]
    options: Mapping[str, Any]  # Options of the cell as plain values, including noise levels.


def truth_path(folder: Path | str) -> Path:
    """Path of a simulated session's ground truth: beside its folder, never inside."""
    folder = Path(folder)
    return folder.with_name(f"{folder.name}.truth.json")


def read_truth(path: Path | str) -> Truth:
    """Reads the ground truth of a simulated session.

    Args:
        path: Folder of the session, or its `.truth.json`.

    Raises:
        DataError: The file is missing or has other content.
    """
    path = Path(path)
    if path.suffix != ".json":
        path = truth_path(path)
    return read(Truth, parse_stored(read_bytes(path), str(path)), str(path))


def truth_of(cell: SimulatedCell) -> dict[str, Any]:
    """Content of a cell's ground truth file: view by view of one robot, else stop by stop."""
    content: dict[str, Any] = {"schema": 1, "wrong_views": cell.wrong_views}
    if isinstance(cell.options, CellOptions):
        options, arm = asdict(cell.options), asdict(cell.robot.true_arm)
        stops = [sight.stop for sight in cell.sights]
        content |= {
            "transforms": cell.transforms,
            "camera": options.pop("camera"),
            "options": options,
            "arm": {key: value for key, value in arm.items() if key != "name"},
            "base_from_flange": cell.robot.true_base_from_flange[stops],
            "cam_from_target": cell.cam_from_target,
        }
        return content | dict(cell.facts)
    layout, robots = cell.layout, cell.robots
    content |= {
        "parents": cell.parents,
        "transforms": dict(cell.mountings),
        "wrong_stops": {name: robot.wrong_stops for name, robot in robots.items()},
        "moved": [
            {"frame": move.frame, "from_stop": layout.first_pushed(move)} for move in layout.moved
        ],
        "options": asdict(cell.options),
        "arms": {name: asdict(robot.true_arm) for name, robot in robots.items()},
        "base_from_flange": {name: robot.true_base_from_flange for name, robot in robots.items()},
    }
    return content | dict(cell.facts)


def write_truth(folder: Path, content: Mapping[str, Any]) -> None:
    """Writes the ground truth of a session beside its folder; arrays as lists."""
    text = json.dumps(content, indent=1, default=np.ndarray.tolist)
    write_atomically(truth_path(folder), text + "\n")


@typed
def write_session(
    cell: SimulatedCell,
    folder: Path | str,
    progress: Callable[[float], None] | None = None,
    *,
    images: bool = True,
    touched: Mapping[str, Touching] | None = None,
    depth: DepthOptions | None = None,
) -> Path:
    """Writes a cell as a session's folder, with its truth in `<folder>.truth.json` beside it.

    Args:
        cell: The cell.
        folder: Folder of the session; it must be empty or missing.
        progress: Called with the finished share of the images, 0 to 1.
        images: Whether to render images. Otherwise rows have cam_from_target as a PnP with
            `pixel_sigma_px` of noise would measure it, or corners if a camera has a rolling
            shutter.
        touched: Touches of its robots, by robot name.
        depth: A sensor of depth, whose pictures go beside the images.

    Returns:
        The session's folder.

    Raises:
        DataError: The folder cannot be written, or a target cannot be drawn.
    """
    folder = Path(folder)
    without: Seen = "poses" if all(sight.at_once for sight in cell.sights) else "corners"
    seen: Seen = "images" if images else without
    session = cell_session(cell, folder.name, progress, seen=seen, depth=depth)
    session.save(folder)
    truth = truth_of(cell) | ({} if depth is None else {"depth": asdict(depth)})
    if touched:
        write_touches(touched, folder)
        for robot, touching in touched.items():
            truth["transforms"] |= touching.transforms(robot)
    write_truth(folder, truth)
    return folder


def cell_session(
    cell: SimulatedCell,
    name: str,
    progress: Progress | None = None,
    *,
    seen: Seen = "images",
    depth: DepthOptions | None = None,
) -> Session:
    """The session of a cell; see `write_session`.

    With `seen="names"`, `SimulatedCell.corners` are the detections in the images that do not exist.
    With poses of a single camera and board, the session states neither of the two.
    """
    if seen in ("images", "poses") and not all(sight.at_once for sight in cell.sights):
        raise DataError(
            "simulation: images and poses are those of a moment, and a sweep has readout_s.",
            next_step="Leave readout_s out, or write corners: visioncal simulate --no-images.",
        )
    if depth is not None and seen != "images":
        raise DataError(
            "simulation: depth pictures need images.", next_step="Leave --no-images out."
        )
    sights = [sight for sight in cell.sights if not sight.is_of_lens or seen != "poses"]
    poses = measured_poses(cell) if seen == "poses" else [None] * len(sights)
    views = {
        sight.view: _row(cell, sight, seen, pose) for sight, pose in zip(sights, poses, strict=True)
    }
    with_rotation = {item.name for item in cell.layout.instruments if item.sigma_rad}
    for reading in cell.readings:
        robot = cell.robot_of(frame_name("point", reading.point))
        keys = POSE if reading.instrument in with_rotation else POSE[:3]
        read = pose_row(reading.instrument_from_point)
        numbers = {f"meas_{key}": read[key] for key in keys}
        text = {"instrument": reading.instrument, "point": reading.point}
        views[reading.view] = _view(cell, reading.view, reading.stop, robot, numbers, text)
    for number, stop, robot in cell.pose_rows:
        views[number] = _view(cell, number, stop, robot, {}, {})
    if depth is not None:
        for sight in (sight for sight in sights if not sight.is_of_lens):
            row = views[sight.view]
            text = {**row.text, "depth": _depth_name(row.image)}
            views[sight.view] = replace(row, text=text)
    rows = [views[number] for number in sorted(views)]
    texts = dict.fromkeys(key for row in rows for key in row.text)
    robots, boards = cell.layout.robots, cell.layout.boards
    is_named = any([*(robot.name for robot in robots), *(board.name for board in boards)])
    columns = [
        *(["view", "stop"] if is_named else ["view"]),
        *(text for text in texts if text != "approach"),
        *(["image"] if any(row.image for row in rows) else []),
        *dict.fromkeys(key for row in rows for key in row.numbers),
        *(["approach"] if "approach" in texts else []),
    ]
    corners = None
    if seen == "corners":
        corners = CornerTable.of_lists(
            [(sight.view, sight.corners.ids, sight.corners.px) for sight in sights]
        )
    documents = {
        board.name: target_document(board.target)
        for board in boards
        if board.name or seen != "poses"
    }
    single = next(iter(documents.values()), None)
    document = _document(cell, name, seen)
    if depth is not None:
        for camera in [document.get("camera", {}), *document.get("cameras", {}).values()]:
            camera["depth_unit_m"] = depth.unit_m
    return Session.assemble(
        document,
        columns,
        [[row.cell(column) for column in columns] for row in rows],
        MemoryImages(_rendered(cell, progress, depth) if seen == "images" else {}),
        target_document=documents if len(documents) > 1 else single,
        corners=corners,
    ).with_streams(cell.streams)


def _document(cell: SimulatedCell, name: str, seen: Seen) -> dict[str, Any]:
    """Content of session.toml."""
    layout = cell.layout
    document: dict[str, Any] = {"schema": 1, "name": name}
    if any(not camera.name for camera in layout.cameras):
        in_hand = cell.parents["cam"] == "flange"
        document["mount"] = "eye-in-hand" if in_hand else "eye-to-hand"
    if all(robot.arm.is_planar for robot in cell.robots.values()) and "cam" in cell.mountings:
        # An arm that cannot tilt leaves a height open, which is measured by a caliper.
        edge = next(name for name in cell.transforms if name.startswith("flange_from_"))
        wrong_m = CALIPER_M * cell.options.stream(RandomStream.MOUNTING, 1).standard_normal()
        height = {"z_m": float(cell.transforms[edge][2, 3] + wrong_m), "sigma_m": CALIPER_M}
        document["prior"] = {edge: height}
    robots = {robot.name: {"model": robot.robot, "tip": "flange"} for robot in layout.robots}
    cameras: dict[str, dict[str, Any]] = {}
    for camera in layout.cameras:
        lens = cell.stated[camera.name]
        table: dict[str, Any] = {} if camera.name else {"name": "simulated"}
        table |= {"resolution": list(lens.resolution), "model": lens.model}
        if camera.state_intrinsics:
            table |= {"matrix": lens.matrix.tolist(), "distortion": lens.distortion.tolist()}
        cameras[camera.name] = table
    # A board that comes with visioncal, or the file that is written.
    shipped = (BOARDS["charuco"], BOARDS["checkerboard"])
    boards = {
        board.name: {
            "target": board.target.name
            if board.target in shipped
            else f"{frame_name('target', board.name)}.toml"
        }
        for board in layout.boards
    }
    if seen == "poses":
        # Measured poses need neither a single camera's table nor a single board's.
        cameras.pop("", None)
        boards.pop("", None)
    document |= _tables("robot", robots)
    document |= boards[""] if "" in boards else _tables("target", boards)
    document |= _tables("camera", cameras)
    if any(robot.name for robot in layout.robots):
        document["frames"] = {
            frame: parent for frame, parent in cell.parents.items() if not frame.startswith("base")
        }
    instruments = {
        instrument.name: {"sigma_m": instrument.sigma_m}
        | ({"sigma_rad": instrument.sigma_rad} if instrument.sigma_rad else {})
        for instrument in layout.instruments
    }
    return document | _tables("instrument", instruments)


def _tables(kind: str, tables: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of one kind: a singular one without a name, or by names."""
    if not tables:
        return {}
    return {kind: tables[""]} if "" in tables else {f"{kind}s": dict(tables)}


def _row(
    cell: SimulatedCell, sight: SimulatedSight, seen: Seen, measured: FloatArray | None
) -> View:
    """Row of a camera observation, with the measured board pose if given."""
    names = {"camera": sight.camera, "target": sight.board}
    text = {column: name for column, name in names.items() if name}
    numbers = {} if sight.stamp_s is None else {"stamp_s": sight.stamp_s}
    if measured is not None:
        numbers |= {f"cft_{key}": value for key, value in pose_row(measured).items()}
    image = _image_name(cell, sight) if seen in ("images", "names") else ""
    if sight.stamp_s is not None:
        return View(sight.view, image, numbers=numbers, text=text)
    if sight.is_of_lens:
        return View(sight.view, image, text=text | {"role": "intrinsics"})
    frames = frame_name("camera", sight.camera), frame_name("target", sight.board)
    robots = [arm for frame in frames if (arm := cell.robot_of(frame)) is not None]
    robot = robots[0] if len(set(robots)) == len(robots) > 0 else None
    return _view(cell, sight.view, sight.stop, robot, numbers, text, image)


def _view(
    cell: SimulatedCell,
    number: int,
    stop: int,
    robot: str | None,
    numbers: Mapping[str, float],
    text: Mapping[str, str],
    image: str = "",
) -> View:
    """A row of a stop, with a robot's pose and joints."""
    state = {} if cell.stamps_s is None else {"stamp_s": float(cell.stamps_s[stop])}
    words = dict(text)
    if robot is not None:
        robot_state = cell.robots[robot]
        state |= pose_row(robot_state.base_from_flange[stop])
        joints = robot_state.joints[stop].tolist()
        state |= {f"q{at}_rad": angle for at, angle in enumerate(joints, start=1)}
        if robot_state.loads:
            state |= robot_state.loads[stop].row()
        words = ({"robot": robot} if robot else {}) | words
        if robot_state.approach is not None:
            words["approach"] = "+" if robot_state.approach[stop] > 0 else "-"
    return View(number, image, stop=stop, numbers={**state, **numbers}, text=words)


def measured_poses(cell: SimulatedCell) -> FloatArray:
    """`cam_from_target` as a PnP on the noisy corners of each image would estimate it.

    PnP uses the board's stated size, so that a larger board appears closer. The error is drawn from
    the covariance of a least-squares fit of the pose to the visible corners, `pixel_sigma_px`
    squared times the inverse normal matrix.

    Returns:
        (m, 4, 4), for all images except those for intrinsics only.

    Raises:
        DataError: An image shows too few corners for a pose.
    """
    options, sights = cell.options, [sight for sight in cell.sights if not sight.is_of_lens]
    if isinstance(options, CellOptions):
        draws = [*options.stream(RandomStream.PAIRS).standard_normal((len(sights), 6))]
    else:
        numbers = [sight.view for sight in sights]
        draws = [
            options.stream(RandomStream.MEASURED, number).standard_normal(6) for number in numbers
        ]
    measured = []
    for sight, white in zip(sights, draws, strict=True):
        ids, board = sight.exact.ids, cell.board(sight.board)
        if ids.size < 4:
            raise DataError(
                f"simulation: view {sight.view} shows {ids.size} corners, a pose needs 4."
            )
        # Jacobian of the pixels by the pose's right perturbation, by finite differences.
        poses = sight.cam_from_target @ _STEPS
        points = apply(poses, corners_m(board)[ids])
        forward, backward = project(cell.camera(sight.camera).camera, points).reshape(2, 6, -1)
        # R^-1 maps white noise to noise with the covariance (R^T R)^-1.
        factor = np.linalg.qr((forward - backward).T / (2.0 * _STEP), mode="r")
        error = exp(options.pixel_sigma_px * np.linalg.solve(factor, white))
        pose = sight.cam_from_target @ error
        pose[:3, 3] /= board.scale
        measured.append(pose)
    return np.array(measured)


def _image_name(cell: SimulatedCell, sight: SimulatedSight) -> str:
    quality = cell.camera(sight.camera).jpeg_quality
    suffix = "png" if quality is None else "jpg"
    if not sight.camera:
        return f"images/{sight.view:03d}.{suffix}"
    folder = f"lens_{sight.camera}" if sight.is_of_lens else f"images/{sight.camera}"
    return f"{folder}/{sight.view:04d}.{suffix}"


def _depth_name(image: str) -> str:
    """Path of the depth picture beside an image."""
    return str(PurePosixPath("depth", image.removeprefix("images/")).with_suffix(".png"))


def _rendered(
    cell: SimulatedCell, progress: Progress | None, depth: DepthOptions | None
) -> dict[str, bytes]:
    """Renders all images, each with one board, and their depth."""
    scenes: dict[tuple[str, str], RenderScene] = {}
    files: dict[str, bytes] = {}
    for camera in cell.layout.cameras:
        for index, sight in enumerate(
            sight for sight in cell.sights if sight.camera == camera.name
        ):
            key = sight.camera, sight.board
            scene = scenes.get(key) or scenes.setdefault(key, prepare_scene(cell, *key))
            path, image = _image_name(cell, sight), render(scene, index)
            if depth is not None and not sight.is_of_lens:
                rng = cell.options.stream(RandomStream.DEPTH, sight.view)
                distances, image = depth_picture(scene, index, image, depth, rng)
                files[_depth_name(path)] = encode(distances, None)
            files[path] = encode(image, camera.jpeg_quality)
            if progress is not None:
                progress((index + 1) / len(scene.sights))
    return files
