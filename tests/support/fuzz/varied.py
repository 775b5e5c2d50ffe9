"""Cells that nobody chose: `cell(seed)` draws one from what a user may declare, `walk` uses it."""

import csv
import itertools
import json
import traceback
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2, norm
from support.commands import visioncal
from support.pages import Page

from visioncal import Session
from visioncal.cli.show import find_recording
from visioncal.core.errors import DataError
from visioncal.core.types import Camera, Target
from visioncal.interchange.result_files import load_calibration
from visioncal.present.viewer import blueprint
from visioncal.robot.files import read_robot_document
from visioncal.session.columns import POSE
from visioncal.simulation import BOARDS, CellOptions, Second, cell_session, simulate
from visioncal.vision.targets import corner_positions

DICTIONARIES = {"DICT_4X4_50": 6, "DICT_5X5_250": 7, "DICT_ARUCO_ORIGINAL": 7,
                "DICT_APRILTAG_36h11": 8}  # fmt: skip
RESOLUTIONS = {(640, 480): 50, (752, 480): 15, (800, 600): 15, (1280, 800): 8, (1281, 1025): 4,
               (2448, 2048): 1}  # fmt: skip
IMAGES = ("{:03d}.png", "cam {:d} äöüß.png", "-{:d}.png", ".{:d}.png", "'{:d}'.png", "📷{:d}.png",
          '"q" {:d}.png', "a,b;{:d}.png", "Ordner ü/дир/{:d}.png", "UPPER{:d}.PNG",
          "[bold]{:d}[/].png", f"{'n' * 190}{{:03d}}.png", "$HOME {:d}.png")  # fmt: skip
TITLES = ("Zelle 4, 2026-11-20", "[red]cell[/red] <b>&amp;", "📷 робот", "-o", ".hidden", "n" * 200,
          "a/b\\c", "100 % {x} $HOME", "tab\tand\nline", "  spaces  ")  # fmt: skip
FOLDERS = ("-session", ".session", "zwei Wörter", "s" * 200, "📷 'q' \"r\"", "[x] 100%")
POSES = ("ros", "ros-launch", "easy-handeye2", "urdf", "opencv", "zivid", "text", "ur", "kuka",
         "fanuc", "abb", "staubli", "yaskawa", "doosan")  # fmt: skip
