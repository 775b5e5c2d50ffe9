"""Start of a fit: lenses by corners alone, poses and edges by closed forms.

A flat board has two poses, and a symmetric one has the same image after a turn: all stay candidates
until edges decide between them.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import ConvergenceError, DegenerateError
from visioncal.core.transforms import apply, compose, distances_m, invert
from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Mask, Target, evenly
from visioncal.fit.consensus import Candidates
from visioncal.fit.joining import Network, Relation
from visioncal.fit.weights import first_weighed, on_planes
from visioncal.model import Cell, MeasuredPlace, MeasuredPose
from visioncal.model.sightings import Evidence
from visioncal.session.document import CameraTable
from visioncal.vision.camera import project
from visioncal.vision.intrinsics import estimate_intrinsics
from visioncal.vision.poses import closed_form_poses, determines_pose
from visioncal.vision.targets import corner_positions, first_numbers, rotation_transforms, rotations

# Focal lengths that lenses have, over the width, and how many are tried; ratio of both, less one.
_FOCAL, _FOCALS, _SQUARE = (0.25, 10.0), 12, 0.05
_NO_POSE = "corners that determine no pose: all, or all but one, lie in one row of the target"


@dataclass(frozen=True, eq=False)
class _Options:
    """Possible poses of a sighting."""

    poses: FloatArray  # (j, 4, 4) `seer_from_seen`.
    turns: IntArray  # (j,) symmetry of the board by which each is turned.


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit starts."""

    read: Cell  # With all sightings.
    # With the sightings that have a pose, by corners that agree within their views; turned boards
    # are numbered as they lie.
    cell: Cell
    lenses: Mapping[str, Camera]
    edges: Mapping[str, FloatArray]  # (4, 4) `parent_from_frame` of the unknown edges.
    distances: FloatArray  # (n,) of the sightings from what the edges predict [m].
    # (n,) sightings that may agree: most of their own corners do, and they are not those of a row
    # nearby.
    sound: Mask
    # Frames that only boards connect that look the same turned, so that other poses fit as well.
    ambiguous: tuple[str, ...] = ()


@contextmanager
def at_rest() -> Iterator[None]:
    """Reports matrices that are singular or not finite as a ConvergenceError."""
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise ConvergenceError(
            "cell: the estimate does not come to rest: poses and images do not belong together, or "
            "a lens of which nothing is stated is far from where it started.",
            next_step="Give matrix and distortion in [camera], or add tilted views; compare the "
            "robot's poses with their images.",
        ) from error


@at_rest()
def start_of(cell: Cell, lenses: Mapping[str, Camera] | None = None, early: float = 1.0) -> Start:
    """Starts a fit; sightings without a pose, or whose frames are not connected, are left out.

    Args:
        cell: The cell.
        lenses: Lenses that are known, by camera, start as they are.
        early: Share of the earliest stops that join frames; later, these may have moved.

    Raises:
        DataError: Too few views show a lens of which nothing is stated.
        ConvergenceError: Views determine no pose.
    """
    read = cell
    lenses = start_lenses(cell.only(np.flatnonzero(~cell.held).tolist()), lenses or {})
    weighed = first_weighed(cell, lenses)
    cell, sound = weighed.cell, weighed.sound & ~cell.held
    options = _options(cell, lenses)
    kept = [at for at, option in enumerate(options) if option is not None]
    lost = dict.fromkeys(np.setdiff1d(np.arange(len(options)), kept).tolist(), _NO_POSE)
    cell, sound = cell.without(lost), sound[kept]
    known = [option for option in options if option is not None]
    # Sightings that are held out help no fit.
    free_rows = np.flatnonzero(~cell.held).tolist()
    tied = _network(cell.only(free_rows), [known[at] for at in free_rows], early).connected()
    joined = [at for at, s in enumerate(cell.sightings) if tied.ties(*s.pair)]
    untied = {
        at: f"nothing ties {' or '.join(sighting.pair)} to the rest of the cell"
        for at, sighting in enumerate(cell.sightings)
        if at not in joined
    }
    seen = [at for at in free_rows if not cell.sightings[at].is_stated]
    wrong = {cell.sightings[seen[at]].view for at in np.flatnonzero(tied.misplaced).tolist()}
    cell, known = cell.without(untied), [known[at] for at in joined]
    is_placed = [s.view not in wrong for s in cell.sightings]
    sound = sound[joined] & np.array(is_placed, bool)
    edges = {name: tied.edges[name] for name in cell.unknown}
    seers = {sighting.seer for sighting in cell.sightings}
    lenses = {name: lens for name, lens in lenses.items() if name in seers}
    sightings, distances = list(cell.sightings), np.zeros(len(known))
    # By which symmetry the first view of each board is turned: that one, if a fit uses it, keeps
    # its numbers.
    firsts, stated = dict[str, int](), {name for s in sightings if s.is_stated for name in s.pair}
    turnable = set(edges) - stated
    numbers = {name: rotations(cell.boards[name]) for name in pictured(cell)}
    for at in sorted(range(len(known)), key=cell.held.__getitem__):
        sighting, option = cell.sightings[at], known[at]
        poses = {name: arm.poses[sighting.stop] for name, arm in cell.arms.items()}
        predicted = tied.predicted(*sighting.pair, poses)
        off = distances_m(option.poses, predicted)
        if isinstance(sighting.evidence, MeasuredPlace):
            between = predicted[:3, 3] - sighting.evidence.place_m
            off = np.array([np.linalg.norm(between)])
        # A stated frame counts until sightings contradict it.
        off = off * (not sighting.is_stated)
        best = int(off.argmin())
        distances[at] = off[best]
        if isinstance(sighting.evidence, Corners):
            orders, turn = numbers[sighting.seen], int(option.turns[best])
            first = firsts.setdefault(sighting.seen, turn if sighting.seen in turnable else 0)
            # Turns are powers of one.
            if turn := (turn - first) % len(orders):
                ids = np.argsort(orders[turn])[sighting.evidence.ids]
                sightings[at] = replace(sighting, evidence=replace(sighting.evidence, ids=ids))
    for name, first in firsts.items():
        if first:
            edges[name] = edges[name] @ invert(rotation_transforms(cell.boards[name])[first])
    cell = cell.with_sightings(sightings)
    return Start(read, cell, lenses, edges, distances, sound, tied.ambiguous)


