"""Dense corner refinement: fits a model of the image to all pixels around each corner."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeAlias

import cv2
import numpy as np

from visioncal.calibration.stages.detect import image_of
from visioncal.core.types import Camera, Corners, FloatArray, Image, Progress, Rejection
from visioncal.results.evidence import ExplainedImage, ViewEvidence
from visioncal.session import Session, View
from visioncal.vision.dense.blur import Blur
from visioncal.vision.dense.board_rendering import MAGNIFIED, DenseImage, render_board
from visioncal.vision.dense.fit import FittedCorners, fit_corners
from visioncal.vision.dense.library import ONE_TORCH_THREAD
from visioncal.vision.finders.template import Refined, refine

# Number of views that show whether smoothing helps, its sigma [px], and the share to which it has
# to reduce the scatter.
_SAMPLE, _SMOOTH_PX, _HELPS = 4, 0.7, 0.95
# Least share of fitted corners of a view; below it the template's are used.
_LEAST_FITTED = 0.5
_KINDS = ("charuco", "checkerboard")
_JPEG_QUALITY = 90
# Corners of an image by the template, and by the dense fit.
_Fit: TypeAlias = tuple[Refined, FittedCorners | None]


@dataclass(frozen=True, eq=False)
class Dense:
    """Settings and results of dense corner fits.

    Attributes:
        device: Torch device: `cpu` or `cuda`.
        fits: Fitted corners by view.
        threads: Number of parallel images on the CPU; 0 for one a core.
    """

    device: str
    fits: Mapping[int, FittedCorners] = field(default_factory=dict)
    threads: int = 0

    @property
    def blurs(self) -> dict[int, Blur]:
        """The point-spread function of each view's image."""
        return {view: fit.blur for view, fit in self.fits.items()}

    def notes(self) -> tuple[str, ...]:
        """Sentences on what blurs the images."""
        words = []
        moved, focus = (
            {view: blur for view, blur in self.blurs.items() if blur.cause == cause}
            for cause in ("motion", "focus")
        )
        if moved:
            view, worst = max(moved.items(), key=lambda pair: pair[1].length_px)
            words.append(
                f"Motion smears {len(moved)} of {len(self.fits)} images, by up to "
                f"{worst.length_px:.1f} px (view {view}, at {worst.direction_deg:.0f} deg from the "
                "image's rows): stand still for longer before an image, or expose for less."
            )
        if focus:
            view, worst = max(focus.items(), key=lambda pair: pair[1].width_px)
            are = "is" if len(focus) == 1 else "are"
            words.append(
                f"{len(focus)} of {len(self.fits)} images {are} out of focus, with edges up to "
                f"{worst.width_px:.1f} px wide as a sigma (view {view}): set the focus to the "
                "distance of the board, or close the aperture."
            )
        return tuple(words)


