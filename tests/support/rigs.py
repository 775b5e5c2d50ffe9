"""Sessions whose corners come from elsewhere, made by numpy and OpenCV's projectPoints alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

RESOLUTION = (1280, 960)
MATRIX = (1150.0, 1152.0, 645.0, 471.0)
DISTORTION = (-0.12, 0.06, 0.0004, -0.0003, 0.0)
LENS = f"matrix = {list(MATRIX)}\ndistortion = {list(DISTORTION)}\n"
NOISE_PX = 0.2
# What a sound arm repeats to, per axis.
ROBOT_MM, ROBOT_DEG = 0.05, 0.005


def _grid(columns: int, rows: int, side_m: float, inset: int) -> np.ndarray:
    places = [[i + inset, j + inset, 0.0] for j in range(rows) for i in range(columns)]
    return side_m * np.array(places)


def _cube() -> np.ndarray:
    """Points on three faces of a cube of 160 mm, all of which a camera may see at once."""
    steps = np.linspace(-0.08, 0.08, 4)
    faces = [[a, b, -0.08] for a in steps for b in steps]
    faces += [[a, -0.08, b] for a in steps for b in steps[1:]]
    return np.array(faces + [[-0.08, a, b] for a in steps[1:] for b in steps[1:]])


# The corners of each target in its frame [m], in the order of their numbers. The flat rig lies in
# the plane y = 20 mm; the plate is a little uneven.
PLACES = {
    "charuco": _grid(8, 5, 0.03, 1),
    "checkerboard": _grid(8, 5, 0.025, 0),
    "marker": 0.06 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
    "flat": np.insert(_grid(5, 4, 0.05, 0)[:, [1, 0]], 1, 0.02, axis=1),
    "plate": _grid(6, 5, 0.04, 0) + np.outer(np.sin(np.arange(30)), [0, 0, 0.003]),
    "cube": _cube(),
}
# Where each shows its face to the camera.
FACES = {
    "flat": Rotation.from_rotvec([np.pi / 2, 0, 0]),
    "cube": Rotation.align_vectors([[0.0, 0, 1]], [[1.0, 1, 1]])[0],
}
PRINTED = {
    "charuco": "columns = 9\nrows = 6\nsquare_m = 0.03\nmarker_m = 0.022\n"
    'dictionary = "DICT_5X5_100"\n',
    "checkerboard": "columns = 8\nrows = 5\nsquare_m = 0.025\n",
    "marker": 'id = 0\nsize_m = 0.12\ndictionary = "DICT_4X4_50"\n',
}


def numbers_of(kind: str) -> np.ndarray:
    """The numbers that corners.csv has for a target's corners; a rig's are its own."""
    count = len(PLACES[kind])
    return np.arange(count) if kind in PRINTED else 700 - 3 * np.arange(count)


def write_target(folder: Path, kind: str, name: str, sigma_m: float = 0.0, seed: int = 0) -> str:
    """Writes a target's file, and a rig's table with places that are known to so much."""
    path = folder / f"{name}.toml"
    if kind in PRINTED:
        path.write_text(f'kind = "{kind}"\n{PRINTED[kind]}square_sigma_m = 1e-7\n')
        return path.name
    path.write_text(f'kind = "points"\npoints = "{name}.csv"\n')
    off = sigma_m * np.random.default_rng(seed + 10_000).normal(size=PLACES[kind].shape)
    rows = zip(numbers_of(kind), (PLACES[kind] + off).tolist(), strict=True)
    lines = [",".join([str(number), *map(repr, place)]) for number, place in rows]
    header = "point,x_m,y_m,z_m"
    if sigma_m:
        header, lines = f"{header},sigma_m", [f"{line},{sigma_m!r}" for line in lines]
    (folder / f"{name}.csv").write_text("\n".join([header, *lines, ""]))
    return path.name


def pose(translation: Sequence[float], rotvec: Sequence[float]) -> RigidTransform:
    return RigidTransform.from_components(translation, Rotation.from_rotvec(rotvec))


def truth(mount: str) -> tuple[RigidTransform, RigidTransform]:
    """Both edges, camera's and target's."""
    in_hand = pose([0.03, -0.05, 0.09], [0.1, -0.05, 1.3])
    stands = pose([0.6, 0.1, 0.05], [2.9, 0.4, -0.2])
    return (in_hand, stands) if mount == "eye-in-hand" else (stands, in_hand)


def base_from_flange(mount: str, cam_from_target: RigidTransform) -> RigidTransform:
    """Where the flange stands when the camera sees the target so."""
    x, z = truth(mount)
    if mount == "eye-in-hand":
        return z * cam_from_target.inv() * x.inv()
    return x * cam_from_target * z.inv()


def looks(kind: str, count: int, rng: np.random.Generator) -> list[RigidTransform]:
    """`cam_from_target` of views: aimed at the target's middle, tilted and turned."""
    middle, found = PLACES[kind].mean(axis=0), []
    for _ in range(count):
        tilt, turn = np.deg2rad(rng.uniform(12, 35)), rng.uniform(-np.pi, np.pi)
        aside = Rotation.from_rotvec(tilt * np.array([np.cos(turn), np.sin(turn), 0.0]))
        spun = Rotation.from_rotvec([0, 0, rng.uniform(-1.5, 1.5)])
        rotation = spun * aside * FACES.get(kind, Rotation.identity())
        there = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.4, 0.6)])
        found.append(RigidTransform.from_components(there - rotation.apply(middle), rotation))
    return found


