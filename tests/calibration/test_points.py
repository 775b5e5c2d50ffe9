"""Points from elsewhere: corners that another detector found, rigs of known points and tags."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from support.boards import any_page, printed
from support.cells import session_of
from support.commands import visioncal
from support.edited import changed
from support.marks import slow
from support.refusals import raised
from support.rendered import disc_kernel, line_kernel

from visioncal import calibrate, doctor
from visioncal.calibration.run import run
from visioncal.calibration.stages.detect import detect, find_corners
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.prediction import predict_stops
from visioncal.core.errors import DataError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert, log
from visioncal.core.types import Target
from visioncal.interchange.formats import load_for_rereading
from visioncal.present.recording import write_recording
from visioncal.results import Calibration, to_document
from visioncal.session import MemoryImages, Session, corners
from visioncal.simulation import (
    BOARDS,
    CellOptions,
    SimulatedCell,
    prepare_scene,
    render,
    simulate,
    write_session,
)
from visioncal.simulation.optics import wide_camera
from visioncal.simulation.render import developed, encode, light_on
from visioncal.vision.boards import NotFound, find_target
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


def smeared(cell: SimulatedCell, *, disc_px: float = 0.0, motion_px: float = 0.0) -> Session:
    """The session of a cell, its images rendered, blurred further, and read out with noise.

    Args:
        cell: The cell, with its own small blur.
        disc_px: Radius of the disc of defocus.
        motion_px: How far everything moves during an exposure, in each image into a direction of
            its own.
    """
    scene, session, files = prepare_scene(cell), session_of(cell), {}
    for at, pose in enumerate(cell.cam_from_target):
        light = light_on(scene, pose)
        rng = np.random.default_rng([cell.options.seed, at])
        along = rng.uniform(0, np.pi)
        half = 0.5 * motion_px * np.array([np.cos(along), np.sin(along)])
        for kernel in (disc_kernel(disc_px), line_kernel(half)):
            if kernel.size > 1:
                light = cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE)
        files[session.views[at].image] = encode(developed(light, cell.options, rng), None)
    return replace(session, images=MemoryImages(files))


IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
REFINED, AUTO = f'{LENS}intrinsics = "refine"\n', LENS
SEEDS = 4
SQUARE = Target("board", "charuco", 6, 6, 0.03, 1e-6, marker_m=0.022, dictionary="DICT_5X5_100")
TAGS = BOARDS["tags"]
PLATE = replace(TAGS, square_m=0.245, square_sigma_m=0.0)
PLACED = "point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,0,1,0\n"
SURE = "point,x_m,y_m,z_m,sigma_m\n0,0,0,0,{}\n1,1,0,0,1\n2,0,1,0,1\n3,0,1,1,{}\n"
TAGGED = "point,x_m,y_m,z_m{}\n0,0,0,0{}\n1,.1,0,0{}\n2,.1,.1,0{}\n3,0,.1,0{}\n"


def bottom_up(ids, columns, rows):
    return columns * (rows - 1 - ids // columns) + ids % columns


def by_column(ids, columns, rows):
    return rows * (ids % columns) + ids // columns


BOARD, OVER = load_target("checkerboard_9x6_25mm"), "numbers the corners of the board as if it was"


def x_of(calibration: Calibration) -> tuple[np.ndarray, float]:
    """The covariance of the camera's edge, and the square of its error over it."""
    edge, x = next(iter(calibration.edges.values())), truth(calibration.mount)[0].as_matrix()
    error = log(invert(edge.matrix) @ x)
    return edge.covariance, float(error @ np.linalg.solve(edge.covariance, error))


def test_points_that_are_not_where_the_table_has_them_are_named(tmp_path):
    rig = Rig("cube", sigma_m=5e-5)
    folder = write_rig(tmp_path / "cell", rig)
    rows = []

    def moved(table):
        table[5][1] = repr(float(table[5][1]) + 5e-4)
        rows.append(table[5])

    rewrite(folder, "target.csv", moved)
    result = calibrate(folder)
    assert result.verdict.status == "check"
    (sentence,) = (reason for reason in result.verdict.reasons if "table has it" in reason)
    assert sentence.startswith(f"Point {rows[0][0]} of target target lies 0.")
    # The views have it where it was, to within four sigmas of what the table says of it.
    assert result.rig.shape[4][0] == pytest.approx(-5e-4, abs=2e-4)
    again = Calibration.from_json(json.dumps(to_document(result)), "again")
    write_rig(tmp_path / "fresh", replace(rig, views=6))
    (folder / "target.csv").replace(tmp_path / "fresh" / "target.csv")
    prior = CalibrationPrior.of(again)
    moved = (prior.free.basis @ prior.free.appearance.board)[4]
    assert moved == pytest.approx(result.rig.shape[4])
    fresh = predict_stops(Session.load(tmp_path / "fresh"), prior)
    assert fresh.observed.pixel_px == pytest.approx(NOISE_PX, rel=0.15)