LENSES, ARMS = ("camera-info", "kalibr"), ("robot-urdf", "robot-dh", "robot-json")


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell: what is true of it, and how it is told."""

    seed: int
    options: CellOptions
    rows: str  # What rows tell of the robot: `poses`, `joints` or `both`.
    seen: str  # `images`, or `poses` where they are measured elsewhere.
    model: str  # Of the robot: a built-in name, a file's, one that nobody knows, or none.
    lens: dict  # What `[camera]` says more.

    @property
    def truth(self) -> dict[str, np.ndarray]:
        """The true transforms, as calibration.json names them."""
        return dict(simulate(self.options).transforms)


def cell(seed: int) -> Cell:
    """Draws the cell of a seed, always the same."""
    for attempt in itertools.count():
        found = _cell(np.random.default_rng([seed, 2027, attempt]), seed)
        # An arm does not reach all places.
        with suppress(DataError):
            simulate(found.options)
            return found
    raise AssertionError


def _cell(rng: np.random.Generator, seed: int) -> Cell:
    camera = _camera(rng)
    boards = [_board(rng, camera) for _ in range(2)]
    # Where the board fills two thirds of the image.
    extent_m = float(np.ptp(corner_positions(boards[0]), axis=0).max())
    far_m = extent_m * camera.matrix[0] / (0.65 * min(camera.resolution))
    estimated = _chance(rng, 0.35)
    motion = _choice(rng, {"free": 92, "few": 5, "one_axis": 3})
    views = int(rng.integers(2, 6) if motion == "few" else rng.integers(9, 14))
    options = CellOptions(
        mount=_choice(rng, {"eye-in-hand": 1, "eye-to-hand": 1}), seed=seed, views=views,
        distance_m=(0.85 * far_m, 1.25 * far_m),
        camera=camera, state_intrinsics=not estimated, target=boards[0],
        motion="free" if motion == "few" else motion, branches=_chance(rng, 0.2),
        robot=_choice(rng, {"ur3e": 1, "ur5e": 1, "ur10e": 1, "generic-6r-1800": 1}),
        robot_sigma_m=_log_uniform(rng, 2e-5, 3e-4), robot_sigma_rad=_log_uniform(rng, 2e-5, 3e-4),
        wrong_views=int(views > 8 and _chance(rng, 0.1)),
        second=Second(target=boards[1]) if _chance(rng, 0.15) else None,
        board_scale=1.0 + boards[0].square_sigma_m / boards[0].square_m * rng.normal(),
        pixel_sigma_px=_log_uniform(rng, 0.02, 0.2), blur_px=rng.uniform(0.45, 1.1),
        image_noise=_log_uniform(rng, 1.0, 5.0),
    )  # fmt: skip
    model = _choice(rng, {"": 35, "built-in": 35, "mein Arm é.toml": 24, "my robot é": 6})
    rows = _choice(rng, {"poses": 25, "joints": 35, "both": 40})
    seen = "poses" if _chance(rng, 0.18) and not options.second else "images"
    # Measured poses come without the board by which somebody measured them.
    options = replace(options, board_scale=1.0) if seen == "poses" else options
    lens = {} if estimated else {"intrinsics": _choice(rng, {"auto": 5, "hold": 3, "refine": 2})}
    # A lens that is held, or behind poses measured elsewhere, has to be right.
    if seen == "images" and lens.get("intrinsics", "hold") != "hold" and _chance(rng, 0.5):
        options = replace(options, lens_mismatch_px=5e-4 * camera.matrix[0])
        lens["matrix_sigma_px"] = 5e-4 * float(camera.matrix[0])
    known = model in ("built-in", "mein Arm é.toml")
    return Cell(seed, options, rows if known else "poses", seen, model, lens)


def _chance(rng: np.random.Generator, probability: float) -> bool:
    return bool(rng.random() < probability)


def _choice(rng: np.random.Generator, of: dict):
    weights = np.array(list(of.values()), float)
    return list(of)[rng.choice(len(of), p=weights / weights.sum())]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _camera(rng: np.random.Generator) -> Camera:
    width, height = _choice(rng, RESOLUTIONS)
    middle = 0.5 * np.array([width - 1, height - 1]) + rng.normal(0, 0.01 * width, 2)
    if _chance(rng, 0.2):
        focal, distortion = width * rng.uniform(0.4, 0.7), rng.normal(0, [0.02, 0.01, 5e-3, 2e-3])
    else:
        focal = width * _log_uniform(rng, 0.75, 2.0)
        k1, k2, k3 = rng.uniform([-0.22, -0.03, -0.01], [0.1, 0.08, 0.01])
        distortion = np.array([k1, k2, *rng.normal(0, 5e-4, 2), k3])
    matrix = np.array([focal, focal * rng.uniform(0.995, 1.005), *middle])
    if _chance(rng, 0.15):
        (width, height), matrix = (height, width), matrix[[1, 0, 3, 2]]
    model = "fisheye" if len(distortion) == 4 else "brown"
    return Camera(model, (int(width), int(height)), matrix, distortion)


def _board(rng: np.random.Generator, camera: Camera) -> Target:
    """A board whose corners detectors find without a bias."""
    kind = _choice(
        rng, {"charuco": 50, "checkerboard": 30, "aprilgrid": 8, "circles": 8, "tags": 4}
    )
    square_m = round(1e-3 * rng.uniform(18, 40), 4)
    # Squares of a checkerboard that are smaller have a bias of up to 0.2 px.
    most = min(int(min(camera.resolution) / 45), 16)
    columns, rows = (int(value) for value in rng.integers(4, most, 2))
    sigma_m = square_m * _log_uniform(rng, 1e-4, 1e-3)
    if kind == "charuco":
        name = str(rng.choice(list(DICTIONARIES)))
        # The smallest dictionary has 50 markers, and every second square has one.
        name = name if columns * rows <= 100 else name.replace("4X4_50", "4X4_250")
        return Target("varied", kind, columns, rows, square_m, sigma_m, legacy=_chance(rng, 0.3),
                      marker_m=round(rng.uniform(0.55, 0.7) * square_m, 4),
                      dictionary=name)  # fmt: skip
    if kind == "checkerboard":
        # Its one numbering needs an odd sum.
        return Target("varied", kind, columns, rows + (columns + rows + 1) % 2, square_m, sigma_m)
    return BOARDS[kind]


def write(item: Cell, parent: Path, visit: int = 0) -> Path:
    """Writes a visit to a cell as a session: the first is to be calibrated, others verify."""
    rng = np.random.default_rng([item.seed, 11, visit])
    odd = _chance(rng, 0.4)
    folder = parent / (str(rng.choice(FOLDERS)) if odd else "session")
    views = 6 if visit else item.options.views
    sim = simulate(replace(item.options, recording=visit, views=views, wrong_views=0 if visit else
                           item.options.wrong_views))  # fmt: skip
    session = cell_session(sim, "cell", seen=item.seen)
    session.save(folder)
    document = dict(session.document) | {"name": str(rng.choice(TITLES)) if odd else "cell"}
    if "camera" in document:
        document["camera"] = document["camera"] | item.lens
    document.pop("robot", None)
    if item.model:
        robot = item.options.robot
        document["robot"] = {"model": robot if item.model == "built-in" else item.model}
        if item.model.endswith(".toml"):
            (folder / item.model).write_text(tomli_w.dumps(read_robot_document(robot)), "utf-8")
    (folder / "session.toml").write_text(tomli_w.dumps(document), "utf-8")
    _rewrite(rng, item, folder, str(rng.choice(IMAGES)) if odd else IMAGES[0], visit)
    return folder


def _rewrite(rng: np.random.Generator, item: Cell, folder: Path, name: str, visit: int) -> None:
    """Other columns, numbers and names of images; some images are missing, torn or show nothing."""
    with (folder / "views.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    begin, stride = _choice(rng, {(0, 1): 70, (1, 1): 15, (7, 10): 15})
    held_out = visit == 0 and len(rows) > 10 and _chance(rng, 0.2)
    left_out = {"joints": POSE, "both": ()}.get(item.rows, tuple(f"q{at}_" for at in range(1, 7)))
    left_out += () if _chance(rng, 0.3) else ("stamp_s",)
    extra = _chance(rng, 0.3)
    written = []
    for at, row in enumerate(rows):
        for key in list(row):
            if key.startswith(left_out):
                del row[key]
        row["view"] = begin + stride * at
        if row.get("image"):
            path = folder / "images" / name.format(at)
            path.parent.mkdir(parents=True, exist_ok=True)
            (folder / row["image"]).rename(path)
            row["image"] = str(path.relative_to(folder))
        if held_out:
            row["role"] = "holdout" if at % 6 == 5 else str(rng.choice(["fit", ""]))
        if extra:
            row |= {"Bemerkung ü": f'gut, "{at}"', "📷": "", "operator": "-"}
        written.append(row)
    with (folder / "views.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(written[0]))
        writer.writeheader()
        writer.writerows(written)
    images = [folder / row["image"] for row in written if row.get("image")]
    if visit == 0 and len(images) > 8 and _chance(rng, 0.15):
        how = str(rng.choice(["missing", "torn", "empty", "grey"]))
        for path in rng.choice(images, int(rng.integers(1, 3)), replace=False):
            data = path.read_bytes()
            path.unlink()
            grey = cv2.imencode(".png", np.full(item.options.camera.resolution[::-1], 90, np.uint8))
            content = {"torn": data[: len(data) // 3], "empty": b"", "grey": grey[1].tobytes()}
            if how != "missing":
                path.write_bytes(content[how])


@dataclass
class Walk:
    """What came of a cell."""

    # Commands with their exit statuses and messages, tracebacks included.
    steps: list[tuple[str, int, str]] = field(default_factory=list)
    wrong: list[str] = field(
        default_factory=list
    )  # Files and messages that are not as they should.
    warned: set[str] = field(default_factory=set)
    verdict: str = ""
    # The error of all transforms together, as that of one normal number that is as unlikely.
    sigmas: float = 0.0


def walk(seed: int, parent: Path) -> Walk:
    """Draws a cell and runs commands through it, in an empty folder; some by the seed's chance."""
    done, drawn, out = Walk(), cell(seed), parent / "out ü"
    for name in ("first", "second"):
        (parent / name).mkdir()
    session, rng = write(drawn, parent / "first"), np.random.default_rng([seed, 3])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if _run(done, "calibrate", session, "-o", out, *(["-v"] if seed % 2 else [])):
            _look_at(done, drawn, out)
            _use(done, drawn, rng, session, out, parent)
        if rng.random() < 0.3:
            forth = _run(done, "convert", session, parent / "it.rrd")
            back = forth and _run(done, "convert", parent / "it.rrd", parent / "again")
            if (
                forth
                and back
                and len({one.partition("sha256 ")[2][:64] for one in (forth, back)}) > 1
            ):
                done.wrong.append("convert: another digest")
    done.warned = {f"{Path(one.filename).name}:{one.lineno} {one.message}" for one in caught}
    return done


