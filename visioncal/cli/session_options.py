"""Records of the commands that make and check sessions: their options, and their help."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from visioncal.cli.options import (
    PageOptions,
    example_flag,
    force_flag,
    json_flag,
    out_folder,
    seed_option,
    session_argument,
    yes_flag,
)
from visioncal.core.choices import (
    PLAN_SPEED,
    POSE_FORMS,
    SIMULATED_ARMS,
    SIMULATED_CELLS,
    UNITS_M,
    CameraMount,
    Criterion,
    Mount,
    Standard,
)
from visioncal.core.options import REQUIRED, SIZE, argument, flag, numbers_option, option
from visioncal.core.parsing import names_in
from visioncal.interchange.mends import Mends, mend_option
from visioncal.live.capture.devices import CAMERAS
from visioncal.live.capture.options import Stillness
from visioncal.planning.purposes import PURPOSES
from visioncal.vision.board_request import BoardRequest

# Options by their headings in the help.
_what = partial(option, panel="What is planned")
_cell = partial(option, panel="The cell, where the source does not say it")
_certainty = partial(option, panel="How well it is known")
kept_option = partial(option, panel="What the arm must keep")
_span = partial(numbers_option, form="near,far", scale=1e-3, panel="What the arm must keep")
_size = partial(option, default=0.0, min=0.0, max=100.0)
_record_cell = partial(option, panel="The cell, where no plan says it")
_taking = partial(option, panel="How views are taken")
_moving = partial(option, panel="How the arm is moved")
_device = partial(option, panel="What the camera is set to")
_poses = partial(option, panel="The poses of a foreign recording")
_names = partial(_poses, parse=names_in)
_recording = partial(option, panel="The recording itself")
_camera = partial(option, panel="Its camera")

Instrument: TypeAlias = Literal["point", "points", "probe"]
# Largest number of stops where a need decides it.
MOST_FOR_NEED = 40
_USUAL_STOPS = ", ".join(f"{purpose.stops} for {purpose.name}" for purpose in PURPOSES.values())
_FORMS = f"{', '.join(POSE_FORMS)}, or a rotation such as euler-ZYX-deg, quaternion-wxyz"
_UNITS = "|".join(UNITS_M)
_BOARD = "A name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm"
_ROUGH, _POSE = "In mm and degrees, about fixed x, y, z.", "'X Y Z RX RY RZ'"


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Simulate a UR cell, calibrate it from its images, and compare with the truth.

    The camera's intrinsics are not given: they too are estimated from the images. With --live the
    arm has joint offsets and the stops are planned from rough guesses; nothing real moves. Exit
    status 0: the result is as near to the truth as it says; 3: it is not, or its verdict is
    bad.
    """

    first: ClassVar = "out live"
    out: Path = out_folder(default=Path("demo"))
    views: int = option("Number of views.", default=20, min=5, max=200)
    seed: int = seed_option()
    live: bool = flag("Plan and record the stops, with a UR's client library and a simulated arm.")
    fault: Literal["encoder-slip"] | None = option(
        "With --live: then an encoder slips, and the calibration is recovered.", needs="live"
    )


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Write a simulated session, and its truth in a file beside it."""

    first: ClassVar = "mount views camera robot images touches recording seed"
    folder: Path = argument("Where to write the session.")
    mount: CameraMount = option("Where the camera is.", default="eye-in-hand")
    views: int = option("Number of views.", default=20, min=1)
    robot: str = option("The arm.", default="ur10e", metavar="|".join(SIMULATED_ARMS))
    camera: Literal["wide", "fine", "fisheye"] = option("Its size and lens.", default="wide")
    board: str = option(
        "The board's pattern, or the file of a target.",
        default="charuco",
        metavar="charuco|checkerboard|aprilgrid|circles|symmetric-circles|tags|FILE",
    )
    second_board: bool = flag("A second board, a checkerboard, beside it.")
    robot_sigma_mm: float = _size("Repeatability of the robot (mm).", default=0.03)
    robot_sigma_mrad: float = _size("Repeatability of its rotation (mrad).", default=0.05)
    arm_sigma_mm: float = _size("Sigma of the errors of the arm's lengths (mm).")
    arm_sigma_mrad: float = _size("Sigma of the errors of its angles (mrad).")
    wrong_views: int = option("Views whose reported pose is wrong.", default=0, min=0)
    board_scale: float = option("Printed size over the stated one.", default=1.0, min=0.5, max=2.0)
    with_intrinsics: bool = option("Whether the session states the lens.", default=True)
    images: bool = option("Whether to render images; else pose pairs.", default=True)
    sweep: bool = option("A sweep without stops, by two clocks: pose pairs.", default=False)
    clock_offset_ms: float = option("With --sweep: lead of the camera's clock (ms).", default=37.0)
    readout_ms: float = option(
        "With --sweep: readout of an image (ms); gives corners, not poses.", default=0.0
    )
    warm_up: bool = option("A cold arm that works for 100 minutes: pose pairs.", default=False)
    cell: str | None = option(
        f"A whole cell: {', '.join(SIMULATED_CELLS)}, or its file.", metavar="NAME|FILE"
    )
    instrument: Instrument | None = option(
        "A tracker that reads points on every flange, or a probe."
    )
    torques: bool = flag("Streams of a moving arm's torques; without views, but for a whole cell.")
    touches: bool = flag("Also touches of a tool and a fixture by every robot, in touches.csv ...")
    depth: bool = flag("Also depth pictures, by a sensor that is off as follows.")
    depth_scale: float = option(
        "Measured over true depth (factor).", default=1.008, min=0.5, max=2.0
    )
    depth_offset_mm: float = option("Offset of depth (mm).", default=-2.5)
    depth_bowl_mm: float = option("How much deeper it is at the sides (mm).", default=4.0)
    depth_box: bool = flag("A box stands before the board in half of the depth pictures.")
    currents: bool = option("Currents, with --warm-up or --torques.", default=False)
    stiffness_knm: list[float] | None = option(
        "Stiffness of every joint, or repeated for each (kN m/rad).", min=0.1
    )
    payload_kg: list[float] | None = option("Payload (kg); repeated for stops in turn.", min=0.0)
    force_n: list[float] | None = option(
        "With --instrument: pull on the flange, downwards (N); repeated for stops in turn.", min=0.0
    )
    at: Path | None = option(
        "With --instrument: a plan's folder or file; each stop under each load."
    )
    recording: int = option("Number of another recording of the cell.", default=0, min=0)
    camera_moved_mm: float = _size("How far the first camera was knocked (mm).")
    seed: int = seed_option()
    given: frozenset[str]  # Names of the fields that were typed.


@dataclass(frozen=True, kw_only=True)
class TargetMakeOptions(BoardRequest):
    """Draw a board as NAME.pdf, NAME.svg and NAME.png at its exact size, with its NAME.toml.

    Rulers along both axes show whether the printer kept the size. Exit status 0: all files are
    written; 2: none, because the board does not fit or files are there already.
    """

    first: ClassVar = "out page kind columns rows square_mm marker_mm"
    target: str | None = argument(
        "A board of visioncal's, a .toml, or a picture; or see --kind.", default=None
    )
    out: Path = option("Folder for the files.", "-o", "--out", default=Path(), file_okay=False)
    page: str | None = option("A5 to A0, letter, legal, tabloid, or 500x300 (mm); else as it fits.")
    landscape: bool | None = option("Left out: as the board fits.", "--landscape/--portrait")
    dpi: float = option("Resolution of the PNG, in pixels per inch.", default=300.0)
    toml_only: bool = flag("Describe a board that is printed already: write no drawing.")
    force: bool = flag("Replace files that are there.")


@dataclass(frozen=True, kw_only=True)
class TargetCheckOptions:
    """Name the board in photographs without further options, and print its description.

    Only the size of its squares cannot be seen. Exit status 0: it is named; 2: no board is seen.
    """

    images: list[Path] = argument("Photographs of the board: png, jpg, tif, bmp or webp.")
    square_mm: float | None = option("Measured side of a square, or of a tag; circles' rows.")
    out: Path | None = option("Write the description here.", "-o", "--out")
    as_json: bool = json_flag()
    force: bool = flag("Replace a description that is there.")


@dataclass(frozen=True, kw_only=True)
class ClearanceOptions:
    """Clearances that the arm must keep in any motion."""

    boxes: list[str] | None = kept_option(
        "Obstacles in the base, in mm.", "--box", metavar="NAME:X,Y,Z:SX,SY,SZ"
    )
    floor: str = kept_option("Height of the floor in the base.", default="0", metavar="Z|none")
    clearance_mm: float = kept_option(
        "Distance of the arm from floor, board, boxes and itself.", default=30.0, min=0.0, max=1e3
    )
    margin_deg: float = kept_option(
        "Distance of joints from their limits.", default=3.0, min=0.0, max=90.0
    )


@dataclass(frozen=True, kw_only=True)
class PlanOptions(ClearanceOptions):
    """Propose the most informative robot stops, or those to add to a session.

    Writes stops.csv, plan.json, plan.rrd to look at, and plan.script for a UR. Nothing is sent to
    a robot. Exit status 2: the cell or the session allows no plan, for the reason given.
    """

    first: ClassVar = "out add to_verify stops need_mm target camera resolution cam board _example"
    source: str = argument("A robot, a session, or an output folder of calibrate.")
    add: int | None = _what("How many stops to add to a recorded session.", min=1, max=500)
    to_verify: bool = flag(
        "Calibrated stops to repeat for visioncal verify, five by default.", "--verify"
    )
    purpose: str | None = _what(
        "Purpose of the stops; else hand-eye, for an instrument kinematics.",
        "--for",
        metavar="|".join(PURPOSES),
    )
    stops: int | None = _what(f"How many stops: {_USUAL_STOPS}.", min=1, max=500)
    need_mm: float | None = _what(
        f"The fewest stops, up to {MOST_FOR_NEED}, with 95 % of picks within it."
    )
    need_deg: float | None = _what("The same of the rotation, in degrees.")
    start_joints: str | None = _what(
        "The arm's present joints [rad], for the way to the first.", metavar="Q1,Q2,..."
    )
    standard: Standard | None = _what("Instead, 30 cycles of the five poses of its cube.")
    criterion: Criterion | None = _what(
        "Least mean variance of positions (I), for an instrument determinant of the covariance (D)."
    )
    candidates: int = _what("Number of candidate stops.", default=1500, min=12, max=20000)
    seed: int = _what("Random seed of the candidate stops.", default=0, min=0)
    robot: str | None = _cell("The robot, where a session names none.")
    target: str | None = _cell(_BOARD)
    camera: str | None = _cell("Numbers [px], or a file of the lens.", metavar="FX,FY,CX,CY | FILE")
    resolution: tuple[int, int] | None = _cell("Size of the images in pixels.", **SIZE)
    mount: Mount | None = _cell("Where the camera is, or that it is an instrument.")
    instrument: str | None = _cell("A known instrument, such as leica-at960.", metavar="NAME")
    probe: Literal["point", "pose"] | None = _cell("Its reading on the flange: point (default).")
    cam: str | None = _cell(
        f"Rough camera on the flange (or in the base, as an instrument). {_ROUGH}", metavar=_POSE
    )
    board: str | None = _cell(
        "Rough board in the base (or on the flange, as a probe); face up: 180 0 0.", metavar=_POSE
    )
    guess_mm: float = _certainty("Sigma of both places, in mm.", default=20.0, min=0.1, max=500.0)
    guess_deg: float = _certainty("The same of both rotations.", default=5.0, min=0.01, max=45.0)
    noise_px: float | None = _certainty(
        "Sigma of a corner; else 0.1, or as recorded.", min=0.0, max=1e3
    )
    noise_mm: float | None = _certainty("The robot's; else 0.03, or as recorded.", min=0.0, max=1e3)
    noise_deg: float | None = _certainty(
        "Its rotation's; else 0.003, or as recorded.", min=0.0, max=1e3
    )
    tilt_deg: float = kept_option(
        "Largest tilt of the board to the sight.", default=50.0, min=5.0, max=80.0
    )
    edge_px: float = kept_option("Board's distance from the edge.", default=20.0, min=0.0, max=1e4)
    distance_m: tuple[float, float] | None = _span(
        "Camera's from the board; else as it fills the image.", "--distance-mm"
    )
    focus_m: tuple[float, float] | None = _span("Depths at which images are sharp.", "--focus-mm")
    out: Path = out_folder(default=Path("plan"))
    as_json: bool = json_flag()
    _example: bool = example_flag("plan")

    def options(self, *names: str) -> dict[str, object]:
        """Options by their names; None for those that were not given."""
        return {f"--{name}": getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class RecordOptions(PageOptions):
    """Record a session: drive the stops of a plan, or follow an arm guided by hand.

    With --page a browser shows the live picture and the next pose, takes typed poses, and gives
    the verdict; no arm is driven from it. Every view is on the disk before the next is taken. Exit
    status 0: all views are there; 2: the recording ended early, the arm stands still, and --resume
    continues it.
    """

    first: ClassVar = "out page arm camera target mount plan follow views resume"
    out: Path = out_folder("The session's folder; a new one.", default=REQUIRED, metavar="SESSION")
    arm: str | None = option(
        "A UR by its address, typed poses, or the robot's own program: socket listens for it.",
        metavar="ur:HOST|manual|socket:PORT|socket:HOST:PORT",
    )
    camera: str | None = option(
        "A camera by its kind, with its address where there are several.",
        metavar=f"{'|'.join(CAMERAS)}[:ADDRESS]",
    )
    target: str | None = _record_cell(_BOARD)
    robot: str | None = _record_cell("The robot's model: a built-in name, a .urdf or .toml.")
    mount: CameraMount | None = _record_cell("Where the camera is; by default eye-in-hand.")
    pose_form: str | None = _record_cell(
        f"How poses are written that are bare numbers: {', '.join(('ours', *POSE_FORMS))}.",
        metavar="kuka|abb|...",
    )
    frames: int = _taking("Frames a view.", default=3, min=1, max=100)
    still_px: float = _taking(
        "Largest motion of a still image.", default=Stillness.image_px, min=0.01, max=10.0
    )
    settle_s: float = _taking(
        "How long all must be still.", default=Stillness.quiet_s, min=0.0, max=30.0
    )
    speed: float = _moving("Speed of the fastest joint, in rad/s; at most 1.5.", default=PLAN_SPEED)
    resolution: tuple[int, int] | None = _device("Size of the images in pixels.", **SIZE)
    exposure_us: int | None = _device("Exposure time in microseconds.")
    gain: int | None = _device("ISO, or the device's own unit.")
    focus: int | None = _device("Lens position, in the device's own unit.")
    plan: Path | None = option("Output of visioncal plan: a folder, or its plan.json.")
    follow: bool = flag("Move nothing: take a view whenever the arm, guided by hand, rests.")
    views: int = option("With --follow, manual or socket: end after this number.", default=0, min=0)
    resume: bool = flag("Go on with a recording that was ended or cut off.")
    dry_run: bool = flag("Only say what would be driven; nothing moves.")
    yes: bool = yes_flag()
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class RobotPoseOptions:
    """Options for the convention of the robot's poses."""

    robot_columns: tuple[str, ...] | None = _names(
        "Position first: X,Y,Z,A,B,C.", "--robot-columns", "--robot-key"
    )
    robot_form: str | None = _poses(f"Their convention: {_FORMS}.")
    robot_unit: str | None = _poses("Unit of their positions.", metavar=_UNITS)
    robot_inverse: bool | None = _poses(
        "They give base in flange.", "--robot-inverse/--robot-as-is"
    )
    joint_columns: tuple[str, ...] | None = _names(
        "Of joint angles.", "--joint-columns", "--joint-key"
    )
    joint_unit: Literal["rad", "deg"] = _poses("Unit of the joint angles.", default="rad")
    robot_model: str | None = _poses("A built-in robot, or the path of a .urdf or .toml.")


