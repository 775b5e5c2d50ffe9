"""Scene of one camera: its targets and corners, with priors of lens and boards."""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Target
from visioncal.estimation.appearance import (
    BOARD_NAMES,
    Compressed,
    board_prior,
    boards_basis,
    shape_slices,
)
from visioncal.estimation.corners import CornerStack, floored_sigma_px
from visioncal.estimation.lens_field import LensLevels, zooms
from visioncal.vision.targets import first_corners, numbered_positions

# Frame of a single camera.
ONLY_CAMERA = "cam"
# Least residuals per unknown of lens and board.
_SPARE = 10
# Prior sigmas of given intrinsics once they are estimated: focal length and centre as shares of the
# focal length, and distortion coefficients.
_FOCAL_SHARE, _DISTORTION_SIGMA = 0.05, 0.3


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
    # Whether the focal length varies neither with the distance nor at random.
    is_focus_fixed: bool = False


def repeat_shares(shown: Mapping[int, Hashable]) -> dict[int, float]:
    """Weight of each view; images that repeat an earlier one share one weight.

    Errors of a lens, a print or a detector in one of them are the same in all. `shown` has a key by
    view number that is equal for views of the same content and pose.
    """
    counts = Counter(shown.values())
    return {view: 1.0 / counts[key] for view, key in shown.items()}