def _use(done: Walk, item: Cell, rng: np.random.Generator, session: Path, out: Path,
         parent: Path) -> None:  # fmt: skip
    """All that is done with a result."""
    if rng.random() < 0.2 and _run(done, "show", out, "-o", parent / "again.html"):
        Page((parent / "again.html").read_text("utf-8"))
    recording = find_recording(out)
    with _noted(done, "show --viewer"):
        blueprint(Session.load(recording), load_calibration(recording))
    formats = [*rng.choice(POSES, 2, replace=False)]
    formats += [rng.choice(LENSES)] * (item.seen == "images")
    formats += [rng.choice(ARMS)] * (item.rows != "poses")
    for at, name in enumerate(formats):
        _run(done, "export", out, "--to", name, "--force", "-o", parent / f"export {at}")
    if rng.random() < 0.25:
        fresh = write(item, parent / "second", visit=1)
        _run(done, "verify", fresh, "--against", out, "-o", parent / "check")
        _run(done, "locate", fresh, "-c", out, "--force")
    if rng.random() < 0.2:
        _run(done, "plan", session, "--add", 3, "-o", parent / "plan", "--candidates", 200)


@contextmanager
def _noted(done: Walk, command: str):
    try:
        yield
    except Exception:  # noqa: BLE001 - a bug of any kind is what is looked for
        done.steps.append((command, 1, traceback.format_exc()))


