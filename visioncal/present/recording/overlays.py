"""What was detected and predicted, drawn over the images."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.present.recording import colours, paths
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence, magnification
from visioncal.session import Session

# Rerun puts the image's corner, not the first pixel's centre, at the origin.
_CENTRE = 0.5
# Radii are shares of the image's width, so that they look alike in small and large images.
_DOT, _LINE = 1 / 280, 1 / 800


@dataclass(frozen=True)
class Overlay:
    """How residuals and corners are drawn, the same in all views.

    Attributes:
        factor: How many times longer residuals of used views are drawn than they are. Those of
            other views, which may be anything, are drawn to scale.
        used: The views that the fit used.
        width: Width of the images [px].
        active: Whether there is anything to draw in any view.
    """

    factor: int
    used: frozenset[int]
    width: float
    active: bool

    @classmethod
    def of(
        cls,
        session: Session,
        calibration: Calibration | None,
        evidence: Mapping[int, ViewEvidence],
    ) -> "Overlay":
        """Chooses the factor by the used views."""
        resolution = session.resolution
        if calibration is not None and calibration.camera is not None:
            resolution = calibration.camera.camera.resolution
        width = 1280 if resolution is None else resolution[0]
        views = () if calibration is None else calibration.views
        used = frozenset(it.view for it in views if it.used)
        shown = [it for view, it in evidence.items() if view in used]
        active = any(it.corners is not None for it in evidence.values())
        return cls(magnification(shown, width), used, float(width), active)

    def log_view(self, stream: rr.RecordingStream, seen: ViewEvidence) -> None:
        """Logs one view's corners and residuals at the stream's current time."""
        if not self.active:
            return
        corners, predicted = seen.corners, seen.predicted_px
        px = np.zeros((0, 2)) if corners is None else corners.px
        predicted_px = np.zeros((0, 2)) if predicted is None else predicted
        frame = rr.CoordinateFrame(paths.IMAGE_FRAME)
        # Empty batches take back what the view before has left.
        stream.log(
            paths.DETECTED,
            frame,
            rr.Points2D(px + _CENTRE, colors=colours.DETECTED, radii=_DOT * self.width),
        )
        stream.log(
            paths.PREDICTED,
            frame,
            rr.Points2D(
                predicted_px + _CENTRE, colors=colours.PREDICTED, radii=0.5 * _DOT * self.width
            ),
        )
        for entity, factor, wanted in (
            (paths.magnified_residuals(self.factor), self.factor, True),
            (paths.RESIDUALS_TO_SCALE, 1, False),
        ):
            paired = len(predicted_px) == len(px) and (seen.view in self.used) is wanted
            arrows = rr.Arrows2D(
                vectors=factor * (predicted_px - px) if paired else np.zeros((0, 2)),
                origins=px + _CENTRE if paired else np.zeros((0, 2)),
                colors=colours.RESIDUAL,
                radii=_LINE * self.width,
            )
            stream.log(entity, frame, arrows)