@pytest.mark.parametrize(
    ("kind", "fault"), [slow("cube", ""), ("cube", "exchanged"), slow("plate", "moved")]
)
def test_wrong_points_of_an_exact_rig_are_named_and_left_out(tmp_path, kind, fault):
    said = []

    def spoil(rows):
        first, second = rows[3], rows[-3]
        if fault == "exchanged":
            first[0], second[0] = second[0], first[0]
            said.append("{}, {}".format(*sorted((first[0], second[0]), key=int)))
        elif fault == "moved":
            first[2] = repr(float(first[2]) + 0.02)
            said.append(first[0])

    result = calibrate(rewrite(write_rig(tmp_path / "cell", Rig(kind)), "target.csv", spoil))
    found = [finding for finding in result.verdict.findings if finding.kind == "rig_points"]
    for finding, numbers in zip(found, said, strict=True):
        assert f"its table has them: {numbers}, by" in finding.words
    assert result.verdict.status == ("check" if fault else "good")
    # What is left determines the camera as well as it says: 40 is what chance leaves of six
    # numbers in less than one of a hundred thousand cases, with a noise known to 20 %.
    assert x_of(result)[1] < 40.0


def scaled(by):
    def change(rows):
        for row in rows[1:]:
            row[1:] = [repr(float(number) * by) for number in row[1:]]

    return change


def test_a_rig_that_is_larger_than_its_table_is_named_with_its_size(tmp_path):
    """Views alone do not tell: a larger rig farther away looks the same."""
    folder = write_rig(tmp_path / "cell", Rig("cube", TO_HAND))
    result = calibrate(rewrite(folder, "target.csv", scaled(1.0 / 1.01)))
    (found,) = (cause for cause in result.verdict.causes if cause.kind == "board_size")
    (advised,) = re.findall(r"multiply the table's x_m, y_m and z_m by ([0-9.]+)", found.do.words)
    # The sentence has a sigma of 0.1 %, by residuals that are the size's own doing.
    assert float(advised) == pytest.approx(1.01, abs=3e-3)
    sized = calibrate(rewrite(folder, "target.csv", scaled(float(advised))))
    assert not any(finding.kind == "board_size" for finding in sized.verdict.findings)


def test_sigmas_weigh_the_corners(tmp_path):
    plain, weighed = (
        np.trace(x_of(calibrate(write_rig(tmp_path / name, rig)))[0])
        for name, rig in (
            ("plain", Rig("charuco", uneven=5.0)),
            ("weighed", Rig("charuco", uneven=5.0, stated=1.0)),
        )
    )
    # Half of the corners are five times as good as the rest: alone, they have a 13th of the mean
    # variance at half the number.
    assert weighed < 0.4 * plain


def test_views_that_do_not_serve_are_left_out_by_name_and_images_are_not_searched(cube):
    row = [str(number) for number in numbers_of("cube")[:4]]

    def spoil(rows):
        """View 1 has three points, view 2 none, view 3 four of a row, view 4 one far outside."""
        of = {view: [line for line in rows if line[0] == str(view)] for view in range(5)}
        of[4][0][3] = "4000.0"
        in_row = [line for line in of[3] if line[1] in row]
        rest = [line for line in rows if line[0] not in ("1", "2", "3", "4")]
        outside.extend(of[4][0])
        return [*rest, *of[1][:3], *in_row, *of[4]]

    def with_images(rows):
        for at, line in enumerate(rows):
            line.append({0: "image", 1: "broken.png", 3: "a.png"}.get(at, ""))

    outside = []
    rewrite(rewrite(cube, "corners.csv", spoil), "views.csv", with_images)
    (cube / "broken.png").write_bytes(b"no image")
    cv2.imwrite(str(cube / "a.png"), np.full((960, 1280), 200, dtype=np.uint8))
    result = calibrate(cube)
    reasons = {view.view: view.reason for view in result.views if not view.used}
    assert reasons.keys() == {1, 2, 3, 4}
    assert "3 of 37, needs 4" in reasons[1]
    # A rig is not looked for in images.
    assert "rig of points, which no image is searched for" in reasons[2]
    assert "on one line" in reasons[3]
    _, point, u_px, _ = outside
    assert f"point {point} at ({float(u_px):g}, 4000) px lies far outside" in reasons[4]
    # An image with corners is not searched.
    assert result.views[0].corners == len(PLACES["cube"])


