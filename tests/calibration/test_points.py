"""Points from elsewhere: corners that another detector found, and rigs of known points."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support.commands import visioncal
from support.edited import changed
from support.marks import slow

from visioncal import calibrate
from visioncal.calibration.stages.detect import detect
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.prediction import predict_stops
from visioncal.core.errors import DataError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert, log
from visioncal.interchange.formats import load_for_rereading
from visioncal.present.recording import write_recording
from visioncal.results import Calibration, to_document
from visioncal.session import Session, corners
from visioncal.simulation import CellOptions, simulate
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    read_target,
    target_document,
    target_from_document,
)

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


IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
REFINED, AUTO = f'{LENS}intrinsics = "refine"\n', LENS
SEEDS = 4


def x_of(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """The error (6,) of the camera's edge, and its covariance."""
    name = next(iter(calibration.edges))
    edge, mount = calibration.edges[name], calibration.mount
    return log(invert(edge.matrix) @ truth(mount)[0].as_matrix()), edge.covariance


def with_line(folder: Path, line: str) -> Path:
    with (folder / "corners.csv").open("a") as file:
        file.write(f"{line}\n")
    return folder


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    return write_rig(tmp_path / "cube", Rig("cube"))


RIGS = (
    Rig("charuco", IN_HAND, uneven=5.0, stated=1.0),
    Rig("checkerboard", TO_HAND, lens=REFINED),
    Rig("marker", TO_HAND, stated=1.0),
    Rig("flat", IN_HAND, lens=""),
    Rig("plate", TO_HAND),
    Rig("cube", IN_HAND, lens=AUTO),
    Rig("cube", TO_HAND, lens="", uneven=5.0, stated=1.0),
    # Taken for exact, points as loose as these put the camera 1.5 sigma off.
    Rig("flat", IN_HAND, sigma_m=2e-4),
)


@pytest.mark.slow
def test_the_camera_is_where_it_is_within_its_sigmas(tmp_path):
    squares = np.zeros((len(RIGS), SEEDS))
    for at, rig in enumerate(RIGS):
        for seed in range(SEEDS):
            folder = write_rig(tmp_path / f"{at}_{seed}", replace(rig, seed=seed))
            error, covariance = x_of(calibrate(folder))
            squares[at, seed] = error @ np.linalg.solve(covariance, error)
    # Sums are chi-square of as many numbers, which chance leaves in one of a thousand cases; the
    # noise of the robot is known to 10 % from so few stops, and its square to 20 %.
    for sums, freedom in ((squares.sum(axis=1), 6 * SEEDS), (squares.sum(), 6 * squares.size)):
        low, high = chi2_limit(np.array([0.9995, 0.0005]), freedom)
        assert np.all((low / 1.2 < sums) & (sums < 1.2 * high))


def test_points_that_are_not_where_the_table_has_them_are_named(tmp_path):
    rig = Rig("cube", sigma_m=5e-5)
    folder = write_rig(tmp_path / "cell", rig)
    lines = (folder / "target.csv").read_text().splitlines()
    number, x_m, *rest = lines[5].split(",")
    lines[5] = ",".join([number, repr(float(x_m) + 5e-4), *rest])
    (folder / "target.csv").write_text("\n".join(lines) + "\n")
    result = calibrate(folder)
    assert result.verdict.status == "check"
    (sentence,) = (reason for reason in result.verdict.reasons if "table has it" in reason)
    assert sentence.startswith(f"Point {number} of target target lies 0.")
    # The views have it where it was, to within four sigmas of what the table says of it.
    assert result.rig.shape[4][0] == pytest.approx(-5e-4, abs=2e-4)
    again = Calibration.from_json(json.dumps(to_document(result)), "again")
    write_rig(tmp_path / "fresh", replace(rig, views=6))
    (folder / "target.csv").replace(tmp_path / "fresh" / "target.csv")
    fresh = Session.load(tmp_path / "fresh")
    free = CalibrationPrior.of(again).free
    moved = (free.basis @ free.appearance.board)[4]
    assert moved == pytest.approx(result.rig.shape[4])
    assert predict_stops(fresh, CalibrationPrior.of(again)).observed.pixel_px == pytest.approx(
        NOISE_PX, rel=0.15
    )


