"""Start of a fit: lenses and boards' poses by OpenCV, edges by closed forms.

Edges are joined pair by pair, the surest first; each by the nearest half of its sightings, so that
wrong ones may be nearly as many as right ones. A flat board has two poses, and a symmetric one
has the same image after a turn: all stay candidates until edges decide between them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.number_format import counted
from visioncal.core.transforms import (
    apply,
    apply_each,
    compose,
    invert,
    log,
    mean_transform,
    nearest_rotation,
    rotation_angle,
)
from visioncal.core.types import (
    Camera,
    CameraKind,
    Corners,
    FloatArray,
    IntArray,
    Mask,
    Target,
    evenly,
)
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.poses import closed_form_poses, determines_pose
from visioncal.fit.places import robust_carried
from visioncal.fit.weights import by_homography, first_weighed, on_planes
from visioncal.model import Cell, MeasuredPlace, MeasuredPose, Sighting
from visioncal.vision.camera import project
from visioncal.vision.targets import corner_positions, rotation_transforms, rotations

# Images of which a lens is estimated, and pairs of poses of which a closed form is, at most.
_IMAGES, _PAIRS = 40, 800
# Small sets of sightings of which edges are tried; how many are refined.
_SETS, _BEST = 200, 5
# Rows by which poses may be shifted; a row is wrong from this multiple of the typical distance on;
# larger distances than this [m] may be those of wrong rows.
_SHIFTS, _FAR, _NEAR_M = (1, -1, 2, -2, 3, -3), 6.0, 0.002
# Focal lengths that lenses have, over the width, and how many are tried; ratio of both, less one.
_FOCAL, _FOCALS, _SQUARE = (0.25, 10.0), 12, 0.05
# The second pose of a flat board stays where it fits within this factor and addition [px].
_ALIKE, _ALIKE_PX = 2.0, 0.3
_NO_POSE = "corners that determine no pose: all, or all but one, lie in one row of the target"
# Distortion moves corners off a homography by this and more [px].
_LEAST_PX = 2.0


@dataclass(frozen=True, eq=False)
class Candidates:
    """Possible poses of a sighting."""

    poses: FloatArray  # (j, 4, 4) `seer_from_seen`.
    turns: IntArray  # (j,) symmetry of the board by which each is turned.


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit starts."""

    # With the sightings that have a pose, by corners that agree within their views; turned boards
    # are numbered as they lie.
    cell: Cell
    lenses: Mapping[str, Camera]
    edges: Mapping[str, FloatArray]  # (4, 4) `parent_from_frame` of the unknown edges.
    distances: FloatArray  # (n,) of the sightings from what the edges predict [m].
    rivals: tuple[FloatArray, ...]  # Other poses (j, 4, 4) that each sighting may have.
    # (n,) sightings that may agree: most of their own corners do, and they are not those of a row
    # nearby.
    sound: Mask


