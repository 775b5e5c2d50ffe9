"""A tilted pane of glass before a lens, as of a housing, which shifts rays by their angle to it."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.model.arm import Moments
from visioncal.model.effects.effect import Displacement, Size

# By so much a normal is turned for its slopes [rad].
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Window(Displacement):
    """A pane's thickness, and that times how its normal is turned, about two axes [m].

    Seen through it, points are nearer along its normal by t (1 - cos / sqrt(n^2 - sin^2)), of the
    ray's angle to the normal (Born and Wolf, Principles of Optics, 4.9). The shift of points on the
    optical axis is left out: the lens's place is that from which it seems to look, as picks
    through the same pane need it.
    """

    kind, bounds, count, is_positive = "window", (3e-3, 1e-6, 0.05), 3, True
    clause = "it was seen through a tilted pane of glass"
    normal: tuple[float, float, float]  # About the pane's normal, in the camera's frame.

    @classmethod
    def tried(cls, camera: str) -> "tuple[Window, ...]":
        """Panes of several tilts, in all directions."""
        tilts, turns = np.deg2rad(np.arange(15.0, 61.0, 15.0)), np.deg2rad(np.arange(0, 360, 30))
        return tuple(
            cls(camera, (np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
            for tilt in tilts.tolist()
            for turn in turns.tolist()
        )

    @property
    def size(self) -> Size:
        """See `Effect`."""
        # Likelihood ratio of a pane: a lens that departs from its model is commoner by far.
        return replace(super().size, limit=40.0)

    def pane(self, values: FloatArray) -> tuple[float, FloatArray]:
        """Thickness [m] and (3,) normal of (3,) values."""
        normal = self._normals()[0] + values[1:] @ self._tangents() / values[0]
        return float(values[0]), normal / np.linalg.norm(normal)

    def moved(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """See `Displacement`."""
        del poses
        still, *turned = (self._shift(points, normal) for normal in self._normals())
        return np.stack([still, *((at - still) / _STEP for at in turned)], axis=2)

    def moved_first(self, points: FloatArray, poses: FloatArray) -> FloatArray:
        """See `Displacement`."""
        del poses
        return self._shift(points, np.array(self.normal))

    @staticmethod
    def _shift(points: FloatArray, normal: FloatArray) -> FloatArray:
        """(n, 3) of (n, 3) points, less that of the optical axis."""
        return nearer(np.array([[0.0, 0.0, 1.0]]), normal) - nearer(points, normal)

    def _tangents(self) -> FloatArray:
        """(2, 3) unit vectors across the normal."""
        return np.asarray(np.linalg.svd(np.array([self.normal]))[2][1:])

    def _normals(self) -> FloatArray:
        """(3, 3) the normal, and the normal after a small turn about each of two axes."""
        normals = np.array(self.normal) + _STEP * np.vstack([np.zeros(3), self._tangents()])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def columns(self, moments: Moments, distances: FloatArray) -> FloatArray:
        """See `Effect`: (k, 3, 3) of its values, the same at all moments."""
        del distances
        return np.tile(np.eye(3), (len(moments), 1, 1))


def nearer(points: FloatArray, normal: FloatArray) -> FloatArray:
    """(n, 3) vectors by which (n, 3) points seem nearer, for a pane of thickness one."""
    cosine = points @ normal / np.linalg.norm(points, axis=1)
    # Refractive index of glass and of acrylic.
    share = 1.0 - cosine / np.sqrt(1.5**2 - 1.0 + cosine**2)
    return np.asarray(share[:, None] * normal)
