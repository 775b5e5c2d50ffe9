"""The joint fit of corners, lens, board and both edges: its unknowns, and its linearisation.

Each view's corners are compressed to its pose and to how that moves with lens and board; the chain
of frames is closed over all stops with what is left open of these. Linearising anew at the answer,
until it stays, is Gauss-Newton's method on the whole problem.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.chance import chi2_limit
from visioncal.errors import ConvergenceError
from visioncal.estimation.appearance import (
    BOARD_NAMES,
    Appearance,
    Compressed,
    Free,
    board_prior,
    boards_basis,
    compress,
    shape_slices,
)
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.chain import chain
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.linalg import covariance, covariance_among
from visioncal.estimation.problem import ROBOT, FramePrior, Problem, State
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
    fitted_covariance,
    normal_equations,
    score_gain,
)
from visioncal.targets import first_corners, numbered_positions
from visioncal.types import Camera, Corners, FloatArray, IntArray, Mount, Target

# Freeing unknowns must gain more than noise does in one session of ten thousand.
_FALSE_ALARM = 1e-4
# Corners must be left over to judge by: so many residuals for each unknown.
_SPARE = 10
# Values that move by less than this share of their sigma have settled.
_SETTLED, _ROUNDS = 0.02, 8
# A step after which corners fit worse by this factor is too long; so often is it halved.
_FOLLOWS, _HALVINGS = 2.0, 12
# What is stated is contradicted by so many standard deviations.
_CONTRADICTION = 3.0
# Errors of an arm's links are taken to be of one size; those few that a board's scale looks like
# may well be so much larger.
_UNEVEN = 2.0
# Given intrinsics that are set free are known to so much without the session: the focal length and
# the centre as shares of the focal length, and the distortion's coefficients.
_FOCAL_SHARE, _DISTORTION_SIGMA = 0.05, 0.3


@dataclass(frozen=True, eq=False)
class Scene:
    """What is looked at, and with what.

    Attributes:
        mount: Where the camera is.
        targets: What was printed, as stated; the corners of several are numbered through.
        camera: The intrinsics.
        estimated: Whether they were estimated from these corners.
        mode: What to do with given ones: `hold`, `refine` or `auto`.
        matrix_sigma_px: What given fx, fy, cx, cy are known to; None where that is not said.
        names: What several targets are called.
    """

    mount: Mount
    targets: tuple[Target, ...]
    camera: Camera
    estimated: bool
    mode: str = "auto"
    matrix_sigma_px: float | None = None
    names: tuple[str, ...] = ("",)


@dataclass(frozen=True, eq=False)
class Arm:
    """The robot's side of the chain.

    Attributes:
        poses: (s, 4, 4) `base_from_flange` at each stop.
        stops: (m,) the stop of each view, numbered from 0.
        targets: (m,) the frame of the target that each view shows.
        basis: (s, 6, p) how its errors move the flange at each stop.
        of_links: Whether these are errors of its own links.
        errors: Their size, where they are free.
        priors: What was measured of frames by hand.
    """

    poses: FloatArray
    stops: IntArray
    targets: tuple[str, ...]
    basis: FloatArray
    of_links: bool
    errors: ArmErrors | None = None
    priors: tuple[FramePrior, ...] = ()


def repeat_shares(shown: Mapping[int, Hashable]) -> dict[int, float]:
    """As how much of a view those count that show the same: one image in all.

    What a lens, a print or a detector does to one of them it does to all.

    Args:
        shown: What each view shows from where, by its number; alike where that is the same.
    """
    counts = Counter(shown.values())
    return {view: 1.0 / counts[it] for view, it in shown.items()}


@dataclass(frozen=True, eq=False)
class CornerProblem:
    """The corners of m views with what is known of the scene beforehand.

    Attributes:
        scene: The scene.
        stack: The corners.
        positions: (c, 3) corners of the flat boards, each in its own frame [m].
        basis: (c, 3, s) of `boards_basis`.
        prior_sigma: (k + s,) what lens and boards are known to; inf where nothing is known.
        shares: (m,) as how much of a view each counts for lens and board; see `repeat_shares`.
        contested: Whether given intrinsics are held although the corners speak against them.
    """

    scene: Scene
    stack: CornerStack
    positions: FloatArray
    basis: FloatArray
    prior_sigma: FloatArray
    shares: FloatArray
    contested: bool = False

    @classmethod
    def of(
        cls, scene: Scene, corners: Mapping[int, Corners], shares: Mapping[int, float]
    ) -> "CornerProblem":
        """Puts the problem together from the corners by view, and the shares of those that repeat.

        Where a view has no share, it counts as one.
        """
        positions = numbered_positions(scene.targets)
        priors = [board_prior(it) for it in scene.targets]
        return cls(
            scene,
            CornerStack.of(corners, positions),
            positions,
            boards_basis(scene.targets),
            np.concatenate([_lens_prior(scene), *priors]),
            np.array([shares.get(it, 1.0) for it in corners]),
        )

    def without_prior(self, columns: IntArray) -> "CornerProblem":
        """The same problem, some values of which nobody has stated."""
        sigma = self.prior_sigma.copy()
        sigma[columns] = np.inf
        return replace(self, prior_sigma=sigma)

    @property
    def stated(self) -> Appearance:
        """Lens and board as they are given or were estimated before."""
        return Appearance(self.scene.camera, np.zeros(self.basis.shape[2]))

    @property
    def lens(self) -> IntArray:
        """Places of the intrinsics among the values; they come first."""
        return np.arange(len(self.prior_sigma) - self.basis.shape[2])

    @property
    def printed(self) -> list[int]:
        """Which targets are printed: those that have a scale, and may be bent."""
        return [at for at, it in enumerate(self.scene.targets) if it.kind != "points"]

    @property
    def scale(self) -> IntArray:
        """Places of the printed boards' scales."""
        return self._joined(self.scale_of(board) for board in self.printed)

    @property
    def shape(self) -> IntArray:
        """Places of the printed boards' aspects and bends."""
        return self._joined(self.shape_of(board) for board in self.printed)

    @property
    def points(self) -> IntArray:
        """Places of the rigs' points, as far as these are not exact."""
        rigs = set(range(len(self.scene.targets))) - set(self.printed)
        return self._joined(self.points_of(rig) for rig in sorted(rigs))

    def scale_of(self, board: int) -> IntArray:
        """Place (1,) of one printed board's scale."""
        return self.points_of(board)[:1]

    def shape_of(self, board: int) -> IntArray:
        """Places (8,) of one printed board's aspect and bend."""
        return self.points_of(board)[1:]

    def points_of(self, target: int) -> IntArray:
        """Places of all that is unknown of where one target's corners lie on it."""
        mine = shape_slices(self.scene.targets, len(self.lens))[target]
        return np.arange(mine.start, mine.stop)

    def _joined(self, places: Iterable[IntArray]) -> IntArray:
        return np.concatenate([self.lens[:0], *places])

    def corners_of(self, board: int) -> slice:
        """The rows of one board's corners in `positions`."""
        starts = [*first_corners(self.scene.targets).tolist(), len(self.positions)]
        return slice(starts[board], starts[board + 1])

    @property
    def has_spare_corners(self) -> bool:
        """Whether the views show more corners than it takes to free lens and board."""
        residuals = 2 * len(self.stack.px) - 6 * len(self.stack.views)
        return residuals >= _SPARE * (len(self.lens) + len(BOARD_NAMES) * len(self.printed))

    def unknowns(self, compressed: Compressed, moving: IntArray) -> int:
        """How many unknowns the corners have told, the poses among them.

        Where a rig's points are known well beforehand, corners tell little of them, and residuals
        are no smaller for their sake.
        """
        rigs = np.intersect1d(self.points, moving)
        sigma_px = self.stack.shown_px(compressed.residuals, 6 * len(compressed.information))
        told = np.diag(compressed.shared_information)[rigs] * self.prior_sigma[rigs] ** 2
        share = told / (told + floored_sigma_px(sigma_px) ** 2)
        exact = len(moving) - len(rigs)
        return 6 * len(compressed.information) + exact + round(float(share.sum()))

    def sigma_px(self, compressed: Compressed, moving: IntArray) -> float:
        """Noise of a corner's coordinate [px]; see `CornerStack.sigma_px`."""
        return self.stack.sigma_px(compressed.residuals, self.unknowns(compressed, moving))

    @property
    def first(self) -> IntArray:
        """What is free from the start."""
        if self.scene.estimated:
            return np.union1d(self.lens, self.points)
        if self.scene.mode == "refine" and self.has_spare_corners:
            return np.concatenate([self.lens, np.union1d(self.shape, self.points)])
        return self.points

    @property
    def counted(self) -> IntArray:
        """What is open and counts in the covariance, whether it is free or not."""
        if self.scene.estimated or self.contested:
            return np.concatenate([self.lens, np.union1d(self.scale, self.points)])
        stated = self.scene.matrix_sigma_px is not None
        lens = self.lens[:4] if stated else self.lens[:0]
        return np.concatenate([lens, np.union1d(self.scale, self.points)])