@pytest.mark.parametrize(
    ("kind", "fault"), [slow("cube", ""), ("cube", "exchanged"), slow("plate", "moved")]
)
def test_wrong_points_of_an_exact_rig_are_named_and_left_out(tmp_path, kind, fault):
    folder = write_rig(tmp_path / "cell", Rig(kind))
    head, *rows = (line.split(",") for line in (folder / "target.csv").read_text().splitlines())
    first, second = rows[2], rows[-3]
    if fault == "exchanged":
        first[0], second[0] = second[0], first[0]
    elif fault == "moved":
        first[2] = repr(float(first[2]) + 0.02)
    (folder / "target.csv").write_text("\n".join(",".join(group) for group in (head, *rows)) + "\n")
    result = calibrate(folder)
    found = [finding for finding in result.verdict.findings if finding.kind == "rig_points"]
    low, high = sorted((first[0], second[0]), key=int)
    said = {
        "exchanged": f"its table has them: {low}, {high}, by",
        "moved": f"its table has them: {first[0]}, by",
    }
    assert [said[fault] in finding.words for finding in found] == [True] * bool(fault)
    assert result.verdict.status == ("check" if fault else "good")
    # What is left determines the camera as well as it says: 40 is what chance leaves of six
    # numbers in less than one of a hundred thousand cases, with a noise known to 20 %.
    error, covariance = x_of(result)
    assert error @ np.linalg.solve(covariance, error) < 40.0


def test_a_rig_that_is_larger_than_its_table_is_named_with_its_size(tmp_path):
    """Views alone do not tell: a larger rig farther away looks the same."""
    folder = write_rig(tmp_path / "cell", Rig("cube", TO_HAND))
    table = folder / "target.csv"
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    small = [[number, *(repr(float(name) / 1.01) for name in place)] for number, *place in rows]
    table.write_text("\n".join(",".join(group) for group in (head, *small)) + "\n")
    result = calibrate(folder)
    (found,) = (cause for cause in result.verdict.causes if cause.kind == "board_size")
    (advised,) = re.findall(r"multiply the table's x_m, y_m and z_m by ([0-9.]+)", found.do.words)
    # The sentence has a sigma of 0.1 %, by residuals that are the size's own doing.
    assert float(advised) == pytest.approx(1.01, abs=3e-3)
    by = float(advised)
    sized = [[number, *(repr(float(name) * by) for name in place)] for number, *place in small]
    table.write_text("\n".join(",".join(group) for group in (head, *sized)) + "\n")
    assert not any(finding.kind == "board_size" for finding in calibrate(folder).verdict.findings)


def test_sigmas_weigh_the_corners(tmp_path):
    rig = Rig("charuco", uneven=5.0)
    plain, weighed = (
        calibrate(write_rig(tmp_path / str(stated), replace(rig, stated=stated)))
        for stated in (None, 1.0)
    )
    # Half of the corners are five times as good as the rest: alone, they have a 13th of the mean
    # variance at half the number.
    assert np.trace(x_of(weighed)[1]) < 0.4 * np.trace(x_of(plain)[1])


@pytest.mark.parametrize(
    ("stated", "status", "said", "level"),
    [
        (1.1, "good", "", 1.1 * NOISE_PX),
        (0.4, "check", "corners.csv states 0.08 px", NOISE_PX),
        # More than would be doubted, if it were measured.
        slow(5.0, "good", "", 5.0 * NOISE_PX),
    ],
)
def test_the_verdict_says_where_the_corners_contradict_what_is_stated(
    stated, status, said, level, tmp_path
):
    result = calibrate(write_rig(tmp_path / "cell", Rig("charuco", stated=stated)))
    assert result.verdict.status == status
    sentences = " ".join(result.verdict.reasons)
    assert said in sentences
    assert ("corners.csv states" in sentences) is bool(said)
    assert "Corners deviate by" not in sentences
    # The scatter of 1200 coordinates shows the noise to 2 %.
    assert result.noise["pixel_px"] == pytest.approx(level, rel=0.06)


