"""What the views so far cover, and what the next one should be."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.calibration.stages.pnp import measure_poses
from visioncal.core.errors import VisioncalError
from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target

# The image is divided so, to find what no corner reached.
_ACROSS, _DOWN = 8, 5
# Noise of a corner by which a view's pose is found [px]; words need no better.
_PIXEL_PX = 0.2
# Views that look from less than this are alike in tilt; to separate the board's distance from the
# lens's length they must lean farther [deg].
_STRAIGHT_DEG, _LEANING_DEG = 10.0, 20.0
# A few views are for the eye, before anything is asked of them.
_FIRST = 3
# All views at distances within this share are at one distance.
_ONE_DISTANCE = 1.25
_COVERED = 0.8
_THIRDS = (("left", "middle", "right"), ("top", "middle", "bottom"))


@dataclass(eq=False)
class Coach:
    """Follows the views of a recording.

    Attributes:
        target: What is seen.
        resolution: (width, height) of the images [px].
        camera: The lens, by which tilt and distance are computed; None where it is not known.
    """

    target: Target
    resolution: tuple[int, int]
    camera: Camera | None
    _reached: Mask = field(init=False)
    _normals: list[FloatArray] = field(default_factory=list)
    _distances: list[float] = field(default_factory=list)
    _views: int = 0

    def __post_init__(self) -> None:
        self._reached = np.zeros((_DOWN, _ACROSS), dtype=bool)

    def add(self, corners: Corners) -> None:
        """Takes a view into account."""
        self._views += 1
        place = np.floor(corners.px * [_ACROSS, _DOWN] / self.resolution).astype(int)
        columns, rows = np.clip(place, 0, [_ACROSS - 1, _DOWN - 1]).T
        self._reached[rows, columns] = True
        for pose in self._poses(corners):
            # The target's z axis points into the board, away from who looks at it.
            self._normals.append(-pose[:3, 2])
            self._distances.append(float(np.linalg.norm(pose[:3, 3])))

    @property
    def coverage(self) -> float:
        """The share of the image that corners have reached."""
        return float(self._reached.mean())

    def words(self) -> str:
        """What is covered: `coverage 45 %, tilts to 32 deg, 0.4 to 0.7 m away`."""
        words = [f"coverage {100 * self.coverage:.0f} %"]
        if self._normals:
            words.append(f"tilts to {max(self._tilts()):.0f} deg")
            near, far = min(self._distances), max(self._distances)
            words.append(f"{near:.2f} to {far:.2f} m away")
        return ", ".join(words)

    def advice(self) -> str:
        """What the next view should be, where a person chooses it; empty where all is there."""
        return next(self._advice(), "")

    def _advice(self) -> Iterator[str]:
        if self._views < _FIRST:
            yield "another place, with the board large in the image"
            return
        if self._normals:
            tilts = np.array(self._tilts())
            if tilts.max() < _LEANING_DEG:
                yield f"tilt the camera: the steepest view leans by {tilts.max():.0f} deg only"
            yield from self._missing_side(tilts)
            if max(self._distances) < _ONE_DISTANCE * min(self._distances):
                yield f"another distance: all views are about {self._distances[0]:.2f} m away"
        if self.coverage < _COVERED:
            yield f"bring the board to the {self._empty()} of the image"

    def _tilts(self) -> list[float]:
        """The angles between the optical axis and the board's normal [deg]."""
        return [
            float(np.rad2deg(np.arccos(np.clip(-normal[2], -1.0, 1.0)))) for normal in self._normals
        ]

    def _missing_side(self, tilts: FloatArray) -> Iterator[str]:
        """Names the axis of the camera about which no view leans yet."""
        leaning = np.array(self._normals)[tilts > _STRAIGHT_DEG]
        if not len(leaning):
            return
        for axis, name in ((1, "x"), (0, "y")):
            if np.rad2deg(np.abs(leaning[:, axis])).max() < _STRAIGHT_DEG:
                yield f"tilt the camera about its {name}: no view leans that way"

    def _empty(self) -> str:
        """The third of the image, across and down, in which least was reached."""
        rows = np.array_split(np.arange(_DOWN), 3)
        columns = np.array_split(np.arange(_ACROSS), 3)
        shares = [[self._reached[np.ix_(r, c)].mean() for c in columns] for r in rows]
        row, column = np.unravel_index(int(np.argmin(shares)), (3, 3))
        across, down = _THIRDS[0][column], _THIRDS[1][row]
        return across if down == "middle" else down if across == "middle" else f"{down} {across}"

    def _poses(self, corners: Corners) -> Sequence[FloatArray]:
        """The pose of the board in a view, (4, 4); nothing where it cannot be computed."""
        if self.camera is None:
            return ()
        seen = {corners.view: corners}
        try:
            found = measure_poses(seen, (self.target,), self.camera, _PIXEL_PX)
        except VisioncalError:
            return ()
        return [view.cam_from_target[0] for view in found]