@dataclass(frozen=True, kw_only=True)
class ForeignOptions(RobotPoseOptions):
    """Options for a foreign recording."""

    form: str | None = _recording("Its format, by a name; a wrong one gets the list.", "--from")
    mount: Mount | None = _recording("Where the camera is, or that it is an instrument.")
    instrument: str | None = _recording(
        "A known instrument, such as leica-at960, or its sigma in mm.", metavar="NAME|MM"
    )
    target: str | None = _recording(f"{_BOARD}, charuco_5x7_36.2mm_18.3mm_DICT_6X6_250.")
    tip: str | None = _recording("The frame that the poses are of.")
    camera_columns: tuple[str, ...] | None = _names(
        "Of the target's poses.", "--camera-columns", "--camera-key"
    )
    camera_form: str | None = _poses("As --robot-form.")
    camera_unit: str | None = _poses("Unit of their positions.", metavar=_UNITS)
    camera_inverse: bool | None = _poses(
        "They give camera in target.", "--camera-inverse/--camera-as-is"
    )
    camera_file: Path | None = _poses("A second file with the camera's poses; clocks are compared.")
    images: Path | None = _camera("Folder of the images; matched by name, number, or order.")
    image_column: str | None = _camera(
        "Column of the image's name.", "--image-column", "--image-key"
    )
    intrinsics: str | None = _camera("A file of any form, or `estimate` to ignore the source's.")
    resolution: tuple[int, int] | None = _camera("Size of the images in pixels.", **SIZE)


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(Mends, ForeignOptions):
    """Write a session as a folder or a recording, or make one of another program's.

    Between our own forms nothing is lost, which digests prove. Exit status 0: it is written; 2:
    nothing was written, and the message says what is missing or wrong.
    """

    first: ClassVar = "target mount images robot_form robot_model intrinsics guess yes force"
    source: Path = argument("A session's folder, its .rrd, or a foreign file or folder.")
    dest: Path = argument("An .rrd, or the folder to write.")
    force: bool = force_flag()
    guess: bool = mend_option("Try other readings, and print them.", "--guess", default=False)
    yes: bool = mend_option("Take one that stands out.", "--yes", default=False, needs="guess")


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Say what is wrong with a session before it is calibrated, and what to type.

    Checks files, pairing, units, conventions of the poses, the board, blur, motion and clocks, in
    seconds, as nothing is fitted. Exit status 0: nothing is wrong; 3: something is; 2:
    it cannot be read.
    """

    session: Path = session_argument()
    as_json: bool = json_flag()
