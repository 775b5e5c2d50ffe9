"""Cells that nobody chose: `cell(seed)` draws one, with its truth, from what a user may declare.

Nothing here is visioncal's: images, arms and transforms come from numpy, OpenCV and scipy alone.
"""

import csv
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from scipy.spatial.transform import RigidTransform, Rotation
from support.fuzz.varied_arms import Arm, built_in, built_in_names, placed, table_arm, urdf_arm
from support.fuzz.varied_images import Lens, Light, Print, background, draw, exposed

SHIPPED = Path(__file__).parents[3] / "targets"
DICTIONARIES = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
BOARDS = ("floor", "Wall_2", "x")
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
LEAST_MODULE_PX = 3.0
# How far a board may be from the camera of an arm that is to look at it from around [m].
FARTHEST_REACHED_M = 0.9
# A view needs six corners, and hardly shows all of a small board.
LEAST_CORNERS = 9
# Finders' limits, which most cells keep: corners of checkerboards of smaller squares are found with
# a bias of up to 0.2 px, and those of ChArUco boards whose markers come nearer with one of 0.1 px.
LEAST_SQUARE_PX = {"charuco": 20.0, "checkerboard": 32.0, "marker": 60.0}
LEAST_GAP_PX, LARGEST_RATIO = 4.5, 0.7
# What is larger is rendered where the board is alone, and is a checkerboard only now and then:
# OpenCV looks for one in 13 megapixels for seconds.
LARGE_PX = 1_500_000
RESOLUTIONS = {
    (640, 480): 45, (752, 480): 12, (800, 600): 10, (1024, 768): 6, (1280, 720): 5, (1280, 800): 5,
    (1280, 1024): 2, (1600, 1200): 1.5, (1920, 1080): 1.5, (1921, 1081): 0.5, (2448, 2048): 0.8,
    (4096, 3000): 0.2, (5472, 3648): 0.2,
}  # fmt: skip
NAMES = (
    "{:03d}.png", "cam {:d} äöüß.png", "-{:d}.png", ".{:d}.png", "'{:d}'.png", '"q" {:d}.jpg',
    "📷{:d}.png", "a,b;{:d}.png", "100%d {:d}.tif", "Ordner ü/дир/{:d}.png", "UPPER{:d}.PNG",
    "[bold]{:d}[/].png", "é{:d}.jpeg", f"{'n' * 190}{{:03d}}.png", "#{:d}.png", "$HOME {:d}.png",
)  # fmt: skip
TITLES = (
    "Zelle 4, 2026-11-20", "cell", "Zelle ÄÖÜ 'Süd' \"oben\"", "[red]cell[/red] <b>&amp;",
    "📷 робот", "-o", ".hidden", "n" * 200, "a/b\\c", "100 % {x} $HOME", "tab\tand\nline",
    "  spaces  ",
)  # fmt: skip
FOLDERS = ("session", "-session", ".session", "zwei Wörter", "s" * 200, "📷 'q' \"r\"", "[x] 100%")


@dataclass(frozen=True, eq=False)
class Stop:
    """Where the robot says that it is, and how the boards stand before the camera."""

    reported: np.ndarray
    joints: np.ndarray | None
    shown: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell: what is declared of it, and what is true."""

    seed: int  # What it was drawn from.
    facts: dict[str, str]  # Its traits in words, to be counted.
    mount: str  # Where the camera is.
    lens: Lens  # The true lens.
    camera: dict | None  # `[camera]`, or None.
    boards: dict[str, Print]  # What is printed, by name; an only one's is "".
    arm: Arm | None  # The robot, where it has joints.
    robot: dict | None  # `[robot]`, or None.
    camera_edge: np.ndarray  # (4, 4) flange_from_cam or base_from_cam.
    board_edges: dict[str, np.ndarray]  # (4, 4) base_from_target or flange_from_target, by board.
    start: np.ndarray | None  # (n,) joints about which the stops lie, where there is an arm.
    together: bool  # Whether the boards stand side by side and are seen in one image.
    views: int  # How many stops.
    sigma: tuple[float, float]  # Standard deviations of the robot (rad, m).
    # Those of measured poses of the board, where no image is taken; else None.
    seen_sigma: tuple[float, float] | None
    light: Light  # How images are exposed.
    rows: str  # What rows tell of the robot: poses, joints or both.
    square_px: float  # How large a square is in the image.
    axis: bool  # Whether the camera turns about one axis alone.

    @property
    def truth(self) -> dict[str, np.ndarray]:
        """The true transforms, as calibration.json names them."""
        in_hand = self.mount == "eye-in-hand"
        camera, board = (
            ("flange_from_cam", "base_from_target")
            if in_hand
            else ("base_from_cam", "flange_from_target")
        )
        return {camera: self.camera_edge} | {
            f"{board}_{name}" if name else board: edge for name, edge in self.board_edges.items()
        }

    def flange(self, name: str, seen: np.ndarray) -> np.ndarray:
        """base_from_flange where a board stands so before the camera."""
        board, camera = self.board_edges[name], self.camera_edge
        if self.mount == "eye-in-hand":
            return board @ np.linalg.inv(seen) @ np.linalg.inv(camera)
        return camera @ seen @ np.linalg.inv(board)

    def seen(self, name: str, flange: np.ndarray) -> np.ndarray:
        """cam_from_target of a board where the flange is there."""
        board, camera = self.board_edges[name], self.camera_edge
        if self.mount == "eye-in-hand":
            return np.linalg.inv(flange @ camera) @ board
        return np.linalg.inv(camera) @ flange @ board

    def turned(self) -> Iterator[dict[str, np.ndarray]]:
        """The true transforms in all the ways in which a checkerboard's frame may be counted."""
        edge = next(iter(self.truth))
        ways: list[dict[str, np.ndarray]] = [{edge: self.camera_edge}]
        for name, board in zip(list(self.truth)[1:], self.boards.values(), strict=True):
            ways = [way | {name: self.truth[name] @ turn} for way in ways
                    for turn in board.half_turns()]  # fmt: skip
        yield from ways


