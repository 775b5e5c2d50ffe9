"""Tables of measured points, as SpatialAnalyzer, PolyWorks, CAM2 and their like write them.

Columns are recognised by the words of their headings, in any order: `X [mm]`, `Meas. Z`, `U95 X`,
`Rx (deg)`, `Load [kg]`. A text export without headings has the names of collection, group and
target, x, y, z and, if asked for, three uncertainties (SpatialAnalyzer's manual, "Exporting ASCII
formatted points"), by default one standard deviation ("Confidence interval"). The robot's joint
angles or poses stand in the same rows, or in a table of their own beside it.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from visioncal.core.conventions import UNITS_M, PoseNumbers
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, figure, known_name, some_of
from visioncal.core.types import FloatArray, IntArray
from visioncal.interchange.formats.assemble import pose_cells
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.file_search import files_in, groups_in, head, shut
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ImportOptions,
    Side,
    Unstated,
    rows_of,
)
from visioncal.interchange.formats.joints import joints_from
from visioncal.interchange.formats.keys import HOW, Keys, matched
from visioncal.interchange.formats.point_files import (
    in_turn,
    parts_of_poses,
    split_states,
    together,
)
from visioncal.interchange.formats.point_tables import (
    CENTRE,
    FORCE,
    MEASURED,
    OTHER,
    PAYLOAD,
    TURNS,
    UNCERTAIN,
    Heading,
    PointTable,
    word_set,
)
from visioncal.interchange.formats.pose_forms import poses_from
from visioncal.interchange.formats.reading import ENDINGS, read_rows
from visioncal.interchange.formats.unread import armless_note
from visioncal.session.columns import INSTRUMENT_POSITION, INSTRUMENT_QUATERNION
from visioncal.session.kinds import known_instruments

# Names of rows, the outermost first, and of the stops of the robot.
_TARGETS = "target point name label feature object frame punkt messpunkt punto"
_LEVELS = (word_set("collection"), word_set("group gruppe grupo"), word_set(_TARGETS))
_STOP = word_set("stop pose station posture stelle")
_LOAD = re.compile(r"(?<![0-9.,])(\d+(?:[.,]\d+)?)[ _]?(kg|N)(?![^\W_])")
_COVERED = {
    2.0: re.compile(r"u\(?95|\b95(?:[.,]\d+)? ?%|k ?= ?2\b|2 ?sigma|expanded|erweitert", re.I),
    3.0: re.compile(r"u\(?99|\b99(?:[.,]\d+)? ?%|k ?= ?3\b|3 ?sigma", re.I),
}
# Instruments that read no points.
_OF_AN_AXIS = {"xl80": "XL-80 reads a length", "xr20": "XR20-W reads the angle of one axis"}


def _read(path: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a table of points with the robot's state, or two tables; raises DataError."""
    files = [file for group in groups_in(path) if group.is_data for file in group.files]
    tables, every = list[PointTable](), list[Fields]()
    for file in [*files, *filter(None, [requested.camera_file])]:
        with suppress(DataError) if path.is_dir() else nullcontext():
            rows = read_rows(file, requested.robot.form)
            tables += [PointTable.of(fields, file, requested) for fields in rows]
            every += rows
    given = {*requested.camera.names}
    of_points = [t for t in tables if t.points() or (given and given <= {*t.fields.numbers})]
    of_points = [t for t in of_points if given == {t.fields.name}] or of_points
    # Poses beside joint angles are of what was measured.
    split, states = split_states(every, requested), [t for t in tables if t.joints]
    states = states or [*(t for t in tables if t.poses), *split]
    parts = parts_of_poses(every) if split else set[str]()
    points_only = [t for t in of_points if t not in states and t.fields.name not in parts]
    # Points of another arm beside these have other rows.
    points_only.sort(key=lambda points: len(points.fields) not in {len(t.fields) for t in states})
    points = next(
        iter(points_only or sorted(of_points, key=lambda table: not table.is_measured)), None
    )
    states.sort(key=lambda t: points is None or len(t.fields) != len(points.fields))
    state = next((t for t in states if (t is points) != bool(points_only)), None)
    is_state_alone = state is points and bool(points and points.poses and not points.is_measured)
    unread = [(each.label, fault) for each in groups_in(path) if (fault := shut(each.label))]
    if unread and (points is None or is_state_alone or state is None):
        missing = "the measured points" if points is None else "where the arm stood"
        raise DataError(
            f"{path.name}: the tables that are read do not say {missing}, and {unread[0][0]} is "
            f"{unread[0][1]}.",
            culprits=[unread[0][0]],
            next_step="Put that table beside the others, and convert the folder.",
        )
    if points is None or is_state_alone:
        listed = "; ".join(dict.fromkeys(table.fields.listing() for table in tables))
        raise DataError(
            f"{path.name}: no columns of measured points are known, as X, Y, Z or Meas X [mm]; it "
            f"has {listed or 'no tables'}.",
            culprits=[str(path)],
            next_step="Name them with --camera-columns X,Y,Z, or put the table of points beside it "
            "in one folder, and convert that.",
        )
    if state is None:
        raise DataError(
            f"{points.file}: {counted(len(points.fields), 'measured point')}, but neither joint "
            "angles nor poses of the robot: nothing says where the arm stood.",
            culprits=[points.fields.places[0]],
            next_step="Add columns J1 [deg] ... J6 [deg], or Robot X [mm] ... of the flange with "
            "--robot-form; or put a table of them, with a column of the targets' or groups' names, "
            f"beside {points.file} in one folder, and convert that.",
        )
    if state is points:
        return _recording(points, state, requested)
    points, notes = (
        together(points_only, len(state.fields)) if points_only and not given else (points, ())
    )
    foreign = _recording(replace(points, poses=()), state, requested)
    return replace(foreign, notes=(*foreign.notes, *notes, *armless_note(foreign, requested)))


