"""`visioncal simulate`."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from visioncal.cli.console import say
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import Instrument, SimulateOptions
from visioncal.core.codec import reading
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_text
from visioncal.core.types import FloatArray
from visioncal.interchange.outputs import PLAN
from visioncal.session import frame_name
from visioncal.session.saving import refuse_filled
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    ArmOptions,
    CellOptions,
    DepthOptions,
    InstrumentAt,
    Moved,
    NetworkOptions,
    Payload,
    PointAt,
    Round,
    Second,
    SimulatedCell,
    SweepOptions,
    WarmUpOptions,
    arm_named,
    read_cell,
    simulate,
    simulate_warm_up,
    sweep,
    touch,
    truth_path,
    write_session,
)
from visioncal.simulation.dynamics import (
    ExerciseOptions,
    LinkBody,
    Senses,
    exercise,
    seed_of,
    with_exercises,
    write_exercise,
)
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, tracked, write_tracked
from visioncal.vision.targets import load_target

# Parameters of a cell of one robot, for any kind of recording.
_SINGLE = frozenset(
    (
        *("mount", "views", "robot", "camera", "board", "robot_sigma_mm", "robot_sigma_mrad"),
        *("arm_sigma_mm", "arm_sigma_mrad", "wrong_views", "board_scale", "with_intrinsics"),
        *("images", "stiffness_knm", "payload_kg", "recording", "camera_moved_mm", "seed"),
    )
)
_DEPTH = ("depth", "depth_scale", "depth_offset_mm", "depth_bowl_mm", "depth_box")
_TAKES: Mapping[str, frozenset[str]] = {
    "": _SINGLE | {"touches", "second_board", *_DEPTH},
    "sweep": _SINGLE | {"clock_offset_ms", "readout_ms"},
    "warm_up": _SINGLE | {"currents"},
    "cell": frozenset(
        (
            *("views", "images", "seed", "recording", "camera_moved_mm", "touches", "currents"),
            *("instrument", "torques", *_DEPTH),
        )
    ),
    "instrument": frozenset(
        (
            *("robot_sigma_mm", "robot_sigma_mrad", "arm_sigma_mm", "arm_sigma_mrad"),
            *("stiffness_knm", "payload_kg", "force_n", "at", "views", "robot", "seed"),
        )
    ),
    "torques": frozenset(("robot", "payload_kg", "currents", "seed")),
}
# Centre of a simulated load in the flange's frame [m].
_CENTRE_M = (0.0, 0.0, 0.1)


def simulate_command(request: SimulateOptions) -> None:
    """Runs `visioncal simulate`."""
    _check(request)
    folder = request.folder
    # Checked first, as rendering takes long.
    refuse_filled(folder.absolute())
    compliance: tuple[float, ...] = ()
    if request.stiffness_knm:
        each = tuple(1e-3 / stiff for stiff in request.stiffness_knm)
        compliance = each if len(each) > 1 else each * len(arm_named(request.robot).offset)
    loads = [Payload(kg, _CENTRE_M) for kg in request.payload_kg or ()]
    loads += [Payload(force_n=(0.0, 0.0, -newtons)) for newtons in request.force_n or ()]
    options = CellOptions(
        robot=request.robot,
        mount=request.mount,
        views=request.views,
        target=BOARDS.get(request.board) or load_target(request.board),
        camera=CAMERAS[request.camera],
        state_intrinsics=request.with_intrinsics,
        robot_sigma_m=1e-3 * request.robot_sigma_mm,
        robot_sigma_rad=1e-3 * request.robot_sigma_mrad,
        dh_sigma_m=1e-3 * request.arm_sigma_mm,
        dh_sigma_rad=1e-3 * request.arm_sigma_mrad,
        wrong_views=request.wrong_views,
        board_scale=request.board_scale,
        compliance_rad_per_nm=compliance,
        payloads=tuple(loads),
        second=Second() if request.second_board else None,
        recording=request.recording,
        camera_moved_m=1e-3 * request.camera_moved_mm,
        seed=request.seed,
    )
    if request.cell is not None:
        _write(_whole_cell(request.cell, options, request), request)
    elif request.instrument is not None:
        instrument = InstrumentOptions(
            stops=request.views if "views" in request.given else InstrumentOptions.stops,
            points=THREE if request.instrument == "points" else THREE[:1],
            poses=request.instrument == "probe",
            seed=options.seed,
            **options.part(ArmOptions),
        )
        joints = None if request.at is None else _planned(request.at, max(len(loads), 1))
        write_tracked(tracked(instrument, joints), folder)
    elif request.torques:
        write_exercise(_exercise_options(request, request.robot, request.seed), folder)
    elif request.warm_up:
        rounds = Round(first=request.views)
        warm = WarmUpOptions(options, round=rounds, temperatures=not request.currents)
        _write(simulate_warm_up(warm), request)
    elif request.sweep:
        offset_s, readout_s = 1e-3 * request.clock_offset_ms, 1e-3 * request.readout_ms
        clocks = SweepOptions(camera_minus_robot_s=offset_s, readout_s=readout_s)
        _write(sweep(options, clocks), request)
    else:
        _write(simulate(options), request)
    say(f"wrote {folder}\nwrote {truth_path(folder)}")


def _check(request: SimulateOptions) -> None:
    """Refuses options that exclude each other, or that change nothing."""
    kinds = [take for take in _TAKES if take and getattr(request, take)]
    if "cell" in kinds:
        kinds = [kind for kind in kinds if kind not in _TAKES["cell"]]
    if len(kinds) > 1:
        named = [_option(kind) for kind in kinds]
        raise DataError(
            f"{' and '.join(named)}: each makes a session of its own kind.",
            culprits=named,
            next_step="Make each into a folder of its own; a whole cell's own file says which "
            "robots warm up, and what is swept.",
        )
    kind = kinds[0] if kinds else ""
    takes = _TAKES[kind]
    tilting = {"touches", "wrong_views", "warm_up", "torques", "stiffness_knm"} & request.given
    if tilting and not request.cell and arm_named(request.robot).is_planar:
        named = [_option(name) for name in sorted(tilting)]
        raise DataError(
            f"{' and '.join(named)}: simulated for arms of six joints, and "
            f"{request.robot} has four.",
            culprits=named,
            next_step="Leave them out, or take another --robot.",
        )
    if kind == "cell" and not request.torques:
        takes = takes - {"currents"}
    for wrong in sorted(request.given - takes - {"folder", kind}):
        possible = [_option(name) for name, taken in _TAKES.items() if wrong in taken]
        raise DataError(
            f"{_option(wrong)} goes with {' or '.join(possible)}, not with {_option(kind)}.",
            culprits=[_option(wrong)],
            next_step="Leave it out; a whole cell's own file says what it is made of."
            if kind == "cell"
            else "Leave it out.",
        )


def _write(cell: SimulatedCell, request: SimulateOptions) -> None:
    """Writes a cell, and its robots' touches."""
    count, depth = len(cell.sights), None
    if request.depth or request.given.intersection(_DEPTH):
        depth = DepthOptions(
            scale=request.depth_scale,
            offset_m=1e-3 * request.depth_offset_mm,
            bowl_m=1e-3 * request.depth_bowl_mm,
            boxed=0.5 * request.depth_box,
        )
    with shown_progress(quiet=False) as progress:
        write_session(
            cell,
            request.folder,
            lambda share: progress("render", round(share * count), count),
            images=request.images and not (request.sweep or request.warm_up),
            touched=touch(cell) if request.touches else None,
            depth=depth,
        )


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}" if name else "a plain cell of one robot"


