"""Scene of one camera: its targets and corners, with priors of lens and boards."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.linalg import covariance_from
from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Mask, Target
from visioncal.estimation.appearance import Compressed
from visioncal.vision.board_shape import BOARD_NAMES, boards_basis, shape_slices, stated_board_sigma
from visioncal.vision.corners import CornerStack, floored_sigma_px
from visioncal.vision.lens_field import LensLevels, row_motions, zooms
from visioncal.vision.targets import numbered_positions

# Frame of a single camera.
ONLY_CAMERA = "cam"


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera and its targets."""

    # The nominal targets; the corners of several are numbered consecutively.
    targets: tuple[Target, ...]
    camera: Camera
    estimated: bool  # Whether they were estimated from these corners.
    mode: str = "auto"  # Treatment of given intrinsics: `hold`, `refine` or `auto`.
    # Prior sigma of given fx, fy, cx, cy; None where not stated.
    matrix_sigma_px: float | None = None
    names: tuple[str, ...] = ("",)  # Names of several targets.

    @property
    def printed(self) -> tuple[str, ...]:
        """Names of the printed targets."""
        pairs = zip(self.names, self.targets, strict=True)
        return tuple(name for name, target in pairs if not target.is_rig)


@dataclass(frozen=True)
class BoardSizes:
    """Sizes of a printed board's errors beyond what is stated: standard deviations."""

    scale: float = 0.0  # Of its size, relative.
    plane: float = 0.0  # Of its aspect ratio and its shear.
    bend: float = 0.0  # Of each term of its bend [m].
    # Whether it keeps its stated scale: errors of an arm by its posture look like a scale, and
    # weigh more than white noise does.
    is_held: bool = False


