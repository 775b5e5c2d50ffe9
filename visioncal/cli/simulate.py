"""`visioncal simulate`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from visioncal.cli.console import say
from visioncal.cli.options import Seed
from visioncal.cli.progress import shown_progress
from visioncal.core.choices import SIMULATED_ARMS, SIMULATED_CELLS, CameraMount
from visioncal.core.errors import DataError

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.simulation import CellOptions, SimulatedCell
    from visioncal.simulation.instrument_session import InstrumentOptions
Read: TypeAlias = Literal["point", "points", "probe"]

# Parameters of a cell of one robot, for any kind of recording.
_SINGLE = frozenset(
    (
        *("mount", "views", "robot", "camera", "board", "robot_sigma_mm", "robot_sigma_mrad"),
        *("arm_sigma_mm", "arm_sigma_mrad", "wrong_views", "board_scale", "with_intrinsics"),
        *("images", "stiffness_knm", "payload_kg", "recording", "camera_moved_mm", "seed"),
    )
)
_ARM = frozenset(
    (
        *("robot_sigma_mm", "robot_sigma_mrad", "arm_sigma_mm", "arm_sigma_mrad"),
        *("stiffness_knm", "payload_kg"),
    )
)
# Kinds of session that a whole cell can include.
_WITH_CELL = frozenset(("instrument", "torques"))
_TAKES: Mapping[str, frozenset[str]] = {
    "": _SINGLE | {"touches", "second_board"},
    "sweep": _SINGLE | {"clock_offset_ms", "readout_ms"},
    "warm_up": _SINGLE | {"currents"},
    "cell": _ARM
    | _WITH_CELL
    | {"views", "wrong_views", "images", "seed", "recording", "camera_moved_mm", "touches"}
    | {"board_scale", "with_intrinsics"},
    "instrument": _ARM | {"views", "robot", "seed"},
    "torques": frozenset(("robot", "payload_kg", "currents", "seed")),
}


@dataclass(frozen=True)
class SimulateOptions:
    """Options of the simulated session."""

    folder: Annotated[Path, typer.Argument(help="Where to write the session.")]
    mount: Annotated[CameraMount, typer.Option(help="Where the camera is.")] = "eye-in-hand"
    views: Annotated[int, typer.Option(min=1, help="Number of views.")] = 20
    robot: Annotated[str, typer.Option(metavar="|".join(SIMULATED_ARMS), help="The arm.")] = "ur10e"
    camera: Annotated[
        Literal["wide", "fine", "fisheye"],
        typer.Option(help="1280 x 800, 2448 x 2048, or a fisheye."),
    ] = "wide"
    board: Annotated[
        Literal["charuco", "checkerboard", "aprilgrid", "circles", "symmetric-circles", "tags"],
        typer.Option(help="The board's pattern."),
    ] = "charuco"
    second_board: Annotated[
        bool, typer.Option("--second-board", help="A second board, a checkerboard, beside it.")
    ] = False
    robot_sigma_mm: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Repeatability of the robot (mm).")
    ] = 0.03
    robot_sigma_mrad: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Repeatability of its rotation (mrad).")
    ] = 0.05
    arm_sigma_mm: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="Sigma of the errors of the arm's lengths (mm)."),
    ] = 0.0
    arm_sigma_mrad: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Sigma of the errors of its angles (mrad).")
    ] = 0.0
    wrong_views: Annotated[int, typer.Option(min=0, help="Views whose reported pose is wrong.")] = 0
    board_scale: Annotated[
        float, typer.Option(min=0.5, max=2.0, help="Ratio of printed to stated size of the board.")
    ] = 1.0
    with_intrinsics: Annotated[
        bool, typer.Option(help="Whether the session states the camera's intrinsics.")
    ] = True
    images: Annotated[
        bool, typer.Option(help="Whether to render images; pose pairs are written otherwise.")
    ] = True
    sweep: Annotated[
        bool,
        typer.Option(help="A sweep without stops: pose pairs by one clock, the robot by another."),
    ] = False
    clock_offset_ms: Annotated[
        float, typer.Option(help="With --sweep: lead of the camera's clock (ms).")
    ] = 37.0
    readout_ms: Annotated[
        float,
        typer.Option(
            help="With --sweep: readout time from an image's first row to its last (ms); unless "
            "0, the frames have corners (corners.csv) in place of poses."
        ),
    ] = 0.0
    warm_up: Annotated[
        bool,
        typer.Option(
            help="A cold arm that works for 100 minutes: pose pairs, and its joints' temperatures."
        ),
    ] = False
    cell: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE.toml",
            help=f"A whole cell: {', '.join(SIMULATED_CELLS)}, or a file that describes one.",
        ),
    ] = None
    instrument: Annotated[
        Read | None,
        typer.Option(
            help="A tracker that reads one point or three on the flange, or a probe; of a whole "
            "cell on every flange."
        ),
    ] = None
    torques: Annotated[
        bool,
        typer.Option(
            "--torques",
            help="Streams of a moving arm's torques, without views; of a whole cell beside its "
            "views.",
        ),
    ] = False
    touches: Annotated[
        bool,
        typer.Option(
            "--touches",
            help="Also touches of a tool and a fixture by every robot, in touches.csv ...",
        ),
    ] = False
    currents: Annotated[
        bool,
        typer.Option(
            help="Motor currents: with --warm-up for temperatures, with --torques for torques."
        ),
    ] = False
    stiffness_knm: Annotated[
        float | None,
        typer.Option(min=0.1, help="Stiffness of every joint (kN m/rad); rigid if left out."),
    ] = None
    payload_kg: Annotated[
        list[float] | None,
        typer.Option(min=0.0, help="Payload of the arm (kg); repeated for stops in turn."),
    ] = None
    recording: Annotated[
        int,
        typer.Option(
            min=0, help="Another recording of the same cell: fresh stops, for verify and locate."
        ),
    ] = 0
    camera_moved_mm: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="How far the camera was knocked (mm); the first."),
    ] = 0.0
    seed: Seed = 0


def simulate_command(context: typer.Context, asked: SimulateOptions) -> None:
    """Write a simulated session, and its truth in a file beside it."""
    from visioncal.cli.simulated_cell import CENTRE_M, exercise_options, exercised, whole_cell
    from visioncal.session.saving import refuse_filled
    from visioncal.simulation import BOARDS, CAMERAS, CellOptions, Payload, Second, truth_path
    from visioncal.simulation.exercise import write_exercise
    from visioncal.simulation.instrument_session import InstrumentOptions, tracked, write_tracked

    given, folder = _given_for(context), asked.folder
    options = CellOptions(
        robot=asked.robot,
        mount=asked.mount,
        views=asked.views,
        target=BOARDS[asked.board],
        camera=CAMERAS[asked.camera],
        state_intrinsics=asked.with_intrinsics,
        robot_sigma_m=1e-3 * asked.robot_sigma_mm,
        robot_sigma_rad=1e-3 * asked.robot_sigma_mrad,
        dh_sigma_m=1e-3 * asked.arm_sigma_mm,
        dh_sigma_rad=1e-3 * asked.arm_sigma_mrad,
        wrong_views=asked.wrong_views,
        board_scale=asked.board_scale,
        compliance_rad_per_nm=_compliance(asked.robot, asked.stiffness_knm),
        payloads=tuple(Payload(value, CENTRE_M) for value in asked.payload_kg or ()),
        second=Second() if asked.second_board else None,
        recording=asked.recording,
        camera_moved_m=1e-3 * asked.camera_moved_mm,
        seed=asked.seed,
    )
    # Checked first, as rendering takes long.
    refuse_filled(folder.absolute())
    if asked.cell is not None:
        cell = whole_cell(asked.cell, options, given, asked.instrument)
        _write(exercised(cell, asked) if asked.torques else cell, asked)
    elif asked.instrument is not None:
        stops = asked.views if "views" in given else InstrumentOptions.stops
        write_tracked(tracked(_read_by(asked.instrument, options, stops)), folder)
    elif asked.torques:
        write_exercise(exercise_options(asked, asked.robot, asked.seed), folder)
    else:
        _write(_single(options, asked), asked)
    say(f"wrote {folder}\nwrote {truth_path(folder)}")


def _single(options: "CellOptions", asked: SimulateOptions) -> "SimulatedCell":
    """A cell of one robot: at stops, in a sweep, or during warm-up."""
    from visioncal.simulation import (
        Round,
        SweepOptions,
        WarmUpOptions,
        simulate,
        simulate_warm_up,
        sweep,
    )

    if asked.warm_up:
        rounds = Round(first=asked.views)
        warm_up = WarmUpOptions(options, round=rounds, temperatures=not asked.currents)
        return simulate_warm_up(warm_up)
    if asked.sweep:
        clocks = SweepOptions(
            camera_minus_robot_s=1e-3 * asked.clock_offset_ms, readout_s=1e-3 * asked.readout_ms
        )
        return sweep(options, clocks)
    return simulate(options)


def _write(cell: "SimulatedCell", asked: SimulateOptions) -> None:
    """Writes a cell, and its robots' touches."""
    from visioncal.simulation import touch, write_session

    count = len(cell.sights)
    with shown_progress(quiet=False) as progress:
        write_session(
            cell,
            asked.folder,
            lambda share: progress("render", round(share * count), count),
            images=asked.images and not (asked.sweep or asked.warm_up),
            touched=touch(cell) if asked.touches else None,
        )


