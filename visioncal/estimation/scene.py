"""What one camera looks at, its corners, and what is known of lens and boards beforehand."""

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

# The frame of the only camera, where there is one.
ONLY_CAMERA = "cam"
# Corners must be left over to judge by: so many residuals for each unknown.
_SPARE = 10
# Given intrinsics that are set free are known to so much without the session: the focal length and
# the centre as shares of the focal length, and the distortion's coefficients.
_FOCAL_SHARE, _DISTORTION_SIGMA = 0.05, 0.3


@dataclass(frozen=True, eq=False)
class Scene:
    """What is looked at, and with what.

    Attributes:
        targets: What was printed, as stated; the corners of several are numbered through.
        camera: The intrinsics.
        estimated: Whether they were estimated from these corners.
        mode: What to do with given ones: `hold`, `refine` or `auto`.
        matrix_sigma_px: What given fx, fy, cx, cy are known to; None where that is not said.
        names: What several targets are called.
        is_focus_fixed: Whether the focal length follows neither the distance nor chance.
    """

    targets: tuple[Target, ...]
    camera: Camera
    estimated: bool
    mode: str = "auto"
    matrix_sigma_px: float | None = None
    names: tuple[str, ...] = ("",)
    is_focus_fixed: bool = False


def repeat_shares(shown: Mapping[int, Hashable]) -> dict[int, float]:
    """As how much of a view those count that show the same: one image in all.

    What a lens, a print or a detector does to one of them it does to all.

    Args:
        shown: What each view shows from where, by its number; alike where that is the same.
    """
    counts = Counter(shown.values())
    return {view: 1.0 / counts[what] for view, what in shown.items()}


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
        levels: Sizes of what the lens does beyond its model; None before they were estimated.
        doubted: Places of given intrinsics that may be off by as much as they are known to.
    """

    scene: Scene
    stack: CornerStack
    positions: FloatArray
    basis: FloatArray
    prior_sigma: FloatArray
    shares: FloatArray
    contested: bool = False
    levels: LensLevels | None = None
    doubted: IntArray = field(default_factory=lambda: np.zeros(0, dtype=int))

    @classmethod
    def of(
        cls, scene: Scene, corners: Mapping[int, Corners], shares: Mapping[int, float]
    ) -> "CornerProblem":
        """Puts the problem together from the corners by view, and the shares of those that repeat.

        Where a view has no share, it counts as one. Weights that nobody has stated are left to
        `CameraParameters.weighed`: what lens and board do to a view had passed for its noise.
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
        """The same problem, its lens erring beyond its model."""
        zoomed = levels.jitter * zooms(self.stack, self.scene.camera)
        stack = replace(self.stack, zooms=zoomed if levels.jitter > 0.0 else None)
        return replace(self, stack=stack, levels=levels)

    def without_levels(self) -> "CornerProblem":
        """The same problem, its lens being what its model says."""
        return replace(self, stack=replace(self.stack, zooms=None), levels=None)

    def with_lens_sigma(self, sigma: FloatArray, doubted: IntArray) -> "CornerProblem":
        """The same problem, the intrinsics being known to (k,), and those in doubt counting."""
        boards = self.prior_sigma[len(self.lens) :]
        return replace(self, prior_sigma=np.concatenate([sigma, boards]), doubted=doubted)

    def without_prior(self, columns: IntArray) -> "CornerProblem":
        """The same problem, some values of which nobody has stated."""
        sigma = self.prior_sigma.copy()
        sigma[columns] = np.inf
        return replace(self, prior_sigma=sigma)

    @property
    def lens(self) -> IntArray:
        """Places of the intrinsics among the values; they come first."""
        return np.arange(len(self.prior_sigma) - self.basis.shape[2])

    @property
    def printed(self) -> list[int]:
        """Which targets are printed: those that have a scale, and may be bent."""
        return [at for at, target in enumerate(self.scene.targets) if target.kind != "points"]

    @property
    def scale(self) -> IntArray:
        """Places of the printed boards' scales."""
        return self._joined(self.scale_of(board) for board in self.printed)

    @property
    def shape(self) -> IntArray:
        """Places of the printed boards' aspects, shears and bends."""
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
        """Places (9,) of one printed board's aspect, shear and bend."""
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
        """How many unknowns the corners have determined, the poses among them.

        Where a rig's points are known well beforehand, corners determine little of them, and
        residuals are no smaller for their sake.
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
        """What is free from the start."""
        if self.scene.estimated:
            return np.union1d(self.lens, self.points)
        if self.scene.mode == "refine" and self.has_spare_corners:
            return np.concatenate([self.lens, np.union1d(self.shape, self.points)])
        return self.points

    @property
    def counted(self) -> IntArray:
        """What is uncertain and counts in the covariance, whether it is free or not."""
        if self.scene.estimated or self.contested:
            return np.concatenate([self.lens, np.union1d(self.scale, self.points)])
        stated = self.scene.matrix_sigma_px is not None
        lens = self.lens[:4] if stated else self.doubted
        return np.concatenate([lens, np.union1d(self.scale, self.points)])


def lens_prior(scene: Scene) -> FloatArray:
    """What a camera's intrinsics are known to beforehand; inf where nothing is."""
    camera = scene.camera
    if scene.estimated:
        return np.full(4 + len(camera.distortion), np.inf)
    matrix = np.full(4, _FOCAL_SHARE * float(camera.matrix[:2].max()))
    if scene.matrix_sigma_px is not None:
        matrix = np.full(4, scene.matrix_sigma_px)
    return np.concatenate([matrix, np.full(len(camera.distortion), _DISTORTION_SIGMA)])