@dataclass(frozen=True)
class Shot:
    """One row of views.csv."""

    flange: RigidTransform  # `base_from_flange`, as it was.
    # The kind of each target and `cam_from_target`, by the target's name.
    seen: Mapping[str, tuple[str, RigidTransform]]
    cells: Mapping[str, str] = field(default_factory=dict)  # Other columns.
    sigma_px: float = NOISE_PX  # Noise of the corners; every other one's is `uneven` times that.
    uneven: float = 1.0


def write_shots(
    folder: Path,
    document: str,
    shots: Sequence[Shot],
    seed: int = 0,
    stated: float | None = None,
    *,
    named: bool = False,
) -> Path:
    """Writes a session's tables.

    Args:
        folder: Where to.
        document: Its session.toml.
        shots: Its views.
        seed: Of the noise.
        stated: By how much sigma_px is off the truth; None for none.
        named: Whether corners.csv names the targets.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    (folder / "session.toml").write_text(document)
    views = [",".join(["view", *shots[0].cells, "x_m,y_m,z_m,qx,qy,qz,qw"])]
    columns = ["view", "point", "u_px", "v_px", *(["target"] if named else [])]
    corners = [",".join([*columns, *([] if stated is None else ["sigma_px"])])]
    for at, shot in enumerate(shots):
        off = pose(1e-3 * ROBOT_MM * rng.normal(size=3), np.deg2rad(ROBOT_DEG) * rng.normal(size=3))
        told = shot.flange * off
        numbers = [*told.translation.tolist(), *told.rotation.as_quat().tolist()]
        views.append(",".join([str(at), *shot.cells.values(), *map(repr, numbers)]))
        for name, (kind, there) in shot.seen.items():
            px = pixels(kind, there)
            odd = np.arange(len(px)) % 2 == 1
            sigma = shot.sigma_px * np.where(odd, shot.uneven, 1.0)
            px = px + sigma[:, None] * rng.normal(size=px.shape)
            inside = np.all((px > 0) & (px < RESOLUTION), axis=1)
            for point in rng.permutation(np.flatnonzero(inside)).tolist():
                cells = [str(at), str(numbers_of(kind)[point]), *map(repr, px[point].tolist())]
                cells += [name] if named else []
                cells += [] if stated is None else [repr(stated * float(sigma[point]))]
                corners.append(",".join(cells))
    (folder / "views.csv").write_text("\n".join([*views, ""]))
    (folder / "corners.csv").write_text("\n".join([*corners, ""]))
    return folder


def pixels(kind: str, cam_from_target: RigidTransform) -> np.ndarray:
    """(c, 2) where the target's corners are seen."""
    fx, fy, cx, cy = MATRIX
    turn, there = cam_from_target.rotation.as_rotvec(), cam_from_target.translation
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    px, _ = cv2.projectPoints(PLACES[kind], turn, there, matrix, np.array(DISTORTION))
    return px.reshape(-1, 2)


