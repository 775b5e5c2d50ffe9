"""Simulated cells of several robots on disk: the session, and the truth beside it."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.session import MemoryImages, Session, View, frame_name
from visioncal.simulation.boards import corners_m
from visioncal.simulation.cell import Cell
from visioncal.simulation.exercise import Exercised
from visioncal.simulation.network import first_pushed
from visioncal.simulation.observed_points import (
    Network,
    Sight,
    board_named,
    camera_named,
    sheet_named,
)
from visioncal.simulation.options import CellOptions
from visioncal.simulation.records import (
    camera_table,
    noisy_pose,
    pose_row,
    target_document,
    target_place,
    write_truth,
)
from visioncal.simulation.render import Scene, encode, prepare_scene, render
from visioncal.simulation.second import Shown
from visioncal.simulation.standing import Stream, stream
from visioncal.simulation.sweep import POSE
from visioncal.simulation.touching import Touching, write_touches

# What rows have of what was seen: rendered images, the names of images that are not there, or the
# board's pose as it was measured.
Seen: TypeAlias = Literal["images", "names", "poses"]


def write_network(
    cell: Network,
    folder: Path | str,
    progress: Callable[[float], None] | None = None,
    *,
    seen: Seen = "images",
    touched: Mapping[str, Touching] | None = None,
    exercised: Mapping[str, Exercised] | None = None,
) -> Path:
    """Writes a cell as a session's folder, and its truth as `<folder>.truth.json` beside it.

    Args:
        cell: The cell.
        folder: The session's folder; it must not hold anything yet.
        progress: Called with the share of the images that is done, 0 to 1.
        seen: What rows have of what was seen.
        touched: What its robots touched, by their names.
        exercised: What their controllers recorded of motions; streams are `ROBOT_MOTION`.

    Returns:
        The session's folder.

    Raises:
        DataError: The folder cannot be written, or a target cannot be drawn.
    """
    folder = Path(folder)
    streams = {
        f"{robot}_{motion}": it
        for robot, done in (exercised or {}).items()
        for motion, it in done.streams.items()
    }
    session = network_session(cell, folder.name, progress, seen=seen)
    session.with_streams({**session.streams, **streams}).save(folder)
    truth = _truth_of(cell)
    if touched:
        write_touches(touched, folder)
        for robot, it in touched.items():
            truth["transforms"] |= it.transforms(robot)
    if exercised:
        truth["dynamics"] = {robot: asdict(it.arm) for robot, it in exercised.items()}
    write_truth(folder, truth)
    return folder


def network_session(
    cell: Network,
    name: str,
    progress: Callable[[float], None] | None = None,
    *,
    seen: Seen = "images",
) -> Session:
    """The session of a cell of several robots; see `write_network`.

    With `seen="names"`, `Network.corners` is what was detected in the images that are not there.
    """
    if seen != "names" and any(it.readout_s for it in cell.options.sweeps):
        raise DataError(
            "simulation: images and poses are those of a moment, and a sweep has readout_s.",
            next_step="Leave readout_s out.",
        )
    lenses = seen != "poses"
    sights = [it for it in cell.sights if lenses or it.stop >= 0 or it.stamp_s is not None]
    views = {it.view: _row(cell, it, seen) for it in sights}
    turned = {it.name for it in cell.options.instruments if it.sigma_rad}
    for reading in cell.readings:
        robot = cell.robot_of(frame_name("point", reading.point))
        keys = POSE if reading.instrument in turned else POSE[:3]
        read = pose_row(reading.instrument_from_point)
        numbers = {f"meas_{key}": read[key] for key in keys}
        text = {"instrument": reading.instrument, "point": reading.point}
        views[reading.view] = _view(cell, reading.view, reading.stop, robot, numbers, text)
    for number, stop, robot in cell.pose_rows:
        views[number] = _view(cell, number, stop, robot, {}, {})
    rows = [views[number] for number in sorted(views)]
    files = _rendered(cell, sights, progress) if seen == "images" else {}
    targets = {it.name: it.target for it in cell.options.boards}
    documents = {it: target_document(target) for it, target in targets.items()}
    single = next(iter(documents.values()), None)
    numbers_used = dict.fromkeys(key for row in rows for key in row.numbers)
    texts_used = dict.fromkeys(key for row in rows for key in row.text)
    images = ("image",) if any(row.image for row in rows) else ()
    columns = ("view", "stop", *texts_used, *images, *numbers_used)
    return Session.assemble(
        _document(cell, name),
        columns,
        [[row.cell(column) for column in columns] for row in rows],
        MemoryImages(files),
        target_document=documents if len(documents) > 1 else single,
    ).with_streams(cell.streams)


def _document(cell: Network, name: str) -> dict[str, Any]:
    options = cell.options
    document: dict[str, Any] = {
        "schema": 1,
        "name": name,
        "robots": {it.name: {"model": it.robot, "tip": "flange"} for it in options.robots},
        "cameras": {
            it.name: camera_table(it.camera, with_intrinsics=it.state_intrinsics)
            for it in options.cameras
        },
        "targets": {
            it.name: {"target": target_place(it.target, f"target_{it.name}.toml")}
            for it in options.boards
        },
        "frames": {it: on for it, on in cell.parents.items() if not it.startswith("base")},
    }
    if options.instruments:
        document["instruments"] = {
            it.name: {"sigma_m": it.sigma_m} | ({"sigma_rad": it.sigma_rad} if it.sigma_rad else {})
            for it in options.instruments
        }
    return document


def _row(cell: Network, sight: Sight, seen: Seen) -> View:
    """The row of what a camera saw."""
    text = {"camera": sight.camera, "target": sight.board}
    timed = {} if sight.stamp_s is None else {"stamp_s": sight.stamp_s}
    if timed and seen != "poses":
        return View(sight.view, image=_image(sight), numbers=timed, text=text)
    if sight.stop < 0 and not timed:
        return View(sight.view, image=_image(sight), text=text | {"role": "intrinsics"})
    frames = frame_name("camera", sight.camera), frame_name("target", sight.board)
    robots = [it for frame in frames if (it := cell.robot_of(frame)) is not None]
    robot = robots[0] if len(set(robots)) == len(robots) > 0 else None
    if seen != "poses":
        return _view(cell, sight.view, sight.stop, robot, {}, text, _image(sight))
    sigma_px = cell.options.pixel_sigma_px
    draws = stream(cell.options, Stream.PAIRS, sight.view).standard_normal(6)
    points = corners_m(sheet_named(cell.options, sight.board))[sight.exact.ids]
    optics = camera_named(cell.options, sight.camera).camera
    pose = noisy_pose(optics, sight.cam_from_target, points, sigma_px, draws)
    measured = {f"cft_{key}": value for key, value in pose_row(pose).items()}
    if timed:
        return View(sight.view, numbers=timed | measured, text=text)
    return _view(cell, sight.view, sight.stop, robot, measured, text)


def _view(
    cell: Network,
    number: int,
    stop: int,
    robot: str | None,
    numbers: Mapping[str, float],
    text: Mapping[str, str],
    image: str = "",
) -> View:
    """A row of a stop, with a robot's pose and joints."""
    pace_s = cell.options.pace_s
    state: dict[str, float] = {"stamp_s": stop * pace_s} if pace_s else {}
    named: dict[str, str] = {}
    if robot is not None:
        state |= pose_row(cell.base_from_flange[robot][stop])
        joints = cell.joints[robot][stop].tolist()
        state |= {f"q{at}_rad": angle for at, angle in enumerate(joints, start=1)}
        named = {"robot": robot}
    return View(number, image, stop=stop, numbers=state | dict(numbers), text=named | dict(text))


