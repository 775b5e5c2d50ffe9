"""`visioncal plan` for a measuring instrument."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from visioncal.calibration.run import calibrate
from visioncal.cli.console import answer, print_json, report_written, say, warn
from visioncal.cli.plan_source import Kept, Source, pose_of, robot_of
from visioncal.cli.session_options import PlanOptions
from visioncal.core.choices import Criterion
from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.files import json_text
from visioncal.core.number_format import some_of
from visioncal.core.parsing import numbers_in, refuse_given
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.frames.touches import robot_noise
from visioncal.interchange.outputs import PLAN, PROGRAM, write_stops
from visioncal.planning.cell import TYPICAL_NOISE, InstrumentCell
from visioncal.planning.instrument import STABLE, InstrumentPlan, plan_for_instrument
from visioncal.planning.plan import Stop
from visioncal.planning.plan_file import joints_in_degrees, ur_program
from visioncal.planning.purposes import purpose_of
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.columns import INSTRUMENT_POSITION, INSTRUMENT_QUATERNION
from visioncal.session.document import InstrumentTable
from visioncal.session.kinds import Instrument, stated_instrument

_CAMERA_ONLY = ("target", "camera", "resolution", "need_mm", "need_deg")


def is_for_instrument(options: PlanOptions, source: Source) -> bool:
    """Whether stops are asked for that an instrument reads."""
    mounts = {part.mount for part in (source.session, source.calibration) if part is not None}
    return options.mount == "instrument" or "instrument" in mounts


def plan_instrument(options: PlanOptions, source: Source, kept: Kept) -> str:
    """Plans stops of an instrument, and prints and writes them; raises DataError."""
    refuse_given(options.options(*_CAMERA_ONLY), "an instrument sees no board")
    purpose = purpose_of(options.purpose or "kinematics", "--for")
    cell, recorded, first = _cell(options, source, kept)
    start = None
    if options.start_joints:
        form = ",".join(f"q{index + 1}" for index in range(cell.robot.joint_count))
        start = np.array(numbers_in(options.start_joints, "--start-joints", form))
    criterion: Criterion = options.criterion or "D"
    plan = plan_for_instrument(
        cell,
        purpose,
        options.add or options.stops or purpose.stops,
        criterion,
        possible=options.candidates,
        seed=options.seed,
        recorded=recorded,
        start_q=start,
    )
    sentences = plan.sentences(options.seed)
    pairs = enumerate(zip(plan.q, plan.via, strict=True), first)
    stops = [Stop(view, q, via, "") for view, (q, via) in pairs]
    document = {
        "schema": 1,
        "visioncal": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "source": {"kind": source.words},
        "mount": "instrument",
        "purpose": purpose.name,
        "judged": purpose.errors,
        "criterion": {"name": criterion, "value": plan.design.sigma_mm},
        "predicted": {"sigma_mm": plan.design.predicted.mm, "sigma_deg": plan.design.predicted.deg},
        "condition": {"phi_t_phi": plan.condition(), "parameters": plan.parameters},
        "joints": list(cell.robot.joint_names),
        "stops": [{"view": at.view, "q": at.q.tolist(), "via_q": at.via.tolist()} for at in stops],
    }
    named = f"Robot {cell.robot.name}, instrument {cell.instrument.words}."
    program = ur_program(
        cell.robot, purpose.name, named, stops, lambda _: "read the instrument", begins=bool(start)
    )
    files: dict[str, str | bytes] = {PLAN: json_text(document)}
    if program:
        files[PROGRAM] = program
    written = write_stops(options.out, _table(plan, stops), files)
    if options.as_json:
        print_json(document)
    else:
        for line in sentences:
            answer(line)
        if plan.condition() >= STABLE:
            warn(
                "the stops leave parameters that are hardly separated: ask for more of them, "
                "or read a 6D probe (--probe pose)"
            )
        say(
            "Type each reading into its row of stops.csv, in metres: the table is then a "
            "session's views.csv."
        )
    report_written(written, quiet=options.as_json)
    return ""


def _table(plan: InstrumentPlan, stops: list[Stop]) -> str:
    """The stops as a views.csv, whose readings are empty."""
    read = INSTRUMENT_POSITION + INSTRUMENT_QUATERNION * plan.cell.are_poses
    joints = [f"q{index + 1}_rad" for index in range(plan.cell.robot.joint_count)]
    rows: list[list[object]] = [["view", *joints, *read, "joints_deg"]]
    for stop in stops:
        angles = (f"{q:.9f}" for q in stop.q)
        rows.append([stop.view, *angles, *[""] * len(read), joints_in_degrees(stop.q)])
    return csv_text(rows)


def _cell(
    options: PlanOptions, source: Source, kept: Kept
) -> tuple[InstrumentCell, FloatArray | None, int]:
    """The cell, the recorded stops that count, and the number of the first new view."""
    session, found = source.session, source.calibration
    if options.add is not None and session is None:
        raise DataError(
            f"--add: {source.words} holds no recorded session to which stops could be added.",
            culprits=["--add"],
            next_step="Name the session, or ask for a plan of its own with --stops.",
        )
    has_guess = options.cam is not None and options.board is not None
    if session is not None and found is None and not has_guess:
        try:
            found = calibrate(session)
        except DegenerateError as error:
            raise error.but(
                f"session {session.name!r} does not show where instrument and probe are: "
                f"{error.message}",
                next_step="Give both roughly, by --cam and --board: what was recorded counts all "
                "the same.",
            ) from error
    robot = robot_of(options, source, found, "stops cannot be planned")
    if found is not None:
        x, z = (found.edges[name].matrix for name in ("base_from_instrument", "flange_from_probe"))
        noise = replace(
            TYPICAL_NOISE, robots=np.maximum(robot_noise(found).robots, 0.5 * TYPICAL_NOISE.robots)
        )
    else:
        x, z, noise = np.eye(4), np.eye(4), TYPICAL_NOISE
    if options.cam is not None:
        x = _placed(options.cam, "--cam")
    if options.board is not None:
        z = _placed(options.board, "--board")
    missing = [f"--{name}" for name in ("cam", "board") if getattr(options, name) is None]
    instrument, are_poses = _instrument(options, session)
    missing += ["--instrument"] if instrument is None else []
    if instrument is None or (found is None and len(missing)):
        raise DataError(
            f"{source.words}: {some_of(missing)} {'is' if len(missing) == 1 else 'are'} needed to "
            "know the instrument, where it stands in the base and where its probe is on the "
            "flange.",
            culprits=missing,
            next_step="Such as --instrument leica-at960 --cam '2500 -1000 400' --board "
            "'30 -20 120', in mm; --probe pose for a 6D probe.",
        )
    cell = InstrumentCell(robot, instrument, x, z, are_poses, noise, *kept)
    recorded, first = None, 1
    if options.add is not None and session is not None:
        recorded = _recorded(session, robot)
        first = 1 + max(view.number for view in session.views)
    return cell, recorded, first


def _placed(words: str, option: str) -> FloatArray:
    """A rough pose as `pose_of` reads it; three numbers are a place alone, which is not turned."""
    return pose_of(words + " 0 0 0" * (len(words.replace(",", " ").split()) == 3), option)


def _instrument(options: PlanOptions, session: Session | None) -> tuple[Instrument | None, bool]:
    """The instrument, and whether it reads poses of a probe."""
    are_poses = options.probe == "pose"
    if options.instrument is not None:
        instrument = stated_instrument(InstrumentTable(name=options.instrument))
    elif session is not None and len(session.instruments) == 1:
        instrument = stated_instrument(next(iter(session.instruments.values())))
        if options.probe is None:
            are_poses = any(view.instrument_from_probe() is not None for view in session.views)
    else:
        return None, are_poses
    if are_poses and instrument.sigma_rad is None:
        raise DataError(
            f"--probe pose: how well {instrument.words} reads rotations is not known.",
            culprits=["--probe"],
            next_step="Name another instrument, state sigma_rad in the session, or plan for a "
            "point.",
        )
    return instrument, are_poses


def _recorded(session: Session, robot: Robot) -> FloatArray:
    """Joint angles (r, n) of the recorded stops [rad]."""
    read = [view for view in session.views if view.reading_m is not None]
    joints = [view.joints_rad for view in read if view.joints_rad is not None]
    if len(joints) < len(read) or any(len(q) != robot.joint_count for q in joints):
        raise DataError(
            f"--add: {len(read) - len(joints)} readings of session {session.name!r} have no joint "
            f"angles of {robot.name}.",
            culprits=["views.csv: q1_rad"],
            next_step="Record q1_rad ..., or plan without --add.",
        )
    return np.unique(np.array(joints), axis=0)
