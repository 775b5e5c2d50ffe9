"""Outlier rejection of corners and views by their reprojection residuals."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.vision.corners import CornerStack, mean_square_by_view
from visioncal.vision.poses import determines_pose

# Views differ in noise by a factor of two or so: eight sigma of all are four of the noisiest. A
# wrong corner is off by a good part of a square.
CORNER_SIGMAS = 8.0
# Views differ in blur and distance, so that their noise differs by two or three; a view with a
# wrong layout, a moving board or another board is off by far more.
VIEW_RATIO = 5.0
# Least rejection limits [px]: smaller errors do no harm.
CORNER_FLOOR_PX, VIEW_FLOOR_PX = 0.5, 1.0


@dataclass(frozen=True, eq=False)
class Gate:
    """Result of the gate: an (n,) mask of inlier corners, and a reason for each rejected view."""

    mask: Mask
    reasons: Mapping[int, str]

    @property
    def is_open(self) -> bool:
        """Whether everything passes."""
        return bool(self.mask.all())


def gate(stack: CornerStack, residuals: FloatArray) -> Gate:
    """Finds the corners, and views, whose reprojection residuals (n, 2) [px] exceed noise."""
    # Median of the length of a two-dimensional Gaussian: sqrt(2 ln 2) sigma (Rayleigh).
    length = np.linalg.norm(residuals, axis=1)
    sigma = np.median(length) / np.sqrt(2 * np.log(2))
    passes = length <= max(CORNER_SIGMAS * sigma, CORNER_FLOOR_PX)

    rms = np.sqrt(mean_square_by_view(stack, residuals))
    limit = max(VIEW_RATIO * float(np.median(rms)), VIEW_FLOOR_PX)
    kept = stack.sum_by_view(passes.astype(float))
    # A view's rms without its wrong corners, which do not make the view wrong.
    inner = np.sqrt(mean_square_by_view(stack, residuals * passes[:, None]))
    reasons = {}
    ends = stack.starts + stack.counts
    for at, view in enumerate(stack.views):
        rows = slice(stack.starts[at], ends[at])
        if (rms[at] > limit) & (inner[at] > limit):
            reasons[view] = (
                f"residual too large: {rms[at]:.2f} px (limit {limit:.2f}, set by the other views)"
            )
        # So is a view that loses half of its corners, or whose others do not determine its pose.
        elif 2.0 * kept[at] < stack.counts[at] or (
            kept[at] < stack.counts[at] and not determines_pose(stack.points[rows][passes[rows]])
        ):
            reasons[view] = (
                f"residual too large: only {kept[at]:.0f} of {stack.counts[at]} corners fit one "
                f"pose of the board, the rms is {rms[at]:.2f} px"
            )
    wrong = np.isin(stack.views, list(reasons))
    return Gate(passes & ~wrong[stack.view_of], reasons)
