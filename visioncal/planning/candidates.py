"""Candidate stops: reachable, free of collisions, with the whole board in view."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, Mask, Progress
from visioncal.planning.cell import AnyCell, PlanCell, collision_model
from visioncal.planning.visibility import BoardViews, Occlusion
from visioncal.robot.collision import Collisions
from visioncal.robot.inverse import Inverse

# A stop must show the board in this share of the draws of the uncertain cell; where too few do, the
# next share is tried.
_SHARES = (0.99, 0.97, 0.9, 0.7, 0.5)
# Views or postures per draw.
_BATCH = 2000
# Number of stops from which the range of useful distances is taken.
_SAMPLE = 100
# A joint cannot pass a range of angles at least this wide [rad] in which no stop has it and this
# share of postures collides.
_WIDE_RAD, _BARRED, _TURN = np.pi / 3.0, 0.5, 2.0 * np.pi
# Limits of stops, with the advice where one keeps out too many.
IMAGE = "the whole board in the image"
GUESS = "the whole board in the image although the guesses are off"
FOCUS, TILT, DISTANCE = "the range of focus", "the tilt", "the distance"
HIDDEN, BEHIND_ARM = "a line of sight past the boxes", "a line of sight past the arm"
AWAY, REACH = "the arm's length", "the arm's reach"
LIMITS, CLEARANCE = "the joints' limits", "the clearance"
_ADVICE = {
    IMAGE: "Look whether guesses, board and camera are the cell's; widen --distance-mm.",
    GUESS: "Measure more closely where camera and board are, or allow a greater distance.",
    FOCUS: "Widen --focus-mm, or set --distance-mm to where the image is sharp.",
    HIDDEN: "Look whether the boxes are where they stand, or put the board elsewhere.",
    BEHIND_ARM: "Put the camera where the arm comes less between it and the board.",
    TILT: "Widen --tilt-deg, or turn the board towards the camera.",
    DISTANCE: "Widen --distance-mm, or put the board elsewhere.",
    AWAY: "Put the board nearer to the arm, or look whether the guesses are right.",
    REACH: "Put the board where the arm can look at it from all sides.",
    LIMITS: "Put the board elsewhere, or look whether the limits are the robot's.",
    CLEARANCE: "Lower --clearance-mm, or look whether --box, --floor and guesses are right.",
}


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate stops."""

    q: FloatArray  # (k, n) joint angles [rad].
    cam_from_target: FloatArray  # (k, 4, 4) board in the camera, if the guesses are right [m].
    # (k,) share of the uncertain cell's draws in which the whole board is in the image.
    seen: FloatArray
    lost: Mapping[str, int]  # Number of drawn views or postures that each limit rejected.

    def __len__(self) -> int:
        return len(self.q)


def candidates(
    cell: PlanCell,
    count: int,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    least: int | None = None,
) -> Candidates:
    """Samples stops over all that the robot can reach and the camera can see.

    Views of the board are drawn, and postures that reach them, each from its own start, so that
    shoulder, elbow and wrist take all their branches. For an arm with fewer than six joints the
    postures are drawn instead.

    Args:
        cell: The cell.
        count: Requested number.
        seed: Random seed; the same seed gives the same stops.
        progress: Called as stops are found.
        least: Least number; None for a tenth of the requested one, below which the guesses are
            probably wrong.

    Returns:
        The stops, in random order; fewer than requested where the cell allows no more.

    Raises:
        DataError: There are too few; the message names the limits that rejected the others.
    """
    search = _CandidateSearch(cell, count, seed)
    search.run(progress)
    # A tenth of the requested number, or what a plan needs.
    if len(search.kept) < (least or max(0.1 * count, min(12, count))):
        raise search.error()
    q = unwound(cell, search.collisions, np.array([posture for posture, _ in search.kept]))
    shares = np.array([share for _, share in search.kept])
    return Candidates(q, cell.cam_from_target(q), shares, dict((+search.lost).most_common()))


