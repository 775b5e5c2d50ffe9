"""Records of the commands that make and use results: their options, and their help."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import typer

from visioncal.cli.options import (
    ActOptions,
    NeedOptions,
    PageOptions,
    WorkOptions,
    against_option,
    example_flag,
    force_bad,
    force_both,
    force_flag,
    form_option,
    json_flag,
    out_file,
    out_folder,
)
from visioncal.core.choice import Choice
from visioncal.core.choices import SITE_FILE, WIDEST_RAD, ActKind, Convention, SolverName, Standard
from visioncal.core.limits import RecoveryLimits
from visioncal.core.options import REQUIRED, argument, flag, numbers_option, option
from visioncal.core.parsing import serial_in, views_in
from visioncal.interchange.outputs import REPORT, VERIFY
from visioncal.interchange.selection import Selection


def _show_formats(wanted: bool) -> None:
    if wanted:
        # Imported late, so that --help stays fast.
        from visioncal.interchange.exports import EXPORT_FORMATS

        width = max(len(export_format.name) for export_format in EXPORT_FORMATS)
        for export_format in EXPORT_FORMATS:
            typer.echo(f"{export_format.name:<{width}}  {export_format.words}")
        raise typer.Exit


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(NeedOptions, WorkOptions, ActOptions):
    """Turn a session into a hand-eye calibration, with reasons to trust it or not.

    Writes calibration.json, report.html and recording.rrd. Tools and fixtures that had joined an
    earlier result there are kept in frames.json. Exit status 0: there is a result to use, good or
    check; 3: there is one, and its verdict is bad; 2: the input or the motion cannot give one, and
    an existing folder stays as it was; 1: drawing the report or the recording failed, and
    calibration.json is there. Several cameras or robots are
    solved together, in one frame; other commands take one of each out of that result (--camera,
    --robot, --target).
    """

    first: ClassVar = "out need_mm need_deg views as_json"
    session: Path = argument("A session's folder, or its .rrd recording.")
    out: Path = out_folder(default=Path("out"))
    views: tuple[int, ...] | None = option("These views alone.", metavar="1-12,14", parse=views_in)
    solver: SolverName = option("The joint fit, or a closed form.", default="joint")
    level: str = option(
        "Part of the arm that is calibrated: hand-eye (nothing), offsets (of its joints), "
        "kinematics, elastic (bending joints, too), thermal (drift with temperature, too).",
        default="auto",
        metavar="auto|hand-eye|offsets|kinematics|elastic|thermal",
    )
    convention: Convention | None = option("Of the arm's joint table; else as stated.")
    against: Path | None = option(
        "Of the unloaded arm: a session under loads adds its joints' stiffness.", metavar="OUT"
    )
    corrected: bool = flag("Targets are sent corrected (visioncal correct), and judged so.")
    dense: bool = flag("Fit the board to all pixels of images that are too blurred for corners.")
    weights: Path | None = option(
        "Weights of LightGlue for SIFT, for pictures that are hard to find (extra kornia).",
        metavar="FOLDER",
    )
    as_json: bool = json_flag()
    verbose: bool = flag("Also show every solver's result.", "-v", "--verbose")


@dataclass(frozen=True, kw_only=True)
class BatchOptions(NeedOptions, ActOptions):
    """Calibrate many sessions at once, and show their results on one page.

    Each result goes into a folder of its own; batch.parquet has a row a session, index.html shows
    them, the worst verdicts first. Existing results are kept: started again, an interrupted batch
    continues. Exit status 0: there are results, none of them bad; 3: one is bad; 2: there is none.
    With --against each result is compared with that one: what changed beyond noise is printed, and
    all differences with their sigmas are in against.csv.
    """

    first: ClassVar = "out need_mm need_deg against workers"
    out: Path = out_folder(default=REQUIRED)
    sessions: list[str] | None = argument(
        "Sessions, recordings, their folders, or globs.", default=None
    )
    workers: int | None = option("Parallel workers, one core each; else one per core.", min=1)
    scheduler: str | None = option(
        "A Dask scheduler, as tcp://HOST:8786 (extra cluster).", metavar="ADDRESS"
    )
    level: str = option("As for calibrate.", default="auto", metavar="auto|hand-eye|offsets|...")
    against: Path | None = option("A result that each is compared with.", metavar="OUT")
    no_report: bool = flag(f"Leave each {REPORT} out.")
    recordings: bool = flag("Also write each recording, with all images.")


@dataclass(frozen=True, kw_only=True)
class ShowOptions:
    """Show an earlier result: its report, its recording, or its certificate.

    Pictures, coverage and joint angles of the report come from the recording.rrd beside a
    calibration.json; where it is missing or belongs to another result, the report says so. With
    --viewer --web the page's URL goes to stdout, and only this machine can reach it; Ctrl-C ends.
    """

    first: ClassVar = "out viewer view certificate"
    result: Path = argument("An output folder, its calibration.json, or an .rrd.", metavar="OUT")
    out: Path | None = option(
        "The page; report.html here, or certificate.html beside the result, otherwise.",
        "-o",
        "--out",
    )
    viewer: bool = flag("Open the recording in the rerun viewer, instead.")
    web: bool = flag("With --viewer: in a browser, not in a window.", needs="viewer")
    view: int | None = option("With --viewer: at which view; else the worst.", needs="viewer")
    certificate: bool = flag("One page to print and sign, instead.")
    operator: str = option("With --certificate: who calibrated.", default="", needs="certificate")
    serial: list[tuple[str, str]] | None = option(
        "As camera=1234.", metavar="WHAT=NUMBER", parse=serial_in, needs="certificate"
    )


@dataclass(frozen=True, kw_only=True)
class VerifyOptions(Choice, PageOptions, ActOptions):
    """Check whether a calibration still holds, and what has changed if it does not.

    With --page SESSION is a folder of checks: a browser leads through five stops of one of the
    calibrations in --against, and shows the answer and those before.
    Exit status 0: it holds; 3: it does not; 2: that cannot be decided, for the reason given.
    """

    first: ClassVar = "against page output as_json"
    session: Path = argument("Five stops or more of the same cell: a folder or an .rrd.")
    against: Path = against_option()
    standard: Standard | None = option(
        "Cycles of five poses instead: accuracy and repeatability by the standard."
    )
    board_moved: bool = flag("The board was put elsewhere on purpose.")
    collision: bool = flag("A collision was reported since.")
    most_days: float | None = option("Age beyond which to calibrate again; else 365.", min=0.0)
    most_kelvin: float | None = option(
        "Change of ambient temperature that calls for it; else 10 K.", min=0.0
    )
    most_kg: float | None = option("Change of payload that calls for it; else 5 kg.", min=0.0)
    output: Path | None = out_folder(
        f"A folder for {REPORT}, {VERIFY} and a recording.", "-o", "--output"
    )
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class GuardOptions(Choice):
    """Say after each look of a working cell whether its calibration still holds.

    Looks come as JSON lines on stdin; each is answered by a JSON line. A line has time_s,
    base_from_flange, cam_from_target or corners or the path of an image, joints_rad where the arm
    was calibrated, and target where there are several; acknowledge: true ends an alarm. With
    --scene a look is an image of the standing cell at a pose that the session shows again. Exit
    status 0: it holds; 3: it does not; 2: a look could not be used, and the others are no reason to
    doubt.
    """

    first: ClassVar = "against state scene _example"
    against: Path = against_option()
    false_alarm_looks: float = option(
        "Mean number of looks to a false alarm.", default=10_000.0, min=100.0, max=1e9
    )
    slow_mm: float = option(
        "Expected motion by heat, over hours (sigma, mm); it is learned.",
        default=0.05,
        min=0.0,
        max=10.0,
    )
    state: Path | None = option("A file that keeps what was learned, for the next start.")
    recording: Path | None = option("Also record the looks, for visioncal show --viewer.")
    scene: Path | None = option(
        "A session or .rrd whose images show the standing scene, without a board."
    )
    mask: Path | None = option(
        "With --scene: an image, white where things stand still.", needs="scene"
    )
    plane: str | None = option(
        "With --scene, for the camera's offset too: the scene is a plane, the board's or at a "
        "distance from the camera (mm).",
        metavar="board|MM",
        needs="scene",
    )
    steady_px: float = option(
        "With --scene: how far images move from look to look without a fault (sigma, px).",
        default=0.1,
        min=0.01,
        max=10.0,
    )
    _example: bool = example_flag("guard")


@dataclass(frozen=True, kw_only=True)
class AuditOptions:
    """Find where a camera moved in the episodes of a data set, by the standing scene.

    DATASET is one of LeRobot, or a folder with a video or a folder of pictures an episode, in their
    order. Its robot and parts may move in the images; the rest must stand still. Exit status 0: the
    camera stood; 3: it moved, and each move is named by episode and frame; 2: that cannot be
    decided.
    """

    first: ClassVar = "image_key mask as_json"
    dataset: Path = argument("The data set's folder.", metavar="DATASET", file_okay=False)
    image_key: str | None = option(
        "Of several cameras: its key, or a part of the paths of its videos or pictures."
    )
    mask: Path | None = option("An image, white where things stand still.")
    against: Path | None = option("A calibration of the camera, for its lens.")
    looks: int = option("Compared frames per episode.", default=4, min=2, max=1000)
    steady_px: float = option(
        "How far images move from look to look without a fault (sigma, px).",
        default=0.1,
        min=0.01,
        max=10.0,
    )
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """Payload of the arm at targets, and its temperatures."""

    payload_kg: float = option(
        "Payload on the flange, for joints that bend (kg).", default=0.0, needs="targets"
    )
    payload_m: tuple[float, float, float] = numbers_option(
        "Its centre in the flange [m].", form="x,y,z", default="0,0,0", needs="targets"
    )
    temperatures: str | None = option(
        "Temperatures of links [deg C]; of an arm with drift.", metavar="T1,T2,...", needs="targets"
    )


@dataclass(frozen=True, kw_only=True)
class RecoverOptions(LoadOptions, Choice, ActOptions):
    """Recover a calibration after a knock: new stops, the cause, and a new zero or calibration.

    FOLDER holds the whole act: started again, it goes on where it was ended. It drives nothing:
    where stops are to be recorded, it says how. A third of them is held back, and proves the
    result. Exit status 0: recovered and proven, or nothing has changed; 3: the cause is not known,
    or the proof fails; 2: stops are next, or it cannot go on.
    """

    first: ClassVar = "against stops count cause targets to"
    folder: Path = argument(
        "A folder for the act; the same one to go on.", metavar="FOLDER", file_okay=False
    )
    against: Path = against_option()
    stops: Path | None = option("A session with new stops; else FOLDER/stops.")
    count: int = option(
        "How many stops.", default=RecoveryLimits.stops, min=RecoveryLimits.fewest, max=200
    )
    cause: list[str] | None = option(
        "A cause that stops cannot show; may be repeated. base: the base moved, away from "
        "all that stands around it; mount: camera and tools are on another mount.",
        metavar="camera|board|base|mount|'joint N'",
    )
    targets: Path | None = option("Also convert a table of targets, as correct does.")
    tool: str | None = option("Frame of the targets: a tool; else the flange.", needs="targets")
    to: list[str] | None = option(
        "Also export in a format, as ur; may be repeated.", metavar="FORMAT"
    )
    force: bool = force_bad()


@dataclass(frozen=True, kw_only=True)
class DiffOptions(Choice):
    """Show what changed between two calibrations, and what is only noise.

    Exit status 0, changed or not: `is_change` in the JSON says which; 2: one cannot be read.
    """

    first: Path = argument("An output folder, its calibration.json, or a recording (.rrd).")
    second: Path = argument("The one to compare with it.")
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Selection):
    """Write a result, or the calibrated arm, in another program's or robot's format.

    The transform a_from_b is the pose of b in a: its parent is a, its child b. Exit status 2:
    nothing was written, for the reason given; 3: nothing was, as the result's verdict is bad.
    """

    first: ClassVar = "to out edge inverse number force _list"
    source: Path = argument("An output folder, its .json, a recording, or a file of frames.")
    to: str = option("A format, as ros or ur; see --list.", default=REQUIRED, metavar="FORMAT")
    out: Path | None = out_file()
    force: bool = force_both()
    _list: bool = flag("List the formats.", "--list", callback=_show_formats, is_eager=True)


@dataclass(frozen=True, kw_only=True)
class CorrectOptions(LoadOptions, Choice):
    """Correct targets so that the arm reaches them by its nominal controller.

    Exit status 2: nothing was written, for the reason given; targets out of reach are named. Exit
    status 3: nothing was, as the calibration's verdict is bad.
    """

    first: ClassVar = "calibration out tool robot_form _example"
    targets: Path = argument("A table as views.csv, or as X,Y,Z,A,B,C; others are kept.")
    calibration: Path = against_option("-c", "--against", "--calibration")
    out: Path | None = out_file()
    tool: str | None = option("Frame of the targets: a tool, or cam; else the flange.")
    robot_form: str | None = form_option()
    seed_joints: str | None = option("Joints [rad] near the first target's.", metavar="Q1,Q2,...")
    widest_deg: float = option(
        "Warn of wider turns.", default=math.degrees(WIDEST_RAD), min=1e-3, max=720.0
    )
    skip: bool = flag("Write the other targets where some are refused.", "--skip-unreachable")
    force: bool = force_both()
    as_json: bool = json_flag()
    _example: bool = example_flag("correct")


@dataclass(frozen=True, kw_only=True)
class HistoryOptions:
    """List a site's history: what was calibrated, verified, placed and touched, and when.

    Commands enter their results where --history or the site's file says so; entries never change.
    With -o it is written as a page, the worst cell first, with the years of each, or as a table.
    Exit status 2: it cannot be read or written, for the reason given.
    """

    first: ClassVar = "out cell kind show add _example"
    file: Path | None = argument(
        f"The history's file; else the nearest {SITE_FILE} here or above.", default=None
    )
    history: Path | None = option("The same file, as other commands name it.")
    cell: str | None = option("Of this cell alone; with --add: whose results they are.")
    kind: ActKind | None = option("Of this kind alone.")
    show: str | None = option("One entry in full, by the beginning of its id.", metavar="ID")
    add: list[Path] | None = option(
        "Add the results of an output folder, such as old ones; once more changes nothing.",
        metavar="OUT",
    )
    out: Path | None = option("The page (.html) or the table (.csv) to write.", "-o", "--out")
    recording: Path | None = option("Record the years, for visioncal show --viewer.")
    force: bool = force_flag()
    as_json: bool = json_flag()
    _example: bool = example_flag("history")