def start_of(cell: Cell) -> Start:
    """Starts a fit; sightings without a pose, or whose frames are not connected, are left out."""
    lenses = start_lenses(cell.only(np.flatnonzero(~cell.held).tolist()))
    weighed = first_weighed(cell, lenses)
    cell, sound = weighed.cell, weighed.sound & ~cell.held
    options = candidates(cell, lenses)
    kept = [at for at, option in enumerate(options) if option is not None]
    lost = dict.fromkeys(np.setdiff1d(np.arange(len(options)), kept).tolist(), _NO_POSE)
    cell, sound = cell.without(lost), sound[kept]
    known = [option for option in options if option is not None]
    # Sightings that are held out help no fit.
    own = np.flatnonzero(~cell.held).tolist()
    places = _Places(cell.only(own))
    places.join_all([known[at] for at in own])
    joined = [at for at, s in enumerate(cell.sightings) if places.are_joined(*s.pair)]
    untied = {
        at: f"nothing ties {' or '.join(sighting.pair)} to the rest of the cell"
        for at, sighting in enumerate(cell.sightings)
        if at not in joined
    }
    cell, known = cell.without(untied), [known[at] for at in joined]
    is_placed = [s.view not in places.misplaced for s in cell.sightings]
    sound = sound[joined] & np.array(is_placed, bool)
    edges = {name: places.edge(name) for name in cell.unknown}
    seers = {sighting.seer for sighting in cell.sightings}
    lenses = {name: lens for name, lens in lenses.items() if name in seers}
    sightings, distances, rivals = list(cell.sightings), np.zeros(len(known)), []
    # By which symmetry the first view of each board is turned: that one keeps its numbers.
    firsts, stated = dict[str, int](), {name for s in sightings if s.is_stated for name in s.pair}
    turnable = set(edges) - stated
    numbers = {name: rotations(cell.boards[name]) for name in pictured(cell)}
    for at, (sighting, option) in enumerate(zip(cell.sightings, known, strict=True)):
        off = away(places.predicted(sighting), option.poses)
        if isinstance(sighting.evidence, MeasuredPlace):
            between = places.predicted(sighting)[:3, 3] - sighting.evidence.place_m
            off = np.array([np.linalg.norm(between)])
        # A stated frame counts until sightings contradict it.
        off = off * (not sighting.is_stated)
        best = int(off.argmin())
        distances[at] = off[best]
        turn = int(option.turns[best])
        if isinstance(sighting.evidence, Corners):
            orders = numbers[sighting.seen]
            first = firsts.setdefault(sighting.seen, turn if sighting.seen in turnable else 0)
            # Turns are powers of one, and candidates come in blocks of all of them.
            turn, was = (turn - first) % len(orders), turn
            best += turn - was
            if turn:
                ids = np.argsort(orders[turn])[sighting.evidence.ids]
                sightings[at] = replace(sighting, evidence=replace(sighting.evidence, ids=ids))
        others = np.flatnonzero((option.turns == turn) & (np.arange(len(off)) != best))
        rivals.append(option.poses[[best, *others]])
    for name, first in firsts.items():
        if first:
            edges[name] = edges[name] @ invert(rotation_transforms(cell.boards[name])[first])
    return Start(cell.with_sightings(sightings), lenses, edges, distances, tuple(rivals), sound)


def start_lenses(cell: Cell) -> dict[str, Camera]:
    """The stated lenses by camera, and those that corners determine (Zhang 2000).

    Raises:
        DataError: Too few views show a lens of which nothing is stated.
    """
    found = {}
    # In the order of sightings: results do not depend on how names are hashed.
    for frame in dict.fromkeys(s.seer for s in cell.sightings if s.corners is not None):
        table = cell.cameras[frame]
        if table.stated is not None:
            found[frame] = table.stated
            continue
        seen = [s for s in cell.sightings if s.seer == frame and s.corners is not None]
        # Corners on a line, or a few beside many, mislead the closed form of focal lengths.
        typical = np.median([len(at.corners.ids) for at in seen if at.corners]) if seen else 0
        seen = [at for at in seen if at.corners and _shows_lens(cell, at, float(typical))]
        if len(seen) < FEWEST_VIEWS:
            raise DataError(
                f"intrinsics: {counted(len(seen), 'view', ('shows', 'show'))} the target, and at "
                f"least {FEWEST_VIEWS} are needed.",
                culprits=["views"],
                next_step="Add views, or give matrix and distortion in [camera].",
            )
        seen = [seen[at] for at in evenly(len(seen), _IMAGES)]
        px, points = [], []
        for sighting in seen:
            if (corners := sighting.corners) is not None:
                board = corner_positions(cell.boards[sighting.seen])[corners.ids]
                agrees = by_homography(board, corners.px, least_px=_LEAST_PX).agreeing
                px.append(corners.px[agrees].astype(np.float32)[:, None])
                points.append(board[agrees].astype(np.float32)[:, None])
        most = np.max([at.max(axis=(0, 1)) for at in px], axis=0)
        size = table.size or (int(most[0]) + 1, int(most[1]) + 1)
        try:
            found[frame] = _by_corners(table.model, size, points, px)
        except cv2.error:  # No closed form starts it.
            none = np.zeros(4 if table.model == "fisheye" else 5)
            found[frame] = Camera(table.model, size, np.array([1.0, 1.0, *size]), none)
        if not _is_made(found[frame]):
            found[frame] = _lens_by_motion(cell, frame, found[frame])
    return found


def _by_corners(
    model: CameraKind,
    size: tuple[int, int],
    points: Sequence[NDArray[np.float32]],
    px: Sequence[NDArray[np.float32]],
) -> Camera:
    """A lens by corners (n, 1, 3) of boards and their pixels (n, 1, 2), view by view."""
    if model == "fisheye":
        focal = 0.4 * size[0]
        guess = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
        flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
        flags |= cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
        _, matrix, lens, *_ = cv2.fisheye.calibrate(
            points, px, size, guess, np.zeros(4), flags=flags
        )
    else:
        _, matrix, lens, *_ = cv2.calibrateCamera(points, px, size, np.eye(3), np.zeros(5))
    four = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], float)
    return Camera(model, size, four, np.asarray(lens, float).ravel()[:5])