def chance(rng: np.random.Generator, probability: float) -> bool:
    return bool(rng.random() < probability)


def choice(rng: np.random.Generator, of: dict) -> object:
    weights = np.array(list(of.values()), float)
    return list(of)[rng.choice(len(of), p=weights / weights.sum())]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def shaken(rng: np.random.Generator, pose: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    noise = rng.normal(size=6) * np.repeat(sigma, 3)
    return pose @ RigidTransform.from_exp_coords(noise).as_matrix()


def cell(seed: int) -> Cell:
    """Draws the cell of a seed, always the same."""
    rng = np.random.default_rng([seed, 2026])
    mount = str(rng.choice(["eye-in-hand", "eye-to-hand"]))
    kind = str(choice(rng, {"none": 40, "built-in": 26, "urdf": 14, "table": 14, "unknown": 6}))
    while True:
        found = _cell(seed, rng, mount, kind)
        # Stops cannot always be found, such as where an arm does not reach.
        if found is not None and len(_stops(found, 0)) == found.views:
            return found


def _cell(seed: int, rng: np.random.Generator, mount: str, arm_kind: str) -> Cell | None:
    """Draws a cell; None where the parts that were drawn do not go together."""
    lens = _lens(rng)
    measured = chance(rng, 0.18)
    count = int(choice(rng, {1: 80, 2: 14, 3: 6}))
    together = count > 1 and not measured and chance(rng, 0.4)
    drawn = _boards(rng, lens, count, together=together)
    if drawn is None:
        return None
    boards, square_px = drawn
    board = next(iter(boards.values()))
    arm = _arm(rng, arm_kind)
    depth_m = board.true_m * float(lens.matrix[0]) / square_px
    if arm is not None and depth_m > FARTHEST_REACHED_M:
        return None
    motion = str(choice(rng, {"sufficient": 92, "2 to 5 stops": 5, "about one axis": 3}))
    estimated = not measured and chance(rng, 0.35)
    views = int(rng.integers(9, 14) if estimated else rng.integers(7, 13))
    if motion == "2 to 5 stops":
        views = int(rng.integers(2, 6))
    elif lens.resolution[0] * lens.resolution[1] > LARGE_PX:
        views = 10 if estimated else 8
    camera, lens_known = _camera(rng, lens, estimated=estimated)
    robot = _robot(rng, arm, arm_kind)
    sigma_m = log_uniform(rng, 2e-5, 3e-4)
    sigma = (log_uniform(rng, 2e-5, 3e-4), sigma_m)
    seen_sigma = None
    if measured:
        seen_sigma = (log_uniform(rng, 1e-4, 1e-3), log_uniform(rng, 5e-5, 5e-4))
        if chance(rng, 0.5):
            camera, lens_known = None, "not declared"
    light = Light(
        rng.uniform(15, 50),
        rng.uniform(170, 225),
        rng.uniform(70, 150),
        rng.uniform(0.45, 1.1),
        log_uniform(rng, 1.0, 5.0),
    )
    start, flange, rows = None, _anywhere(rng, 0.8), "poses"
    if arm is not None:
        rows = str(choice(rng, {"poses": 25, "joints": 35, "both": 40}))
        start = _start(rng, arm)
        flange = arm.frames(start[None])[1][0]
    camera_edge, edges = _edges(rng, mount, boards, flange, depth_m, together=together)
    megapixels = lens.resolution[0] * lens.resolution[1] / 1e6
    facts = {
        "mount": mount,
        "boards": str(count) + (" in one image" if together else ""),
        "board": board.kind + (" (shipped)" if "file" in board.document else ""),
        "camera": f"{lens.model} {len(lens.distortion)}",
        "image": next(
            f"up to {value:g} MP" for value in (0.5, 1, 2, 5, 13, 20) if megapixels <= value
        ),
        "upright": "portrait" if lens.resolution[1] > lens.resolution[0] else "landscape",
        "intrinsics": lens_known,
        "robot": f"built-in {arm.model}" if arm is not None and not arm.text else arm_kind,
        "seen": "cft_ columns" if measured else "images",
        "motion": motion,
        "corners": "no image" if measured else _within_limits(board, square_px),
    }
    return Cell(
        seed,
        facts,
        mount,
        lens,
        camera,
        boards,
        arm,
        robot,
        camera_edge,
        edges,
        start,
        together,
        views + 4 * (count - 1),
        sigma,
        seen_sigma,
        light,
        rows,
        square_px,
        motion == "about one axis",
    )


def _boards(
    rng: np.random.Generator, lens: Lens, count: int, *, together: bool
) -> tuple[dict[str, Print], float] | None:
    """The boards by name, and how many pixels a square of the first has in most views."""
    first = _print(rng, lens, together=together)
    if first is None:
        return None
    board, square_px = first
    if count == 1:
        return {"": board}, square_px
    boards = {BOARDS[0]: board}
    for name in BOARDS[1:count]:
        other = _another(rng, board, list(boards.values()), same=not together)
        if other is None:
            return None
        boards[name] = other
    return boards, square_px


def _robot(rng: np.random.Generator, arm: Arm | None, kind: str) -> dict | None:
    """`[robot]`, or None."""
    if arm is not None:
        told = kind == "urdf" or chance(rng, 0.5)  # a URDF may end anywhere
        return {"model": arm.model} | ({"tip": arm.tip} if told else {})
    return {"model": "my robot é", "tip": "tool0"} if kind == "unknown" else None


def _edges(
    rng: np.random.Generator,
    mount: str,
    boards: dict[str, Print],
    flange: np.ndarray,
    depth_m: float,
    *,
    together: bool,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Where camera and boards are, so that the camera sees the first from about the middle stop."""
    board = next(iter(boards.values()))
    centre = np.array([0.0, 0.0, depth_m]) + np.array([*rng.normal(0, 0.02 * depth_m, 2), 0.0])
    middle = placed(centre, Rotation.identity()) @ placed(-board.centre, Rotation.identity())
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    lean = Rotation.from_rotvec([*rng.normal(0, 0.25, 2), 0.0])
    if chance(rng, 0.15):
        lean = Rotation.random(random_state=int(rng.integers(1 << 31)))
    held = placed(rng.uniform([-0.12, -0.12, 0.0], [0.12, 0.12, 0.15]), turn * lean)
    if mount == "eye-in-hand":
        camera_edge, main = held, flange @ held @ middle
    else:
        camera_edge, main = flange @ held @ np.linalg.inv(middle), held
    edges = {next(iter(boards)): main}
    for at, name in enumerate(list(boards)[1:], 1):
        if together:
            beside = board.true_m * (board.size[0] + 2.0) * at
            edges[name] = main @ placed([beside, 0.0, 0.0], Rotation.identity())
        else:
            tilt = Rotation.from_rotvec(rng.normal(0, 0.3, 3))
            edges[name] = main @ placed(rng.normal(0, 0.1, 3), tilt)
    return camera_edge, edges


def _lens(rng: np.random.Generator) -> Lens:
    """A lens that can be inverted all over its image and a little beyond."""
    while True:
        lens = _any_lens(rng)
        width, height = lens.resolution
        x, y = np.meshgrid([-24.0, 0.5 * width, width + 23.0], [-24.0, 0.5 * height, height + 23.0])
        px = np.stack([x.ravel(), y.ravel()], axis=1)
        rays = np.concatenate([lens.plane_of(px), np.ones((len(px), 1))], axis=1)
        if np.abs(lens.project(rays) - px).max() < 1e-3:
            return lens


def _any_lens(rng: np.random.Generator) -> Lens:
    width, height = choice(rng, RESOLUTIONS)
    model = str(choice(rng, {"brown 5": 55, "brown 8": 25, "fisheye": 20}))
    if model == "fisheye":
        focal = width * rng.uniform(0.4, 0.7)
        distortion = rng.normal(0, [0.02, 0.01, 0.005, 0.002])
    else:
        focal = width * log_uniform(rng, 0.75, 2.0)
        k1, k2 = rng.uniform(-0.22, 0.1), rng.uniform(-0.03, 0.08)
        p1, p2 = rng.normal(0, 5e-4, 2)
        k3 = rng.uniform(-0.01, 0.01)
        distortion = np.array([k1, k2, p1, p2, k3])
        if chance(rng, 0.1):
            distortion = np.zeros(5)
        if model == "brown 8":
            k4, k5, k6 = rng.uniform(-0.05, 0.05), rng.uniform(-0.02, 0.02), 0.002
            distortion = np.concatenate([distortion, [k4, k5, k6]])
    middle = 0.5 * np.array([width - 1, height - 1]) + rng.normal(0, 0.01 * width, 2)
    matrix = np.array([focal, focal * rng.uniform(0.995, 1.005), *middle])
    if chance(rng, 0.15):
        width, height, matrix = height, width, matrix[[1, 0, 3, 2]]
    return Lens(model.split()[0], (int(width), int(height)), matrix, distortion)


def _camera(rng: np.random.Generator, lens: Lens, *, estimated: bool) -> tuple[dict, str]:
    """`[camera]`, and how it is known."""
    table = {
        "name": str(rng.choice(["oak-d-lite", "Kamera ü", "-cam", "c" * 200])),
        "resolution": list(lens.resolution),
        "model": lens.model,
    }
    if estimated:
        return table, "estimated"
    how = str(choice(rng, {"auto": 50, "hold": 30, "refine": 20}))
    matrix, words = lens.matrix, "exact"
    if how != "hold" and chance(rng, 0.5):
        sigma_px = 5e-4 * float(lens.matrix[0])
        matrix, words = lens.matrix + rng.normal(0, sigma_px, 4), "off as stated"
        table["matrix_sigma_px"] = sigma_px
        # No view tells a shifted centre from a turned camera: what is not stated is not counted.
        if chance(rng, 0.1):
            words = "off, and not said"
            del table["matrix_sigma_px"]
    table |= {"matrix": matrix.tolist(), "distortion": lens.distortion.tolist()}
    if how != "auto" or chance(rng, 0.3):
        table["intrinsics"] = how
    return table, f"{how}, {words}"


def _print(rng: np.random.Generator, lens: Lens, *, together: bool) -> tuple[Print, float] | None:
    """A board, and how many pixels a square of it has in most views."""
    large = lens.resolution[0] * lens.resolution[1] > LARGE_PX
    kinds = {"charuco": 50, "checkerboard": 5 if large else 33, "marker": 0 if together else 17}
    kind = str(choice(rng, kinds))
    if chance(rng, 0.15) and not together:
        return _shipped(rng, lens)
    beyond = chance(rng, 0.05)
    least_px = 14.0 if beyond else LEAST_SQUARE_PX[kind]
    for _ in range(200):
        if kind == "marker":
            columns = rows = 1
            fill = rng.uniform(0.2, 0.45)
        else:
            columns, rows = (round(log_uniform(rng, 2.6, 30.4)) for _ in range(2))
            fill = rng.uniform(0.45, 0.8)
            if kind == "charuco" and chance(rng, 0.3):
                fill = rng.uniform(0.8, 1.2)
        if together:
            fill *= 0.6
        square_px = _square_px(lens, kind, (columns, rows), fill)
        tiny = kind == "charuco" and (columns - 1) * (rows - 1) < LEAST_CORNERS
        if square_px > least_px and (beyond or not tiny):
            break
    else:
        return None
    low_m, high_m = (value * square_px / lens.matrix[0] for value in (0.15, 1.8))
    least, most = (20, 300) if kind == "marker" else (5, 100)
    low_mm, high_mm = max(least, 1e3 * low_m), min(most, 1e3 * high_m)
    if low_mm > high_mm:
        return None
    square_mm = log_uniform(rng, low_mm, high_mm)
    square_m = float(f"{square_mm:.1f}") / 1e3 if chance(rng, 0.7) else square_mm / 1e3
    document = _document(rng, kind, columns, rows, square_m, square_px, beyond=beyond)
    return None if document is None else (_printed(rng, document), square_px)


def _document(rng: np.random.Generator, kind: str, columns: int, rows: int, square_m: float,
              square_px: float, *, beyond: bool) -> dict | None:  # fmt: skip
    """The content of a board's .toml; within what finders do well, or beyond."""
    document = {"kind": kind}
    if kind == "marker":
        name = str(rng.choice(DICTIONARIES))
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        number = int(rng.integers(len(dictionary.bytesList)))
        document |= {"id": number, "size_m": square_m, "dictionary": name}
    else:
        document |= {"columns": columns, "rows": rows, "square_m": square_m}
    if chance(rng, 0.5):
        document["square_sigma_m"] = square_m * log_uniform(rng, 1e-4, 1e-3)
    if kind == "charuco":
        for _ in range(50):
            name = str(rng.choice(DICTIONARIES))
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            ratio = rng.uniform(0.4, 0.9) if beyond else rng.uniform(0.4, LARGEST_RATIO)
            near = 0.5 * (1.0 - ratio) * square_px < LEAST_GAP_PX
            enough = len(dictionary.bytesList) >= columns * rows // 2
            read = ratio * square_px / (dictionary.markerSize + 2) > LEAST_MODULE_PX
            if enough and read and (beyond or not near):
                break
        else:
            return None
        marker_mm = 1e3 * ratio * square_m
        marker_m = round(marker_mm, 1) / 1e3 if chance(rng, 0.6) else marker_mm / 1e3
        document |= {"marker_m": marker_m, "dictionary": name}
        if chance(rng, 0.4):
            document["legacy"] = chance(rng, 0.6)
    return document


def _within_limits(board: Print, square_px: float) -> str:
    """Whether a board keeps what finders do well."""
    if square_px < LEAST_SQUARE_PX[board.kind]:
        return "squares too small"
    if board.kind == "charuco":
        ratio = board.document["marker_m"] / board.document["square_m"]
        # A marker's side may have been rounded up.
        if ratio > LARGEST_RATIO + 0.01 or 0.5 * (1 - ratio) * square_px < LEAST_GAP_PX - 0.3:
            return "markers too near"
    return "as finders like"


def _printed(rng: np.random.Generator, document: dict) -> Print:
    """The board as printers make it: off by what is declared, or by what is usual."""
    side_m = document.get("square_m", document.get("size_m"))
    off_m = document.get("square_sigma_m", 1e-3 * side_m) * np.clip(rng.normal(), -2.5, 2.5)
    return Print(document, side_m + off_m)


def _square_px(lens: Lens, kind: str, size: tuple[int, int], fill: float) -> float:
    more = 1 if kind == "checkerboard" else 0
    sides = np.sort(np.array(size) + more)
    return float(np.min(fill * np.sort(lens.resolution) / sides))


def _is_drawn(path: Path) -> bool:
    """Whether this walk draws boards of its kind; grids of tags and of circles are none of them."""
    return tomllib.loads(path.read_text(encoding="utf-8"))["kind"] in LEAST_SQUARE_PX


def _shipped(rng: np.random.Generator, lens: Lens) -> tuple[Print, float] | None:
    path = rng.choice(sorted(path for path in SHIPPED.glob("*.toml") if _is_drawn(path)))
    document = tomllib.loads(path.read_text(encoding="utf-8")) | {"file": path.stem}
    kind = document["kind"]
    size = (1, 1) if kind == "marker" else (document["columns"], document["rows"])
    square_px = _square_px(lens, kind, size, 0.4 if kind == "marker" else rng.uniform(0.5, 0.85))
    board = _printed(rng, document)
    depth_m = board.true_m * lens.matrix[0] / square_px
    modules_px = square_px
    if kind == "charuco":
        ratio = document["marker_m"] / document["square_m"]
        modules_px = ratio * square_px / (board.dictionary.markerSize + 2)
    fits = square_px > LEAST_SQUARE_PX[kind] and modules_px > LEAST_MODULE_PX and depth_m < 1.8
    return (board, square_px) if fits else None


def _another(
    rng: np.random.Generator, board: Print, others: list[Print], *, same: bool
) -> Print | None:
    """Another board of about the same size; in one image, of markers that no other has."""
    if same and chance(rng, 0.5):
        return _printed(rng, board.document)
    document = {key: value for key, value in board.document.items() if key != "file"}
    if board.kind != "marker":
        document["columns"] = max(3, document["columns"] - int(rng.integers(0, 3)))
    if same:
        return _printed(rng, document)
    if board.kind != "charuco":
        return None
    taken = {other.document["dictionary"].rsplit("_", 1)[0] for other in others}
    bits = board.dictionary.markerSize
    for name in rng.permutation(DICTIONARIES).tolist():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        enough = len(dictionary.bytesList) >= document["columns"] * document["rows"] // 2
        if enough and dictionary.markerSize <= bits and name.rsplit("_", 1)[0] not in taken:
            return _printed(rng, document | {"dictionary": name})
    return None


def _arm(rng: np.random.Generator, kind: str) -> Arm | None:
    if kind == "built-in":
        return built_in(str(rng.choice(built_in_names())))
    if kind == "urdf":
        return urdf_arm(rng, str(rng.choice(["arm.urdf", "mein Arm é.urdf"])), "arm")
    if kind == "table":
        return table_arm(rng, str(rng.choice(["arm.toml", "-arm 'ü'.toml"])), "arm é")
    return None


def _start(rng: np.random.Generator, arm: Arm) -> np.ndarray:
    """Joints in the middle half of their limits, away from folded and stretched postures."""
    low, high = np.maximum(arm.lower, -2.2), np.minimum(arm.upper, 2.2)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    q = middle + 0.6 * half * rng.uniform(-1, 1, len(low))
    return q + 0.4 * np.sign(q) * (half > 1.5)


def _anywhere(rng: np.random.Generator, far_m: float) -> np.ndarray:
    turn = Rotation.random(random_state=int(rng.integers(1 << 31)))
    return placed(rng.uniform(-far_m, far_m, 3), turn)


def _look(rng: np.random.Generator, item: Cell, board: Print) -> np.ndarray | None:
    """cam_from_target of a view that shows enough of a board; None where none is found."""
    lens = item.lens
    size = np.array(lens.resolution)
    for attempt in range(60):
        covariance = 0.35 if board.kind != "charuco" else 0.25
        px = 0.5 * (size - 1) + rng.uniform(-1, 1, 2) * covariance * size * (1 - attempt / 80)
        ray = np.append(lens.plane_of(px[None])[0], 1.0)
        ray /= np.linalg.norm(ray)
        scale = rng.uniform(0.85, 1.25) * (1 + attempt / 60)
        depth_m = scale * board.true_m * lens.matrix[0] / item.square_px
        along = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * np.array([0.0, 0.0, 1.0]))
        tilt = along.apply([np.deg2rad(rng.uniform(8, 42)), 0.0, 0.0])
        roll = Rotation.from_rotvec([0.0, 0.0, rng.normal(0, 0.5)])
        if item.axis:
            turn = roll
        else:
            turn = Rotation.from_rotvec(0.7 * np.cross([0, 0, 1], ray)) * Rotation.from_rotvec(tilt)
            turn = turn * roll
        pose = placed(depth_m * ray - turn.apply(board.centre), turn)
        if _shows(lens, board, pose):
            return pose
    return None


def _shows(lens: Lens, board: Print, pose: np.ndarray) -> bool:
    """Whether enough of a board is in the image, seen from its front and not too flatly."""
    seen = board.corners @ pose[:3, :3].T + pose[:3, 3]
    if (seen[:, 2] < 0.02).any():
        return False
    sight = pose[:3, 2] @ seen.mean(axis=0) / np.linalg.norm(seen.mean(axis=0))
    if sight < 0.5:
        return False
    corner_px = np.array([[0, 0], [lens.resolution[0] - 1, lens.resolution[1] - 1.0]])
    reach = 1.02 * np.abs(lens.plane_of(corner_px)).max(axis=0)
    within = (np.abs(seen[:, :2] / seen[:, 2:]) < reach).all(axis=1)
    if not within.any():
        return False
    px = lens.project(seen[within])
    edge = 10.0
    inside = ((px > edge) & (px < np.array(lens.resolution) - edge)).all(axis=1)
    if board.kind == "charuco":
        return inside.sum() >= max(min(8, len(seen)), 0.55 * len(seen))
    # A checkerboard's outer squares are needed too.
    around = (
        board.true_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (board.kind != "marker")
    )
    ends = seen[[0, board.size[0] - 2, -1, 1 - board.size[0]]] if board.kind != "marker" else seen
    outer = ends + np.concatenate([around, np.zeros((4, 1))], axis=1) @ pose[:3, :3].T
    if (outer[:, 2] < 0.02).any() or (np.abs(outer[:, :2] / outer[:, 2:]) > reach).any():
        return False
    px = lens.project(outer)
    return bool(inside.sum() == len(seen) and
                ((px > 2) & (px < np.array(lens.resolution) - 3)).all())  # fmt: skip


def _stops(item: Cell, visit: int) -> list[Stop]:
    """The stops of a visit; fewer than wanted where they cannot be found."""
    rng = np.random.default_rng([item.seed, 7, visit])
    names, found = list(item.boards), []
    wanted = item.views if visit == 0 else max(6, 3 * len(names))
    for attempt in range(8):
        short = wanted - len(found)
        if short == 0:
            break
        looks = []
        for at in range(short if item.arm is None else 3 * short):
            name = names[(len(found) + at) % len(names)]
            pose = _look(rng, item, item.boards[name])
            if pose is not None:
                looks.append((name, pose))
        if not looks:
            return []
        flanges = np.array([item.flange(name, pose) for name, pose in looks])
        if item.arm is None:
            joints, fits = [None] * len(looks), np.ones(len(looks), bool)
        else:
            joints, fits = item.arm.reach(flanges, item.start)
            flanges = item.arm.frames(joints)[1]
        if attempt == 1 and len(found) + fits.sum() < 0.3 * wanted:
            return []
        for (name, _), flange, q, fit in zip(looks, flanges, joints, fits, strict=True):
            if fit and len(found) < wanted:
                found.append(_stop(rng, item, name, flange, q))
    return found


def _stop(rng: np.random.Generator, item: Cell, name: str, reported: np.ndarray,
          joints: np.ndarray | None) -> Stop:  # fmt: skip
    true = shaken(rng, reported, item.sigma)
    shown = {name: item.seen(name, true)}
    if item.together:
        for other, board in item.boards.items():
            pose = item.seen(other, true)
            if other != name and _shows(item.lens, board, pose):
                shown[other] = pose
    return Stop(reported, joints, shown)


@dataclass(frozen=True)
class Written:
    """A session on disk, and traits of its rows to be counted."""

    folder: Path
    facts: dict[str, str]


def write(cell: Cell, beside: Path, visit: int = 0) -> Written:
    """Writes a visit to a cell as a session: the first is to be calibrated, others verify.

    Args:
        cell: The cell.
        beside: The folder in which the session's own is made.
        visit: Each has other stops and other noise.
    """
    rng = np.random.default_rng([cell.seed, 11, visit])
    odd = chance(rng, 0.4)
    folder = beside / (str(rng.choice(FOLDERS)) if odd else "session")
    (folder / "images").mkdir(parents=True)
    title = str(rng.choice(TITLES)) if odd else f"cell {cell.seed}"
    image_name = str(rng.choice(NAMES)) if odd else NAMES[0]
    facts = {"names": "odd" if odd else "plain"}
    document = {"schema": 1, "name": title, "mount": cell.mount}
    if cell.camera is not None:
        document["camera"] = cell.camera
    if cell.robot is not None:
        document["robot"] = cell.robot
        if cell.arm is not None and cell.arm.text:
            (folder / cell.arm.model).write_text(cell.arm.text, encoding="utf-8")
    if (
        cell.seen_sigma is None
        or len(cell.boards) > 1
        or (cell.camera is not None and chance(rng, 0.5))
    ):
        document |= _targets(rng, cell, folder, odd=odd)
    columns, rows = _rows(rng, cell, visit, facts, folder, image_name)
    (folder / "session.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    with (folder / "views.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
    return Written(folder, facts)


def _targets(rng: np.random.Generator, item: Cell, folder: Path, *, odd: bool) -> dict:
    """Writes the boards' files, and gives what session.toml says of them."""
    places = {}
    for at, (name, board) in enumerate(item.boards.items()):
        if "file" in board.document:
            places[name] = board.document["file"]
            continue
        file = (
            str(rng.choice(["board {}.toml", "-tafel ü{}.toml", ".b{}.toml"]))
            if odd
            else "b{}.toml"
        )
        places[name] = file.format(at)
        text = tomli_w.dumps(board.document)
        (folder / places[name]).write_text(text, encoding="utf-8")
    if len(places) == 1:
        return {"target": places[""]}
    return {"targets": places}


def _rows(rng: np.random.Generator, item: Cell, visit: int, facts: dict[str, str], folder: Path,
          image_name: str) -> tuple[list[str], list[dict]]:  # fmt: skip
    """The rows of views.csv, with their images written."""
    facts["rows"] = item.rows
    repeats = item.seen_sigma is None and not item.together and chance(rng, 0.08)
    stops = _stops(item, visit)
    held_out = chance(rng, 0.2) and visit == 0 and len(stops) > 10
    shots = [(stop, stops[stop]) for stop in range(len(stops)) for _ in range(1 + repeats)]
    of_stop = item.together or repeats or chance(rng, 0.1)
    facts["stops"] = "several rows" if repeats or item.together else "one row"
    begin, stride = choice(rng, {(0, 1): 70, (1, 1): 15, (7, 10): 15})
    stamped = chance(rng, 0.3)
    extra = chance(rng, 0.3)
    rows: list[dict] = []
    images: list[str] = []
    for at, (number, stop) in enumerate(shots):
        image = ""
        if item.seen_sigma is None:
            image = f"images/{image_name.format(at)}"
            images.append(image)
            _take(rng, item, stop.shown, folder / image)
        shared: dict[str, object] = {"stop": number} if of_stop else {}
        if stamped:
            shared["stamp_s"] = f"{1.7e9 + 3.25 * at:.6f}"
        if extra:
            shared |= {"Bemerkung ü": f'gut, "{at}"', "📷": "", "operator": "-"}
        for name, pose in stop.shown.items():
            row: dict[str, object] = {"view": begin + stride * len(rows), "image": image}
            row |= shared | _told(item, stop)
            if name:
                row["target"] = name
            if item.seen_sigma is not None:
                row |= _pose_cells(shaken(rng, pose, item.seen_sigma), "cft_")
            if held_out:
                row["role"] = "holdout" if number % 6 == 5 else str(rng.choice(["fit", ""]))
            rows.append(row)
    facts["roles"] = "with holdout" if held_out else "fit"
    if item.seen_sigma is None and visit == 0:
        _spoil(rng, item, facts, folder, images, rows, image_name)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return columns, rows


def _told(item: Cell, stop: Stop) -> dict[str, str]:
    """What a row tells of the robot."""
    cells = {} if item.rows == "joints" else _pose_cells(stop.reported)
    if stop.joints is not None and item.rows != "poses":
        cells |= {f"q{n}_rad": f"{q:.9f}" for n, q in enumerate(stop.joints, 1)}
    return cells


def _spoil(rng: np.random.Generator, item: Cell, facts: dict[str, str], folder: Path,
           images: list[str], rows: list[dict], image_name: str) -> None:  # fmt: skip
    """Rows for the lens alone; images that are missing, torn or show nothing."""
    width, height = item.lens.resolution
    small = width * height < LARGE_PX
    if chance(rng, 0.1) and small:
        facts["roles"] += " and intrinsics"
        name, board = next(iter(item.boards.items()))
        for at in range(int(rng.integers(1, 6))):
            pose = _look(rng, item, board)
            if pose is not None:
                image = f"images/{image_name.format(900 + at)}"
                _take(rng, item, {name: pose}, folder / image)
                row = {"view": 10_000 + at, "image": image, "role": "intrinsics"}
                rows.append(row | ({"target": name} if name else {}))
    facts["images"] = "all there"
    if chance(rng, 0.15) and len(images) > 5:
        how = str(rng.choice(["missing", "torn", "empty", "no board"]))
        facts["images"] = f"some {how}"
        for image in rng.choice(images, int(rng.integers(1, 3)), replace=False):
            path = folder / str(image)
            if how == "missing":
                path.unlink()
            elif how == "torn":
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
            elif how == "empty":
                path.write_bytes(b"")
            else:
                _take(rng, item, {}, path)


def _take(rng: np.random.Generator, item: Cell, shown: dict[str, np.ndarray], path: Path) -> None:
    """Takes an image and stores it."""
    width, height = item.lens.resolution
    image = background(rng, item.lens, item.light)
    covered = [
        draw(image, item.lens, item.boards[name], pose, item.light, item.square_px)
        for name, pose in shown.items()
    ]
    where = None if width * height < LARGE_PX else [part for part in covered if part is not None]
    grey = exposed(rng, image, item.light, where)
    if item.seed % 7 == 0:
        grey = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    settings: dict[str, list[int]] = {
        ".png": [cv2.IMWRITE_PNG_COMPRESSION, 1],
        ".tif": [],
    }
    suffix = path.suffix.lower()
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, 95]
    _, data = cv2.imencode(suffix, grey, settings.get(suffix, jpeg))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())


def _pose_cells(pose: np.ndarray, before: str = "") -> dict[str, str]:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    cells = [*(f"{item:.7f}" for item in pose[:3, 3]), *(f"{item:.9f}" for item in quaternion)]
    return {before + name: word for name, word in zip(POSE, cells, strict=True)}