def test_every_storage_of_it_is_the_same_session(tmp_path):
    folder = write_rig(tmp_path / "cell", Rig("cube", stated=1.0))
    session = Session.load(folder)
    write_recording(tmp_path / "cell.rrd", session, None, (), None)
    recorded = Session.load(tmp_path / "cell.rrd")
    recorded.save(tmp_path / "back")
    ours, result = session.corner_table, to_document(calibrate(session))
    for again in (recorded, Session.load(tmp_path / "back")):
        theirs = again.corner_table
        assert again.digest() == session.digest()
        assert again.boards == {"": replace(session.boards[""], name=again.boards[""].name)}
        for name in ("views", "points", "px", "sigmas_px"):
            np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name))
        assert to_document(calibrate(again)) | {"created": ""} == result | {"created": ""}


def test_what_was_measured_counts_in_the_digest(cube):
    digest = Session.load(cube).digest()
    text = (cube / "corners.csv").read_text()
    for name, old, new in (
        ("corners.csv", text.split("\n")[1], text.split("\n")[1].replace(".", ".5", 1)),
        ("target.csv", "-0.08,-0.08,-0.08", "-0.08,-0.08,-0.081"),
    ):
        before = (cube / name).read_text()
        assert Session.load(changed(cube, name, old, new)).digest() != digest
        (cube / name).write_text(before)
    # Spelling counts for nothing.
    (cube / "corners.csv").write_text(text.replace(",", " , "))
    assert Session.load(cube).digest() == digest


def test_an_image_with_corners_is_not_searched(cube):
    rows = (cube / "views.csv").read_text().splitlines()
    told = [f"{rows[0]},image", f"{rows[1]},broken.png", *(f"{row}," for row in rows[2:])]
    (cube / "views.csv").write_text("\n".join(told) + "\n")
    (cube / "broken.png").write_bytes(b"no image")
    result = calibrate(cube)
    assert all(view.used for view in result.views)
    assert result.views[0].corners == len(PLACES["cube"])


def test_views_that_do_not_serve_are_left_out_by_name(cube):
    lines = (cube / "corners.csv").read_text().splitlines()
    of = {view: [line for line in lines if line.startswith(f"{view},")] for view in range(5)}
    # View 1 has three points, view 2 none, view 3 four of a row, view 4 one far outside.
    row = [str(number) for number in numbers_of("cube")[:4]]
    in_row = [value for value in of[3] if value.split(",")[1] in row]
    view, point, u_px, _ = of[4][0].split(",")
    rest = [line for line in lines if line.split(",")[0] not in ("1", "2", "3", "4")]
    kept = [*rest, *of[1][:3], *in_row, f"{view},{point},{u_px},4000.0", *of[4][1:]]
    (cube / "corners.csv").write_text("\n".join(kept) + "\n")
    reasons = {view.view: view.reason for view in calibrate(cube).views if not view.used}
    assert reasons.keys() == {1, 2, 3, 4}
    assert "3 of 37, needs 4" in reasons[1]
    assert "neither image nor rows in corners.csv" in reasons[2]
    assert "on one line" in reasons[3]
    assert f"point {point} at ({float(u_px):g}, 4000) px lies far outside" in reasons[4]


@pytest.mark.parametrize(
    ("kind", "size", "stated"), [("charuco", (9, 6), (6, 9)), ("checkerboard", (8, 5), (7, 6))]
)
def test_numbers_of_a_board_of_other_columns_are_refused_before_anything_is_fitted(
    kind, size, stated, tmp_path
):
    folder = write_rig(tmp_path / kind, Rig(kind))
    (file,) = (path.name for path in folder.glob("*.toml") if path.name != "session.toml")
    changed(folder, file, *("columns = {}\nrows = {}\n".format(*value) for value in (size, stated)))
    with pytest.raises(DataError, match="do not lie as its drawing numbers them") as caught:
        detect(Session.load(folder))
    assert "Compare columns, rows and the order" in caught.value.next_step