def _recording(points: PointTable, state: PointTable, requested: ImportOptions) -> ForeignRecording:
    """The recording of a table of points and of the robot's state at each; raises DataError."""
    fields, robot = points.fields, state.fields
    places, notes = _places(points, requested)
    loads, at = _loads(points), np.arange(len(fields))
    state_names = (*points.joints, *points.poses) if state is points else ()
    stops, spots = _stops(points, loads, state_names)
    if state is not points and (turns := in_turn(points, len(robot))):
        stops, spots, how = turns
        notes += (how,)
    if state is not points:
        notes += robot.notes
        at, how = _paired(points, stops, state)
        notes += (f"Points and the robot's states are paired by {how}.",)
        loads = {k: tuple(v[row] for row in at) for k, v in _loads(state).items()} | loads
    numbers = {stop: str(number) for number, stop in enumerate(dict.fromkeys(stops))}
    used = {*next(iter(points.points().values()), ()), *state_names}
    columns = {f"source_{name}": c for name, c in fields.texts.items() if name not in used} | loads
    columns |= {"stop": tuple(numbers[stop] for stop in stops), "point": tuple(spots)}
    for name in dict.fromkeys(name for row in places for name in row):
        columns[name] = tuple(row.get(name, "") for row in places)
    kept = (at >= 0) & np.array([bool(row) for row in places])
    if not kept.all():
        left = some_of([fields.places[row] for row in np.flatnonzero(~kept)])
        notes += (f"Rows without a place or a state of the robot are left out: {left}.",)
    joints, poses = None, PoseNumbers.empty(robot.places)
    unstated = dict[Side, Unstated]()
    if state.joints:
        angles, more = joints_from(robot, state.joints, degrees=requested.joints_deg)
        joints, notes = angles[at], (*notes, *more)
    if state.poses:
        of_robot = poses_from(robot, state.poses, requested.robot, "robot")
        poses, more, unstated["robot"] = of_robot
        notes = (*notes, *more)
    instrument, more = _instrument(points, requested)
    foreign = ForeignRecording(
        name=fields.name,
        robot=poses.rows(at),
        mount="instrument",
        joints_rad=joints,
        form=robot.form,
        columns=columns,
        notes=(*notes, *more),
        unstated=unstated,
        instrument=instrument,
    )
    return rows_of(foreign, np.flatnonzero(kept))


def _places(
    points: PointTable, requested: ImportOptions
) -> tuple[list[dict[str, str]], tuple[str, ...]]:
    """Cells of readings by row, of places or of a probe's poses, and notes; raises DataError."""
    fields, given = points.fields, requested.camera
    words, names = next(iter(points.points().items()), (word_set(""), ()))
    if given.names != (fields.name,) or fields.name in fields.numbers:
        names = tuple(map(fields.find, given.names)) or names
    unit, notes = points.unit(names[:3], given.unit)
    angles = {w - TURNS: n for w, n in points.triples().items() if w & TURNS}
    turns = angles.get(words) or (next(iter(angles.values())) if len(angles) == 1 else ())
    lower = {name.lower(): name for name in fields.numbers}
    for quaternion in (("qx", "qy", "qz", "qw"), ("q0", "q1", "q2", "q3")):
        turns = tuple(lower[name] for name in quaternion) if {*quaternion} <= {*lower} else turns
    if len(names) == 3 and {*turns} & {*points.poses, *points.joints}:
        turns = ()
    if sum(fields.column(name).shape[1] for name in names) + len(turns) == 3:
        places = UNITS_M[unit] * np.hstack([fields.column(name) for name in names])
        cells = (
            dict(zip(INSTRUMENT_POSITION, map(repr, at), strict=True)) for at in places.tolist()
        )
        return [{} if "nan" in row.values() else row for row in cells], notes
    form = given.form
    if form is None and len(turns) == 3:
        form = f"euler-xyz-{'rad' if Heading.of(turns[0]).unit == 'rad' else 'deg'}"
        notes += (
            f"{', '.join(turns)} are taken for turns about the fixed axes x, y, z, as "
            "SpatialAnalyzer writes them; --camera-form names another form.",
        )
    probe_options = replace(given, names=names + turns * (len(names) == 3), form=form, unit=unit)
    numbers, more, _ = poses_from(fields, probe_options.names, probe_options, "camera")
    return pose_cells(numbers, INSTRUMENT_POSITION + INSTRUMENT_QUATERNION), (*notes, *more)