def fit_densely(
    session: Session,
    views: Sequence[View],
    corners: Mapping[int, Corners],
    dense: Dense,
    progress: Progress | None = None,
) -> tuple[dict[int, Corners], Dense]:
    """Fits the corners of views by all pixels around them.

    Args:
        session: The session.
        views: Its views.
        corners: Detected corners by view, in their own board's numbers.
        dense: Settings, and earlier results.
        progress: Called after each image.

    Returns:
        The corners with their weights, and the results. Corners by other detectors stay as they
        are.
    """
    boards, board_of = session.boards, session.board_of
    mine = [
        view
        for view in views
        if view.number in corners
        and view.image
        and not view.has_corners
        and boards[board_of(view)].kind in _KINDS
    ]

    def fit(view: View, smooth_px: float) -> _Fit | None:
        image = image_of(session, view)
        if isinstance(image, Rejection):
            return None
        target, seen = boards[board_of(view)], corners[view.number]
        start = refine(image, target, seen.ids, seen.px)
        fitted = fit_corners(
            image,
            target,
            seen.ids,
            start.px,
            start.blur_px,
            device=dense.device,
            smooth_px=smooth_px,
        )
        return start, fitted

    # One thread keeps a GPU busy.
    threads = (dense.threads or os.cpu_count() or 1) if dense.device == "cpu" else 1
    found = {}
    with ONE_TORCH_THREAD.held(), ThreadPoolExecutor(threads) as pool:
        sample = mine[:: max(1, len(mine) // _SAMPLE)][:_SAMPLE]
        both = [
            list(pool.map(lambda view, px=px: fit(view, px), sample)) for px in (0.0, _SMOOTH_PX)
        ]
        smooths = _smoothing_helps(*both)
        ready = dict(zip((view.number for view in sample), both[smooths], strict=True))
        rest = [view for view in mine if view.number not in ready]
        others = pool.map(lambda view: fit(view, smooths * _SMOOTH_PX), rest)
        pairs = chain(ready.items(), zip((view.number for view in rest), others, strict=True))
        for view, pair in pairs:
            if pair is not None:
                found[view] = pair
            if progress is not None:
                progress("dense", len(found), len(mine))
    fits = {
        view: fitted
        for view, (_, fitted) in found.items()
        if fitted is not None and fitted.fitted.mean() >= _LEAST_FITTED
    }
    sigmas = {view: fits[view].sigma_px if view in fits else start.sigma_px
              for view, (start, _) in found.items()}  # fmt: skip
    all_sigmas = np.concatenate([np.zeros(0), *sigmas.values()])
    typical_px = float(np.nanmedian(all_sigmas)) if np.isfinite(all_sigmas).any() else 1.0
    weighted = {
        view: _weighted(corners[view], fits.get(view), typical_px / sigmas[view]) for view in found
    }
    return {**corners, **weighted}, replace(dense, fits={**dense.fits, **fits})


def _smoothing_helps(plain: Sequence[_Fit | None], smooth: Sequence[_Fit | None]) -> bool:
    """Whether corners scatter less with image and model smoothed alike."""
    shares = [
        after[1].scatter_px / before[1].scatter_px
        for before, after in zip(plain, smooth, strict=True)
        if before is not None and before[1] is not None
        and after is not None and after[1] is not None and before[1].scatter_px > 0.0
    ]  # fmt: skip
    return bool(shares) and float(np.median(shares)) < _HELPS


def _weighted(seen: Corners, fit: FittedCorners | None, weights: FloatArray) -> Corners:
    """Fitted corners, or else the template's, with weights where they are known."""
    known = np.isfinite(weights)
    if fit is None and known.any():
        return replace(seen, weights=np.where(known, weights, np.nanmin(weights)))
    if fit is None:
        return seen
    return replace(
        seen,
        ids=seen.ids[known],
        px=fit.px[known],
        blur_px=fit.blur.width_px,
        weights=weights[known],
    )


def explained(
    session: Session, evidence: Sequence[ViewEvidence], dense: Dense, camera: Camera
) -> tuple[ViewEvidence, ...]:
    """Adds rendered images and their residuals to the evidence of views."""
    rows = {view.number: view for view in session.views}

    def explained(seen: ViewEvidence) -> ViewEvidence:
        fit, px = dense.fits.get(seen.view), seen.predicted_px
        if fit is None or px is None or seen.corners is None:
            return seen
        view = rows[seen.view]
        image = image_of(session, view)
        if isinstance(image, Rejection):
            return seen
        target = session.boards[session.board_of(view)]
        rendered = render_board(image, target, seen.corners.ids, px, camera, fit.blur, fit.tone)
        if rendered is None:
            return seen
        drawn, rest = (_as_jpeg(array) for array in (rendered.rendered, rendered.difference))
        return replace(seen, explained=ExplainedImage(drawn, rest, _words(fit, rendered)))

    with ONE_TORCH_THREAD.held(), ThreadPoolExecutor(dense.threads or os.cpu_count() or 1) as pool:
        return tuple(pool.map(explained, evidence))


def _as_jpeg(image: Image) -> bytes:
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return bytes(cv2.imencode(".jpg", image, quality)[1].tobytes())


def _words(fit: FittedCorners, rendered: DenseImage) -> str:
    """Blur and unexplained residual of an image, in words."""
    blur = fit.blur
    causes = {"motion": "Smeared by motion", "focus": "Out of focus", "": "Sharp"}
    return (
        f"**{causes[blur.cause]}.** Edges are {blur.width_px:.2f} px wide as a sigma: a Gaussian "
        f"of {blur.sigma_px:.2f} px, a disc of {blur.disc_px:.2f} px radius, and a line of "
        f"{blur.length_px:.2f} px at {blur.direction_deg:.0f} deg from the image's rows.\n\n"
        f"What is not explained has an rms of {rendered.difference_rms:.1f} grey levels on the "
        f"board, about its corners alone {fit.noise:.1f}; it is drawn {MAGNIFIED} times as strong. "
        "Edges that show on one side light and on the other dark are where the board is not where "
        "the calibration has it."
    )