def test_one_view_of_other_numbers_is_left_out_by_name(tmp_path):
    folder = write_rig(tmp_path / "board", Rig("charuco"))
    rows = [line.split(",") for line in (folder / "corners.csv").read_text().splitlines()]
    # In view 2 the corners are numbered column by column.
    for row in rows[1:]:
        if row[0] == "2":
            row[1] = str(int(row[1]) % 5 * 8 + int(row[1]) // 5)
    (folder / "corners.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    found = detect(Session.load(folder))
    (rejection,) = found.rejections
    assert rejection.view == 2
    assert "do not lie as the target's drawing numbers them" in rejection.reason


def test_a_rig_is_not_looked_for_in_images(cube):
    changed(cube, "views.csv", "view,", "image,view,")
    text = (cube / "views.csv").read_text().splitlines()
    rows = [
        text[0],
        *(f"{'a.png' if at == 1 else ''},{value}" for at, value in enumerate(text[1:])),
    ]
    (cube / "views.csv").write_text("\n".join(rows) + "\n")
    image = np.full((960, 1280), 200, dtype=np.uint8)
    cv2.imwrite(str(cube / "a.png"), image)
    lines = (cube / "corners.csv").read_text().splitlines()
    kept = [line for line in lines if not line.startswith("1,")]
    (cube / "corners.csv").write_text("\n".join(kept) + "\n")
    (view,) = (view for view in calibrate(cube).views if not view.used)
    assert view.view == 1
    assert "rig of points, which no image is searched for" in view.reason


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("99,700,10,10", "column view: views.csv has no view 99"),
        ("0,5,10,10", "has no point 5; its 37 points have the numbers 592 to 700"),
        ("0,700,10,10", "point 700 of view 0 is there twice, first in corners.csv, line"),
        ("0,x,10,10", "column point: 'x' is no whole number"),
        ("0,700,nan,10", "column u_px: 'nan' is no finite number"),
        ("0,700,10", "it has 3 fields, but the header has 4 columns"),
    ],
)
def test_wrong_rows_are_named(line, said, cube):
    with pytest.raises(DataError, match=r"corners\.csv, line 557") as error:
        Session.load(with_line(cube, line))
    assert said in error.value.message


@pytest.mark.parametrize(("line_end", "marks"), [(b"\r\n", 1), (b"\r\r\n", 2), (b"\n\n", 0)])
def test_line_ends_and_marks_of_other_programs_change_nothing(marks, line_end, cube):
    file = cube / "corners.csv"
    expected = Session.load(cube).corner_table
    plain = file.read_bytes()
    file.write_bytes(marks * b"\xef\xbb\xbf" + plain.replace(b"\n", line_end))
    assert Session.load(cube).corner_table.fact() == expected.fact()
    # The line that a message names is the file's, also after blank ones.
    wrong = [*plain.splitlines()[:3], b"0,x,10,10"]
    file.write_bytes(marks * b"\xef\xbb\xbf" + line_end.join([*wrong, b""]))
    text = file.read_text(encoding="utf-8-sig")
    (line,) = (at for at, words in enumerate(text.splitlines(), 1) if words.startswith("0,x"))
    with pytest.raises(DataError, match=rf"corners\.csv, line {line}, column point"):
        Session.load(cube)


@pytest.mark.parametrize(("kind", "first"), [("checkerboard", 1), ("cube", 0)])
def test_points_that_count_from_another_number_are_named_at_once(tmp_path, kind, first):
    """Of a board, whose corners count from 0, and of a rig whose table counts from 1."""
    folder = write_rig(tmp_path / kind, Rig(kind))

    def renumber(name: str, column: int, start: int) -> None:
        header, *rows = ((folder / name).read_text()).splitlines()
        cells = [row.split(",") for row in rows]
        numbers = sorted({int(cell[column]) for cell in cells})
        for cell in cells:
            cell[column] = str(numbers.index(int(cell[column])) + start)
        (folder / name).write_text("\n".join([header, *map(",".join, cells)]) + "\n")

    renumber("corners.csv", 1, first)
    if kind == "cube":
        renumber("target.csv", 0, 1)
    with pytest.raises(DataError, match=f"counts the points of target .* from {first}: ") as error:
        Session.load(folder)
    sign = "-" if first else "+"
    assert f"write point {sign} 1 in the place of point" in error.value.next_step
    # One sentence, and not a line for each of hundreds of corners.
    assert "\n" not in error.value.message