@dataclass(frozen=True, eq=False)
class CornerProblem:
    """The corners of m views with the priors of lens and boards."""

    scene: Scene
    stack: CornerStack
    positions: FloatArray  # (c, 3) corners of the flat boards, each in its own frame [m].
    basis: FloatArray  # (c, 3, s) of `boards_basis`.
    # (k + s,) prior sigmas of lens and boards; inf where there is no prior.
    prior_sigma: FloatArray
    shares: FloatArray  # (m,) weight of each view for lens and board; see `repeat_shares`.
    # Whether given intrinsics are held although the corners contradict them.
    contested: bool = False
    # Sizes of lens errors beyond the model; None before their estimation.
    levels: LensLevels | None = None
    # Columns of given intrinsics whose prior sigma counts in the covariance.
    doubted: IntArray = field(default_factory=lambda: np.zeros(0, dtype=int))

    @classmethod
    def of(
        cls, scene: Scene, corners: Mapping[int, Corners], shares: Mapping[int, float]
    ) -> "CornerProblem":
        """Builds the problem from the corners by view, and the weights of repeated views.

        Views without a share have weight one. Unstated corner weights are left to
        `CameraParameters.weighed`: errors of lens and board would pass for a view's noise.
        """
        positions = numbered_positions(scene.targets)
        stack = CornerStack.of(corners, positions)
        if stack.stated_px is None:
            stack = replace(stack, weights=None)
        priors = [board_prior(target) for target in scene.targets]
        return cls(
            scene,
            stack,
            positions,
            boards_basis(scene.targets),
            np.concatenate([lens_prior(scene), *priors]),
            np.array([shares.get(view, 1.0) for view in corners]),
        )

    def with_levels(self, levels: LensLevels) -> "CornerProblem":
        """Returns the problem with lens errors beyond the model."""
        zoomed = levels.jitter * zooms(self.stack, self.scene.camera)
        stack = replace(self.stack, zooms=zoomed if levels.jitter > 0.0 else None)
        return replace(self, stack=stack, levels=levels)

    def without_levels(self) -> "CornerProblem":
        """Returns the problem without lens errors beyond the model."""
        return replace(self, stack=replace(self.stack, zooms=None), levels=None)

    def with_lens_sigma(self, sigma: FloatArray, doubted: IntArray) -> "CornerProblem":
        """Returns the problem with prior sigmas (k,) of the intrinsics, and those that count."""
        boards = self.prior_sigma[len(self.lens) :]
        return replace(self, prior_sigma=np.concatenate([sigma, boards]), doubted=doubted)

    def without_prior(self, columns: IntArray) -> "CornerProblem":
        """Returns the problem without priors of some values."""
        sigma = self.prior_sigma.copy()
        sigma[columns] = np.inf
        return replace(self, prior_sigma=sigma)

    @property
    def lens(self) -> IntArray:
        """Columns of the intrinsics; they come first."""
        return np.arange(len(self.prior_sigma) - self.basis.shape[2])

    @property
    def printed(self) -> list[int]:
        """Indices of the printed targets: those with a scale, and possibly a bend."""
        return [at for at, target in enumerate(self.scene.targets) if target.kind != "points"]

    @property
    def scale(self) -> IntArray:
        """Columns of the printed boards' scales."""
        return self._joined(self.scale_of(board) for board in self.printed)

    @property
    def shape(self) -> IntArray:
        """Columns of the printed boards' aspects, shears and bends."""
        return self._joined(self.shape_of(board) for board in self.printed)

    @property
    def points(self) -> IntArray:
        """Columns of the rigs' points, if these are not exact."""
        rigs = set(range(len(self.scene.targets))) - set(self.printed)
        return self._joined(self.points_of(rig) for rig in sorted(rigs))

    def scale_of(self, board: int) -> IntArray:
        """Column (1,) of one printed board's scale."""
        return self.points_of(board)[:1]

    def shape_of(self, board: int) -> IntArray:
        """Columns (9,) of one printed board's aspect, shear and bend."""
        return self.points_of(board)[1:]

    def points_of(self, target: int) -> IntArray:
        """Columns of all unknowns of one target's corner positions."""
        columns = shape_slices(self.scene.targets, len(self.lens))[target]
        return np.arange(columns.start, columns.stop)

    def _joined(self, places: Iterable[IntArray]) -> IntArray:
        return np.concatenate([self.lens[:0], *places])

    def corners_of(self, board: int) -> slice:
        """Rows of one board's corners in `positions`."""
        starts = [*first_corners(self.scene.targets).tolist(), len(self.positions)]
        return slice(starts[board], starts[board + 1])

    @property
    def has_spare_corners(self) -> bool:
        """Whether there are enough residuals to estimate lens and board."""
        residuals = 2 * len(self.stack.px) - 6 * len(self.stack.views)
        return residuals >= _SPARE * (len(self.lens) + len(BOARD_NAMES) * len(self.printed))

    @property
    def is_refined_by_prior(self) -> bool:
        """Whether a given matrix is refined within its stated sigma, by corners too few to test it.

        The robot's motion determines it, too. Without a stated sigma it is held.
        """
        scene = self.scene
        is_stated = scene.matrix_sigma_px is not None and not scene.estimated
        return is_stated and scene.mode != "hold" and not self.has_spare_corners

    def unknowns(self, compressed: Compressed, moving: IntArray) -> int:
        """Number of unknowns that the corners have determined, including the poses.

        Where a rig's points have a tight prior, corners determine little of them, and reduce no
        residuals.
        """
        rigs = np.intersect1d(self.points, moving)
        sigma_px = self.stack.shown_px(compressed.residuals, 6 * len(compressed.information))
        information = np.diag(compressed.shared_information)[rigs] * self.prior_sigma[rigs] ** 2
        share = information / (information + floored_sigma_px(sigma_px) ** 2)
        exact = len(moving) - len(rigs) + round(compressed.field_freedom)
        return 6 * len(compressed.information) + exact + round(float(share.sum()))

    def sigma_px(self, compressed: Compressed, moving: IntArray) -> float:
        """Noise of a corner's coordinate [px]; see `CornerStack.sigma_px`."""
        return self.stack.sigma_px(compressed.residuals, self.unknowns(compressed, moving))

    @property
    def first(self) -> IntArray:
        """Columns that are free from the start."""
        if self.scene.estimated:
            return np.union1d(self.lens, self.points)
        if self.scene.mode == "refine" and self.has_spare_corners:
            return np.concatenate([self.lens, np.union1d(self.shape, self.points)])
        if self.is_refined_by_prior:
            return np.concatenate([self.lens[:4], self.points])
        return self.points

    @property
    def counted(self) -> IntArray:
        """Columns that count in the covariance, whether free or held."""
        if self.scene.estimated or self.contested:
            return np.concatenate([self.lens, np.union1d(self.scale, self.points)])
        stated = self.scene.matrix_sigma_px is not None
        lens = self.lens[:4] if stated else self.doubted
        return np.concatenate([lens, np.union1d(self.scale, self.points)])


def lens_prior(scene: Scene) -> FloatArray:
    """Prior sigmas of a camera's intrinsics; inf where there is no prior."""
    camera = scene.camera
    if scene.estimated:
        return np.full(4 + len(camera.distortion), np.inf)
    matrix = np.full(4, _FOCAL_SHARE * float(camera.matrix[:2].max()))
    if scene.matrix_sigma_px is not None:
        matrix = np.full(4, scene.matrix_sigma_px)
    return np.concatenate([matrix, np.full(len(camera.distortion), _DISTORTION_SIGMA)])
