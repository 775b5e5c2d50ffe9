"""Calibrates a session of one camera and robot or of a whole cell; also with dense corners."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.running import (
    CalibrationOptions,
    Run,
    initial_state,
    run,
    run_stages,
)
from visioncal.calibration.stages.dense import Dense, explained
from visioncal.core.arguments import typed
from visioncal.core.choices import Convention, SolverName
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.number_format import figure
from visioncal.core.types import Corners, Progress
from visioncal.results import Calibration, Rms
from visioncal.results.sections import CornerResiduals, DenseResult, ImageBlur
from visioncal.session import Session
from visioncal.session.selecting import is_whole_cell
from visioncal.vision.dense.library import chosen_device

# A growth of squared residuals by fewer standard errors is chance.
_CHANCE = 2.0


@typed
def calibrate(
    session: Session | Path | str,
    *,
    solver: SolverName = "joint",
    level: str = "auto",
    convention: Convention | None = None,
    need_mm: float | None = None,
    need_deg: float | None = None,
    corrected: bool = False,
    progress: Progress | None = None,
    dense: bool = False,
    device: str = "auto",
    threads: int | None = None,
    corners: Mapping[int, Corners] | None = None,
) -> Calibration:
    """Calibrates a session.

    Several threads may calibrate at once. Meanwhile BLAS is limited to one thread per caller, and
    OpenCV, too, while targets are detected; afterwards both limits are restored.

    Args:
        session: A session, or the path of its folder or recording. Several cameras or robots are
            calibrated as a whole cell; `Calibration.of` selects one camera, robot and target.
        solver: `joint` for the fit of both edges, or the name of a closed form.
        level: How far to go: `auto` for all that the data allows, `hand-eye` without a calibrated
            arm, `offsets` of its joints, its `kinematics`, `elastic` with joint compliance, or
            `thermal` with drift over temperature.
        convention: Joint table convention of a calibrated arm's parameters: `standard`,
            `modified` or `hayati`; None for the stated one, or Hayati's where axes are parallel.
        need_mm: Required accuracy of picks [mm]; replaces that of `[need]`.
        need_deg: The same in rotation [deg].
        corrected: Whether targets are corrected for a calibrated arm before they are sent; else the
            verdict is about picks by the controller's own poses.
        progress: Called with the progress of long work.
        dense: Whether to fit corners to all pixels around them, for blurred, moving and badly lit
            images; needs the extra `dense`. Dense corners are kept only where left-out views are
            predicted no worse.
        device: Device of the dense fit: `auto` for a GPU where there is one, `cpu` or `cuda`.
        threads: How many images are searched in parallel; one a core where None. The result is the
            same to the bit.
        corners: Corners detected before, by view; None to detect them.

    Returns:
        The result with its verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: The motion leaves a direction of the result undetermined.
        ConvergenceError: The intrinsics do not converge.
    """
    asked = CalibrationOptions(
        solver=solver,
        level=level,
        convention=convention,
        progress=progress,
        threads=threads,
    )
    state = initial_state(session, **asked)
    with_need = state.session.needing(need_mm, need_deg, corrected=corrected)
    state = replace(state, session=with_need, given_corners=corners)
    if dense:
        return run_dense(state.session, device=device, **asked).calibration
    return result_of(run_stages(state))


def _is_worse(before: Run, after: Run) -> bool:
    """Whether left-out views are predicted worse, in pixels or in millimetres.

    That is where their mean squared error grows by more than chance explains.
    """
    common = sorted(before.left_out.keys() & after.left_out.keys())
    growth = np.array(
        [np.square(after.left_out[view]) - np.square(before.left_out[view]) for view in common]
    )
    growth = growth[np.isfinite(growth).all(axis=1)]
    if len(growth) < 2:
        return True
    chance = _CHANCE * growth.std(axis=0, ddof=1) / np.sqrt(len(growth))
    return bool(np.any(growth.mean(axis=0) > chance))


def _words(before: Rms, after: Rms, *, kept: bool) -> str:
    """Compares the left-out residuals of both corner methods in a sentence."""
    return (
        f"Dense corners are {'kept' if kept else 'not kept'}: with them, views that were left out "
        f"are predicted to {_figures(after)}, with those of the template to {_figures(before)}."
    )


def _figures(rms: Rms) -> str:
    px = "" if rms.px is None else f"{figure(rms.px)} px and "
    return f"{px}{figure(rms.mm)} mm"


def run_dense(
    session: Session, *, device: str = "auto", **asked: Unpack[CalibrationOptions]
) -> Run:
    """Calibrates a session with template corners and with dense ones; see `calibrate`.

    Args:
        session: The session.
        device: Device of the dense fit: `auto` for a GPU where there is one, `cpu` or `cuda`.
        asked: See `calibrate`.

    Returns:
        The run with dense corners, unless it predicts left-out views worse than the other, by more
        than chance. Its verdict notes how well both predict.

    Raises:
        DataError: torch or kornia is missing, there are no images of boards, or as `calibrate`.
    """
    if is_whole_cell(session):
        raise DataError(
            "dense corners cannot be asked of a whole cell.",
            culprits=["--dense"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    torch_device = chosen_device(device)
    if not any(board.kind in ("charuco", "checkerboard") for board in session.boards.values()):
        raise DataError(
            "--dense needs images of a checkerboard or a ChArUco board; this session has none.",
            culprits=["--dense"],
            next_step="Leave it out.",
        )

    plain = run(session, **asked)
    try:
        fitted = run(session, dense=Dense(torch_device, threads=asked.get("threads") or 0), **asked)
    except VisioncalError as error:
        return _noting(plain, None, [f"Dense corners are not kept: {error.message}"])
    if fitted.dense is None or not fitted.dense.fits:
        return _noting(plain, None, ["Dense corners are not kept: no image could be fitted."])
    residuals = [item.calibration.validation.held_out for item in (plain, fitted)]
    kept = not _is_worse(plain, fitted)
    result = DenseResult(
        kept=kept,
        held_out={
            name: CornerResiduals(mm=rms.mm, px=rms.px)
            for name, rms in zip(("template", "dense"), residuals, strict=True)
        },
        images=tuple(
            ImageBlur(
                view=view,
                sigma_px=fit.blur.sigma_px,
                disc_px=fit.blur.disc_px,
                motion_px=fit.blur.length_px,
                motion_deg=fit.blur.direction_deg,
                tone=fit.tone,
                pixel_noise=fit.noise,
            )
            for view, fit in fitted.dense.fits.items()
        ),
    )
    notes = [_words(*residuals, kept=kept), *fitted.dense.notes()]
    chosen = fitted if kept else plain
    if chosen.calibration.camera is not None:
        camera = chosen.calibration.camera.camera
        evidence = explained(session, chosen.evidence, fitted.dense, camera)
        chosen = replace(chosen, evidence=evidence)
    return _noting(chosen, result, notes)


def _noting(fitted: Run, result: DenseResult | None, notes: list[str]) -> Run:
    """Adds the dense section and its notes to a run's calibration."""
    calibration: Calibration = fitted.calibration
    verdict = calibration.verdict.noting(notes)
    return replace(fitted, calibration=replace(calibration, verdict=verdict, dense=result))