@pytest.mark.parametrize(
    ("header", "cells", "said"),
    [
        ("view,point,u_px,v_px,sigma_px", ",0", "column sigma_px: 0 px is no standard deviation"),
        ("view,point,u_px,v_px,sigma_px", ",-0.1", "-0.1 px is no standard deviation"),
        # Their squares overflow.
        ("view,point,u_px,v_px,sigma_px", ",1e150", "1e+150 px is no standard deviation"),
        ("view,point,u_px,v_px,sigma_px", ",1e-300", "1e-300 px is no standard deviation"),
        ("view,point,u_px,v_px,score", ",1", "others are not read"),
        ("view,point,u_px,sigma_px", "", "view, point, u_px, v_px are needed"),
    ],
)
def test_wrong_columns_are_named(header, cells, said, cube):
    _, *rows = (cube / "corners.csv").read_text().splitlines()
    (cube / "corners.csv").write_text("\n".join([header, *(f"{row}{cells}" for row in rows)]))
    with pytest.raises(DataError, match=r"corners\.csv") as error:
        Session.load(cube)
    assert said in error.value.message


def test_sigmas_are_stated_of_all_rows_or_none(tmp_path):
    folder = write_rig(tmp_path / "cell", Rig(stated=1.0))
    with pytest.raises(DataError, match="it is empty; all rows state it, or none"):
        Session.load(with_line(folder, "0,700,10,10,"))


def test_corners_without_images_need_a_resolution(cube):
    changed(cube, "session.toml", "resolution = [1280, 960]\n", "")
    changed(cube, "session.toml", LENS, "")
    with pytest.raises(DataError, match="the camera's resolution is missing"):
        calibrate(cube)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n", "has 3 points"),
        (
            "point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n2,0,1,1\n",
            "has 2 again as point of row 4",
        ),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,100,0,0\n2,0,100,0\n3,0,0,80\n", "looks like millimetres"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n3,0,nan,1\n", "line 5, column y_m: 'nan'"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n3,0,b,1\n", "line 5, column y_m: 'b'"),
        ("point,x_m,y_m\n0,0,0\n1,1,0\n2,0,1\n3,0,1\n", "point, x_m, y_m, z_m"),
        (
            "point,x_m,y_m,z_m,sigma_m\n0,0,0,0,1\n1,1,0,0,1\n2,0,1,0,1\n3,0,1,1,0\n",
            "has 0 as sigma_m of row 4",
        ),
        (
            "point,x_m,y_m,z_m,sigma_m\n0,0,0,0,1e-300\n1,1,0,0,1\n2,0,1,0,1\n3,0,1,1,1\n",
            "has 1e-300 as sigma_m of row 1",
        ),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,2,0,0\n3,5,0,0\n", "all points on one line"),
        ("point,x_m,y_m,z_m\n0,1,0,0\n1,1,0,0\n2,1,0,0\n3,1,0,0\n", "all points in one place"),
    ],
)
def test_wrong_rigs_are_refused(table, said, tmp_path):
    name = write_target(tmp_path, "cube", "rig")
    (tmp_path / "rig.csv").write_text(table)
    with pytest.raises(DataError) as error:
        load_target(name, tmp_path)
    assert said in str(error.value)


def test_a_rig_is_described_by_its_document(tmp_path):
    target, document = read_target(write_target(tmp_path, "cube", "rig", 1e-4), tmp_path)
    assert target_document(target) == document
    assert target_from_document(document, "rig") == target
    assert target.point_numbers == tuple(numbers_of("cube"))


def test_one_image_of_two_targets_is_two_views(tmp_path):
    session = Session.load(write_two_targets(tmp_path / "cell"))
    # Fourteen images show the rig, and twelve of them the board, too.
    assert len(session.views) == 26
    result = calibrate(session)
    assert all(view.used for view in result.views)
    places = [result.edges[f"base_from_target_{name}"] for name in ("board", "rig")]
    between = log(invert(places[0].matrix) @ places[1].matrix @ BOARD_FROM_CUBE.inv().as_matrix())
    # Four standard deviations of both places, as if they were independent.
    sigmas = np.sqrt(sum(np.diag(place.covariance) for place in places))
    assert np.all(np.abs(between[3:]) < 4.0 * np.linalg.norm(sigmas[3:]))
    session.save(tmp_path / "copy")
    assert Session.load(tmp_path / "copy").digest() == session.digest()


def test_targets_of_rows_are_those_of_their_views(tmp_path):
    folder = write_two_targets(tmp_path / "cell")
    cases = {
        "wall": "'wall' is not declared; session.toml declares board, rig",
        "": "it is empty, and so is view 0's",
    }
    for name, said in cases.items():
        with pytest.raises(DataError) as error:
            Session.load(changed(folder, "corners.csv", ",board\n", f",{name}\n"))
        assert said in error.value.message
        changed(folder, "corners.csv", f",{name}\n", ",board\n")
    rows = (folder / "views.csv").read_text().splitlines()
    told = [f"target,{rows[0]}", *(f"rig,{row}" for row in rows[1:])]
    (folder / "views.csv").write_text("\n".join(told) + "\n")
    with pytest.raises(DataError, match=r"views\.csv says that view 0 shows 'rig'"):
        Session.load(folder)