def _lens_prior(scene: Scene) -> FloatArray:
    camera = scene.camera
    if scene.estimated:
        return np.full(4 + len(camera.distortion), np.inf)
    matrix = np.full(4, _FOCAL_SHARE * float(camera.matrix[:2].max()))
    if scene.matrix_sigma_px is not None:
        matrix = np.full(4, scene.matrix_sigma_px)
    return np.concatenate([matrix, np.full(len(camera.distortion), _DISTORTION_SIGMA)])


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit begins: lens and board, (m, 4, 4) poses of the target, and where frames are."""

    appearance: Appearance
    poses: FloatArray
    frames: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Seen:
    """The corners' word on poses and appearance, where it was linearised."""

    compressed: Compressed
    free: Free
    sigma_px: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """The fit at rest: the linearisation, the problem of all frames, and what came out."""

    seen: Seen
    problem: Problem
    fit: Solution

    @property
    def looks(self) -> slice:
        """The columns of lens and board: the first effect's."""
        first = 6 * len(self.problem.unknown)
        return slice(first, first + len(self.seen.free.columns))

    @property
    def frames(self) -> Mapping[str, FloatArray]:
        """Where the unknown frames are."""
        return dict(zip(self.problem.unknown, self.fit.state.edges, strict=True))

    @property
    def appearance(self) -> Appearance:
        """Lens and board as they came out."""
        return self.seen.free.after(self.fit.state.values)

    def again(self) -> Start:
        """The answer as the start of the next fit."""
        return Start(self.appearance, self.seen.compressed.cam_from_target, self.frames)

    def spread(self) -> FloatArray:
        """(p, p) covariance of what the fit moves, where it was measured."""
        return fitted_covariance(self.problem, self.fit.state, self.fit.noise)

    @property
    def moving(self) -> IntArray:
        """Places of the values that the fit moves."""
        return self.seen.free.columns[~self.seen.free.anchored]