def _read_by(instrument: Read, options: "CellOptions", stops: int) -> "InstrumentOptions":
    """Options of an instrument that measures the cell's arm."""
    from visioncal.simulation import ArmOptions
    from visioncal.simulation.instrument_session import THREE, InstrumentOptions

    return InstrumentOptions(
        stops=stops,
        points=THREE if instrument == "points" else THREE[:1],
        poses=instrument == "probe",
        seed=options.seed,
        **options.part(ArmOptions),
    )


def _compliance(robot: str, stiffness_knm: float | None) -> tuple[float, ...]:
    """Compliance of each joint [rad/(N m)]; empty for a rigid arm."""
    from visioncal.simulation import arm_named

    if stiffness_knm is None:
        return ()
    return (1e-3 / stiffness_knm,) * len(arm_named(robot).offset)


def _given_for(context: typer.Context) -> frozenset[str]:
    """The given parameters, after checking that they apply to the kind of session."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = frozenset(
        name for name, source in sources.items() if source and source.name == "COMMANDLINE"
    )
    kinds = [take for take in _TAKES if context.params.get(take)]
    if "cell" in kinds:
        kinds = [kind for kind in kinds if kind not in _WITH_CELL]
    if len(kinds) > 1:
        named = [_option(kind) for kind in kinds]
        raise DataError(
            f"{' and '.join(named)}: each makes a session of its own kind.",
            culprits=named,
            next_step="A whole cell's own file says which robots warm up, and what is swept."
            if "cell" in kinds
            else "Give one of them, and make the others into folders of their own.",
        )
    kind = kinds[0] if kinds else ""
    takes = _TAKES[kind]
    if kind == "cell" and context.params.get("torques"):
        takes = takes | {"currents"}
    for wrong in sorted(given - takes - {"folder", kind}):
        possible = [_option(name) for name, taken in _TAKES.items() if wrong in taken]
        raise DataError(
            f"{_option(wrong)} goes with {' or '.join(possible)}, not with {_option(kind)}.",
            culprits=[_option(wrong)],
            next_step="Leave it out."
            if kind != "cell"
            else "Leave it out; what a whole cell is made of is said by a file of your own.",
        )
    return given


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}" if name else "a plain cell of one robot"