def test_a_cell_of_two_cameras_is_aligned(tmp_path):
    found = calibrate(write_two_cameras(tmp_path / "cell"))
    x, z = truth(IN_HAND)
    for name, true in {
        "flange_from_cam_left": x,
        "cell_from_target_floor": z,
        "cell_from_cam_right": z,
        "flange_from_target_held": x,
    }.items():
        edge = found.edges[name]
        error = log(invert(edge.matrix) @ true.as_matrix())
        # Chi-square of six exceeds this in one case of 100,000.
        assert error @ np.linalg.solve(edge.covariance, error) < 33.0
    assert found.cell.noise["cam_left"]["pixel_px"] == 0.1
    assert found.cell.noise["cam_right"]["pixel_px"] == 0.4


def test_commands_take_a_rig_or_say_why_not(cube, tmp_path):
    out = tmp_path / "out"
    assert visioncal("calibrate", cube, "-o", out).status == 0
    fresh = write_rig(tmp_path / "fresh", Rig("cube", seed=9, views=6))
    assert visioncal("verify", fresh, "--against", out).status == 0
    located = visioncal("locate", fresh, "-c", out)
    assert located.out.count("view ") == 6
    fixture = visioncal("fixture", fresh, "-c", out, "-o", tmp_path / "fixture.json")
    assert "rig target seen in 6 images" in fixture.out + fixture.err
    other = visioncal("locate", fresh, "-c", out, "--target", "charuco_9x6_30mm")
    assert other.status == 2
    assert "corners of its own target" in other.err
    changed(cube, "session.toml", "[camera]", '[robot]\nmodel = "ur10e"\n[camera]')
    planned = visioncal("plan", cube, "--add", 2, "-o", tmp_path / "plan")
    assert planned.status == 2
    assert "rig of points outside the plane z = 0" in planned.err


@pytest.mark.slow
def test_corners_of_images_give_what_the_images_give(rendered, tmp_path):
    session = Session.load(rendered)
    found = detect(session)
    session.save(tmp_path / "cell")
    for image in (tmp_path / "cell").rglob("*.png"):
        image.unlink()
    rows = [
        f"{view},{point},{u_px!r},{v_px!r}"
        for view, view_corners in found.corners.items()
        for point, (u_px, v_px) in zip(
            view_corners.ids.tolist(), view_corners.px.tolist(), strict=True
        )
    ]
    (tmp_path / "cell" / "corners.csv").write_text("\n".join(["view,point,u_px,v_px", *rows]))
    ours, theirs = (to_document(calibrate(value)) for value in (tmp_path / "cell", session))
    for name in ("transforms", "noise", "views", "rms", "verdict"):
        assert ours[name] == theirs[name]


def test_more_corners_than_a_session_holds_are_refused(monkeypatch):
    monkeypatch.setattr(corners, "_MOST_CORNERS", 2)
    rows = "".join(f"1,{at},10.0,20.0\n" for at in range(3))
    with pytest.raises(DataError, match="more than 2 rows"):
        corners.parse_corners("view,point,u_px,v_px\n" + rows)


def test_a_rig_lies_beside_its_description(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "points.csv").write_text("point,x_m,y_m,z_m\n", encoding="utf-8")
    target = tmp_path / "inside" / "rig.toml"
    target.write_text('kind = "points"\npoints = "../points.csv"\n', encoding="utf-8")
    with pytest.raises(DataError, match="leads out of the folder"):
        load_target("rig.toml", target.parent)


def test_corners_outside_of_the_folder_are_not_read(tmp_path):
    elsewhere = tmp_path / "elsewhere.csv"
    elsewhere.write_text("view,point,u_px,v_px\n", encoding="utf-8")
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "corners.csv").symlink_to(elsewhere)
    with pytest.raises(DataError, match="leads out of its folder"):
        corners.read_corners(tmp_path / "session")


