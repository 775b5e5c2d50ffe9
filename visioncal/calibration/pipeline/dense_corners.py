"""Calibrating with corners by all pixels around them, kept only where unseen views agree."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Unpack

import numpy as np

from visioncal.calibration.pipeline.running import Asked, Run, run
from visioncal.calibration.stages.dense import Dense, explained
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.number_format import figure
from visioncal.results import Calibration, Rms
from visioncal.results.sections import CornerResiduals, DenseResult, ImageBlur
from visioncal.session import Session
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.dense.library import chosen_device

# What is worse by less standard errors is chance.
_CHANCE = 2.0


def _is_worse(before: Run, after: Run) -> bool:
    """Whether views that were left out are predicted worse, in pixels or in millimetres."""
    # That is so where their squared errors grow in the mean, by more than chance explains.
    views = sorted(before.left_out.keys() & after.left_out.keys())
    growth = np.array(
        [np.square(after.left_out[view]) - np.square(before.left_out[view]) for view in views]
    )
    growth = growth[np.isfinite(growth).all(axis=1)]
    if len(growth) < 2:
        return True
    chance = _CHANCE * growth.std(axis=0, ddof=1) / np.sqrt(len(growth))
    return bool(np.any(growth.mean(axis=0) > chance))


def _words(before: Rms, after: Rms, *, kept: bool) -> str:
    """What both predict, in a sentence."""
    return (
        f"Dense corners are {'kept' if kept else 'not kept'}: with them, views that were left out "
        f"are predicted to {_figures(after)}, with those of the template to {_figures(before)}."
    )


def _figures(rms: Rms) -> str:
    px = "" if rms.px is None else f"{figure(rms.px)} px and "
    return f"{px}{figure(rms.mm)} mm"


def run_dense(session: Session, *, device: str = "auto", **asked: Unpack[Asked]) -> Run:
    """Calibrates a session by the template's corners and by dense ones; see `calibrate`.

    Args:
        session: The session.
        device: What torch works on: `auto` for a GPU where there is one, `cpu` or `cuda`.
        asked: See `calibrate`.

    Returns:
        The one with dense corners, unless it predicts views that were left out worse than the
        other, by more than chance. Either says what both predict.

    Raises:
        DataError: torch or kornia is missing, there are no images of boards, or as `calibrate`.
    """
    if is_whole_cell(session):
        raise DataError(
            "dense corners cannot be asked of a whole cell.",
            culprits=["--dense"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    on = chosen_device(device)
    if not any(board.kind in ("charuco", "checkerboard") for board in session.boards.values()):
        raise DataError(
            "--dense needs images of a checkerboard or a ChArUco board; this session has none.",
            culprits=["--dense"],
            next_step="Leave it out.",
        )

    plain = run(session, **asked)
    try:
        found = run(session, dense=Dense(on, threads=asked.get("threads") or 0), **asked)
    except VisioncalError as error:
        return _noting(plain, None, [f"Dense corners are not kept: {error.message}"])
    if found.dense is None or not found.dense.fits:
        return _noting(plain, None, ["Dense corners are not kept: no image could be fitted."])
    both = [item.calibration.validation.held_out for item in (plain, found)]
    kept = not _is_worse(plain, found)
    result = DenseResult(
        kept=kept,
        held_out={
            name: CornerResiduals(mm=rms.mm, px=rms.px)
            for name, rms in zip(("template", "dense"), both, strict=True)
        },
        images=tuple(_images(found.dense)),
    )
    words = [_words(*both, kept=kept), *found.dense.notes()]
    chosen = found if kept else plain
    if chosen.calibration.camera is not None:
        camera = chosen.calibration.camera.camera
        evidence = explained(session, chosen.evidence, found.dense, camera)
        chosen = replace(chosen, evidence=evidence)
    return _noting(chosen, result, words)


def _images(dense: Dense) -> Iterator[ImageBlur]:
    for view, fit in dense.fits.items():
        yield ImageBlur(
            view=view,
            sigma_px=fit.blur.sigma_px,
            disc_px=fit.blur.disc_px,
            motion_px=fit.blur.length_px,
            motion_deg=fit.blur.direction_deg,
            tone=fit.tone,
            pixel_noise=fit.noise,
        )


def _noting(found: Run, result: DenseResult | None, words: list[str]) -> Run:
    """The result with what is said of dense corners."""
    calibration: Calibration = found.calibration
    verdict = calibration.verdict.noting(words)
    return replace(found, calibration=replace(calibration, verdict=verdict, dense=result))