def _shows_lens(cell: Cell, sighting: Sighting, typical: float) -> bool:
    """Whether an image has half of the typical number of corners, and not on a line."""
    corners = sighting.corners
    if corners is None or 2 * len(corners.ids) < typical:
        return False
    return determines_pose(corner_positions(cell.boards[sighting.seen])[corners.ids])


def _is_made(lens: Camera) -> bool:
    """Whether a lens has square pixels and a focal length that are made."""
    fx, fy = lens.matrix[:2] / lens.resolution[0]
    return bool(_FOCAL[0] < fx < _FOCAL[1] and abs(np.log(fx / fy)) < _SQUARE)


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
        options = zip(cell.sightings, candidates(cell, trial), strict=True)
        known = [(s, option) for s, option in options if option is not None]
        places = _Places(cell.with_sightings([sighting for sighting, _ in known]))
        places.join_all([found for _, found in known])
        off = [
            float(away(places.predicted(s), found.poses).min())
            for s, found in known
            if places.are_joined(*s.pair)
        ]
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


def candidates(cell: Cell, lenses: Mapping[str, Camera]) -> list[Candidates | None]:
    """Both poses of each flat board, in all turns of a symmetric one; None where it has none."""
    found, planes = list[Candidates | None](), on_planes(cell, lenses)
    turns = {name: rotation_transforms(cell.boards[name]) for name in pictured(cell)}
    option: Candidates | None
    once = np.zeros(1, dtype=np.int64)
    for at, sighting in enumerate(cell.sightings):
        evidence = sighting.evidence
        if isinstance(evidence, MeasuredPose):
            option = Candidates(evidence.matrix[None], once)
        elif isinstance(evidence, MeasuredPlace):
            option = Candidates(compose(np.eye(3), evidence.place_m)[None], once)
        elif at in planes:
            board, own = cell.boards[sighting.seen], turns[sighting.seen]
            option = _of_corners(lenses[sighting.seer], board, own, evidence, planes[at])
        else:
            option = None
        found.append(option)
    return found


def pictured(cell: Cell) -> set[str]:
    """Boards that are in images."""
    return {sighting.seen for sighting in cell.sightings if sighting.corners is not None}


def _of_corners(
    lens: Camera, board: Target, symmetries: FloatArray, corners: Corners, plane: FloatArray
) -> Candidates | None:
    px, points = corners.px, corner_positions(board)[corners.ids]
    poses = closed_form_poses(points, plane)
    off = np.array([_off_px(lens, pose, points, px) for pose in poses])
    if not np.isfinite(off).any():
        return None
    alike = poses[off < _ALIKE * np.nanmin(off) + _ALIKE_PX]
    numbers = np.tile(np.arange(len(symmetries)), len(alike))
    return Candidates((alike[:, None] @ symmetries).reshape(-1, 4, 4), numbers)


def _off_px(lens: Camera, pose: FloatArray, points: FloatArray, px: FloatArray) -> float:
    found = project(lens, apply(pose, points))
    return float(np.sqrt(np.nanmean((found - px) ** 2)))


def away(predicted: FloatArray, poses: FloatArray) -> FloatArray:
    """Distances (..., j) [m] of (..., j, 4, 4) poses from (..., 4, 4) predictions."""
    between = invert(predicted)[..., None, :, :] @ poses
    distances = np.linalg.norm(between[..., :3, 3], axis=-1)
    return np.asarray(distances + LEVER_M * rotation_angle(between))


@dataclass(frozen=True, eq=False)
class _Joint:
    """Edges that a pair's sightings determine, and how surely."""

    typical: float  # Mean distance of the nearest half, less where they are many [m].
    # First and second frame, (4, 4) `first_from_second`.
    links: tuple[tuple[str, str, FloatArray], ...]


_HandEye: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


