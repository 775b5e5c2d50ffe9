"""Coverage of the views so far, and advice for the next one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.calibration.stages.pnp import measure_poses
from visioncal.core.errors import VisioncalError
from visioncal.core.types import Camera, Corners, FloatArray, Mask, Target

# Cells of the image in which coverage is counted.
_ACROSS, _DOWN = 8, 5
# Assumed corner noise for the pose of a view [px]; advice needs no better.
_PIXEL_PX = 0.2
# Tilts below the first count as frontal; to separate the board's distance from the focal length
# some must exceed the second [deg].
_STRAIGHT_DEG, _LEANING_DEG = 10.0, 20.0
# Number of views before advice is given on tilt and distance.
_FIRST = 3
# Ratio below which the greatest and the least distance count as one.
_ONE_DISTANCE = 1.25
_COVERED = 0.8
_THIRDS = (("left", "middle", "right"), ("top", "middle", "bottom"))


@dataclass(eq=False)
class Coach:
    """Coverage of a recording by its views."""

    target: Target
    resolution: tuple[int, int]  # (width, height) of the images [px].
    camera: Camera | None  # Intrinsics for tilt and distance; None where they are not known.
    _covered_cells: Mask = field(init=False)
    _normals: list[FloatArray] = field(default_factory=list)
    _distances: list[float] = field(default_factory=list)
    _views: int = 0

    def __post_init__(self) -> None:
        self._covered_cells = np.zeros((_DOWN, _ACROSS), dtype=bool)

    def add(self, corners: Corners) -> None:
        """Takes a view into account."""
        self._views += 1
        cells = np.floor(corners.px * [_ACROSS, _DOWN] / self.resolution).astype(int)
        columns, rows = np.clip(cells, 0, [_ACROSS - 1, _DOWN - 1]).T
        self._covered_cells[rows, columns] = True
        for pose in self._poses(corners):
            # The target's z axis points into the board, away from the camera.
            self._normals.append(-pose[:3, 2])
            self._distances.append(float(np.linalg.norm(pose[:3, 3])))

    @property
    def coverage(self) -> float:
        """Share of the image that corners have covered."""
        return float(self._covered_cells.mean())

    def words(self) -> str:
        """States the coverage: `coverage 45 %, tilts to 32 deg, 0.4 to 0.7 m away`."""
        words = [f"coverage {100 * self.coverage:.0f} %"]
        if self._normals:
            words.append(f"tilts to {max(self._tilts()):.0f} deg")
            near, far = min(self._distances), max(self._distances)
            words.append(f"{near:.2f} to {far:.2f} m away")
        return ", ".join(words)

    def advice(self) -> str:
        """Advice for the next view, where a person chooses it; empty where nothing is missing."""
        return next(self._advice(), "")

    def _advice(self) -> Iterator[str]:
        if self._views < _FIRST:
            yield "another place, with the board large in the image"
            return
        if self._normals:
            tilts = np.array(self._tilts())
            if tilts.max() < _LEANING_DEG:
                yield f"tilt the camera: the steepest view leans by {tilts.max():.0f} deg only"
            yield from self._missing_tilt_axis(tilts)
            if max(self._distances) < _ONE_DISTANCE * min(self._distances):
                yield f"another distance: all views are about {self._distances[0]:.2f} m away"
        if self.coverage < _COVERED:
            yield f"bring the board to the {self._emptiest_region()} of the image"

    def _tilts(self) -> list[float]:
        """Angles between the optical axis and the board's normal [deg]."""
        return [
            float(np.rad2deg(np.arccos(np.clip(-normal[2], -1.0, 1.0)))) for normal in self._normals
        ]

    def _missing_tilt_axis(self, tilts: FloatArray) -> Iterator[str]:
        """Advises to tilt about an axis of the camera about which no view is tilted yet."""
        leaning = np.array(self._normals)[tilts > _STRAIGHT_DEG]
        if not len(leaning):
            return
        for axis, name in ((1, "x"), (0, "y")):
            if np.rad2deg(np.abs(leaning[:, axis])).max() < _STRAIGHT_DEG:
                yield f"tilt the camera about its {name}: no view leans that way"

    def _emptiest_region(self) -> str:
        """The third of the image, across and down, with the least coverage."""
        rows = np.array_split(np.arange(_DOWN), 3)
        columns = np.array_split(np.arange(_ACROSS), 3)
        shares = [[self._covered_cells[np.ix_(r, c)].mean() for c in columns] for r in rows]
        row, column = np.unravel_index(int(np.argmin(shares)), (3, 3))
        across, down = _THIRDS[0][column], _THIRDS[1][row]
        return across if down == "middle" else down if across == "middle" else f"{down} {across}"

    def _poses(self, corners: Corners) -> Sequence[FloatArray]:
        """Pose (4, 4) of the board in a view [m]; empty where it cannot be computed."""
        if self.camera is None:
            return ()
        by_view = {corners.view: corners}
        try:
            poses = measure_poses(by_view, (self.target,), self.camera, _PIXEL_PX)
        except VisioncalError:
            return ()
        return [view.cam_from_target[0] for view in poses]