@dataclass(frozen=True, eq=False)
class CornerProblem:
    """The corners of m views with the priors of lens and boards."""

    scene: Scene
    stack: CornerStack
    positions: FloatArray  # (c, 3) corners of the flat boards, each in its own frame [m].
    basis: FloatArray  # (c, 3, s) of `boards_basis`.
    # (k + s,) stated sigmas of lens and boards; inf where they are estimated from the corners.
    stated_sigma: FloatArray
    # (m,) weight of each view for lens and board; images that repeat an earlier one share one.
    shares: FloatArray
    # Sizes of lens errors beyond the model; None before their estimation.
    levels: LensLevels | None = None
    # (k, k) covariance of a given lens's intrinsics beyond what is stated; None for a sound one.
    lens_covariance: FloatArray | None = None
    board_sizes: tuple[BoardSizes, ...] = ()  # The same of each printed board.

    @classmethod
    def of(
        cls, scene: Scene, corners: Mapping[int, Corners], shares: Mapping[int, float]
    ) -> "CornerProblem":
        """Builds the problem from the corners by view, and the weights of repeated views.

        Unstated corner weights are left to `CameraParameters.weighed`: errors of lens and board
        would pass for a view's noise.
        """
        positions = numbered_positions(scene.targets)
        stack = CornerStack.of(corners, positions)
        if stack.stated_px is None:
            stack = replace(stack, weights=None)
        boards = [*map(stated_board_sigma, scene.targets)]
        problem = cls(
            scene,
            stack,
            positions,
            boards_basis(scene.targets),
            np.concatenate([_lens_sigma(scene, is_refined=False), *boards]),
            np.array([shares.get(view, 1.0) for view in corners]),
        )
        problem = replace(problem, board_sizes=(BoardSizes(),) * len(problem.printed))
        # Corners too few to judge by, with under ten residuals per unknown, leave a lens as it is.
        sought = len(problem.lens) + len(BOARD_NAMES) * len(problem.printed)
        is_spare = 2 * len(stack.px) - 6 * len(stack.views) >= 10 * sought
        lens = _lens_sigma(scene, is_refined=scene.mode == "refine" and is_spare)
        return replace(problem, stated_sigma=np.concatenate([lens, *boards]))

    def with_levels(self, levels: LensLevels) -> "CornerProblem":
        """Returns the problem with lens errors beyond the model."""
        px, camera, of_views = self.stack.px, self.scene.camera, list[FloatArray]()
        if levels.jitter > 0.0:
            of_views.append(levels.jitter * zooms(px, camera))
        if levels.motion > 0.0:
            of_views.append(levels.motion * row_motions(px, camera))
        zoomed = np.concatenate(of_views, axis=2) if of_views else None
        return replace(self, stack=replace(self.stack, zooms=zoomed), levels=levels)

    @cached_property
    def covariance(self) -> FloatArray:
        """(k + s, k + s) prior covariance of lens and boards; zero where it is flat."""
        known = np.where(np.isinf(self.stated_sigma), 0.0, self.stated_sigma)
        covariance, count = np.diag(known**2), len(self.lens)
        if self.lens_covariance is not None:
            covariance[:count, :count] += self.lens_covariance
        for board, sizes in zip(self.printed, self.board_sizes, strict=True):
            scale, aspect, *bends, shear = self.points_of(board)[: len(BOARD_NAMES)]
            covariance[scale, scale] += sizes.scale**2
            covariance[[aspect, shear], [aspect, shear]] += sizes.plane**2
            covariance[bends, bends] += sizes.bend**2
        return covariance

    @property
    def is_flat(self) -> Mask:
        """(k + s,) mask of the values without a prior."""
        return np.isinf(self.stated_sigma)

    @property
    def is_uncertain(self) -> Mask:
        """(k + s,) mask of the values that are not exactly as stated."""
        return np.asarray(self.is_flat | (np.diag(self.covariance) > 0.0))

    @property
    def is_held(self) -> Mask:
        """(k + s,) mask of the values that no fit moves, however uncertain they are."""
        held = np.zeros(len(self.stated_sigma), dtype=bool)
        held[self.lens] = self.scene.mode == "hold" and not self.scene.estimated
        held[self.scale] = [sizes.is_held for sizes in self.board_sizes]
        return held

    @cached_property
    def prior_information(self) -> FloatArray:
        """(k + s, k + s) inverse of `covariance` of the uncertain values; zero elsewhere."""
        information, kept = np.zeros_like(self.covariance), self.is_uncertain & ~self.is_flat
        if kept.any():
            information[np.ix_(kept, kept)] = covariance_from(self.covariance[np.ix_(kept, kept)])
        return information

    @property
    def lens(self) -> IntArray:
        """Columns of the intrinsics; they come first."""
        return np.arange(len(self.stated_sigma) - self.basis.shape[2])

    @property
    def printed(self) -> list[int]:
        """Indices of the printed targets: those with a scale, and possibly a bend."""
        return [at for at, target in enumerate(self.scene.targets) if not target.is_rig]

    @property
    def scale(self) -> IntArray:
        """Columns of the printed boards' scales."""
        return np.concatenate([self.lens[:0], *map(self.scale_of, self.printed)])

    def scale_of(self, board: int) -> IntArray:
        """Column (1,) of one printed board's scale."""
        return self.points_of(board)[:1]

    def points_of(self, target: int) -> IntArray:
        """Columns of all unknowns of one target's corner positions."""
        columns = shape_slices(self.scene.targets, len(self.lens))[target]
        return np.arange(columns.start, columns.stop)

    def unknowns(self, compressed: Compressed) -> int:
        """Number of unknowns, poses among them, that the corners have determined, not a prior."""
        sigma_px = self.stack.shown_px(compressed.residuals, 6 * len(compressed.information))
        kept = self.is_uncertain & ~self.is_held
        information = compressed.shared_information[np.ix_(kept, kept)]
        prior = floored_sigma_px(sigma_px) ** 2 * self.prior_information[np.ix_(kept, kept)]
        found = compressed.coefficients
        freedom = 0.0 if found is None else found.freedom
        # Values that nothing determines are none. Share of the information of values that is added
        # where they have none.
        ridge = 1e-12 * np.diag(np.diag(information) + 1.0)
        effective = float(np.trace(np.linalg.solve(information + prior + ridge, information)))
        return 6 * len(compressed.information) + round(effective + freedom)

    def sigma_px(self, compressed: Compressed) -> float:
        """Noise of a corner's coordinate [px]; see `CornerStack.sigma_px`."""
        return self.stack.sigma_px(compressed.residuals, self.unknowns(compressed))


def _lens_sigma(scene: Scene, *, is_refined: bool) -> FloatArray:
    """(k,) prior sigmas of a camera's intrinsics; inf where they are estimated."""
    count = len(scene.camera.distortion)
    if scene.estimated:
        return np.full(4 + count, np.inf)
    matrix, distortion = scene.matrix_sigma_px or 0.0, 0.0
    if is_refined:
        # Prior sigmas of intrinsics that are given to be refined: focal length and centre as shares
        # of the focal length, and distortion coefficients.
        matrix = scene.matrix_sigma_px or 0.05 * float(scene.camera.matrix[:2].max())
        distortion = 0.3
    return np.repeat([matrix, distortion], [4, count])
