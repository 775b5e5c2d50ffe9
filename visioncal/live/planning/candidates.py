"""Stops that a robot can take: reachable, clear of everything, with the whole board in view."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray, IntArray, Mask, Progress
from visioncal.live.planning.cell import PlanCell, collisions_of
from visioncal.live.planning.visibility import Shade, sight_of
from visioncal.robot import Robot
from visioncal.robot.atlas import Atlas
from visioncal.robot.collision import Collisions
from visioncal.robot.inverse import Inverse

# Stops are taken that show the board in this share of what the cell may really be; where there are
# too few, those that show it less surely.
_SURE = (0.99, 0.97, 0.9, 0.7, 0.5)
# How many views or postures are drawn at a time; how many times before the next share is taken,
# and how many where next to none are found: less than this share of the wish.
_BATCH, _DRAWS, _FIRST_DRAWS, _NEXT_TO_NONE = 2000, 100, 8, 0.03
# Less sure stops help only where doubt about the guesses keeps out this share, and are taken only
# where there are fewer sure ones than this share of the wish: few good ones are a better choice.
_UNSURE, _ENOUGH = 0.5, 0.2
# Fewer than this share of the wish, or than a plan needs, are too few.
_LEAST_SHARE, _LEAST = 0.1, 12
# So many stops show at what distances others may be found.
_SAMPLE = 100
# An arm with fewer joints reaches a drawn view only by chance: its postures are drawn instead.
_FREE = 6
# A joint that stands nowhere in such a range [rad], and touches something there in this share of
# postures, cannot pass it.
_WIDE_RAD, _BARRED, _TURN = np.pi / 3.0, 0.5, 2.0 * np.pi
# How many views that were out of reach are looked at again, to say why.
_ASKED_AGAIN = 12
IMAGE = "the whole board in the image"
GUESS = "the whole board in the image although the guesses are off"
FOCUS, TILT, DISTANCE = "the range of focus", "the tilt", "the distance"
HIDDEN, BEHIND_ARM = "a free line of sight", "a line of sight past the arm"
AWAY, REACH = "the arm's length", "the arm's reach"
LIMITS, CLEARANCE = "the joints' limits", "the clearance"
_ADVICE = {
    IMAGE: "Look whether guesses, board and camera are the cell's; widen --distance-mm.",
    GUESS: "Measure more closely where camera and board are, or allow a greater distance.",
    FOCUS: "Widen --focus-mm, or set --distance-mm to where the image is sharp.",
    HIDDEN: "Look whether the boxes are where they stand, or put the board elsewhere.",
    BEHIND_ARM: "Put the camera where the arm comes less between it and the board, or hold the "
    "board farther away from the arm.",
    TILT: "Widen --tilt-deg, or turn the board towards the camera.",
    DISTANCE: "Widen --distance-mm, or put the board elsewhere.",
    AWAY: "Put the board nearer to the arm, allow smaller distances, or look whether the guesses "
    "are right.",
    REACH: "Put the board where the arm can look at it from all sides, or look whether the guesses "
    "are right.",
    LIMITS: "Put the board elsewhere, or look whether the limits are the robot's.",
    CLEARANCE: "Move one of the two, lower --clearance-mm, or look whether --box, --floor and "
    "guesses are right.",
}
# So many limits are named in a message, those that most was lost to.
_NAMED = 6


@dataclass(frozen=True, eq=False)
class Candidates:
    """Stops that a robot can take.

    Attributes:
        q: (k, n) joint angles [rad].
        cam_from_target: (k, 4, 4) how the board is seen, if the guesses are right [m].
        seen: (k,) share of what the cell may really be in which the whole board is in the image.
        lost: What kept how many drawn views or postures from being among them.
    """

    q: FloatArray
    cam_from_target: FloatArray
    seen: FloatArray
    lost: Mapping[str, int]

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
    """Finds stops all over what the robot can reach and the camera can see.

    Views of the board are drawn, and postures that reach them, each from a start of its own, so
    that shoulder, elbow and wrist take all their branches. Of an arm with fewer than six joints the
    postures are drawn.

    Args:
        cell: The cell.
        count: How many are wished.
        seed: Of everything random; the same seed gives the same stops.
        progress: Called as stops are found.
        least: With fewer than these there is no plan; None for a tenth of the wish, without which
            a guessed cell is rather guessed wrong.

    Returns:
        The stops, in random order; fewer than wished where the cell gives no more.

    Raises:
        DataError: There are too few; the message names what keeps the others from it.
    """
    search = _CandidateSearch(cell, count, seed)
    search.run(progress)
    if len(search.kept) < (least or max(_LEAST_SHARE * count, min(_LEAST, count))):
        search.ask_again()
        raise search.error()
    q = _unwound(cell, search.collisions, np.array([array for array, _ in search.kept]))
    shares = np.array([share for _, share in search.kept])
    return Candidates(q, cell.cam_from_target(q), shares, search.losses.counts())


class _CandidateSearch:
    """Stops as they are found, with a count of what the others were lost to."""

    def __init__(self, cell: PlanCell, count: int, seed: int) -> None:
        self.kept: list[tuple[FloatArray, float]] = []
        self.losses = Losses()
        self._bar, self._narrowed = _SURE[0], False
        self._cell, self._count = cell, count
        self._rng = np.random.default_rng(seed)
        self._sight = sight_of(cell, seed)
        self._shade = Shade.of(cell, np.vstack([self._sight.outline, self._sight.centre]))
        self.collisions = collisions_of(cell)
        self._inverse = Inverse(cell.robot)
        self._unreached: list[FloatArray] = []

    @cached_property
    def _atlas(self) -> Atlas:
        return Atlas(self._cell.robot, self._inverse, self._rng)

    def run(self, progress: Progress | None) -> None:
        """Draws until there are enough, or until it is plain that there are not."""
        draw = self._reaching if self._cell.robot.joint_count >= _FREE else self._postures
        for self._bar in _SURE:
            for draws in range(_DRAWS):
                poor = len(self.kept) < _NEXT_TO_NONE * self._count
                if len(self.kept) >= self._count or (poor and draws >= _FIRST_DRAWS):
                    break
                self._keep(*draw())
                self._narrow()
                if progress is not None:
                    progress("candidates", min(len(self.kept), self._count), self._count)
            doubted = self.losses.lost[GUESS] >= _UNSURE * self.losses.tried[GUESS]
            if not doubted or len(self.kept) >= _ENOUGH * self._count:
                break
        del self.kept[self._count :]

    def _narrow(self) -> None:
        """Draws at the distances that turn out well, once some have: others cost time alone."""
        if not self._narrowed and len(self.kept) >= min(_SAMPLE, self._count):
            q = np.array([q for q, _ in self.kept])
            self._sight = self._sight.nearer_to(self._cell.cam_from_target(q))
            self._narrowed = True

    def error(self) -> DataError:
        """The error that too few were found."""
        error, cell = self.losses.error(len(self.kept), self._count), self._cell
        if (
            cell.mount == "eye-in-hand"
            or cell.limits.distance_m is not None
            or self.losses.worst() not in (AWAY, REACH)
        ):
            return error
        # A camera that does not move may look from farther off than its board asks for.
        near, far = (1e3 * distance for distance in self._sight.distance_m)
        return DataError(
            error.message,
            culprits=error.culprits,
            next_step=f"Allow other distances than those at which the board fills the image, "
            f"{near:.0f} to {far:.0f} mm (--distance-mm), bring camera and arm nearer to each "
            "other, or look whether the guesses are right.",
        )

    def ask_again(self) -> None:
        """Finds the joints whose limits alone kept the arm from views that it did not reach."""
        still = np.zeros(self._cell.robot.joint_count)
        found = [self._inverse.solve(array, still) for array in self._unreached]
        self.losses.blame(
            REACH, [f"limits of {name}" for posture in found for name in posture.beyond]
        )

    def _reaching(self) -> tuple[FloatArray, FloatArray]:
        """Postures (k, n) that reach drawn views, and their shares (k,)."""
        sight, robot, passed = self._sight, self._cell.robot, self.losses.passed
        views = sight.draw(_BATCH, self._rng)
        views = views[passed(IMAGE, sight.shows(views))]
        views = views[passed(FOCUS, sight.sharp(views))]
        flange = self._cell.flange_at(views)
        flange = flange[self._unhidden(self._shade.behind_boxes(flange))]
        flange = flange[passed(AWAY, _within(robot, flange))]
        within, starts = self._atlas.starts(flange, self._rng)
        self._unreached += list(flange[~within][: _ASKED_AGAIN - len(self._unreached)])
        flange = flange[passed(REACH, within)]
        share = sight.share(flange, self._bar)
        sure = passed(GUESS, share >= self._bar)
        # More than are still needed would be thrown away.
        few = np.flatnonzero(sure)[: 3 * (self._count - len(self.kept)) + 50]
        flange, starts, share = flange[few], starts[few], share[few]
        positions, reached = self._inverse.from_starts(flange, starts)
        self.losses.lost[REACH] += int(np.sum(~reached))
        return robot.chain.encoded(positions[reached]), share[reached]

    def _postures(self) -> tuple[FloatArray, FloatArray]:
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
            self.losses.passed(limit, good[kept])
            kept &= good
        q, flange = q[kept], flange[kept]
        kept = self._unhidden(self._shade.behind_boxes(flange))
        q, share = q[kept], sight.share(flange[kept], self._bar)
        sure = self.losses.passed(GUESS, share >= self._bar)
        return q[sure], share[sure]

    def _unhidden(self, behind: IntArray) -> Mask:
        """Counts and names the boxes (k,) that hide the board, and where none does."""
        free = self.losses.passed(HIDDEN, behind < 0)
        self.losses.blame(HIDDEN, [self._cell.boxes[place].name for place in behind[~free]])
        return free

    def _keep(self, q: FloatArray, share: FloatArray) -> None:
        """Keeps the postures (k, n) that are within limits, hide nothing and touch nothing."""
        robot, margin = self._cell.robot, self._cell.limits.joint_margin_rad
        over = np.maximum(robot.lower_rad + margin - q, q - robot.upper_rad + margin)
        within = self.losses.passed(LIMITS, np.asarray(np.all(over <= 0.0, axis=1)))
        self.losses.blame(
            LIMITS, [robot.joint_names[index] for index in over[~within].argmax(axis=1)]
        )
        q, share = q[within], share[within]
        behind = self._shade.behind_arm(q)
        free = self.losses.passed(BEHIND_ARM, behind < 0)
        self.losses.blame(BEHIND_ARM, [self._shade.parts[index].name for index in behind[~free]])
        q, share = q[free], share[free]
        contact = self.collisions.first_contact(q)
        clear = self.losses.passed(CLEARANCE, contact < 0)
        pairs = [self.collisions.names[place] for place in contact[~clear]]
        self.losses.blame(CLEARANCE, [f"{first} and {second}" for first, second in pairs])
        self.kept += zip(q[clear], share[clear].tolist(), strict=True)


def _within(robot: Robot, flange: FloatArray) -> Mask:
    """Whether poses (k, 4, 4) are nearer than the outstretched arm."""
    chain = robot.chain
    if chain.prismatic.any():
        return np.ones(len(flange), dtype=bool)
    longest = float(np.linalg.norm(chain.placements[1:, :3, 3], axis=1).sum())
    away = np.linalg.norm(flange[:, :3, 3] - chain.placements[0][:3, 3], axis=1)
    return np.asarray(away <= longest)


def _unwound(cell: PlanCell, collisions: Collisions, q: FloatArray) -> FloatArray:
    """Turns joints of postures (k, n) by whole turns, so that ways between them may be straight."""
    # Where a joint never stands in a wide range of angles, and most postures touch something if it
    # is turned there, as the floor, it cannot pass: its angles are counted from the middle of that
    # range on.
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
            # Of the turns that begin there the one about zero.
            cut -= _TURN * np.round((cut + 0.5 * _TURN) / _TURN)
            positions[:, joint] = cut + (positions[:, joint] - cut) % _TURN
    turned = chain.encoded(positions)
    low, high = cell.robot.lower_rad + margin, cell.robot.upper_rad - margin
    return np.where((turned >= low) & (turned <= high), turned, q)


@dataclass
class Losses:
    """How many tries each limit let through, in the order in which they are looked at.

    Attributes:
        tried: How many came to each limit.
        lost: How many did not pass it.
        named: The same, with the joint or the pair of bodies where it is known.
    """

    tried: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    named: Counter[str] = field(default_factory=Counter)

    def passed(self, limit: str, good: Mask) -> Mask:
        """Counts what a limit lets through, and returns it."""
        self.tried[limit] += len(good)
        self.lost[limit] += int(np.sum(~good))
        return good

    def blame(self, limit: str, names: Sequence[str]) -> None:
        """Names what was in the way of tries that were lost to a limit."""
        self.named.update(f"{limit} ({name})" for name in names)

    def counts(self) -> Mapping[str, int]:
        """How many were lost to what, the most first."""
        counts = Counter(self.named)
        for limit, times in self.lost.items():
            known = sum(
                index for name, index in self.named.items() if name.startswith(f"{limit} (")
            )
            counts[limit] += times - known
        return {limit: times for limit, times in counts.most_common() if times > 0}

    def worst(self) -> str:
        """The limit that lets the smallest share through."""
        left = {name: 1.0 - self.lost[name] / tried for name, tried in self.tried.items() if tried}
        return min(left, key=lambda limit: left[limit])

    def error(self, found: int, wished: int) -> DataError:
        """The error of a search that found too few."""
        worst = self.worst()
        own = {
            name: count for name, count in self.counts().items() if name.startswith(f"{worst} (")
        }
        culprit = max(own, key=lambda name: own[name], default=worst)
        tried = max(self.tried.values())
        lost = some_of([f"{times} to {what}" for what, times in self.counts().items()], _NAMED)
        share = 100.0 * self.lost[worst] / self.tried[worst]
        return DataError(
            f"plan: {found} of {wished} possible stops were found in {tried} tries. Lost were "
            f"{lost}. Most in the way is {culprit}: {worst} kept out {share:.1f} % of the "
            f"{self.tried[worst]} that came so far.",
            culprits=[culprit],
            next_step=_ADVICE[worst],
        )