def settle(problem: CornerProblem, arm: Arm, moving: IntArray, start: Start) -> Fitted:
    """Linearises and fits in turn, until the values stay where they are.

    Raises:
        ConvergenceError: They run away: what the robot says has nothing to do with what is seen.
    """
    try:
        # Numbers that run away overflow before they fail.
        with np.errstate(over="ignore", invalid="ignore"):
            return _settled(problem, arm, moving, start)
    except np.linalg.LinAlgError as error:
        raise ConvergenceError(
            "hand-eye: no frames explain both the robot's poses and what the camera saw: the fit "
            "runs away. The likeliest cause is poses of other views than the images.",
            culprits=["poses", "images"],
            next_step="Look at which image belongs to which pose; visioncal convert --guess tries "
            "other readings of the poses.",
        ) from error


def _settled(problem: CornerProblem, arm: Arm, moving: IntArray, start: Start) -> Fitted:
    fitted = _fitted(problem, arm, moving, start)
    for _ in range(_ROUNDS):
        sigma = np.sqrt(np.diag(fitted.spread())[fitted.looks])
        if np.all(np.abs(fitted.fit.state.values[: len(sigma)]) <= _SETTLED * sigma):
            break
        fitted = _fit(problem, arm, _stepped(problem, moving, fitted), fitted.frames)
    return fitted


