"""Measured points and the robot's poses that stand in several files, or in turn without names."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.number_format import counted, some_of
from visioncal.core.procrustes import align
from visioncal.core.types import FloatArray, IntArray
from visioncal.interchange.formats.fields import Fields, joined
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.point_tables import PointTable
from visioncal.interchange.formats.poses import possible_poses

# Most that distances of points on one flange change by, as a share of how far they move: an arm
# moves them by some hundreds of millimetres, and their distances change by what they were read to.
_RIGID = 0.02
# Points of one place, as a drawing's beside measured ones, are as far from each other as these
# differ by chance.
_APART = 5.0
# How much less distances change in one order of rows than in another, where it is theirs.
_CLEARLY = 10.0


def split_states(rows: Sequence[Fields], requested: ImportOptions) -> list[PointTable]:
    """The robot's poses whose positions and rotations are in a file each, as `pos_tcp, rotvec_tcp`.

    Raises DataError where names that the user gives are none of the files'.
    """
    found = list[PointTable]()
    files = [fields for fields in rows if _three(fields)]
    given = {*requested.robot.names}
    for count in dict.fromkeys(map(len, files)):
        whole = [fields for fields in files if len(fields) == count]
        for merged in joined(whole, whole[0].name, whole[0].folder, prefixed=True):
            options = requested if given <= {*merged.numbers} else _without_names(requested)
            table = PointTable.of(merged, whole[0].folder / whole[0].name, options)
            named = [item.names for item in possible_poses(merged) if item.is_named]
            pairs = [names for names in named if len(names) == 2]
            of_two = (table.poses, *pairs) if len(table.poses) == 2 else pairs[: len(pairs) == 1]
            for names in of_two[:1]:
                left = [", ".join(other) for other in pairs if other != names]
                note = f"The robot's poses are {', '.join(names)}; left aside: {some_of(left)}. "
                noted = replace(
                    table.fields, notes=(f"{note}--robot-key names them.",) * bool(left)
                )
                found.append(replace(table, fields=noted, poses=names, file=", ".join(names)))
    return found


def _without_names(requested: ImportOptions) -> ImportOptions:
    return replace(requested, robot=replace(requested.robot, names=()))


def parts_of_poses(rows: Sequence[Fields]) -> set[str]:
    """Names of files that are positions or rotations of poses in two files each."""
    files = [fields for fields in rows if _three(fields)]
    return {
        name
        for merged in (
            joined(files, files[0].name, files[0].folder, prefixed=True) if files else ()
        )
        for item in possible_poses(merged)
        if item.is_named and len(item.names) == 2
        for name in item.names
    }


def _three(fields: Fields) -> bool:
    """Whether rows are three numbers and nothing else."""
    return sum(int(np.prod(each.shape[1:])) for each in fields.numbers.values()) == 3 and (
        {*fields.texts} <= {*fields.numbers}
    )


def together(tables: Sequence[PointTable], count: int) -> tuple[PointTable, tuple[str, ...]]:
    """Tables of one point each at all stops of the robot as one, and a note on those left aside.

    Points of one flange keep their distances. `count` is that of the stops.
    """
    first, *others = tables
    names = [*first.points().values()]
    alike = [first]
    for table in others if len(first.fields) == count and not _is_named(first) else ():
        fits = len(table.fields) == count and not _is_named(table)
        fits = fits and [*table.points().values()] == names
        # Of a copy in another folder, one of the points has no distance.
        if fits and all(_are_rigid(_places(each), _places(table)) for each in alike):
            alike.append(table)
    left = [f"{t.file} ({counted(len(t.fields), 'row')})" for t in others if t not in alike]
    notes = (
        f"Left aside: {some_of(left)}. Points of several files are read together where each has a "
        "row a stop of the robot and they keep their distances; others as rows of one table with "
        "columns `stop` and `point`.",
    ) * bool(left)
    if len(alike) == 1:
        return first, notes
    labels = [re.sub(r"\W+", "_", table.fields.name) for table in alike]
    columns = names[0]
    fields = Fields(
        name=first.fields.name,
        folder=first.fields.folder,
        places=tuple(place for table in alike for place in table.fields.places),
        numbers={
            name: np.concatenate([table.fields.column(name)[:, 0] for table in alike])
            for name in columns
        },
        texts={
            "stop": tuple(str(at + 1) for _ in alike for at in range(count)),
            "point": tuple(label for label in labels for _ in range(count)),
        },
    )
    note = f"Points of the files {some_of(labels)} are read together: they keep their distances."
    file = ", ".join(table.file for table in alike)
    return replace(first, fields=fields, poses=(), joints=(), file=file), (note, *notes)


def in_turn(points: PointTable, count: int) -> tuple[list[object], list[str], str] | None:
    """Stops and points of rows without names, several times as many as the robot's stops; and how.

    None where their distances do not say which they are.
    """
    found = None if _is_named(points) else _in_order(_places(points), count)
    if found is None:
        return None
    how, stops, spots = found
    several = len(points.fields) // count
    note = f"{several} points are taken {how} of the robot: so they keep their distances."
    return list[object](stops.tolist()), [str(spot + 1) for spot in spots], note


def _in_order(places: FloatArray, count: int) -> tuple[str, IntArray, IntArray] | None:
    """How (n, 3) places are several at each of `count` stops, and the stop and point of each.

    Points at a stop follow one another, or stops of a point: distances that stay say which. None
    where neither is clear.
    """
    rows = len(places)
    if rows % count or rows == count or rows > _MOST_POINTS * count:
        return None
    several, at = rows // count, np.arange(rows)
    orders = {
        "in turn at each stop": (at // several, at % several),
        "one after the other, each at all stops": (at % count, at // count),
    }
    changes = {
        how: _change(places[np.lexsort((spots, stops))].reshape(count, several, 3))
        for how, (stops, spots) in orders.items()
    }
    best, other = sorted(orders, key=changes.__getitem__)
    if not changes[best] < min(_RIGID, changes[other] / _CLEARLY):
        return None
    return best, *orders[best]


# Most points of a thing at a stop: thousands are a surface that was scanned.
_MOST_POINTS = 60
# Fewest points whose places are a pose, and the least share of their extent off a line.
_OF_A_POSE, _OFF_LINE = 3, 0.05


def with_point_sets(fields: Fields, others: Sequence[Fields]) -> Fields:
    """Rows of the robot's poses with the target's, where other rows are points of it at each.

    Three points and more that keep their distances, and lie on no line, have a pose: that of the
    points at the first stop, from their mean.
    """
    count, found = len(fields), dict[str, tuple[FloatArray, str]]()
    for other in others if len(possible_poses(fields)) == 1 else ():
        order = None
        if _three(other) and len(other) >= _OF_A_POSE * count > 0:
            name = other.name if len(other.numbers) > 1 else next(iter(other.numbers))
            places = np.hstack([other.column(each) for each in other.numbers])
            order = _in_order(places, count) if np.isfinite(places).all() else None
        if order is not None:
            how, stops, spots = order
            sets = places[np.lexsort((spots, stops))].reshape(count, -1, 3)
            found[name] = sets, how
    if len(found) != 1:
        return fields
    name, (sets, how) = found.popitem()
    shape = sets[0] - sets[0].mean(axis=0)
    extents = np.linalg.svd(shape, compute_uv=False)
    if extents[1] < _OFF_LINE * extents[0]:
        return fields
    poses = align(sets, np.broadcast_to(shape, sets.shape))
    note = (
        f"{name} has {sets.shape[1]} points {how} of the robot, as they keep their distances: "
        "fitted to these of the first, they are poses of the target."
    )
    named = {f"camera.{name.rpartition('.')[2]}": poses}
    return replace(fields, numbers={**fields.numbers, **named}, notes=(*fields.notes, note))


def _is_named(table: PointTable) -> bool:
    """Whether texts name the rows."""
    return any(name not in table.fields.numbers for name in table.fields.texts)


def _places(table: PointTable) -> FloatArray:
    """(n, 3) measured places, in the file's unit; NaN without."""
    names = next(iter(table.points().values()), ())
    if not names:
        return np.full((len(table.fields), 3), np.nan)
    return np.hstack([table.fields.column(name) for name in names])


def _change(places: FloatArray) -> float:
    """How much distances of (n, k, 3) points change, as a share of how far they move."""
    first, second = np.triu_indices(places.shape[1], 1)
    lengths = np.linalg.norm(places[:, first] - places[:, second], axis=2)
    moved = np.linalg.norm(places - np.nanmean(places, axis=0), axis=2)
    return float(np.nanstd(lengths, axis=0).max() / max(float(np.nanmedian(moved)), 1e-12))


def _are_rigid(one: FloatArray, other: FloatArray) -> bool:
    """Whether two (n, 3) points keep their distance, and are not one place."""
    lengths = np.linalg.norm(one - other, axis=1)
    is_apart = np.nanmean(lengths) > _APART * np.nanstd(lengths)
    return bool(is_apart and _change(np.stack([one, other], axis=1)) < _RIGID)
