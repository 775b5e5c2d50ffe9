"""The report's plots: residuals, image coverage and coverage of orientations."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import Rotation

from visioncal.core.limits import CalibrationLimits
from visioncal.core.transforms import nearest_rotation
from visioncal.core.types import FloatArray
from visioncal.present.report import bars, svg
from visioncal.present.report.advice import contradicts
from visioncal.present.report.bars import Bar
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence

# Beyond this many marks a bitmap is smaller than the vectors.
_MANY_MARKS = 2500
# Widths of figures, such that their text is as large as the page's.
_WIDE_IN, _SMALL_IN = 9.2, 3.7


def residuals(calibration: Calibration, outlying: Collection[int] = ()) -> Markup:
    """Position, orientation and reprojection residual of every view.

    Args:
        calibration: The result.
        outlying: Numbers of used views that are marked, beside those that were not used.

    Returns:
        The figure; empty where there are no residuals.
    """
    limits = CalibrationLimits()
    panels: list[tuple[str, Callable[[ViewResult], float | None], float | None, float | None]] = [
        ("position [mm]", lambda view: view.residual_mm, calibration.rms.mm, limits.scatter_mm[0]),
        (
            "orientation [deg]",
            lambda view: view.residual_deg,
            calibration.rms.deg,
            limits.scatter_deg[0],
        ),
        ("reprojection [px]", lambda view: view.rms_px, calibration.rms.px, None),
    ]
    shown = [it for it in panels if any(it[1](view) is not None for view in calibration.views)]
    if not shown:
        return Markup("")
    with svg.style():
        figure = svg.new_figure(_WIDE_IN, 1.3 * len(shown) + 0.25, svg.Margins(0.75, 0.75))
        rows = figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0]
        for axes, (label, value_of, rms, limit) in zip(rows, shown, strict=True):
            _residual_panel(axes, calibration.views, value_of, rms, outlying, limit)
            axes.set_ylabel(label)
        rows[-1].set_xlabel("view")
        return svg.inline(figure, "residuals", "Bars: residuals of each view")


def _residual_panel(
    axes: Axes,
    views: Sequence[ViewResult],
    value_of: Callable[[ViewResult], float | None],
    rms: float | None,
    outlying: Collection[int],
    limit: float | None,
) -> None:
    """Bars by the view's place in the session."""
    bars.draw(
        axes,
        [Bar(str(it.view), value_of(it), it.used, _colour(it, outlying)) for it in views],
        rms,
        limit=limit,
    )


def _colour(view: ViewResult, outlying: Collection[int]) -> str:
    if view.used:
        return svg.CHECK if view.view in outlying else svg.ACCENT
    return svg.BAD if contradicts(view) else svg.MUTED


