"""What moves the poses of all views together, and what is known of it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.types import FloatArray, Mask


@dataclass(frozen=True, eq=False)
class Shared:
    """Unknowns by which all views move together: lens and board, and errors of the arm's links.

    Attributes:
        information: (k, k) on them, from the corners and from what is known beforehand.
        pull: (k,) half the gradient of what is known of them, where the camera poses were made.
        anchor: (k,) information that keeps some of them where they are while the fit moves: they
            are held, yet what is open about them counts in the covariance.
        by_camera: (m, 6, k) how each view's `cam_from_target` moves with them.
        by_flange: (m, 6, k) how each view's `base_from_flange` moves with them.
    """

    information: FloatArray
    pull: FloatArray
    anchor: FloatArray
    by_camera: FloatArray
    by_flange: FloatArray

    def subset(self, chosen: Mask) -> "Shared":
        """Returns the views of an (m,) mask."""
        return replace(self, by_camera=self.by_camera[chosen], by_flange=self.by_flange[chosen])

    def only(self, chosen: slice) -> "Shared":
        """Returns some of these unknowns alone, as if nothing were open about the others."""
        return Shared(
            self.information[chosen, chosen],
            self.pull[chosen],
            self.anchor[chosen],
            self.by_camera[:, :, chosen],
            self.by_flange[:, :, chosen],
        )

    def told(self, weights: FloatArray, slopes: FloatArray, residuals: FloatArray) -> "Shared":
        """Returns these unknowns with what residuals (m, d) tell of them that have no other ones.

        Args:
            weights: (m, d, d) inverse covariances of the residuals.
            slopes: (m, d, k) their derivatives.
            residuals: (m, d) where the camera poses were made.
        """
        weighted = np.swapaxes(slopes, 1, 2) @ weights
        return replace(
            self,
            information=self.information + np.sum(weighted @ slopes, axis=0),
            pull=self.pull + np.einsum("mij,mj->i", weighted, residuals),
        )

    def joined(self, other: "Shared") -> "Shared":
        """Returns these unknowns and others behind them, of which nothing is known in common."""
        return Shared(
            block_diag(self.information, other.information),
            np.concatenate([self.pull, other.pull]),
            np.concatenate([self.anchor, other.anchor]),
            np.concatenate([self.by_camera, other.by_camera], axis=2),
            np.concatenate([self.by_flange, other.by_flange], axis=2),
        )