def test_a_table_of_corners_that_was_cut_off_is_named(tmp_path):
    def without(lost):
        return lambda rows: [row for row in rows if row[0] not in map(str, lost)]

    folder = write_rig(tmp_path / "cell", Rig("charuco", views=16))
    # A single row without corners is named, and the others are as good as they were.
    one = calibrate(rewrite(folder, "corners.csv", without([4])))
    assert one.verdict.status == "good"
    (lost,) = (view for view in one.views if not view.used)
    assert lost.view == 4
    assert "it has neither image nor rows in corners.csv" in lost.reason
    most = calibrate(rewrite(folder, "corners.csv", without(range(10, 16))))
    assert most.verdict.status == "check"
    (found,) = (found for found in most.verdict.findings if found.kind == "lost_views")
    assert found.views == (4, *range(10, 16))
    assert found.words.startswith("7 of 16 rows of views.csv have neither an image nor rows in")
    assert doctor(folder).findings[0].kind == "lost_views"


def test_numbers_that_do_not_lie_as_drawn_are_refused_or_left_out_by_name(tmp_path):
    for kind, size, stated in (("charuco", (9, 6), (6, 9)), ("checkerboard", (8, 5), (7, 6))):
        folder = write_rig(tmp_path / kind, Rig(kind))
        texts = ("columns = {}\nrows = {}\n".format(*value) for value in (size, stated))
        changed(folder, "target.toml", *texts)
        words = "do not lie as its drawing numbers them"
        caught = raised(DataError, words, detect, Session.load(folder))
        assert "Compare columns, rows and the order" in caught.next_step

    def by_columns(rows):
        for row in rows[1:]:
            if row[0] == "2":
                row[1] = str(int(row[1]) % 5 * 8 + int(row[1]) // 5)

    folder = write_rig(tmp_path / "one", Rig("charuco"))
    (rejection,) = detect(Session.load(rewrite(folder, "corners.csv", by_columns))).rejections
    assert rejection.view == 2
    assert "do not lie as the target's drawing numbers them" in rejection.reason


def test_targets_of_rows_are_those_of_their_views(tmp_path):
    folder = write_two_targets(tmp_path / "cell")
    cases = {
        "wall": "'wall'; one of board, rig is needed",
        "": "''; one of board, rig is needed",
    }
    for name, said in cases.items():
        with pytest.raises(DataError) as error:
            Session.load(changed(folder, "corners.csv", ",board\n", f",{name}\n"))
        assert said in error.value.message
        changed(folder, "corners.csv", f",{name}\n", ",board\n")

    def all_of_the_rig(rows):
        return [[name, *row] for row, name in zip(rows, ["target", *["rig"] * 99], strict=False)]

    with pytest.raises(DataError, match=r"views\.csv says that view 0 shows 'rig'"):
        Session.load(rewrite(folder, "views.csv", all_of_the_rig))


def test_one_image_of_two_targets_is_two_views(tmp_path):
    session = Session.load(write_two_targets(tmp_path / "cell"))
    # Fourteen images show the rig, and twelve of them the board, too.
    assert len(session.views) == 26
    result = calibrate(session)
    assert all(view.used for view in result.views)
    board, rig = (result.edges[f"base_from_target_{name}"] for name in ("board", "rig"))
    between = log(invert(board.matrix) @ rig.matrix @ BOARD_FROM_CUBE.inv().as_matrix())
    # Four standard deviations of both places, as if they were independent.
    sigmas = np.sqrt(np.diag(board.covariance + rig.covariance))
    assert np.all(np.abs(between[3:]) < 4.0 * np.linalg.norm(sigmas[3:]))
    session.save(tmp_path / "copy")
    assert Session.load(tmp_path / "copy").digest() == session.digest()


def test_a_cell_of_two_cameras_is_aligned(tmp_path):
    found = calibrate(write_two_cameras(tmp_path / "cell"))
    x, z = (edge.as_matrix() for edge in truth(IN_HAND))
    for name, true in {
        "flange_from_cam_left": x,
        "cell_from_target_floor": z,
        "cell_from_cam_right": z,
        "flange_from_target_held": x,
    }.items():
        error = log(invert(found.edges[name].matrix) @ true)
        # Chi-square of six exceeds this in one case of 100,000.
        assert error @ np.linalg.solve(found.edges[name].covariance, error) < 33.0
    noise = found.cell.noise
    assert (noise["cam_left"]["pixel_px"], noise["cam_right"]["pixel_px"]) == (0.1, 0.4)


def session_with(cell, seen=None, size=None, target=None, camera=True, **more):
    """The session of a cell's corners, or of others."""
    return Session.from_corners(
        seen or [(corners.ids, corners.px) for corners in cell.corners],
        cell.robot.base_from_flange,
        target or cell.options.target,
        size or cell.stated[""].resolution,
        mount=cell.options.mount,
        **({"camera": cell.stated[""]} if camera else {}),
        **more,
    )


@pytest.mark.slow
def test_corners_of_images_give_what_the_images_give(rendered, tmp_path):
    session = Session.load(rendered)
    found = detect(session)
    session.save(tmp_path / "cell")
    for image in (tmp_path / "cell").rglob("*.png"):
        image.unlink()
    rows = [
        f"{view},{point},{u_px!r},{v_px!r}"
        for view, seen in found.corners.items()
        for point, (u_px, v_px) in zip(seen.ids.tolist(), seen.px.tolist(), strict=True)
    ]
    (tmp_path / "cell" / "corners.csv").write_text("\n".join(["view,point,u_px,v_px", *rows]))
    ours, theirs = (to_document(calibrate(value)) for value in (tmp_path / "cell", session))
    for name in ("transforms", "noise", "views", "rms", "verdict"):
        assert ours[name] == theirs[name]


def test_a_board_in_millimetres_is_read_so(tmp_path):
    session = session_with(simulate(CellOptions(views=12, seed=4)))
    session.save(tmp_path / "cell")
    board, file = session.target, tmp_path / "cell" / "session.toml"
    wrong = target_document(board) | {"square_m": 1e3 * board.square_m}
    wrong |= {"marker_m": 1e3 * board.marker_m}
    wrong.pop("square_sigma_m")
    file.write_text(re.sub(r"target = [^\n]*", 'target = "b.toml"', file.read_text(), count=1))
    lines = (f"{key} = {json.dumps(value)}\n" for key, value in wrong.items())
    (tmp_path / "cell" / "b.toml").write_text("".join(lines))
    read = load_for_rereading(tmp_path / "cell").session
    # The unit's own rounding.
    assert read.target.square_m == pytest.approx(board.square_m, rel=1e-12)
    assert read.target.marker_m == pytest.approx(board.marker_m, rel=1e-12)
    side = f"{wrong['square_m']:g}"
    assert read.warnings[0].endswith(f"{side} is read as {side} mm.")


@pytest.mark.parametrize(
    ("mount", "size", "dh_sigma"), [(TO_HAND, 1.004, 0.0), slow(IN_HAND, 1.0, 3e-4)]
)
def test_a_rigs_size_is_parted_from_errors_of_the_links(tmp_path, mount, size, dh_sigma):
    """Longer links explain a larger rig, and one size is simpler: of an arm that errs it is not."""
    options = CellOptions(mount=mount, views=20, seed=2, dh_sigma_m=dh_sigma, dh_sigma_rad=dh_sigma)
    cell = simulate(options)
    rows = enumerate((size * corner_positions(options.target)).tolist())
    lines = [",".join(map(repr, (number, *place))) for number, place in rows]
    (tmp_path / "rig.csv").write_text("\n".join(("point,x_m,y_m,z_m", *lines)) + "\n")
    (tmp_path / "rig.toml").write_text('kind = "points"\npoints = "rig.csv"\n')
    rig = load_target("rig.toml", tmp_path)
    result = calibrate(session_with(cell, target=rig, robot=options.robot, q=cell.robot.joints))
    found = [cause.words for cause in result.verdict.causes if cause.kind == "board_size"]
    assert bool(found) == (result.verdict.status != "good") == (size != 1.0)
    for name in found:
        said = re.search(r"is ([0-9.]+) % smaller than stated \(sigma ([0-9.]+) %\)", name)
        percent, sigma = map(float, said.groups())
        assert abs(percent - 0.4) < 4.0 * sigma < 0.1


@pytest.mark.parametrize(
    ("order", "target", "mount", "words"),
    [
        (bottom_up, BOARD, TO_HAND, OVER),
        slow(by_column, SQUARE, IN_HAND, OVER),
        (
            lambda ids, *_: ids[::-1],
            replace(load_target("aruco_4x4_50_id0_120mm"), square_sigma_m=1e-6),
            IN_HAND,
            "counterclockwise",
        ),
        # As drawn, and turned, which is as good.
        slow(lambda ids, *_: ids, BOARD, IN_HAND, ""),
        slow(lambda ids, columns, rows: columns * rows - 1 - ids, BOARD, IN_HAND, ""),
    ],
    ids=["bottom up", "by column", "marker", "as drawn", "turned"],
)
def test_numbers_that_turn_the_board_over_are_named(order, target, mount, words):
    cell, session = renumbered(order, target, mount)
    found, kinds = calibrate(session), [finding.kind for finding in doctor(session).findings]
    assert kinds == ["corner_numbers"] * bool(words)
    if not words:
        assert found.verdict.status == "good"
        return
    cause = found.verdict.causes[0]
    assert cause.kind == "corner_numbers"
    assert words in cause.words
    if words == OVER:
        assert found.verdict.status == "check"
        assert "row by row from corner 0" in str(cause.do)
        # The board's z axis points at the camera, and the camera is where it is.
        board = "base_from_target" if mount == IN_HAND else "flange_from_target"
        assert found.edges[board].matrix[:3, 2] @ cell.transforms[board][:3, 2] < -0.99
        (camera,) = set(cell.transforms) - {board}
        away = found.edges[camera].matrix - cell.transforms[camera]
        assert np.linalg.norm(away[:3, 3]) < 1e-3


def errors_px(found, truth):
    """The errors of corners that were found, of more than twenty of them."""
    both, ours, theirs = np.intersect1d(found.ids, truth.ids, return_indices=True)
    assert len(both) > 20
    return found.px[ours] - truth.px[theirs]


def test_tags_are_found_to_a_hundredth_of_a_pixel(seen):
    truth, image = seen
    error = errors_px(find_target(image, TAGS), truth)
    # OpenCV's own corners are off by 0.1 px, and maps made once, from those, leave 0.010 px.
    assert np.sqrt(np.mean(error**2)) < 0.009
    assert np.abs(error.mean(axis=0)).max() < 0.005
    # Out of one plane they are found one by one.
    lifted = tuple((x, y, 0.01 * (at // 4)) for at, (x, y, _) in enumerate(TAGS.points_m))
    error = errors_px(find_target(image, replace(TAGS, points_m=lifted)), truth)
    assert np.sqrt(np.mean(error**2)) < 0.06
    # One tag will do for a view.
    names = ("points_m", "point_numbers", "point_tags")
    first = {name: getattr(TAGS, name)[:4] for name in names}
    found, _ = find_corners(image, replace(TAGS, columns=4, **first), 0)
    assert found.ids.tolist() == [0, 1, 2, 3]
    # Another page is named.
    moved = tuple((x + 0.2 * (at < 4), y, z) for at, (x, y, z) in enumerate(TAGS.points_m))
    lost = find_target(image, replace(TAGS, points_m=moved))
    assert "do not lie as the target describes" in lost.reason
    others = tuple((tag + 200, corner) for tag, corner in TAGS.point_tags)
    lost = find_target(image, replace(TAGS, point_tags=others))
    assert isinstance(lost, NotFound)
    assert lost.misfit
    assert "no tag of the target's, of DICT_APRILTAG_36h11, is seen; seen instead:" in lost.reason


def test_corners_outside_the_stated_image_are_refused(cube):
    cell = simulate(CellOptions(views=12, seed=3))
    for size, moved in (((640, 400), 0.0), ((1280, 800), [-1280, 0])):
        seen = [(view.ids, view.px + moved) for view in cell.corners]
        session = session_with(cell, seen, size, camera=False)
        refused = raised(DataError, "lie outside the image of", calibrate, session)
        px = np.concatenate([px for _, px in seen])
        said = refused.message
        assert f"u_px is {px[:, 0].min():.1f} to {px[:, 0].max():.1f}" in said
        assert "Correct resolution" in refused.next_step
        (found,) = (item for item in doctor(session).findings if item.words == said)
        assert found.do.words == refused.next_step
    changed(cube, "session.toml", "resolution = [1280, 960]\n", "")
    changed(cube, "session.toml", LENS, "")
    with pytest.raises(DataError, match="the camera's resolution is missing"):
        calibrate(cube)


@pytest.mark.slow
def test_dense_corners_bring_in_refused_views_and_leave_sharp_ones_alone():
    # A quarter of the pixels.
    camera = wide_camera()
    camera = replace(camera, resolution=(640, 400), matrix=camera.matrix / 2)
    plain = CellOptions(views=8, seed=3, blur_px=0.5, target=BOARDS["checkerboard"], camera=camera)
    cell = simulate(plain)
    # Five sharp images; the others are smeared by 18 px, most of a square.
    sharp, moved = smeared(cell), smeared(cell, motion_px=18.0)
    files = {
        view.image: (sharp if view.number < 5 else moved).images.read(view.image)
        for view in sharp.views
    }
    session = replace(sharp, images=MemoryImages(files))
    plain, dense = (run(session, dense=dense).calibration for dense in (False, True))
    used = [{view.view for view in found.views if view.used} for found in (plain, dense)]
    assert used == [set(range(5)), set(range(8))]
    edge, known = (found.edges["flange_from_cam"] for found in (dense, plain))
    error = log(invert(cell.transforms["flange_from_cam"]) @ edge.matrix)
    # Beyond 16.8 is a chi-square of six degrees of freedom in 1 % of sessions.
    assert error @ np.linalg.solve(edge.covariance, error) < 16.8
    assert np.trace(edge.covariance[3:, 3:]) < np.trace(known.covariance[3:, 3:])
    assert any("--dense" in reason for reason in dense.verdict.reasons)
    found = run(session.only(range(5)), dense=True).calibration.edges["flange_from_cam"]
    np.testing.assert_array_equal(found.matrix, known.matrix)


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


def renumbered(order, target, mount="eye-in-hand"):
    """A sound cell, and its session with the corners numbered in another order."""
    cell = simulate(CellOptions(mount=mount, views=16, seed=3, target=target))
    inset = 1 if target.kind == "charuco" else 0
    columns, rows = target.columns - inset, target.rows - inset
    seen = [(order(view.ids, columns, rows), view.px) for view in cell.corners]
    session = Session.from_corners(
        seen, cell.robot.base_from_flange, target, cell.stated[""].resolution, mount=mount
    )
    return cell, session


@pytest.fixture(scope="module")
def seen():
    """A cell's view, and its image."""
    cell = simulate(CellOptions(target=TAGS, views=3, seed=2))
    return cell.exact_corners[0], render(prepare_scene(cell), 0)


def test_they_are_printed_where_the_table_has_them():
    turned = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    points = tuple((*(np.array(point[:2]) @ turned).tolist(), 0.0) for point in TAGS.points_m)
    target = replace(PLATE, points_m=points)
    sheet, page = any_page(target), printed(target, 200)
    seen = find_target(cv2.GaussianBlur(page, (0, 0), 0.7), target)
    assert len(seen.ids) == len(points)
    expected = (
        (np.array(sheet.origin_mm) + 1e3 * corner_positions(target)[seen.ids, :2]) * 200 / 25.4
    )
    # A page in whole pixels is stretched by up to one.
    np.testing.assert_allclose(seen.px, expected - 0.5, atol=1.0)
    lifted = replace(TAGS, points_m=tuple((x, y, x) for x, y, _ in TAGS.points_m))
    with pytest.raises(DataError, match="in one plane z = 0"):
        any_page(lifted)


@pytest.mark.parametrize("mount", [IN_HAND, slow(TO_HAND)])
def test_a_cell_is_calibrated_with_them(tmp_path, mount):
    cell = simulate(CellOptions(target=TAGS, views=12, mount=mount, seed=4))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    assert result.verdict.status in ("good", "check")
    error = np.concatenate(
        [log(invert(result.edges[name].matrix) @ true) for name, true in cell.transforms.items()]
    )
    # Twelve values, to one case in a thousand.
    assert error @ np.linalg.solve(result.joint_covariance, error) < 32.9


def rewrite(folder: Path, name: str, change) -> Path:
    """Changes a table of a folder: its rows as lists of texts, the header the first of them."""
    rows = [line.split(",") for line in (folder / name).read_text().splitlines()]
    (folder / name).write_text("\n".join(map(",".join, change(rows) or rows)) + "\n")
    return folder


def with_line(line: str):
    return lambda folder: rewrite(folder, "corners.csv", lambda rows: rows.append(line.split(",")))


def with_column(name: str, value: str):
    def change(rows):
        for row in rows:
            row.append(value)
        rows[0][-1] = name

    return lambda folder: rewrite(folder, "corners.csv", change)


def counted_from(starts):
    """The points of tables renumbered in their order, from some first numbers."""

    def change(folder):
        for name, (column, start) in starts.items():

            def renumbered(rows, column=column, start=start):
                numbers = sorted({int(row[column]) for row in rows[1:]})
                for row in rows[1:]:
                    row[column] = str(numbers.index(int(row[column])) + start)

            rewrite(folder, name, renumbered)

    return change


def views_renumbered(change):
    def renumber(rows):
        for row in rows[1:]:
            row[0] = str(change(int(row[0])))

    return lambda folder: rewrite(folder, "views.csv", renumber)


def without_sigma(folder):
    """One row more, which states none."""
    rewrite(folder, "corners.csv", lambda rows: rows.append(["0", "700", "10", "10", ""]))


@pytest.mark.parametrize(
    ("rig", "change", "said"),
    [
        (Rig(), with_line("99,700,10,10"), "column view: views.csv has no view 99"),
        (Rig(), with_line("0,5,10,10"), "no point 5; its 37 points have the numbers 592 to 700"),
        (Rig(), with_line("0,700,10,10"), "point 700 of view 0 is there twice, first in corners.c"),
        (Rig(), with_line("0,x,10,10"), "corners.csv, line 557, column point: 'x' is no whole num"),
        (Rig(), with_line("0,700,nan,10"), "column u_px: 'nan' is no finite number"),
        (Rig(), with_line("0,700,10"), "it has 3 fields, but the header has 4 columns"),
        (Rig(), with_column("sigma_px", "0"), "column sigma_px: 0 px is no standard deviation"),
        # Its square overflows.
        (Rig(), with_column("sigma_px", "1e150"), "1e+150 px is no standard deviation"),
        (Rig(), with_column("score", "1"), "others are not read"),
        (
            Rig(),
            lambda folder: changed(folder, "corners.csv", "v_px", "sigma_px"),
            "view, point, u_px, v_px are needed",
        ),
        (Rig(stated=1.0), without_sigma, "it is empty; all rows state it, or none"),
        # Of a board, whose corners count from 0, and of a rig whose table counts from 1.
        (Rig("checkerboard"), counted_from({"corners.csv": (1, 1)}), "numbers 0 to 39"),
        (
            Rig(),
            counted_from({"corners.csv": (1, 0), "target.csv": (0, 1)}),
            "numbers 1 to 37",
        ),
        # Views are numbered otherwise.
        (Rig(), views_renumbered(lambda view: 77 if view == 2 else view), "csv has no view 2"),
    ],
)
def test_tables_of_corners_that_do_not_fit_are_refused(tmp_path, rig, change, said):
    folder = write_rig(tmp_path / "cell", rig)
    change(folder)
    with pytest.raises(DataError) as error:
        Session.load(folder)
    words = f"{error.value.message} {error.value.next_step}"
    assert said.lower() in words.lower()
    # One sentence, and not a line for each of hundreds of corners.
    assert "\n" not in error.value.message


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (PLACED, "has 3 points"),
        (f"{PLACED}2,0,1,1\n", "has 2 again as point of row 4"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,99,0,0\n2,0,99,0\n3,0,0,80\n", "looks like millimetres"),
        (f"{PLACED}3,0,nan,1\n", "line 5, column y_m: 'nan'"),
        (f"{PLACED}3,0,b,1\n", "line 5, column y_m: 'b'"),
        ("point,x_m,y_m\n0,0,0\n1,1,0\n2,0,1\n3,0,1\n", "point, x_m, y_m, z_m"),
        (SURE.format(1, 0), "has 0 as sigma_m of row 4"),
        (SURE.format("1e-300", 1), "has 1e-300 as sigma_m of row 1"),
        ("point,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n2,2,0,0\n3,5,0,0\n", "all points on one line"),
        ("point,x_m,y_m,z_m\n0,1,0,0\n1,1,0,0\n2,1,0,0\n3,1,0,0\n", "all points in one place"),
        (TAGGED.format(",tag,corner", ",7,0", ",7,1", ",7,2", ",7,4"), "with tag 7, corner 4"),
        (TAGGED.format(",tag,corner", ",7,0", ",7,1", ",7,2", ",7,2"), "corner 2 of tag 7 twice"),
        (TAGGED.format(",tag,corner", *[f",587,{at}" for at in range(4)]), "tags 0 to 586"),
        (TAGGED.format(",corner", *[f",{at}" for at in range(4)]), "a table with corner alone"),
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
    # A table says which corner of which tag each point is.
    (tmp_path / "rig.csv").write_text(
        TAGGED.format(",tag,corner", *[f",7,{at}" for at in range(4)])
    )
    target = load_target("rig.toml", tmp_path)
    assert target.point_tags == ((7, 0), (7, 1), (7, 2), (7, 3))
    assert target.dictionary == "DICT_APRILTAG_36h11"
    assert target_from_document(target_document(target), "rig") == target


def test_files_lie_beside_what_names_them(tmp_path, monkeypatch):
    (tmp_path / "inside").mkdir()
    (tmp_path / "points.csv").write_text("point,x_m,y_m,z_m\n", encoding="utf-8")
    target = tmp_path / "inside" / "rig.toml"
    target.write_text('kind = "points"\npoints = "../points.csv"\n', encoding="utf-8")
    with pytest.raises(DataError, match="leads out of the folder"):
        load_target("rig.toml", target.parent)
    (tmp_path / "elsewhere.csv").write_text("view,point,u_px,v_px\n", encoding="utf-8")
    (tmp_path / "inside" / "corners.csv").symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(DataError, match="leads out of its folder"):
        corners.read_corners(tmp_path / "inside")
    monkeypatch.setattr(corners, "_MOST_CORNERS", 2)
    rows = "".join(f"1,{at},10.0,20.0\n" for at in range(3))
    with pytest.raises(DataError, match="more than 2 rows"):
        corners.parse_corners("view,point,u_px,v_px\n" + rows)


def test_what_was_measured_counts_in_the_digest_and_a_deleted_row_takes_its_corners(cube):
    digest, text = Session.load(cube).digest(), (cube / "corners.csv").read_text()
    line = text.split("\n")[1]
    for name, old, new in (
        ("corners.csv", line, line.replace(".", ".5", 1)),
        ("target.csv", "-0.08,-0.08,-0.08", "-0.08,-0.08,-0.081"),
    ):
        assert Session.load(changed(cube, name, old, new)).digest() != digest
        changed(cube, name, new, old)
    # Spelling counts for nothing.
    (cube / "corners.csv").write_text(text.replace(",", " , "))
    assert Session.load(cube).digest() == digest
    rewrite(cube, "views.csv", lambda rows: rows.pop(3) and None)
    session = Session.load(cube)
    assert len(session.views) == 14
    assert set(session.corner_table.views.tolist()) == {view.number for view in session.views}


@pytest.mark.slow
def test_the_camera_is_where_it_is_within_its_sigmas(tmp_path):
    squares = np.zeros((len(RIGS), SEEDS))
    for at, rig in enumerate(RIGS):
        for seed in range(SEEDS):
            folder = write_rig(tmp_path / f"{at}_{seed}", replace(rig, seed=seed))
            squares[at, seed] = x_of(calibrate(folder))[1]
    # Sums are chi-square of as many numbers, which chance leaves in one of a thousand cases; the
    # noise of the robot is known to 10 % from so few stops, and its square to 20 %.
    for sums, freedom in ((squares.sum(axis=1), 6 * SEEDS), (squares.sum(), 6 * squares.size)):
        low, high = chi2_limit(np.array([0.9995, 0.0005]), freedom)
        assert np.all((low / 1.2 < sums) & (sums < 1.2 * high))