def _image(sight: Sight) -> str:
    of_lens = sight.stop < 0 and sight.stamp_s is None
    folder = f"lens_{sight.camera}" if of_lens else f"images/{sight.camera}"
    return f"{folder}/{sight.view:04d}.png"


def _rendered(
    cell: Network, sights: list[Sight], progress: Callable[[float], None] | None
) -> dict[str, bytes]:
    """Takes the pictures, each of which shows one board."""
    files: dict[str, bytes] = {}
    for camera, board in dict.fromkeys((it.camera, it.board) for it in sights):
        mine = [it for it in sights if (it.camera, it.board) == (camera, board)]
        scene = _scene(cell, camera, board, np.array([it.cam_from_target for it in mine]))
        for at, sight in enumerate(mine):
            files[_image(sight)] = encode(render(scene, at), None)
            if progress is not None:
                progress(len(files) / len(sights))
    return files


def _scene(cell: Network, camera: str, board: str, poses: FloatArray) -> Scene:
    """A cell of one camera and one board, as it is drawn."""
    options = cell.options
    sheet = sheet_named(options, board)
    places = (
        [it.name for it in options.cameras].index(camera),
        options.boards.index(board_named(options, board)),
    )
    drawing = CellOptions(
        views=len(poses),
        target=sheet.target,
        camera=camera_named(options, camera).camera,
        seed=seed_of(options.seed, *places),
    )
    robot = next(iter(cell.arms))
    exact = tuple(it.exact for it in cell.sights if (it.camera, it.board) == (camera, board))
    none = np.tile(np.eye(4), (len(poses), 1, 1))
    return prepare_scene(
        Cell(
            options=drawing,
            arm=cell.arms[robot],
            true_arm=cell.true_arms[robot],
            sheet=sheet,
            stated_camera=drawing.camera,
            transforms={},
            joints=np.zeros((len(poses), cell.arms[robot].a.size)),
            base_from_flange=none,
            true_base_from_flange=none,
            cam_from_target=poses,
            exact_corners=exact,
            corners=exact,
            wrong_views=(),
            sheets=(sheet,),
            shown=Shown(np.arange(len(poses)), np.zeros(len(poses), dtype=np.int64)),
        )
    )


def seed_of(*numbers: int) -> int:
    """One seed of several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def _truth_of(cell: Network) -> dict[str, Any]:
    return {
        "schema": 1,
        "parents": cell.parents,
        "transforms": dict(cell.transforms),
        "wrong_views": cell.wrong_views,
        "moved": [
            {"frame": it.frame, "from_stop": first_pushed(cell.options, it)}
            for it in cell.options.moved
        ],
        "options": asdict(cell.options),
        "arms": {name: asdict(arm) for name, arm in cell.true_arms.items()},
        "base_from_flange": cell.true_base_from_flange,
    }