def _run(done: Walk, command: str, *arguments: object) -> str:
    """Runs a command; what it said, empty where there is no result. A check that says no is one."""
    with _noted(done, command):
        end = visioncal(command, *arguments)
        # A check says no on standard output.
        done.steps.append((command, end.status, end.said if end.status == 3 else end.err))
        return end.said or " " if end.status in (0, 3) else ""
    return ""


def _look_at(done: Walk, item: Cell, out: Path) -> None:
    """The three files, and how far the result is from the truth."""
    names = {"calibration.json", "report.html", "recording.rrd"}
    done.wrong += sorted(names - {path.name for path in out.iterdir()})
    assert "h1" in Page((out / "report.html").read_text("utf-8")).tags
    text = (out / "calibration.json").read_text("utf-8")
    document = json.loads(text, parse_constant=lambda word: done.wrong.append(f"JSON: {word}"))
    done.wrong += ["JSON: null"] * ("null" in text)
    done.verdict = document["verdict"]["status"]
    order, truth = document["joint_covariance"]["order"], item.truth
    away = [np.linalg.inv(truth[name]) @ document["transforms"][name]["matrix"] for name in order]
    error = RigidTransform.from_matrix(np.array(away)).as_exp_coords().ravel()
    square = float(error @ np.linalg.solve(document["joint_covariance"]["matrix"], error))
    done.sigmas = float(norm.isf(0.5 * max(chi2.sf(square, len(error)), 1e-300)))