@dataclass(frozen=True)
class Rig:
    """A session of one target and one camera."""

    kind: str = "cube"  # Of the target, among `PLACES`.
    mount: str = "eye-in-hand"  # Where the camera is.
    seed: int = 0  # Of all that is random.
    views: int = 15  # How many.
    uneven: float = 1.0  # By how much more every other corner errs.
    stated: float | None = None  # By how much the column sigma_px is off the truth; None for none.
    # What session.toml says of the lens, beside its resolution.
    lens: str = f'{LENS}intrinsics = "hold"\n'
    sigma_m: float = 0.0  # How well a rig's points are known.


def write_rig(folder: Path, rig: Rig) -> Path:
    """Writes a session without any image."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(rig.seed)
    target = write_target(folder, rig.kind, "target", rig.sigma_m, rig.seed)
    document = (
        f'schema = 1\nname = "{rig.kind}"\nmount = "{rig.mount}"\ntarget = "{target}"\n'
        f"[camera]\nresolution = {list(RESOLUTION)}\n{rig.lens}"
    )
    shots = [
        Shot(base_from_flange(rig.mount, look), {"": (rig.kind, look)}, uneven=rig.uneven)
        for look in looks(rig.kind, rig.views, rng)
    ]
    return write_shots(folder, document, shots, rig.seed + 1000, rig.stated)


# Where a cube stands beside the board, when both are in one image.
BOARD_FROM_CUBE = pose([0.30, 0.02, 0.03], [0.2, -0.1, 0.5])


def write_two_targets(folder: Path) -> Path:
    """Writes a session whose images show a board and a cube beside it, in one row a stop."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, mount = np.random.default_rng(5), "eye-in-hand"
    names = [write_target(folder, *pair) for pair in (("charuco", "board"), ("cube", "rig"))]
    document = (
        f'schema = 1\nname = "two"\nmount = "{mount}"\n[camera]\nresolution = {list(RESOLUTION)}\n'
        f'{LENS}[targets]\nboard = "{names[0]}"\nrig = "{names[1]}"\n'
    )
    shots = []
    for at, there in enumerate(looks("charuco", 14, rng)):
        seen = {"board": ("charuco", there), "rig": ("cube", there * BOARD_FROM_CUBE)}
        if at % 5 == 4:
            del seen["board"]
        shots.append(Shot(base_from_flange(mount, there), seen))
    return write_shots(folder, document, shots, named=True)


def write_two_cameras(folder: Path) -> Path:
    """Writes a robot with a camera and a cube on its flange, a board and a camera in the cell."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(6)
    names = [write_target(folder, *pair) for pair in (("charuco", "floor"), ("cube", "held"))]
    lens = f"resolution = {list(RESOLUTION)}\n{LENS}"
    document = (
        f'schema = 1\nname = "cell"\n[cameras.left]\n{lens}[cameras.right]\n{lens}[targets]\n'
        f'floor = "{names[0]}"\nheld = "{names[1]}"\n[frames]\ncam_left = "flange"\n'
        'target_held = "flange"\ncam_right = "cell"\ntarget_floor = "cell"\n'
    )
    shots = []
    for camera, target, kind, mount, sigma_px in (
        ("left", "floor", "charuco", "eye-in-hand", 0.1),
        ("right", "held", "cube", "eye-to-hand", 0.4),
    ):
        for there in looks(kind, 12, rng):
            cells = {"stop": str(len(shots)), "camera": camera, "target": target}
            seen = {target: (kind, there)}
            shots.append(Shot(base_from_flange(mount, there), seen, cells, sigma_px))
    return write_shots(folder, document, shots, stated=1.0)