def _levels(points: PointTable) -> list[tuple[str, ...]]:
    """Names of the rows: of collections, groups and targets, those in one cell (A::B::C) apart."""
    texts = points.fields.texts
    columns = [texts[name] for kind in _LEVELS if (name := points.named(kind))]
    parts = ["::".join(filter(None, row)).split("::") for row in zip(*columns, strict=True)]
    depth = max(map(len, parts), default=0)
    return [*zip(*([""] * (depth - len(row)) + row for row in parts), strict=True)]


def _stops(
    points: PointTable, loads: Mapping[str, Sequence[str]], held: Sequence[str]
) -> tuple[list[object], list[str]]:
    """The stop of each row as its load and its name, and the name of its point on the flange.

    Stops end where what `held` columns have changes, where there are some. Else, of two levels of
    names that which has fewer is the points', as of targets SMR1 to SMR3 in groups P1 to P30, or of
    targets P1 to P30 in groups SMR1 to SMR3.
    """
    texts, count = points.fields.texts, len(points.fields)
    load = [*zip(*loads.values(), strict=True)] or [()] * count
    free = [c for c in _levels(points) if len({*c}) > 1 and not all(map(_LOAD.search, c))]
    last = free[-1] if free and len({*free[-1]}) < count else ("",) * count
    names, spots = texts.get(points.named(_STOP), ()), last
    if held:
        cells = (map(str, points.fields.column(name).tolist()) for name in held)
        rows = [*zip(load, *cells, strict=True)]
        changes = [row != before for row, before in zip(rows, [None, *rows], strict=False)]
        names = tuple(map(str, np.cumsum(changes)))
    elif len({*names}) < 2 and len(free) > 1 and any(last):
        names, spots = sorted(free[-2:], key=lambda cells: -len({*cells}))
    elif len({*names}) < 2:
        names, spots = free[-1] if free else ("",) * count, ("",) * count
    keys = list[object](zip(load, names, strict=True))
    seen, times = Counter[object](), list[int]()
    for key in keys:
        seen[key] += 1
        times.append(seen[key])
    if any(spots) or max(times) == 1:
        return keys, [*spots]
    # Points without names are told by their order at a stop; those that return are at another one.
    return (keys, [*map(str, times)]) if held else ([*zip(load, times, strict=True)], [*names])


def _paired(points: PointTable, stops: Sequence[object], state: PointTable) -> tuple[IntArray, str]:
    """The robot's row of each point, -1 for none, and how it was found; raises DataError."""
    robot, keys = state.fields, [*dict.fromkeys(stops)]
    names = [str(key[1]) for key in keys if isinstance(key, tuple) and isinstance(key[1], str)]
    unique = [*dict.fromkeys(names)]
    match = matched(Keys.of(len(unique), {"stop": (*unique,)}), robot.keys) if all(names) else None
    if match is not None and unique and (match.how != HOW[-1] or len(keys) != len(robot)):
        rows = dict(zip(unique, match.rows.tolist(), strict=True))
        place, how = {key: rows[name] for key, name in zip(keys, names, strict=True)}, match.how
    elif len(keys) == len(robot):
        place, how = {key: row for row, key in enumerate(keys)}, HOW[-1]
    else:
        raise DataError(
            f"{points.file}: points of {counted(len(keys), 'stop')}, but {state.file} has "
            f"{counted(len(robot), 'state')} of the robot, and neither names nor numbers say which "
            "belong together.",
            culprits=[points.fields.places[0], robot.places[0]],
            next_step="Add a column `stop` of the same names or numbers to both tables, or delete "
            "the rows that the other has not.",
        )
    return np.array([place[stop] for stop in stops]), how


