"""Small sound inputs of every kind that a command reads, made when they are asked for."""

import io
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from unittest.mock import patch

import numpy as np
import rerun as rr
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support import foreign_samples as foreign
from support.commands import turned_poses, visioncal, write_poses, write_table
from support.placed import FLANGE_FROM_TOOL, alone, fixture, tool
from support.samples import HOME_RAD
from support.touched import TIP, Job, touched

from visioncal.core.types import FloatArray
from visioncal.robot import load_robot
from visioncal.simulation import (
    BOARDS,
    BoardAt,
    CameraAt,
    CellOptions,
    NetworkOptions,
    RobotAt,
    simulate,
    wide_camera,
    write_session,
)
from visioncal.simulation.dynamics import (
    LinkBody,
    Senses,
    exercise_session,
    multi_sine,
    real_dynamics,
    record,
)
from visioncal.simulation.instrument_session import InstrumentOptions, session_of, tracked

CAMERA = replace(wide_camera(), resolution=(640, 400), matrix=wide_camera().matrix / 2)
VIEWS = 7
BOARD = CellOptions(views=VIEWS, camera=CAMERA, state_intrinsics=False)
PLAN = (
    "--stops 4 --target charuco_9x6_30mm --camera 1000,1000,640,400 --resolution 1280,800 --cam "
    "'0 -60 60 0 0 0' --board '500 0 5 180 0 0' --guess-deg 2 --candidates 30"
)
DRAWING_MM = np.array([[0, 0, 0], [300, 0, 0], [300, 200, 0], [0, 200, 0], [150, 60, 40]])
PLACE_M = np.array([0.5, 0.1, 0.0])
LOAD = LinkBody(2.8, np.array([0.02, -0.03, 0.08]), np.diag([0.012, 0.01, 0.008]))


