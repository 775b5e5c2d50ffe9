"""Sessions whose corners come from elsewhere, made by numpy and OpenCV's projectPoints alone."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

RESOLUTION = (1280, 960)
MATRIX = (1150.0, 1152.0, 645.0, 471.0)
DISTORTION = (-0.12, 0.06, 0.0004, -0.0003, 0.0)
# What a sound arm repeats to, per axis.
ROBOT_MM, ROBOT_DEG = 0.05, 0.005


def _grid(columns: int, rows: int, side_m: float, inset: int) -> np.ndarray:
    return np.array(
        [
            [(i + inset) * side_m, (j + inset) * side_m, 0.0]
            for j in range(rows)
            for i in range(columns)
        ]
    )


def _cube() -> np.ndarray:
    """Points on three faces of a cube of 160 mm, all of which a camera may see at once."""
    steps = np.linspace(-0.08, 0.08, 4)
    faces = [[a, b, -0.08] for a in steps for b in steps]
    faces += [[a, -0.08, b] for a in steps for b in steps[1:]]
    return np.array(faces + [[-0.08, a, b] for a in steps[1:] for b in steps[1:]])


# The corners of each target in its frame [m], in the order of their numbers.
PLACES = {
    "charuco": _grid(8, 5, 0.03, 1),
    "checkerboard": _grid(8, 5, 0.025, 0),
    "marker": 0.06 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
    # In the plane y = 20 mm of its frame.
    "flat": np.insert(_grid(5, 4, 0.05, 0)[:, [1, 0]], 1, 0.02, axis=1),
    "cube": _cube(),
}
_TOML = {
    "charuco": 'kind = "charuco"\ncolumns = 9\nrows = 6\nsquare_m = 0.03\nmarker_m = 0.022\n'
    'dictionary = "DICT_5X5_100"\nsquare_sigma_m = 1e-7\n',
    "checkerboard": 'kind = "checkerboard"\ncolumns = 8\nrows = 5\nsquare_m = 0.025\n'
    "square_sigma_m = 1e-7\n",
    "marker": 'kind = "marker"\nid = 0\nsize_m = 0.12\ndictionary = "DICT_4X4_50"\n'
    "square_sigma_m = 1e-7\n",
}
# A rig's points have numbers of their own, in no order.
NUMBERS = {name: 700 - 3 * np.arange(len(it)) for name, it in PLACES.items() if name not in _TOML}


@dataclass(frozen=True)
class Rig:
    """How a session is made.

    Attributes:
        kind: Of the target, among `PLACES`.
        mount: Where the camera is.
        seed: Of all that is random.
        views: How many.
        noise_px: Of a corner's coordinate.
        uneven: Whether every other corner errs by five times as much.
        sigma: By how much the column sigma_px is off the truth; None for none.
        lens: Whether the lens is given.
        mode: Of the given lens.
    """

    kind: str = "cube"
    mount: str = "eye-in-hand"
    seed: int = 0
    views: int = 15
    noise_px: float = 0.2
    uneven: bool = False
    sigma: float | None = None
    lens: bool = True
    mode: str = "hold"


def write_target(folder: Path, kind: str, name: str = "target") -> str:
    """Writes a target's file, and its table where it is a rig."""
    path = folder / f"{name}.toml"
    if kind in _TOML:
        path.write_text(_TOML[kind])
        return path.name
    path.write_text(f'kind = "points"\npoints = "{name}.csv"\n')
    rows = zip(NUMBERS[kind], PLACES[kind].tolist(), strict=True)
    lines = [f"{number},{x!r},{y!r},{z!r}" for number, (x, y, z) in rows]
    (folder / f"{name}.csv").write_text("\n".join(["point,x_m,y_m,z_m", *lines, ""]))
    return path.name


def numbers_of(kind: str) -> np.ndarray:
    """The numbers that corners.csv has for a target's corners."""
    return NUMBERS.get(kind, np.arange(len(PLACES[kind])))


def _pose(translation, rotvec) -> RigidTransform:
    return RigidTransform.from_components(translation, Rotation.from_rotvec(rotvec))


