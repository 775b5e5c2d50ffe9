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


def simulate_command(asked: SimulateOptions) -> None:
    """Runs `visioncal simulate`."""
    _check(asked)
    folder = asked.folder
    # Checked first, as rendering takes long.
    refuse_filled(folder.absolute())
    compliance: tuple[float, ...] = ()
    if asked.stiffness_knm:
        each = tuple(1e-3 / stiff for stiff in asked.stiffness_knm)
        compliance = each if len(each) > 1 else each * len(arm_named(asked.robot).offset)
    loads = [Payload(kg, _CENTRE_M) for kg in asked.payload_kg or ()]
    loads += [Payload(force_n=(0.0, 0.0, -newtons)) for newtons in asked.force_n or ()]
    options = CellOptions(
        robot=asked.robot,
        mount=asked.mount,
        views=asked.views,
        target=BOARDS.get(asked.board) or load_target(asked.board),
        camera=CAMERAS[asked.camera],
        state_intrinsics=asked.with_intrinsics,
        robot_sigma_m=1e-3 * asked.robot_sigma_mm,
        robot_sigma_rad=1e-3 * asked.robot_sigma_mrad,
        dh_sigma_m=1e-3 * asked.arm_sigma_mm,
        dh_sigma_rad=1e-3 * asked.arm_sigma_mrad,
        wrong_views=asked.wrong_views,
        board_scale=asked.board_scale,
        compliance_rad_per_nm=compliance,
        payloads=tuple(loads),
        second=Second() if asked.second_board else None,
        recording=asked.recording,
        camera_moved_m=1e-3 * asked.camera_moved_mm,
        seed=asked.seed,
    )
    if asked.cell is not None:
        _write(_whole_cell(asked.cell, options, asked), asked)
    elif asked.instrument is not None:
        instrument = InstrumentOptions(
            stops=asked.views if "views" in asked.given else InstrumentOptions.stops,
            points=THREE if asked.instrument == "points" else THREE[:1],
            poses=asked.instrument == "probe",
            seed=options.seed,
            **options.part(ArmOptions),
        )
        joints = None if asked.at is None else _planned(asked.at, max(len(loads), 1))
        write_tracked(tracked(instrument, joints), folder)
    elif asked.torques:
        write_exercise(_exercise_options(asked, asked.robot, asked.seed), folder)
    elif asked.warm_up:
        rounds = Round(first=asked.views)
        warm = WarmUpOptions(options, round=rounds, temperatures=not asked.currents)
        _write(simulate_warm_up(warm), asked)
    elif asked.sweep:
        offset_s, readout_s = 1e-3 * asked.clock_offset_ms, 1e-3 * asked.readout_ms
        clocks = SweepOptions(camera_minus_robot_s=offset_s, readout_s=readout_s)
        _write(sweep(options, clocks), asked)
    else:
        _write(simulate(options), asked)
    say(f"wrote {folder}\nwrote {truth_path(folder)}")


def _check(asked: SimulateOptions) -> None:
    """Refuses options that exclude each other, or that change nothing."""
    kinds = [take for take in _TAKES if take and getattr(asked, take)]
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
    tilting = {"touches", "wrong_views", "warm_up", "torques", "stiffness_knm"} & asked.given
    if tilting and not asked.cell and arm_named(asked.robot).is_planar:
        named = [_option(name) for name in sorted(tilting)]
        raise DataError(
            f"{' and '.join(named)}: simulated for arms of six joints, and {asked.robot} has four.",
            culprits=named,
            next_step="Leave them out, or take another --robot.",
        )
    if kind == "cell" and not asked.torques:
        takes = takes - {"currents"}
    for wrong in sorted(asked.given - takes - {"folder", kind}):
        possible = [_option(name) for name, taken in _TAKES.items() if wrong in taken]
        raise DataError(
            f"{_option(wrong)} goes with {' or '.join(possible)}, not with {_option(kind)}.",
            culprits=[_option(wrong)],
            next_step="Leave it out; a whole cell's own file says what it is made of."
            if kind == "cell"
            else "Leave it out.",
        )


def _write(cell: SimulatedCell, asked: SimulateOptions) -> None:
    """Writes a cell, and its robots' touches."""
    count, depth = len(cell.sights), None
    if asked.depth or asked.given.intersection(_DEPTH):
        depth = DepthOptions(
            scale=asked.depth_scale,
            offset_m=1e-3 * asked.depth_offset_mm,
            bowl_m=1e-3 * asked.depth_bowl_mm,
            boxed=0.5 * asked.depth_box,
        )
    with shown_progress(quiet=False) as progress:
        write_session(
            cell,
            asked.folder,
            lambda share: progress("render", round(share * count), count),
            images=asked.images and not (asked.sweep or asked.warm_up),
            touched=touch(cell) if asked.touches else None,
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


def _whole_cell(name: str, options: CellOptions, asked: SimulateOptions) -> SimulatedCell:
    """Simulates a whole cell; the user's options override its description."""
    cell = simulate(_described(name, options, asked.given, asked.instrument))
    if not (cell.sights or cell.readings):
        raise DataError(
            f"--cell {name}: nothing in this cell is seen or read.",
            culprits=[name],
            next_step="Give it a camera that sees a target, or an instrument and points.",
        )
    if not asked.torques:
        return cell
    exercises = {
        robot.name: exercise(_exercise_options(asked, robot.robot, seed_of(cell.options.seed, at)))
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