def _loads(table: PointTable) -> dict[str, tuple[str, ...]]:
    """Columns of payloads [kg], their centres [m] and forces [N], by headings or by names of rows.

    A force without axes pulls downwards.
    """
    found = dict[str, FloatArray]()
    for name in table.fields.numbers:
        heading = Heading.of(name)
        axis, unit, column = heading.axis, heading.unit, table.fields.column(name)[:, 0]
        if axis and heading.words & CENTRE and unit in UNITS_M:
            found[f"payload_{axis}_m"] = UNITS_M[unit] * column
        elif axis and heading.words & FORCE:
            found[f"force_{axis}_n"] = column
        elif not axis and (unit == "n" or (heading.words & FORCE and not unit)):
            found |= dict.fromkeys(("force_x_n", "force_y_n"), 0 * column)
            found["force_z_n"] = -np.abs(column)
        elif not axis and (unit == "kg" or (heading.words & PAYLOAD and not unit)):
            found["payload_kg"] = column
    for cells in [] if found else _levels(table):
        tags = [_LOAD.search(cell) for cell in cells]
        size = np.array([float(tag[1].replace(",", ".")) if tag else 0.0 for tag in tags])
        if {tag[2] for tag in tags if tag} == {"kg"}:
            found["payload_kg"] = size
        elif any(tags):
            found |= {"force_x_n": 0 * size, "force_y_n": 0 * size, "force_z_n": -size}
    return {
        name: tuple("" if np.isnan(value) else repr(value) for value in column.tolist())
        for name, column in found.items()
    }


def _instrument(
    points: PointTable, requested: ImportOptions
) -> tuple[dict[str, object], tuple[str, ...]]:
    """The content of [instrument], and notes on it; raises DataError."""
    column = points.named(word_set("instrument device gerät messgerät"))
    said = requested.instrument or " ".join(
        (*points.fields.texts.get(column, ())[:1], points.title)
    )
    plain = re.sub(r"[\W_]+", "", said.lower())
    if axis := next((words for name, words in _OF_AN_AXIS.items() if name in plain), ""):
        raise DataError(
            f"{points.file}: an {axis}, and no points.",
            culprits=[points.fields.name],
            next_step="Read points or poses on the flange, as with a tracker.",
        )
    if is_number(said):
        return {"sigma_m": 1e-3 * float(said)}, ()
    known = (name for name in known_instruments() if "".join(name.split("-")[1:]) in plain)
    name = requested.instrument or next(known, "")
    found: dict[str, object] = {"name": name} if name else {}
    stated = (
        names
        for words, names in points.triples().items()
        if words & UNCERTAIN or {"standard", "deviation"} <= words
    )
    if not (names := next(stated, ())):
        if name:
            step = "Or say its sigma in mm, as --instrument 0.02."
            known_name("instrument", name, known_instruments(), next_step=step)
        step = "Give --instrument NAME, or its sigma in mm, or add [instrument] to session.toml."
        return found, () if found else (f"The sigma of the readings is not stated. {step}",)
    places = next(iter(points.points().values()), ())
    unit = Heading.of(names[0]).unit or points.unit(places, requested.camera.unit)[0]
    text = "\n".join((*names, points.title))
    factor = next((k for k, pattern in _COVERED.items() if pattern.search(text)), 1.0)
    sigmas = UNITS_M[unit] / factor * np.hstack([points.fields.column(each) for each in names])
    found["sigma_m"] = float(np.sqrt(np.nanmean(sigmas**2)))
    words = "standard deviations, as nothing else is said" if factor == 1.0 else f"k = {factor:g}"
    by_axis = ", ".join(figure(1e3 * each) for each in np.nanmedian(sigmas, axis=0))
    note = (
        f"{', '.join(names)} are taken for uncertainties, {words}: {by_axis} mm along x, y, z in "
        "the median. All axes have the sigma_m of [instrument], their root mean square."
    )
    return found, (note,)


def _is_of_points(path: Path) -> bool:
    """Whether a text file begins with names or headings of such programs."""
    for line in head(path).splitlines()[:60]:
        cells = re.split(r"[;,\t]", line)
        headings = [Heading.of(cell) for cell in cells]
        axes = {heading.axis for heading in headings if not heading.words & OTHER}
        words = word_set("").union(*(heading.words for heading in headings))
        if {*"xyz"} <= axes and words & (MEASURED | UNCERTAIN | _LEVELS[0] | _LEVELS[1]):
            return not any(map(is_number, cells))
        if re.search(r"\w::\w.*\d", line):
            return True
    return False


METROLOGY = ForeignFormat(
    "metrology",
    "points that a tracker, a measuring arm or a CMM read (SpatialAnalyzer, PolyWorks, CAM2)",
    lambda path: any(
        file.suffix.lower() in ENDINGS and _is_of_points(file) for file in files_in(path) or (path,)
    ),
    _read,
)