def start_lenses(cell: Cell, known: Mapping[str, Camera]) -> dict[str, Camera]:
    """Lenses by camera: known and stated ones, and those that corners determine (Zhang 2000).

    Raises:
        DataError: Too few views show a lens of which nothing is stated.
    """
    found = {}
    # In the order of sightings: results do not depend on how names are hashed.
    for frame in dict.fromkeys(s.seer for s in cell.sightings if s.corners is not None):
        table = cell.cameras[frame]
        lens = known.get(frame, table.stated)
        if lens is None:
            lens = _by_corners(cell, frame, table)
            fx, fy = lens.matrix[:2] / lens.resolution[0]
            # Lenses are made with square pixels and such focal lengths.
            if not (_FOCAL[0] < fx < _FOCAL[1] and abs(np.log(fx / fy)) < _SQUARE):
                lens = _lens_by_motion(cell, frame, lens)
        found[frame] = lens
    return found


def _by_corners(cell: Cell, frame: str, table: CameraTable) -> Camera:
    """A lens by the corners of some images; without a focal length where these determine none."""
    seen = {at: s for at, s in enumerate(cell.sightings) if s.seer == frame and s.corners}
    # Corners on a line, or a few beside many, mislead the closed form of focal lengths.
    typical = np.median([len(s.corners.ids) for s in seen.values() if s.corners])
    names = tuple(dict.fromkeys(s.seen for s in seen.values()))
    boards = {name: cell.boards[name] for name in names}
    firsts = first_numbers(boards)
    corners = {
        at: replace(s.corners, ids=s.corners.ids + firsts[s.seen])
        for at, s in seen.items()
        if s.corners is not None
        and 2 * len(s.corners.ids) >= typical
        and determines_pose(corner_positions(cell.boards[s.seen])[s.corners.ids])
    }
    rows = [*corners]
    # Most images of which a lens is estimated.
    corners = {rows[at]: corners[rows[at]] for at in evenly(len(rows), 40)}
    most = np.max([np.ones(2), *(at.px.max(axis=0) for at in corners.values())], axis=0)
    size = table.resolution or (int(most[0]) + 1, int(most[1]) + 1)
    try:
        return estimate_intrinsics(corners, [*boards.values()], size, table.model).camera
    except (ConvergenceError, DegenerateError):
        none = np.zeros(4 if table.model == "fisheye" else 5)
        return Camera(table.model, size, np.array([1.0, 1.0, *size]), none)


