"""How well the edges are known, in the cell: ellipsoids, and where each view puts the target.

Both are far too small to be seen at their true size, so both are drawn larger by one factor,
which their names say.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from visioncal.core.types import FloatArray
from visioncal.present import parts
from visioncal.present.placements import placement
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.results import Calibration, Edge
from visioncal.results.evidence import ViewEvidence

# Half axes of the ellipsoid that holds a point in 95 % of cases, in standard deviations: the root
# of the chi-square distribution's quantile for three degrees of freedom.
SIGMAS_95 = 2.795
# How large the largest of them is drawn, as a share of the cell's size.
_SHARE = 0.07
# Placements beyond this are drawn here, as shares of the same: wrong views lie anywhere.
_REACH = 0.2
_POINT, _LINE = 0.005, 0.0015


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is drawn of the uncertainty.

    Attributes:
        edges: The edges that have a covariance, by name; tools and fixtures among them.
        scatter_m: By view, how far from the result it puts its target: (3,) in the target's frame.
        frames: By view, the frame of its target.
        used: The views that the fit used.
        factor: How many times larger than it is everything is drawn.
        size_m: The cell's size [m].
    """

    edges: Mapping[str, Edge]
    scatter_m: Mapping[int, FloatArray]
    frames: Mapping[int, str]
    used: frozenset[int]
    factor: int
    size_m: float

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        evidence: Mapping[int, ViewEvidence],
        size_m: float,
        frames: Mapping[int, str] | None = None,
    ) -> "Uncertainty":
        """Collects the placements and chooses the factor by the used views.

        Args:
            calibration: The result.
            evidence: What each view shows.
            size_m: The cell's size [m].
            frames: By view, the frame of its target; the only one's where None.
        """
        used = frozenset(view.view for view in calibration.views if view.used)
        if frames is None:
            frames = dict.fromkeys(evidence, list(calibration.edges)[1].rpartition("_from_")[2])
        scatter_m = {
            view: placed[:3, 3]
            for view, other in evidence.items()
            if view in frames
            and (placed := placement(calibration, other, frames[view])) is not None
        }
        last = parts.frames(calibration).matrices
        edges = {
            name: edge
            for name, edge in calibration.placed.items()
            if edge.covariance.any() and name.rpartition("_from_")[2] in last
        }
        sizes_m = [SIGMAS_95 * _axes(edge)[0].max() for edge in edges.values()]
        sizes_m += [float(np.linalg.norm(scatter_m[view])) for view in scatter_m.keys() & used]
        factor = round_factor(_SHARE * size_m, max(sizes_m, default=0.0))
        return cls(edges, scatter_m, frames, used, factor, size_m)

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Draws the ellipsoids, and all views' placements of the target."""
        for name, edge in self.edges.items():
            self._log_ellipsoid(stream, name, edge)
        for name, colour, wanted in (
            (paths.USED, colours.USED, True),
            (paths.REJECTED, colours.REJECTED, False),
        ):
            some = [view for view in self.scatter_m if (view in self.used) is wanted]
            for frame in self._frames_of(some):
                positions_m = self._positions_m(some, frame)
                points = rr.Points3D(positions_m, colors=colour, radii=_POINT * self.size_m)
                entity = f"{self._placements(frame)}/{name}"
                stream.log(entity, rr.CoordinateFrame(frame), points, static=True)
        for frame in self._frames_of(self.scatter_m):
            self._log_beyond(stream, frame)

    def _frames_of(self, views: Iterable[int]) -> list[str]:
        return sorted({self.frames[view] for view in views})

    def _log_ellipsoid(self, stream: rr.RecordingStream, name: str, edge: Edge) -> None:
        child = name.rpartition("_from_")[2]
        entity = f"{paths.entity_of(child)}/{name}_95_percent_magnified_{self.factor}x"
        frame = rr.CoordinateFrame(child)
        sigmas_m, axes = _axes(edge)
        ellipsoid = rr.Ellipsoids3D(
            half_sizes=[SIGMAS_95 * self.factor * sigmas_m],
            quaternions=[Rotation.from_matrix(axes).as_quat()],
            colors=colours.UNCERTAINTY,
            line_radii=_LINE * self.size_m,
        )
        stream.log(entity, frame, ellipsoid, static=True)
        if child not in (paths.TARGET_FRAME, *self.frames.values()):
            # All are drawn alike, and tools are close to the camera: more labels would hide them.
            return
        # Beside the board, clear of the name of the frame.
        label = rr.Points3D(
            [[0.0, -2.0 * _SHARE * self.size_m, 0.0]],
            radii=0.0,
            colors=colours.UNCERTAINTY,
            labels=f"95 %, {self.factor} x",
            show_labels=True,
        )
        stream.log(f"{entity}/label", frame, label, static=True)

    def log_views(self, stream: rr.RecordingStream, views: Sequence[int]) -> None:
        """Marks each view's placement of the target when it is looked at.

        Args:
            stream: Where to.
            views: All, in the order of the session.
        """
        for frame in self._frames_of(self.scatter_m):
            # Of the other targets, nothing takes the mark of the view before off the screen.
            marked = [self._positions_m([view] * (view in self.scatter_m), frame) for view in views]
            entity = f"{self._placements(frame)}/{paths.THIS_VIEW}"
            radius = 1.5 * _POINT * self.size_m
            style = rr.Points3D.from_fields(colors=colours.THIS_VIEW, radii=radius)
            stream.log(entity, rr.CoordinateFrame(frame), style, static=True)
            points = rr.Points3D.columns(positions=np.vstack(marked))
            parts = points.partition([len(array) for array in marked])
            send_rows(stream, entity, range(len(views)), parts)

    def _positions_m(self, views: Iterable[int], frame: str) -> FloatArray:
        """(k, 3) where the placements of a target by some views are drawn, in its frame."""
        shown = [view for view in views if self.frames[view] == frame]
        places_m = [self._within_reach(self.factor * self.scatter_m[index]) for index in shown]
        return np.reshape(places_m, (-1, 3))

    def _placements(self, frame: str) -> str:
        return f"{paths.entity_of(frame)}/placements_magnified_{self.factor}x"

    def _log_beyond(self, stream: rr.RecordingStream, frame: str) -> None:
        """Arrows towards the placements that lie too far out to be drawn."""
        mine = [array for view, array in self.scatter_m.items() if self.frames[view] == frame]
        drawn_m = [self.factor * array for array in mine]
        far = [array for array in drawn_m if np.linalg.norm(array) > _REACH * self.size_m]
        if far:
            arrows = rr.Arrows3D(
                vectors=[self._within_reach(array) for array in far],
                origins=np.zeros((len(far), 3)),
                colors=colours.REJECTED,
                radii=_LINE * self.size_m,
            )
            entity = f"{self._placements(frame)}/{paths.BEYOND}"
            stream.log(entity, rr.CoordinateFrame(frame), arrows, static=True)

    def _within_reach(self, drawn_m: FloatArray) -> FloatArray:
        reach_m = _REACH * self.size_m
        return drawn_m * min(1.0, reach_m / max(float(np.linalg.norm(drawn_m)), 1e-12))


def _axes(edge: Edge) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (3,) [m] along the columns of a (3, 3) rotation, in the child's frame."""
    variances_m2, axes = np.linalg.eigh(edge.covariance[3:, 3:])
    return np.sqrt(np.clip(variances_m2, 0.0, None)), axes * np.sign(np.linalg.det(axes))


def round_factor(wanted_m: float, size_m: float) -> int:
    """The largest of 1, 2, 5, 10, 20 ... by which a size stays under the wanted one."""
    if not size_m > 0.0:
        return 1
    ratio = max(wanted_m / size_m, 1.0)
    decade = 10 ** int(np.floor(np.log10(ratio)))
    return int(max(step * decade for step in (1, 2, 5) if step * decade <= ratio))