def image_coverage(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """All corners of the used views over the image frame, coloured by reprojection error."""
    used = {view.view for view in calibration.views if view.used}
    seen = [it for it in evidence if it.corners is not None and it.view in used]
    if not seen or calibration.camera is None:
        return Markup("")
    px = np.concatenate([it.corners.px for it in seen if it.corners is not None])
    errors = np.concatenate([corner_errors(it) for it in seen])
    known = np.isfinite(errors)
    width, height = calibration.camera.camera.resolution
    with svg.style():
        figure = svg.new_figure(
            _SMALL_IN, 0.5 + 0.75 * _SMALL_IN * height / width, svg.Margins(right=0.25)
        )
        axes = figure.subplots()
        marks: dict[str, Any] = {"s": 5, "linewidths": 0, "rasterized": len(px) > _MANY_MARKS}
        axes.scatter(px[~known, 0], px[~known, 1], color=svg.ACCENT, **marks)
        if known.any():
            top = float(np.percentile(errors[known], 98))
            marks |= {"c": errors[known], "cmap": "plasma", "vmin": 0.0, "vmax": top}
            coloured = axes.scatter(px[known, 0], px[known, 1], **marks)
            bar = figure.colorbar(coloured, ax=axes, shrink=0.8, extend="max")
            bar.set_label("reprojection error [px]")
            bar.outline.set_visible(False)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_aspect("equal")
        for spine in axes.spines.values():
            spine.set_visible(True)
        axes.set_xlabel("image x [px]")
        axes.set_ylabel("image y [px]")
        return svg.inline(figure, "coverage", "Corners of all used views over the image")


def corner_errors(evidence: ViewEvidence) -> FloatArray:
    """Distances [px] of a view's corners from their predictions; NaN where there is none."""
    if evidence.corners is None:
        return np.zeros(0)
    if evidence.predicted_px is None:
        return np.full(len(evidence.corners.px), np.nan)
    return np.asarray(np.linalg.norm(evidence.corners.px - evidence.predicted_px, axis=1))


def viewing_directions(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Where the camera looked at the target from: tilt against its normal, and azimuth."""
    poses = {it.view: it.cam_from_target for it in evidence if it.cam_from_target is not None}
    if not poses or calibration.mount == "instrument":
        return Markup("")
    used = {view.view for view in calibration.views if view.used}
    with svg.style():
        figure = svg.new_figure(_SMALL_IN, 3.0, svg.Margins(0.5, 0.5, 0.4, 0.4))
        axes = figure.add_subplot(projection="polar")
        for is_used, mark, colour, label in (
            (True, "o", svg.ACCENT, "used"),
            (False, "x", svg.BAD, "not used"),
        ):
            some = [pose for view, pose in poses.items() if (view in used) is is_used]
            if some:
                azimuth, tilt_deg = _tilt(np.stack(some))
                axes.plot(azimuth, tilt_deg, mark, color=colour, markersize=4.5, label=label)
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        axes.set_xticks(np.arange(0.0, 2 * np.pi, np.pi / 2), ["x", "y", "-x", "-y"])
        axes.set_ylim(0.0, max(45.0, 5.0 + axes.get_ylim()[1]))
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0f}\N{DEGREE SIGN}")
        if len(axes.lines) > 1:
            axes.legend(loc="lower left", bbox_to_anchor=(-0.32, -0.08))
        return svg.inline(figure, "directions", "Where the camera looked from")


def _tilt(cam_from_target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Azimuth [rad] and tilt [deg] of the place the camera looks from, in the target's frame."""
    optical_axis = cam_from_target[:, 2, :3]
    azimuth = np.arctan2(-optical_axis[:, 1], -optical_axis[:, 0])
    return azimuth, np.rad2deg(np.arccos(np.clip(optical_axis[:, 2], -1.0, 1.0)))


def flange_rotations(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """How far the flange turned from its mean orientation, about each of its own axes."""
    used = {view.view for view in calibration.views if view.used}
    poses = [
        it.base_from_flange
        for it in evidence
        if it.base_from_flange is not None and it.view in used
    ]
    if len(poses) < 2:
        return Markup("")
    rotations = np.stack(poses)[:, :3, :3]
    base_from_mean = nearest_rotation(rotations.mean(axis=0))
    turns_deg = np.rad2deg(Rotation.from_matrix(base_from_mean.T @ rotations).as_rotvec())
    with svg.style():
        figure = svg.new_figure(_SMALL_IN, 2.0, svg.Margins(left=0.5))
        axes = figure.subplots()
        for row in range(3):
            axes.plot(turns_deg[:, row], np.full(len(turns_deg), row), "|", color=svg.ACCENT,
                      markersize=17, markeredgewidth=1.4)  # fmt: skip
        axes.set_yticks(range(3), ["x", "y", "z"])
        axes.set_ylim(2.6, -0.6)
        reach = max(10.0, 1.1 * float(np.abs(turns_deg).max()))
        axes.set_xlim(-reach, reach)
        axes.set_xlabel("rotation from the mean orientation [deg]")
        axes.set_ylabel("flange axis")
        return svg.inline(figure, "rotations", "Rotations of the flange in the used views")