def _lens_by_motion(cell: Cell, frame: str, lens: Camera) -> Camera:
    """A lens with the focal length by which boards' poses agree best with the robots' motion.

    Boards that are far, or face the camera, have none of their own: it is as good as a distance.
    """
    cell = cell.with_sightings([s for s in cell.sightings if s.seer == frame and s.corners])
    middle, none = (np.array(lens.resolution) - 1.0) / 2.0, np.zeros_like(lens.distortion)

    def at(focal: float) -> Camera:
        return Camera(lens.model, lens.resolution, np.array([focal, focal, *middle]), none)

    def closing(log_focal: float) -> float:
        trial = {frame: at(float(np.exp(log_focal)))}
        options = zip(cell.sightings, _options(cell, trial), strict=True)
        known = [(s, option) for s, option in options if option is not None]
        posed_cell = cell.with_sightings([sighting for sighting, _ in known])
        tied = _network(posed_cell, [found for _, found in known]).connected()
        off = []
        for s, found in known:
            poses = {name: arm.poses[s.stop] for name, arm in cell.arms.items()}
            if tied.ties(*s.pair):
                off.append(float(distances_m(found.poses, tied.predicted(*s.pair, poses)).min()))
        return float(np.mean(np.sort(off)[: len(off) // 2 + 1])) if off else np.inf

    # Imported here, as a stated lens needs none of SciPy's optimisers.
    from scipy.optimize import minimize_scalar

    logs = np.log(lens.resolution[0] * np.geomspace(*_FOCAL, _FOCALS))
    values = [closing(float(value)) for value in logs]
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        return lens
    ends = logs[max(best - 1, 0)], logs[min(best + 1, len(logs) - 1)]
    found = minimize_scalar(closing, bounds=ends, method="bounded", options={"xatol": 1e-2})
    return at(float(np.exp(found.x)))


def _options(cell: Cell, lenses: Mapping[str, Camera]) -> list[_Options | None]:
    """Both poses of each flat board, in all turns of a symmetric one; None where it has none."""
    found, planes = list[_Options | None](), on_planes(cell, lenses)
    turns = {name: rotation_transforms(cell.boards[name]) for name in pictured(cell)}
    option: _Options | None
    once = np.zeros(1, dtype=np.int64)
    for at, sighting in enumerate(cell.sightings):
        evidence = sighting.evidence
        if isinstance(evidence, MeasuredPose):
            option = _Options(evidence.matrix[None], once)
        elif isinstance(evidence, MeasuredPlace):
            option = _Options(compose(np.eye(3), evidence.place_m)[None], once)
        elif at in planes:
            board, board_turns = cell.boards[sighting.seen], turns[sighting.seen]
            option = _of_corners(lenses[sighting.seer], board, board_turns, evidence, planes[at])
        else:
            option = None
        found.append(option)
    return found


def pictured(cell: Cell) -> set[str]:
    """Boards that are in images."""
    return {sighting.seen for sighting in cell.sightings if sighting.corners is not None}


def _of_corners(
    lens: Camera, board: Target, symmetries: FloatArray, corners: Corners, plane: FloatArray
) -> _Options | None:
    px, points = corners.px, corner_positions(board)[corners.ids]
    poses = closed_form_poses(points, plane)
    away = project(lens, apply(poses, points).reshape(-1, 3)).reshape(-1, *px.shape) - px
    off = np.array([np.sqrt(np.nanmean(each**2)) for each in away])
    if not np.isfinite(off).any():
        return None
    # The second pose of a flat board stays where it fits within this factor and addition [px].
    alike = poses[off < 2.0 * np.nanmin(off) + 0.3]
    numbers = np.tile(np.arange(len(symmetries)), len(alike))
    return _Options((alike[:, None] @ symmetries).reshape(-1, 4, 4), numbers)


def _network(cell: Cell, options: Sequence[_Options], early: float = 1.0) -> Network:
    """The sightings as a network; priors that state a whole pose come last."""
    seen = [at for at, one in enumerate(cell.sightings) if not one.is_stated]
    stated = [pair for pair in cell.pairs.items() if cell.sightings[pair[1][0]].is_stated]
    found = [_stated(pair, [cell.sightings[row].evidence for row in rows]) for pair, rows in stated]
    rows = [cell.sightings[at] for at in seen]
    turns = {name: rotation_transforms(cell.boards[name]) for name in pictured(cell)}
    return Network(
        cell.tree,
        {name: arm.poses for name, arm in cell.arms.items()},
        [one.seer for one in rows],
        [one.seen for one in rows],
        np.array([one.stop for one in rows]),
        np.array([not isinstance(one.evidence, MeasuredPlace) for one in rows]),
        Candidates.of([options[at].poses for at in seen], [options[at].turns for at in seen]),
        {name: board_turns for name, board_turns in turns.items() if len(board_turns) > 1},
        tuple(one for one in found if one is not None),
        frozenset(name for pair, _ in stated for name in pair),
        early,
    )


def _stated(pair: tuple[str, str], stated: Sequence[Evidence]) -> Relation | None:
    """The pose that priors of two frames state; None unless they state all six numbers."""
    matrix, known = np.eye(4), 0
    for evidence in stated:
        if isinstance(evidence, MeasuredPlace):
            matrix[list(evidence.axes), 3] = evidence.place_m[list(evidence.axes)]
            known += len(evidence.axes)
        elif isinstance(evidence, MeasuredPose):
            matrix[:3, :3], known = evidence.matrix[:3, :3], known + 3
    return Relation(*pair, matrix[None], np.inf) if known == 6 else None
