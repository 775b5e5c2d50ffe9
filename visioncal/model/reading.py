"""Reading a session as a cell."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.core.types import Corners, FloatArray
from visioncal.model.arm import Arm, Moments, Reported, Swept, even_progress
from visioncal.model.cell import Cell
from visioncal.model.heating import recorded_inputs
from visioncal.model.priors import stated_sightings
from visioncal.model.sightings import Evidence, MeasuredPlace, MeasuredPose, Sighting, is_copy
from visioncal.robot import Robot
from visioncal.session import Observation, Session, frame_name
from visioncal.session.columns import MEASURED_CAM_POSE
from visioncal.session.frames import CELL
from visioncal.session.kinds import name_of, stated_instrument
from visioncal.session.table import loads_of
from visioncal.session.tree import Branch, Tree
from visioncal.vision.poses import FEWEST_CORNERS


def read_cell(
    session: Session,
    corners: Mapping[int, Corners],
    sweeps: Sequence[Swept] = (),
    reports: Mapping[str, Reported] | None = None,
    reference: str = "",
) -> Cell:
    """Reads a session.

    Args:
        session: The session; rows of the lens alone are left out, and a copy of an earlier reading
            of its stop. Rows of sweeps have the robot's poses at their times.
        corners: The corners in its images by view, each numbered on its own board.
        sweeps: What was seen while a robot moved.
        reports: What is known of robots' rows, by robot; of others, they are taken as they are.
        reference: The cell's own frame; empty for the base of the robot that most sightings move
            with.

    Raises:
        DataError: No row has an observation, or frames are ambiguous.
    """
    rows = [
        row for row in session.observations if not row.view.is_of_lens and not row.missing_robots
    ]
    if not rows:
        raise DataError(
            f"session {session.name!r}: no row has an observation of a camera or an instrument.",
            next_step="Give rows images and cameras, or poses in cft_ columns.",
        )
    stations = {station: at for at, station in enumerate(sorted({row.station for row in rows}))}
    arms = {arm.flange: arm for arm in _arms(session, rows, stations, reports or {})}
    sightings = list[Sighting]()
    of_pair: dict[tuple[object, ...], list[Sighting]] = {}
    absent = dict[int, str]()
    for row in rows:
        stop = stations[row.station]
        known = (arms[frame_name("flange", name)].poses[stop] for name in row.robots)
        view, found = row.view.number, corners.get(row.view.number)
        evidence = _evidence(session, row, found)
        if evidence is None:
            count = "no corners" if found is None else counted(len(found.ids), "corner")
            absent[view] = f"too few corners: {count}, needs {FEWEST_CORNERS}"
        elif not all(np.isfinite(pose).all() for pose in known):
            absent[view] = "the robot's pose there is not known"
        else:
            earlier = of_pair.setdefault((stop, row.seer, row.seen), [])
            # A copy says nothing new about noise.
            is_anew = row.view.stop is not None or row.view.stamp_s is not None
            copied = (at for at in earlier if is_copy(evidence, at.evidence, is_anew=is_anew))
            first = next(copied, None)
            if first is None:
                one = Sighting(view, stop, row.seer, row.seen, evidence, row.view.holdout)
                earlier.append(one)
                sightings.append(one)
            else:
                absent[view] = f"repeats view {first.view}"
    tree = _tree(session, [*arms], sightings, reference)
    sightings += stated_sightings(session.declaration, tree, sightings)
    rates = {(sweep.camera, sweep.flange): np.zeros((len(stations), 6)) for sweep in sweeps}
    stamps_s = np.full(len(stations), np.nan)
    for row in rows:
        stop = stations[row.station]
        stamps_s[stop] = np.nan if row.view.stamp_s is None else row.view.stamp_s
        for sweep in sweeps:
            if row.seer == sweep.camera and row.view.number in sweep.rates:
                rates[sweep.camera, sweep.flange][stop] = sweep.rates[row.view.number]
    return Cell(
        tree,
        arms,
        {frame_name("camera", name): table for name, table in session.cameras.items()},
        {session.board_frames[name]: board for name, board in session.boards.items()},
        tuple(sightings),
        Moments.of(arms, even_progress(len(stations)), rates, stamps_s),
        tuple(sweeps),
        absent,
        tuple(stations),
    )


def _arms(
    session: Session,
    rows: list[Observation],
    stations: Mapping[int, int],
    reports: Mapping[str, Reported],
) -> Iterator[Arm]:
    models = {name: Robot.from_document(at) for name, at in session.robot_documents.items()}
    for name in session.robots:
        report = reports.get(name)
        model = models.get(name) if report is None else report.model
        poses = np.full((len(stations), 4, 4), np.nan)
        joints = np.full((len(stations), model.joint_count if model else 0), np.nan)
        numbers: list[Mapping[str, float]] = [{}] * len(stations)
        approaches = [""] * len(stations)
        for row in rows:
            if name not in row.robots:
                continue
            at, posed_row = stations[row.station], row.robots[name]
            numbers[at], approaches[at] = posed_row.numbers, posed_row.text.get("approach", "")
            if report is None:
                angles, stated = posed_row.joints_rad, posed_row.base_from_flange()
                pose = None if stated is None else stated.as_matrix()
            else:
                view = posed_row.number if posed_row.number in report.poses else row.view.number
                angles, pose = report.joints.get(view), report.poses.get(view)
            if model is not None and angles is not None:
                joints[at] = angles
            if pose is not None:
                poses[at] = pose
            elif model is not None and angles is not None:
                poses[at] = model.base_from_flange(angles[None])[0]
        is_known = model is not None and bool(
            np.isfinite(joints[np.isfinite(poses[:, 0, 0])]).all()
        )
        known: FloatArray | None = np.nan_to_num(joints) if is_known else None
        loads = loads_of(numbers, approaches)
        heat = recorded_inputs(session, model.joint_count, name) if model is not None else None
        yield Arm(frame_name("flange", name), poses, known, model, loads, heat)


def _evidence(session: Session, row: Observation, corners: Corners | None) -> Evidence | None:
    """The sighting of a row; None for none."""
    if corners is not None:
        return corners if len(corners.ids) >= FEWEST_CORNERS else None
    measured = row.view.matrix(MEASURED_CAM_POSE)
    if measured is not None:
        return MeasuredPose(measured)
    place = row.view.reading_m
    if place is None:
        return None
    name = name_of(session.declaration, "instrument", row.view)
    noise = stated_instrument(session.instruments[name])
    sigma_m = float(noise.sigmas_m(place))
    probe = row.view.instrument_from_probe()
    return (
        MeasuredPlace(place, sigma_m)
        if probe is None
        else MeasuredPose(probe, (noise.sigma_rad, sigma_m))
    )


def _tree(session: Session, flanges: list[str], sightings: list[Sighting], reference: str) -> Tree:
    """The tree, with its reference."""
    branches = {
        name: Branch(parent, robot=name if name in flanges else "")
        for name, parent in session.frames.items()
    }
    tree = Tree(CELL, branches)
    if reference:
        return tree.with_known(reference, np.eye(4))
    passed = [step.robot for sight in sightings for step in tree.path(*sight.pair)]
    most = max(flanges, key=passed.count, default=None)
    if most is None:
        first = next(iter(tree.unknown), None)
        return tree if first is None else tree.with_known(first, np.eye(4))
    return tree.with_known(tree.branches[most].parent, np.eye(4))