class Inputs:
    """The folder that the sound inputs are in; each is made once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __getitem__(self, name: str) -> Path:
        path = self.folder / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            MAKERS[name](self, path)
        return path


def _done(*words: object) -> None:
    done = visioncal(*words)
    if done.status not in (0, 3):
        raise RuntimeError(f"{words}: {done.err}")


def _command(*words: str) -> Callable[[Inputs, Path], None]:
    """A maker: a command with names of inputs in brackets, and what it writes last."""

    def make(inputs: Inputs, path: Path) -> None:
        _done(*(inputs[word[1:-1]] if word.startswith("[") else word for word in words), path)

    return make


def _board(_: Inputs, path: Path) -> None:
    write_session(simulate(BOARD), path)


@cache
def typed() -> str:
    """What is typed to `record` at each picture of the board: take it, its pose, it is right."""
    lines = []
    for pose in simulate(BOARD).robot.base_from_flange:
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        lines += ["", f"p[{', '.join(f'{value:.6f}' for value in [*pose[:3, 3], *turn])}]", ""]
    return "\n".join([*lines, "q", ""])


def _pairs(_: Inputs, path: Path) -> None:
    _done("simulate", path, "--no-images", "--views", 12)
    # The text of a truth beside it would be nobody's input.
    path.with_name(path.name + ".truth.json").unlink()


def _held(_: Inputs, path: Path) -> None:
    """A board on the flange, before a camera that stands."""
    options = CellOptions(mount="eye-to-hand", views=VIEWS)
    write_session(simulate(options), path)


def _arm(_: Inputs, path: Path) -> None:
    _done(
        "simulate", path, "--no-images", "--views", 30, "--arm-sigma-mm", 0.5, "--arm-sigma-mrad", 1
    )
    path.with_name(path.name + ".truth.json").unlink()


def _sweep(_: Inputs, path: Path) -> None:
    _done("simulate", path, "--sweep")
    path.with_name(path.name + ".truth.json").unlink()


def _warm(_: Inputs, path: Path) -> None:
    _done("simulate", path, "--warm-up")
    path.with_name(path.name + ".truth.json").unlink()


def _tracked(_: Inputs, path: Path) -> None:
    session_of(tracked(InstrumentOptions(stops=20))).save(path)


def _network(_: Inputs, path: Path) -> None:
    plain = replace(BOARDS["checkerboard"], name="6x5", columns=6, rows=5)
    cameras = (
        CameraAt("left", place_m=(0.0, -0.5, 0.9), camera=CAMERA),
        CameraAt("right", place_m=(0.1, 0.45, 0.95), camera=CAMERA),
    )
    options = NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)), RobotAt("b", (0.6, 0.05, 0.02))),
        cameras=cameras,
        boards=(
            BoardAt("plate_a", "a", target=plain),
            BoardAt(
                "plate_b", "b", target=replace(BOARDS["charuco"], name="5x4", columns=5, rows=4)
            ),
        ),
        stops=12,
    )
    write_session(simulate(options), path)
    path.with_name(path.name + ".truth.json").unlink()


def _motions(_: Inputs, path: Path) -> None:
    _exercised(path, {"excite": 5.0, "check": 4.0})


def _loaded(_: Inputs, path: Path) -> None:
    _exercised(path, {"loaded": 5.0}, LOAD)


def _currents(load: LinkBody | None) -> Callable[[Inputs, Path], None]:
    senses = Senses(gains_nm_a=(20.0, 21.0, 16.0, 9.0, 9.5, 8.7))
    return lambda _, path: _exercised(path, {"excite": 5.0}, load, senses)


def _exercised(
    path: Path,
    motions: dict[str, float],
    load: LinkBody | None = None,
    senses: Senses | None = None,
) -> None:
    """Motions of so many seconds, by name."""
    rng = np.random.default_rng(0)
    built = real_dynamics("ur10e", rng)
    built = built if load is None else built.carrying(load)
    done = {name: multi_sine(6, rng, seconds=motion) for name, motion in motions.items()}
    runs = {name: record(built, exercise, rng, senses) for name, exercise in done.items()}
    exercise_session("ur10e", runs).save(path)


def _touches(_: Inputs, path: Path) -> None:
    made = touched(Job(axes=3), 1).touches
    write_poses(path, made.base_from_flange, {"kind": list(made.kinds)})


def _joints(_: Inputs, path: Path) -> None:
    """Joint angles at which the tip is at one point, each another way."""
    robot, rng = load_robot("ur10e"), np.random.default_rng(4)

    def tip(joints: FloatArray) -> FloatArray:
        return np.asarray(robot.base_from_flange(joints[None])[0, :3] @ np.append(TIP, 1.0))

    starts = HOME_RAD + rng.uniform(-0.4, 0.4, (8, 6))
    rows = [
        least_squares(lambda value: tip(value) - tip(HOME_RAD), start).x.tolist()
        for start in starts
    ]
    write_table(path, [f"q{index}_rad" for index in range(1, 7)], rows)


def _features(_: Inputs, path: Path) -> None:
    places = 1e-3 * np.array([[0, 0, 0], [250, 0, 0], [300, 0, 0], [100, 200, 0], [200, 150, 0]])
    rng = np.random.default_rng(2)
    poses = turned_poses(rng, places + PLACE_M, FLANGE_FROM_TOOL[:3, 3], np.eye(3))
    write_poses(path, poses, {"kind": ["origin", "x", "x", "xy", "xy"]})


def _points(_: Inputs, path: Path) -> None:
    places = 1e-3 * DRAWING_MM + PLACE_M
    poses = turned_poses(np.random.default_rng(3), places, FLANGE_FROM_TOOL[:3, 3], np.eye(3))
    write_poses(path, poses, {"point": [f"P{index}" for index in range(len(poses))]})


def _drawing(_: Inputs, path: Path) -> None:
    names = [f"P{index}" for index in range(len(DRAWING_MM))]
    write_table(path, ("x_mm", "y_mm", "z_mm"), DRAWING_MM.tolist(), {"point": names})


def _targets(_: Inputs, path: Path) -> None:
    q = HOME_RAD + np.random.default_rng(1).uniform(-0.3, 0.3, (6, 6))
    columns = {f"q{at + 1}_rad": q[:, at].tolist() for at in range(6)}
    write_poses(path, load_robot("ur10e").base_from_flange(q), columns)


def _frames(_: Inputs, path: Path) -> None:
    alone(tool(), fixture()).save(path)


def _packaged(name: str) -> Callable[[Inputs, Path], None]:
    return lambda _, path: path.write_bytes((files("visioncal") / name).read_bytes()) and None


def _target(_: Inputs, path: Path) -> None:
    path.write_text(
        'kind = "charuco"\ncolumns = 9\nrows = 6\nsquare_m = 0.03\nsquare_sigma_m = 1e-05\n'
        'marker_m = 0.022\ndictionary = "DICT_5X5_100"\nlegacy = false\n'
    )


def _photo(inputs: Inputs, path: Path) -> None:
    shutil.copyfile(inputs["board"] / "images" / "000.png", path)


def _pictures(inputs: Inputs, path: Path) -> None:
    shutil.copytree(inputs["board"] / "images", path)


def _recorded(inputs: Inputs, path: Path) -> None:
    """A session that was recorded from typed poses."""
    words = ["--arm", "manual", "--camera", f"folder:{inputs['pictures']}"]
    with patch.object(sys, "stdin", io.StringIO(typed())):
        _done("record", "-o", path, *words, "--target", "charuco_9x6_30mm")


def _others_rrd(_: Inputs, path: Path) -> None:
    """A recording of another program."""
    stream = rr.RecordingStream("another", recording_id="another")
    stream.save(path)
    stream.log("world/points", rr.Points3D([[0, 0, 0], [1, 1, 1]]))
    stream.flush()
    stream.disconnect()


def _foreign(name: str) -> Callable[[Inputs, Path], None]:
    """A recording in the form of others; a file of a folder of its own."""

    def make(_: Inputs, path: Path) -> None:
        (foreign.RECORDINGS | foreign.MORE_RECORDINGS)[name](path)

    return make


def _oak(inputs: Inputs, path: Path) -> None:
    _done("export", inputs["board_out"], "--to", "oak", "-o", path)


def _lens(inputs: Inputs, path: Path) -> None:
    _done("export", inputs["board_out"], "--to", "camera-info", "-o", path)


MAKERS: Mapping[str, Callable[[Inputs, Path], None]] = {
    "board": _board,
    "board.rrd": _command("convert", "[board]"),
    "board_out": _command("calibrate", "[board]", "-o"),
    "pairs": _pairs,
    "pairs.rrd": _command("convert", "[pairs]"),
    "out": _command("calibrate", "[pairs]", "-o"),
    "held": _held,
    "held_out": _command("calibrate", "[held]", "-o"),
    "arm": _arm,
    "arm_out": _command("calibrate", "[arm]", "-o"),
    "sweep": _sweep,
    "warm": _warm,
    "warm_out": _command("calibrate", "[warm]", "-o"),
    "tracked": _tracked,
    "network": _network,
    "network_out": _command("calibrate", "[network]", "-o"),
    "motions": _motions,
    "loaded": _loaded,
    "currents/empty": _currents(None),
    "currents/loaded": _currents(LOAD),
    "dynamics_out": _command("dynamics", "identify", "[motions]", "-o"),
    "plan": _command("plan", "ur5e", *shlex.split(PLAN), "-o"),
    "touches.csv": _touches,
    "joints.csv": _joints,
    "features.csv": _features,
    "points.csv": _points,
    "drawing.csv": _drawing,
    "targets.csv": _targets,
    "frames.json": _frames,
    "arm.toml": _packaged("robot/models/ur10e.toml"),
    "arm.json": _command("export", "[arm_out]", "--to", "robot-json", "-o"),
    "arm.urdf": _command("export", "[arm_out]", "--to", "robot-urdf", "-o"),
    "target.toml": _target,
    "photo.png": _photo,
    "pictures": _pictures,
    "recorded": _recorded,
    "another.rrd": _others_rrd,
    "oak.json": _oak,
    "lens.yaml": _lens,
} | {
    f"foreign/{recording}": _foreign(recording)
    for recording in (*foreign.RECORDINGS, *foreign.MORE_RECORDINGS)
}