class _CandidateSearch:
    """Search for stops that counts how many tries each limit rejected."""

    def __init__(self, cell: PlanCell, count: int, seed: int) -> None:
        self.kept: list[tuple[FloatArray, float]] = []
        # Number of tries that reached each limit, and that it rejected.
        self.tried: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self._least_share = _SHARES[0]
        self._cell, self._count = cell, count
        self._rng = np.random.default_rng(seed)
        self._sight = BoardViews(cell, seed)
        self._shade = Occlusion(cell, np.vstack([self._sight.outline, self._sight.centre]))
        self.collisions = collision_model(cell)
        self._inverse = Inverse(cell.robot)

    def run(self, progress: Progress | None) -> None:
        """Draws until there are enough stops, or it is clear that there are not."""
        narrowed = False
        # With fewer joints an arm reaches a drawn view only by chance: its postures are drawn
        # instead.
        in_views = self._cell.robot.joint_count >= 6
        draw = self._from_views if in_views else self._from_postures
        for self._least_share in _SHARES:
            # Draws before the next share is tried, and how many where next to none are found: less
            # than this share of the requested number.
            for draws in range(100):
                poor = len(self.kept) < 0.03 * self._count
                if len(self.kept) >= self._count or (poor and draws >= 8):
                    break
                self._keep(*draw())
                if not narrowed and len(self.kept) >= min(_SAMPLE, self._count):
                    # Further draws are at the distances of the stops found.
                    q = np.array([q for q, _ in self.kept])
                    self._sight = self._sight.nearer_to(self._cell.cam_from_target(q))
                    narrowed = True
                if progress is not None:
                    progress("candidates", min(len(self.kept), self._count), self._count)
            # Few good stops are better than many that the guess makes doubtful.
            doubted = self.lost[GUESS] >= 0.5 * self.tried[GUESS]
            if not doubted or len(self.kept) >= 0.2 * self._count:
                break
        del self.kept[self._count :]

    def error(self) -> DataError:
        """Error of a search with too few stops."""
        shares = {limit: self.lost[limit] / tries for limit, tries in self.tried.items() if tries}
        worst = max(shares, key=lambda limit: shares[limit])
        words = some_of([f"{times} to {limit}" for limit, times in (+self.lost).most_common()], 6)
        return DataError(
            f"plan: {len(self.kept)} of {self._count} possible stops were found in "
            f"{max(self.tried.values())} tries; {words} were lost. Most in the way is {worst}, "
            f"which kept out {100.0 * shares[worst]:.1f} % of those that came so far.",
            culprits=[worst],
            next_step=_ADVICE[worst],
        )

    def _passed(self, limit: str, good: Mask) -> Mask:
        """Counts the tries that a limit lets through, and returns their mask."""
        self.tried[limit] += len(good)
        self.lost[limit] += int(np.sum(~good))
        return good

    def _from_views(self) -> tuple[FloatArray, FloatArray]:
        """Postures (k, n) that reach drawn views, and their shares (k,)."""
        sight, robot, passed = self._sight, self._cell.robot, self._passed
        views = sight.draw(_BATCH, self._rng)
        views = views[passed(IMAGE, sight.shows(views))]
        views = views[passed(FOCUS, sight.sharp(views))]
        flange = self._cell.flange_at(views)
        flange = flange[passed(HIDDEN, ~self._shade.behind_boxes(flange))]
        if not robot.chain.prismatic.any():
            # No farther than the outstretched arm.
            places = robot.chain.placements
            longest = float(np.linalg.norm(places[1:, :3, 3], axis=1).sum())
            distance = np.linalg.norm(flange[:, :3, 3] - places[0][:3, 3], axis=1)
            flange = flange[passed(AWAY, np.asarray(distance <= longest))]
        share = sight.share(flange, self._least_share)
        likely = passed(GUESS, share >= self._least_share)
        # Not many more than are still needed are solved.
        few = np.flatnonzero(likely)[: 3 * (self._count - len(self.kept)) + 50]
        flange, share = flange[few], share[few]
        positions, reached = self._inverse.from_starts(
            flange, self._inverse.starts(len(flange), self._rng)
        )
        reached = passed(REACH, reached)
        return robot.chain.encoded(positions[reached]), share[reached]

    def _from_postures(self) -> tuple[FloatArray, FloatArray]:
        """Drawn postures (k, n) that show the board, and their shares (k,)."""
        sight, cell = self._sight, self._cell
        q = cell.robot.chain.encoded(self._inverse.starts(_BATCH, self._rng))
        flange = cell.robot.base_from_flange(q)
        views = cell.seen_from(flange)
        near, far = sight.distance_m
        distance = sight.distances_m(views)
        kept = np.ones(len(q), dtype=bool)
        for limit, good in (
            (IMAGE, sight.shows(views)),
            (TILT, sight.tilt_rad(views) <= cell.limits.tilt_rad),
            (DISTANCE, (distance >= near) & (distance <= far)),
            (FOCUS, sight.sharp(views)),
        ):
            self._passed(limit, good[kept])
            kept &= good
        q, flange = q[kept], flange[kept]
        kept = self._passed(HIDDEN, ~self._shade.behind_boxes(flange))
        q, share = q[kept], sight.share(flange[kept], self._least_share)
        likely = self._passed(GUESS, share >= self._least_share)
        return q[likely], share[likely]

    def _keep(self, q: FloatArray, share: FloatArray) -> None:
        """Keeps postures (k, n) within limits, with a free line of sight and no collision."""
        robot, margin = self._cell.robot, self._cell.limits.joint_margin_rad
        within = (q >= robot.lower_rad + margin) & (q <= robot.upper_rad - margin)
        kept = self._passed(LIMITS, np.asarray(within.all(axis=1)))
        q, share = q[kept], share[kept]
        kept = self._passed(BEHIND_ARM, ~self._shade.behind_arm(q))
        q, share = q[kept], share[kept]
        kept = self._passed(CLEARANCE, self.collisions.first_contact(q) < 0)
        self.kept += zip(q[kept], share[kept].tolist(), strict=True)


def unwound(cell: AnyCell, collisions: Collisions, q: FloatArray) -> FloatArray:
    """Shifts joints of postures (k, n) by full turns, so that straight paths are possible."""
    # A joint cannot pass a wide range of angles in which no stop has it and most postures collide,
    # with the floor for example: its angles are counted from the middle of that range.
    chain, margin = cell.robot.chain, cell.limits.joint_margin_rad
    positions = chain.effective(q)
    for joint in np.flatnonzero(~chain.prismatic):
        angles = np.sort(positions[:, joint] % _TURN)
        gaps = np.diff(angles, append=angles[0] + _TURN)
        barred, cut = _BARRED, None
        for place in np.flatnonzero(gaps > _WIDE_RAD):
            between = angles[place] + 0.5 * gaps[place]
            turned = positions[:_SAMPLE].copy()
            turned[:, joint] = between
            share = float((collisions.first_contact(chain.encoded(turned)) >= 0).mean())
            if share > barred:
                barred, cut = share, between
        if cut is not None:
            # Of the full turns that begin there, the one around zero.
            cut -= _TURN * np.round((cut + 0.5 * _TURN) / _TURN)
            positions[:, joint] = cut + (positions[:, joint] - cut) % _TURN
    turned = chain.encoded(positions)
    low, high = cell.robot.lower_rad + margin, cell.robot.upper_rad - margin
    return np.where((turned >= low) & (turned <= high), turned, q)