def _planned(plan: Path, times: int) -> FloatArray:
    """(k times, n) joint angles of a plan's k stops, each several times [rad]."""
    file = plan / PLAN if plan.is_dir() else plan
    document = parse_stored(read_text(file), str(file))
    with reading(str(plan), "a plan", "Make one with visioncal plan."):
        return np.repeat(np.array([stop["q"] for stop in document["stops"]]), times, axis=0)


def _whole_cell(name: str, options: CellOptions, request: SimulateOptions) -> SimulatedCell:
    """Simulates a whole cell; the user's options override its description."""
    cell = simulate(_described(name, options, request.given, request.instrument))
    if not (cell.sights or cell.readings):
        raise DataError(
            f"--cell {name}: nothing in this cell is seen or read.",
            culprits=[name],
            next_step="Give it a camera that sees a target, or an instrument and points.",
        )
    if not request.torques:
        return cell
    exercises = {
        robot.name: exercise(
            _exercise_options(request, robot.robot, seed_of(cell.options.seed, at))
        )
        for at, robot in enumerate(cell.layout.robots)
    }
    return with_exercises(cell, exercises)


def _described(
    name: str, options: CellOptions, given: frozenset[str], instrument: Instrument | None
) -> NetworkOptions:
    """A cell's description, with the user's options in its place."""
    described = read_cell(name)
    fields = {"stops": "views", "seed": "seed", "recording": "recording"}
    changes = {field: getattr(options, name) for field, name in fields.items() if name in given}
    described = replace(described, **changes)
    if "camera_moved_mm" in given:
        if not described.cameras:
            raise DataError(
                f"--cell {name}: there is no camera to knock.", culprits=["--camera-moved-mm"]
            )
        frame = frame_name("camera", described.cameras[0].name)
        knocked = Moved(frame, 0, shift_m=options.camera_moved_m, turn_rad=0.0)
        described = replace(described, moved=(*described.moved, knocked))
    if instrument is None:
        return described
    if described.instruments or described.points:
        raise DataError(
            f"--cell {name} has instruments or points of its own.",
            culprits=["--instrument"],
            next_step="Leave --instrument out.",
        )
    # It measures every robot's flange.
    places = THREE if instrument == "points" else THREE[:1]
    points = tuple(
        PointAt(f"{robot.name}{at}", robot.name, place)
        for robot in described.robots
        for at, place in enumerate(places, start=1)
    )
    sigma_rad = InstrumentOptions.sigma_rad if instrument == "probe" else 0.0
    tracker = InstrumentAt("tracker", (2.5, -1.0, 0.4), 2.5, sigma_rad=sigma_rad)
    return replace(described, instruments=(tracker,), points=points)


def _exercise_options(options: SimulateOptions, robot: str, seed: int) -> ExerciseOptions:
    """An arm's motions, without load or with a cube on its flange."""
    loads = options.payload_kg or [0.0]
    if len(loads) > 1:
        raise DataError(
            f"--payload-kg is given {len(loads)} times; with --torques the arm carries one load.",
            culprits=["--payload-kg"],
            next_step="Make a session of each load, with the same --seed.",
        )
    # A cube of 0.1 m a side.
    inertia = loads[0] * 2.0 / 3.0 * 0.05**2 * np.eye(3)
    load = LinkBody(loads[0], np.array(_CENTRE_M), inertia) if loads[0] else None
    senses = Senses(gains_nm_a=(10.0, 10.0, 9.0, 7.0, 7.0, 7.0) if options.currents else ())
    return ExerciseOptions(robot, load, senses, seed=seed)