class _Places:
    """Frames whose relative poses are known form parts; sightings join these."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.tree = cell, cell.tree
        frames = [cell.tree.root, *cell.tree.branches]
        self.part = {name: name for name in frames}
        self.pose = {name: np.eye(4) for name in frames}  # In the part's own frame.
        self.misplaced = set[int]()  # Views whose robot's pose is that of a row nearby.
        for name, branch in cell.tree.branches.items():
            if branch.known is not None:
                self.join(branch.parent, name, branch.known)

    def join(self, first: str, second: str, first_from_second: FloatArray) -> None:
        """Makes one part of two."""
        if self.part[first] == self.part[second]:
            return
        change = self.pose[first] @ first_from_second @ invert(self.pose[second])
        gone, kept = self.part[second], self.part[first]
        for name in [name for name, part in self.part.items() if part == gone]:
            self.part[name], self.pose[name] = kept, change @ self.pose[name]

    def segments(self, seer: str, seen: str) -> list[tuple[str, str, str, bool]]:
        """Frames between which no robot moves, along a path, each with the robot behind it."""
        found, at = [], seer
        for step in self.tree.path(seer, seen):
            if step.robot:
                base = self.tree.branches[step.frame].parent
                near, far = (step.frame, base) if step.is_up else (base, step.frame)
                found.append((at, near, step.robot, step.is_up))
                at = far
        return [*found, (at, seen, "", True)]

    def are_joined(self, seer: str, seen: str) -> bool:
        """Whether all between two frames is known."""
        return all(self.part[a] == self.part[b] for a, b, *_ in self.segments(seer, seen))

    def edge(self, name: str) -> FloatArray:
        """(4, 4) `parent_from_frame`."""
        return np.asarray(invert(self.pose[self.tree.branches[name].parent]) @ self.pose[name])

    def predicted(self, sighting: Sighting) -> FloatArray:
        """(4, 4) `seer_from_seen` where all between is known."""
        found = np.eye(4)
        for first, second, robot, is_up in self.segments(*sighting.pair):
            found = found @ invert(self.pose[first]) @ self.pose[second]
            if robot:
                moved = self.cell.arms[robot].poses[sighting.stop]
                found = found @ (invert(moved) if is_up else moved)
        return found

    def join_all(self, options: Sequence[Candidates]) -> None:
        """Joins all that sightings join."""
        known: dict[tuple[tuple[str, str], tuple[bool, ...]], _Joint | None] = {}
        while True:
            joints = []
            for pair, rows in self.cell.pairs.items():
                state = tuple(self.part[a] == self.part[b] for a, b, *_ in self.segments(*pair))
                if all(state):
                    continue
                if (pair, state) not in known:
                    known[pair, state] = self._joint(pair, rows, options)
                joint = known[pair, state]
                if joint is not None:
                    joints.append(joint)
            if not joints:
                return
            for first, second, matrix in min(joints, key=lambda joint: joint.typical).links:
                self.join(first, second, matrix)

    def _joint(
        self, pair: tuple[str, str], rows: Sequence[int], options: Sequence[Candidates]
    ) -> _Joint | None:
        """Edges by the sightings of a pair, where one or two are unknown."""
        seen_rows = [row for row in rows if not self.cell.sightings[row].is_stated]
        if not seen_rows:
            return self._stated(rows)
        rows = [row for row in seen_rows if self.cell.sightings[row].view not in self.misplaced]
        sightings = [self.cell.sightings[row] for row in rows]
        if not rows:
            return None
        stops = np.array([sighting.stop for sighting in sightings])
        links, parts = self._parts(pair, stops)
        places = [s.evidence.place_m for s in sightings if isinstance(s.evidence, MeasuredPlace)]
        if len(places) == len(rows):
            return _placed(links, parts, np.array(places))
        both = _padded([options[row] for row in rows])
        seen = invert(parts[0])[:, None] @ both @ invert(parts[-1])[:, None]
        if len(links) == 1:
            matrix, typical = _agreed(seen)
            return _Joint(typical, ((*links[0], matrix),))
        if len(links) != 2 or len(rows) < 3:
            return None
        x, z, own = robust_hand_eye(invert(parts[1]), seen)
        if _is_doubtful(own):
            x, z, own = self._shifted(sightings, both, (x, z, own))
        typical = float(np.sort(own)[: len(rows) // 2 + 1].mean())
        return _Joint(typical, ((*links[0], invert(x)), (*links[1], z)))

    def _parts(
        self, pair: tuple[str, str], stops: IntArray
    ) -> tuple[list[tuple[str, str]], list[FloatArray]]:
        """Ends of the unknown edges of a path, and (m, 4, 4) what is known around them."""
        links, parts = list[tuple[str, str]](), [np.tile(np.eye(4), (len(stops), 1, 1))]
        for first, second, robot, is_up in self.segments(*pair):
            if self.part[first] == self.part[second]:
                parts[-1] = parts[-1] @ invert(self.pose[first]) @ self.pose[second]
            else:
                links.append((first, second))
                parts.append(np.tile(np.eye(4), (len(stops), 1, 1)))
            if robot:
                moved = self.cell.arms[robot].poses[stops]
                parts[-1] = parts[-1] @ (invert(moved) if is_up else moved)
        return links, parts

    def _shifted(self, sightings: Sequence[Sighting], seen: FloatArray, best: _HandEye) -> _HandEye:
        """Both edges by poses of rows nearby, if these are of the same edges as some rows' own.

        Where rows are shifted from one on, fewer than half may be right; those shifted back have
        the same edges, and both together have more.
        """
        pair, stops = sightings[0].pair, np.array([sighting.stop for sighting in sightings])
        half, found = len(stops) // 2 + 1, best
        robots = [robot for _, _, robot, _ in self.segments(*pair) if robot]
        own = self._parts(pair, stops)[1]
        for shift in _SHIFTS:
            there = np.flatnonzero((stops + shift >= 0) & (stops + shift < len(self.cell.moments)))
            moved = [self.cell.arms[robot].poses[stops[there] + shift] for robot in robots]
            there = there[np.isfinite(moved).all(axis=(0, 2, 3))]
            if len(there) < half:
                continue
            other = self._parts(pair, stops[there] + shift)[1]
            near_both = invert(other[0])[:, None] @ seen[there] @ invert(other[2])[:, None]
            x, z, _ = robust_hand_eye(invert(other[1]), near_both)
            near = away(own[0] @ invert(x) @ own[1] @ z @ own[2], seen).min(axis=1)
            by_shift = np.full(len(stops), np.inf)
            by_shift[there] = away(invert(x) @ other[1] @ z, near_both).min(axis=1)
            either = np.minimum(near, by_shift)
            limit = _FAR * np.sort(either)[:half].mean()
            is_better = 4.0 * np.sort(either)[:half].sum() < np.sort(found[2])[:half].sum()
            if is_better and (near <= limit).sum() >= 4:
                found = x, z, either
                wrong = (near > limit) & (by_shift <= limit)
                gone = set(stops[wrong].tolist()) - set(stops[~wrong].tolist())
                views = {sightings[row].view for row in np.flatnonzero(wrong).tolist()}
                self.misplaced = views | {
                    s.view for s in self.cell.sightings if s.stop in gone and not s.is_stated
                }
        return found

    def _stated(self, rows: Sequence[int]) -> _Joint | None:
        """Edges by priors of two frames that state all six numbers: the last to be used."""
        matrix, known = np.eye(4), 0
        for row in rows:
            evidence = self.cell.sightings[row].evidence
            if isinstance(evidence, MeasuredPlace):
                matrix[list(evidence.axes), 3] = evidence.place_m[list(evidence.axes)]
                known += len(evidence.axes)
            elif isinstance(evidence, MeasuredPose):
                matrix[:3, :3], known = evidence.matrix[:3, :3], known + 3
        pair = self.cell.sightings[rows[0]].pair
        between = self.segments(*pair)
        is_whole = known == 6 and len(between) == 1
        return _Joint(np.inf, ((*pair, matrix),)) if is_whole else None


def _placed(
    links: Sequence[tuple[str, str]], parts: Sequence[FloatArray], places: FloatArray
) -> _Joint | None:
    """Edges by (m, 3) places: rotations of frames at their ends are left as they are."""
    near = apply_each(invert(parts[0]), places)
    far = parts[-1][:, :3, 3]
    is_point = float(np.ptp(far, axis=0).max()) < 1e-9  # But for rounding.
    if len(links) == 1 and is_point:
        point = np.median(near - far, axis=0)
        typical = float(np.median(np.linalg.norm(near - far - point, axis=1)))
        return _Joint(typical, ((*links[0], compose(np.eye(3), point)),))
    if len(links) == 1 and len(places) >= 3:
        # A carrier without axes leaves no point to find.
        frame, _, typical = robust_carried(compose(np.zeros((3, 3)), far), near)
        return _Joint(typical, ((*links[0], invert(frame)),))
    if len(links) == 2 and len(places) >= 4 and is_point:
        frame, point, typical = robust_carried(parts[1], near)
        second = compose(np.eye(3), point - far[0])
        return _Joint(typical, ((*links[0], invert(frame)), (*links[1], second)))
    return None


def _padded(options: Sequence[Candidates]) -> FloatArray:
    """(m, j, 4, 4) poses, the first repeated where there are fewer."""
    most = max(len(option.poses) for option in options)
    rows = [np.minimum(np.arange(most), len(option.poses) - 1) for option in options]
    return np.array([option.poses[at] for option, at in zip(options, rows, strict=True)])


def _agreed(seen: FloatArray) -> tuple[FloatArray, float]:
    """The pose (4, 4) on which the nearest half of (m, j, 4, 4) agree, and its distance [m]."""
    count = len(seen)
    flat = seen.reshape(-1, 4, 4)
    flat = flat[:: len(flat) // 100 + 1]
    off = away(np.broadcast_to(flat[:, None], (len(flat), count, 4, 4)), seen)
    half = count // 2 + 1
    best = int(np.sort(off.min(axis=2), axis=1)[:, :half].sum(axis=1).argmin())
    own = off[best].min(axis=1)
    near = own.argsort()[:half]
    matrix = mean_transform(seen[near, off[best, near].argmin(axis=1)])
    return matrix, float(own[near].mean() / np.sqrt(half))


def robust_hand_eye(robot: FloatArray, seen: FloatArray) -> _HandEye:
    """Both edges (4, 4) of `robot X seen = Z`, and (m,) how far each row is from them [m].

    Least trimmed squares over small sets (Rousseeuw and Van Driessen 1999).

    Args:
        robot: (m, 4, 4) poses.
        seen: (m, j, 4, 4) candidates for what was seen there.
    """
    count, rng = len(robot), np.random.default_rng(0)
    half = max(count // 2 + 1, 3)
    sets = np.array([rng.choice(count, min(4, count), replace=False) for _ in range(_SETS)])
    picks = rng.integers(seen.shape[1], size=sets.shape)
    picks[::2] = 0
    x, z = _hand_eye(robot[sets], seen[sets, picks])
    off = away(invert(robot[None] @ x[:, None]) @ z[:, None], seen[None])
    sums = np.sort(off.min(axis=2), axis=1)[:, :half].sum(axis=1)
    found = []
    for at in sums.argsort()[:_BEST]:
        best, own, total = (x[at], z[at]), off[at], float(sums[at])
        for _ in range(10):
            rows = own.min(axis=1).argsort()[:half]
            one = _hand_eye(robot[rows][None], seen[rows, own[rows].argmin(axis=1)][None])
            trial = away(invert(robot @ one[0]) @ one[1], seen)
            lower = float(np.sort(trial.min(axis=1))[:half].sum())
            if lower >= total:
                break
            best, own, total = (one[0][0], one[1][0]), trial, lower
        found.append((total, best, own.min(axis=1)))
    _, best, own = min(found, key=lambda item: item[0])
    return *best, own


def _is_doubtful(own: FloatArray) -> bool:
    """Whether (m,) distances are not those of noise for two thirds of the rows [m]."""
    typical = np.sort(own)[: max(2 * len(own) // 5, 1)].mean()
    return bool(typical > _NEAR_M or np.mean(own > _FAR * typical) > 1 / 3)


def _hand_eye(robot: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and Z (k, 4, 4) of `robot X seen = Z`, of k sets of m poses (Park and Martin 1994)."""
    first, second = np.triu_indices(robot.shape[1], 1)
    if len(first) > _PAIRS:
        chosen = np.random.default_rng(0).choice(len(first), _PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    a = invert(robot[:, second]) @ robot[:, first]
    b = seen[:, second] @ invert(seen[:, first])
    turns_a, turns_b = log(a)[..., :3], log(b)[..., :3]
    rotation = nearest_rotation(np.swapaxes(turns_a, 1, 2) @ turns_b)
    left = (a[..., :3, :3] - np.eye(3)).reshape(len(robot), -1, 3)
    right = (rotation[:, None] @ b[..., :3, 3:] - a[..., :3, 3:]).reshape(len(robot), -1, 1)
    normal = np.swapaxes(left, 1, 2) @ left
    # A direction about which poses turn by less than a microradian is left at nothing.
    normal += 1e-12 * len(first) * np.eye(3)
    place: FloatArray = np.linalg.solve(normal, np.swapaxes(left, 1, 2) @ right).astype(float)
    x = compose(rotation, place[..., 0])
    placed = robot @ x[:, None] @ seen
    middle = np.median(placed[..., :3, 3], axis=1)
    return x, compose(nearest_rotation(placed[..., :3, :3].sum(axis=1)), middle)
