"""Detected and predicted corners drawn over the images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present import result_parts
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence, magnification
from visioncal.session import Session

# Rerun's origin is the image's corner, not the first pixel's centre.
_CENTRE = 0.5
# Radii as shares of the image's width.
_DOT, _LINE = 1 / 280, 1 / 800


@dataclass(frozen=True)
class Overlay:
    """Style of corners and residuals, the same in all views."""

    # Magnification of the used views' residuals. Those of other views are drawn to scale, as they
    # may be arbitrarily large.
    factor: int
    used: frozenset[int]  # The views in the fit.
    width: float  # Width of the images [px].
    frames: Mapping[int, str]  # Frame of each image, by row.
    active: bool  # Whether any view has corners.

    @classmethod
    def of(
        cls, session: Session, calibration: Calibration | None, evidence: Mapping[int, ViewEvidence]
    ) -> "Overlay":
        """Chooses the magnification by the used views' residuals."""
        views = () if calibration is None else calibration.views
        width = None if calibration is None else result_parts.image_width(calibration)
        if width is None:
            width = 1280 if session.resolution is None else session.resolution[0]
        used = frozenset(view.view for view in views if view.used)
        shown = [seen_view for view, seen_view in evidence.items() if view in used]
        active = any(view.corners is not None for view in evidence.values())
        # Image frame of each view, by row.
        frames = dict.fromkeys(range(len(session.views)), paths.IMAGE_FRAME)
        if calibration is not None and calibration.cell is not None:
            seers = {seen.view.number: seen.seer for seen in session.observations}
            by_row = {row: seers.get(view.number, "") for row, view in enumerate(session.views)}
            lenses = calibration.cell.lenses
            frames = {row: paths.image_frame(at) for row, at in by_row.items() if at in lenses}
        return cls(magnification(shown, width), used, float(width), frames, active)

    def log_views(self, stream: rr.RecordingStream, seen: Sequence[ViewEvidence]) -> None:
        """Logs corners and residuals of all views, in the order of the session."""
        self._log_depth(stream, [view.depth for view in seen])
        if not self.active:
            return
        empty = np.zeros((0, 2))
        px = [empty if view.corners is None else view.corners.px for view in seen]
        predicted_px = [empty if view.predicted_px is None else view.predicted_px for view in seen]
        for entity, points_px, colour, size in (
            (paths.DETECTED, px, colours.DETECTED, _DOT),
            (paths.PREDICTED, predicted_px, colours.PREDICTED, 0.5 * _DOT),
        ):
            dots = rr.Points2D.from_fields(colors=colour, radii=size * self.width)
            positions = rr.Points2D.columns(positions=np.vstack(points_px) + _CENTRE)
            self._send(stream, entity, dots, positions, points_px)
        for entity, factor, is_used in (
            (paths.magnified_residuals(self.factor), self.factor, True),
            (paths.RESIDUALS_TO_SCALE, 1, False),
        ):
            pairs_px = [
                (begins, ends)
                if len(ends) == len(begins) and (view.view in self.used) is is_used
                else (empty, empty)
                for view, begins, ends in zip(seen, px, predicted_px, strict=True)
            ]
            begins_px, ends_px = zip(*pairs_px, strict=True)
            origins = np.vstack(begins_px)
            vectors = factor * (np.vstack(ends_px) - origins)
            arrows = rr.Arrows2D.columns(vectors=vectors, origins=origins + _CENTRE)
            style = rr.Arrows2D.from_fields(colors=colours.RESIDUAL, radii=_LINE * self.width)
            self._send(stream, entity, style, arrows, begins_px)

    def _log_depth(self, stream: rr.RecordingStream, depths: Sequence[FloatArray | None]) -> None:
        """Logs the deviations of depth, in radii by their size."""
        cells = [np.zeros((0, 5)) if part is None else part for part in depths]
        every = np.vstack(cells) if cells else np.zeros((0, 5))
        if not len(every):
            return
        most_m = max(float(np.quantile(np.abs(every[:, 3]), 0.98)), 1e-6)
        radii = 1.5 * _DOT * self.width * np.clip(np.abs(every[:, 3]) / most_m, 0.1, 1.0)
        colour = np.where(every[:, 3:4] > 0.0, colours.REJECTED, colours.USED)
        columns = rr.Points2D.columns(positions=every[:, :2] + _CENTRE, colors=colour, radii=radii)
        self._send(
            stream, paths.DEPTH, rr.Points2D.from_fields(colors=colours.USED), columns, cells
        )

    def _send(
        self,
        stream: rr.RecordingStream,
        entity: str,
        style: rr.Points2D | rr.Arrows2D,
        columns: rr.ComponentColumnList,
        parts: Sequence[FloatArray],
    ) -> None:
        """Sends what is drawn in the image; an empty part clears that of the previous view."""
        stream.log(entity, style, static=True)
        log_image_frames(stream, entity, self.frames)
        send_rows(
            stream, entity, range(len(parts)), columns.partition([len(part) for part in parts])
        )


def log_image_frames(stream: rr.RecordingStream, entity: str, frames: Mapping[int, str]) -> None:
    """Logs the image frame of an entity, by row."""
    names = set(frames.values())
    if len(names) == 1:
        stream.log(entity, rr.CoordinateFrame(*names), static=True)
    elif names:
        columns = rr.CoordinateFrame.columns(frame=list(frames.values()))
        send_rows(stream, entity, frames, columns)