def _fitted(problem: CornerProblem, arm: Arm, moving: IntArray, start: Start) -> Fitted:
    seen = seen_at(problem, moving, start.appearance, start.poses)
    return _fit(problem, arm, seen, start.frames)


def _stepped(problem: CornerProblem, moving: IntArray, fitted: Fitted) -> Seen:
    """Linearises where the fit came to rest, or on the way there as far as the corners follow.

    Far from the answer, as where a lens was stated for images of another size, the whole step
    leads to lenses that see nothing.
    """
    limit = _FOLLOWS * floored_sigma_px(fitted.seen.sigma_px)
    change, poses = fitted.fit.state.values, fitted.seen.compressed.cam_from_target
    for _ in range(_HALVINGS):
        seen = seen_at(problem, moving, fitted.seen.free.after(change), poses)
        if seen.sigma_px <= limit:
            return seen
        change = change / 2
    return fitted.seen


def _fit(problem: CornerProblem, arm: Arm, seen: Seen, frames: Mapping[str, FloatArray]) -> Fitted:
    whole = _chain(problem, arm, seen, seen.free)
    return Fitted(seen, whole, fit_problem(whole, whole.start(frames)))


def seen_at(
    problem: CornerProblem, moving: IntArray, appearance: Appearance, poses: FloatArray
) -> Seen:
    """Linearises the corners.

    Args:
        problem: The corners.
        moving: Places of the values that a fit will move.
        appearance: Lens and board to linearise at.
        poses: (m, 4, 4) `cam_from_target` to start from.
    """
    compressed = compress(
        problem.stack, problem.basis, appearance, poses, problem.scale, problem.shares
    )
    sigma_px = problem.sigma_px(compressed, moving)
    free = _known_beforehand(problem, moving, appearance, compressed, sigma_px)
    return Seen(compressed, free, sigma_px)


def _known_beforehand(
    problem: CornerProblem,
    moving: IntArray,
    appearance: Appearance,
    compressed: Compressed,
    sigma_px: float,
) -> Free:
    """What the corners and the priors say of the free values."""
    columns = np.union1d(moving, problem.counted)
    weight = 1.0 / floored_sigma_px(sigma_px) ** 2
    prior = 1.0 / problem.prior_sigma[columns] ** 2
    away = (appearance.values - problem.stated.values)[columns]
    information = weight * compressed.shared_information[np.ix_(columns, columns)] + np.diag(prior)
    pull = weight * compressed.shared_pull[columns] + prior * away
    return Free(
        appearance,
        problem.basis,
        problem.positions,
        columns,
        ~np.isin(columns, moving),
        information,
        pull,
    )


def _chain(problem: CornerProblem, arm: Arm, seen: Seen, free: Free) -> Problem:
    effects = [free.effect(seen.compressed.by_shared[:, :, free.columns])]
    if arm.errors is not None:
        effects.append(arm.errors.effect(ROBOT))
    return chain(
        problem.scene.mount,
        arm.poses,
        seen.compressed.cam_from_target,
        floored_sigma_px(seen.sigma_px) ** 2 * covariance(seen.compressed.information),
        stops=arm.stops,
        targets=arm.targets,
        effects=effects,
        priors=arm.priors,
    )