def looks(rig: Rig, rng: np.random.Generator) -> list[RigidTransform]:
    """`cam_from_target` of the views: aimed at the target's middle, tilted and turned."""
    middle = PLACES[rig.kind].mean(axis=0)
    axis = Rotation.from_rotvec([np.pi / 2, 0, 0]) if rig.kind == "flat" else Rotation.identity()
    if rig.kind == "cube":
        # Its three faces look along the diagonal.
        axis = Rotation.align_vectors([[0.0, 0, 1]], [[1.0, 1, 1]])[0]
    found = []
    for _ in range(rig.views):
        tilt, turn = np.deg2rad(rng.uniform(12, 35)), rng.uniform(-np.pi, np.pi)
        aside = Rotation.from_rotvec(tilt * np.array([np.cos(turn), np.sin(turn), 0.0]))
        spun = Rotation.from_rotvec([0, 0, rng.uniform(-1.5, 1.5)])
        rotation = spun * aside * axis
        there = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.4, 0.6)])
        found.append(RigidTransform.from_components(there - rotation.apply(middle), rotation))
    return found


def truth(mount: str) -> tuple[RigidTransform, RigidTransform]:
    """Both edges, camera's and target's."""
    in_hand, stands = (
        _pose([0.03, -0.05, 0.09], [0.1, -0.05, 1.3]),
        _pose([0.6, 0.1, 0.05], [2.9, 0.4, -0.2]),
    )
    return (in_hand, stands) if mount == "eye-in-hand" else (stands, in_hand)


def flange_poses(mount: str, seen: list[RigidTransform]) -> list[RigidTransform]:
    """`base_from_flange` by which the camera sees the target so."""
    x, z = truth(mount)
    if mount == "eye-in-hand":
        return [z * it.inv() * x.inv() for it in seen]
    return [x * it * z.inv() for it in seen]


def pixels(kind: str, cam_from_target: RigidTransform) -> np.ndarray:
    """(c, 2) where the target's corners are seen."""
    fx, fy, cx, cy = MATRIX
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    px, _ = cv2.projectPoints(
        PLACES[kind],
        cam_from_target.rotation.as_rotvec(),
        cam_from_target.translation,
        matrix,
        np.array(DISTORTION),
    )
    return px.reshape(-1, 2)


def write_session(folder: Path, rig: Rig) -> Path:
    """Writes a session of one target, without any image."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(rig.seed)
    seen = looks(rig, rng)
    stated = f"matrix = {list(MATRIX)}\ndistortion = {list(DISTORTION)}\n" if rig.lens else ""
    mode = f'intrinsics = "{rig.mode}"\n' if rig.lens else ""
    (folder / "session.toml").write_text(
        f'schema = 1\nname = "{rig.kind}"\nmount = "{rig.mount}"\n'
        f'target = "{write_target(folder, rig.kind)}"\n[camera]\n'
        f"resolution = {list(RESOLUTION)}\n{stated}{mode}"
    )
    views, corners = ["view,x_m,y_m,z_m,qx,qy,qz,qw"], ["view,point,u_px,v_px"]
    if rig.sigma is not None:
        corners[0] += ",sigma_px"
    numbers = numbers_of(rig.kind)
    for at, (pose, there) in enumerate(zip(seen, flange_poses(rig.mount, seen), strict=True)):
        off = _pose(
            1e-3 * ROBOT_MM * rng.normal(size=3), np.deg2rad(ROBOT_DEG) * rng.normal(size=3)
        )
        told = there * off
        cells = [*told.translation.tolist(), *told.rotation.as_quat().tolist()]
        views.append(",".join([str(at), *map(repr, cells)]))
        px = pixels(rig.kind, pose)
        sigma = rig.noise_px * np.where(rig.uneven & (np.arange(len(px)) % 2 == 1), 5.0, 1.0)
        px = px + sigma[:, None] * rng.normal(size=px.shape)
        for point in rng.permutation(len(px)).tolist():
            row = [str(at), str(numbers[point]), *map(repr, px[point].tolist())]
            if rig.sigma is not None:
                row.append(repr(float(rig.sigma * sigma[point])))
            corners.append(",".join(row))
    (folder / "views.csv").write_text("\n".join([*views, ""]))
    (folder / "corners.csv").write_text("\n".join([*corners, ""]))
    return folder