def test_a_deleted_row_takes_its_corners_along(cube):
    lines = (cube / "views.csv").read_text().splitlines()
    (cube / "views.csv").write_text("\n".join([*lines[:3], *lines[4:]]) + "\n")
    session = Session.load(cube)
    assert len(session.views) == len(lines) - 2
    assert set(session.corner_table.views.tolist()) == {view.number for view in session.views}
    # A row without corners instead: views are numbered otherwise.
    moved = [*lines[:3], lines[3].replace("2,", "77,", 1), *lines[4:]]
    (cube / "views.csv").write_text("\n".join(moved) + "\n")
    with pytest.raises(DataError, match="views\\.csv has no view 2"):
        Session.load(cube)


@pytest.fixture
def drawn(tmp_path: Path) -> Path:
    """A session of corners alone, whose board and lens are stated."""
    cell = simulate(CellOptions(views=12, seed=4))
    session = Session.from_corners(
        [(view_corners.ids, view_corners.px) for view_corners in cell.corners],
        cell.robot.base_from_flange,
        cell.options.target,
        cell.stated[""].resolution,
        mount=IN_HAND,
        camera=cell.stated[""],
    )
    session.save(tmp_path / "drawn")
    return tmp_path / "drawn"


def state(folder: Path, key: str, value: object) -> None:
    """Replaces what session.toml says of a key."""
    file = folder / "session.toml"
    pattern = re.compile(rf"{key} = (\[.*?\]|[^\n]*)", re.DOTALL)
    text, count = pattern.subn(f"{key} = {value}", file.read_text())
    assert count == 1
    file.write_text(text)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), slow("inch", 0.0254)])
def test_a_board_in_another_unit_is_read_as_the_chain_has_it(unit, metres, drawn):
    board = Session.load(drawn).target
    sides = {"square_m": board.square_m, "marker_m": board.marker_m}
    wrong = target_document(board) | {name: side / metres for name, side in sides.items()}
    wrong.pop("square_sigma_m")
    state(drawn, "target", '"b.toml"')
    (drawn / "b.toml").write_text(
        "".join(f"{key} = {json.dumps(value)}\n" for key, value in wrong.items())
    )
    read = load_for_rereading(drawn).session
    # The unit's own rounding.
    assert read.target.square_m == pytest.approx(board.square_m, rel=1e-12)
    assert read.target.marker_m == pytest.approx(board.marker_m, rel=1e-12)
    assert read.warnings[0].endswith(
        f"{wrong['square_m']:g} is read as {wrong['square_m']:g} {unit}."
    )


@pytest.mark.parametrize(
    ("mount", "size", "dh_sigma"),
    [(TO_HAND, 1.004, 0.0), slow(IN_HAND, 1.0, 3e-4)],
)
def test_a_rigs_size_is_parted_from_errors_of_the_links(tmp_path, mount, size, dh_sigma):
    """Longer links explain a larger rig, and one size is simpler: of an arm that errs it is not."""
    options = CellOptions(mount=mount, views=20, seed=2, dh_sigma_m=dh_sigma, dh_sigma_rad=dh_sigma)
    cell = simulate(options)
    rows = enumerate((size * corner_positions(options.target)).tolist())
    lines = [",".join(map(repr, (number, *place))) for number, place in rows]
    (tmp_path / "rig.csv").write_text("\n".join(("point,x_m,y_m,z_m", *lines)) + "\n")
    (tmp_path / "rig.toml").write_text('kind = "points"\npoints = "rig.csv"\n')
    session = Session.from_corners(
        [(view_corners.ids, view_corners.px) for view_corners in cell.corners],
        cell.robot.base_from_flange,
        load_target("rig.toml", tmp_path),
        cell.stated[""].resolution,
        mount=mount,
        camera=cell.stated[""],
        robot=options.robot,
        q=cell.robot.joints,
    )
    result = calibrate(session)
    found = [cause.words for cause in result.verdict.causes if cause.kind == "board_size"]
    assert bool(found) == (size != 1.0)
    for name in found:
        said = re.search(r"is ([0-9.]+) % smaller than stated \(sigma ([0-9.]+) %\)", name)
        percent, sigma = map(float, said.groups())
        assert abs(percent - 0.4) < 4.0 * sigma < 0.1
    assert (result.verdict.status == "good") == (size == 1.0)