@dataclass(frozen=True)
class MeasuredScale:
    """What the chain alone says of a board's scale, as if no size had been stated.

    Attributes:
        board: Which board.
        scale: By which share the board is larger than stated.
        sigma: Its standard deviation.
        stated_sigma: What the stated size is known to.
    """

    board: int
    scale: float
    sigma: float
    stated_sigma: float

    @property
    def is_another(self) -> bool:
        """Whether it differs from the stated one by more than chance."""
        return (self.scale / self.sigma) ** 2 > chance_limit(1)

    @property
    def contradicts(self) -> bool:
        """Whether it differs by more than both uncertainties explain."""
        return abs(self.scale) > _CONTRADICTION * float(np.hypot(self.sigma, self.stated_sigma))


def measured_scale(
    problem: CornerProblem, arm: Arm, fitted: Fitted, board: int = 0
) -> MeasuredScale:
    """Measures a board's size by the robot's motion."""
    place = problem.scale_of(board)
    whole, at_change = _with_free(
        problem, arm, fitted, np.union1d(fitted.moving, place), ignored=place
    )
    information, gradient = normal_equations(whole, at_change, fitted.fit.noise)
    spread = covariance_among(information, whole.moving)
    at = fitted.looks.start + int(np.searchsorted(fitted.seen.free.columns, place[0]))
    now = float(fitted.appearance.values[place[0]])
    uneven = _UNEVEN if arm.errors is not None and arm.of_links else 1.0
    return MeasuredScale(
        board,
        now - float(spread[at] @ gradient),
        uneven * float(np.sqrt(spread[at, at])),
        problem.scene.targets[board].square_sigma_m / problem.scene.targets[board].square_m,
    )


def moved_surprise(problem: CornerProblem, fitted: Fitted, places: IntArray) -> float:
    """Squared distance of some values from the stated ones, in units of their covariance.

    Args:
        problem: The corners.
        fitted: A fit that moves these values among others.
        places: (k,) where they stand among the values.
    """
    at = fitted.looks.start + np.searchsorted(fitted.seen.free.columns, places)
    away = (fitted.appearance.values - problem.stated.values)[places]
    return float(away @ np.linalg.solve(fitted.spread()[np.ix_(at, at)], away))


def contradicted_lens(problem: CornerProblem, fitted: Fitted) -> bool:
    """Whether given intrinsics are farther off than what they are known to explains."""
    away = fitted.appearance.values - problem.stated.values
    return contradicts(away[problem.lens], _lens_prior(problem.scene))


def contradicts(away: FloatArray, prior_sigma: FloatArray) -> bool:
    """Whether (k,) values are farther from the stated ones than what is known of them explains."""
    return bool(np.any(np.abs(away) > _CONTRADICTION * prior_sigma))


def chance_limit(freedom: int) -> float:
    """What a squared error may fall by chance when so many more values are free (chi-square)."""
    return float(chi2_limit(_FALSE_ALARM, freedom))


def gain(problem: CornerProblem, arm: Arm, fitted: Fitted, moving: IntArray) -> float:
    """How much the whitened squared error falls when more values are free (Rao's score test)."""
    whole, at = _with_free(problem, arm, fitted, moving)
    return score_gain(*normal_equations(whole, at, fitted.fit.noise), whole.moving)


def _with_free(
    problem: CornerProblem,
    arm: Arm,
    fitted: Fitted,
    moving: IntArray,
    ignored: IntArray | None = None,
) -> tuple[Problem, State]:
    """The problem at the same state with other values free, and without the prior of some."""
    seen = fitted.seen
    stated = problem if ignored is None else problem.without_prior(ignored)
    free = _known_beforehand(stated, moving, seen.free.appearance, seen.compressed, seen.sigma_px)
    looks, rest = np.split(fitted.fit.state.values, [len(seen.free.columns)])
    change = np.zeros(len(free.columns))
    change[np.searchsorted(free.columns, seen.free.columns)] = looks
    there = State(fitted.fit.state.edges, np.concatenate([change, rest]))
    return _chain(problem, arm, seen, free), there
