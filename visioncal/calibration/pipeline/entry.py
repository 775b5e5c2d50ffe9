"""Calibrating a session of any cell: one camera and robot, or many; by all pixels, too."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.running import Asked, Run, known_at_first, run, run_steps
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

# What is worse by less standard errors is chance.
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
    progress: Progress | None = None,
    dense: bool = False,
    device: str = "auto",
    threads: int | None = None,
    keep_corners: bool = False,
) -> Calibration:
    """Calibrates a session.

    Several threads may do so at once. While one does, BLAS has one thread for each, and OpenCV,
    too, while targets are looked for; afterwards both have those that they had.

    Args:
        session: A session, or the path of its folder or recording. One of several cameras or
            robots is solved as a whole; `Calibration.of` takes one camera, robot and target of it.
        solver: `joint` for the fit of both edges, or the name of a closed form.
        level: How far to go: `auto` for all that the data allows, `hand-eye` without a calibrated
            arm, `offsets` of its joints, its `kinematics`, `elastic` for joints that bend, too, or
            `thermal` for its drift with temperature, too.
        convention: Of the joint table in which a calibrated arm's numbers are given: `standard`,
            `modified` or `hayati`; None for the stated one, or Hayati's where axes are parallel.
        need_mm: How near picks have to come [mm], in the place of what `[need]` declares.
        need_deg: The same in rotation [deg].
        progress: Told of long work.
        dense: Whether to fit corners by all pixels around them, for blurred, moving and badly lit
            images; needs the extra `dense`. They are kept only where views that were left out
            are predicted no worse.
        device: What that works on: `auto` for a GPU where there is one, `cpu` or `cuda`.
        threads: How many images are searched at a time; one a core where None. The result is the
            same to the bit.
        keep_corners: Whether what is found in the images is kept in the session's folder, in
            `.visioncal`, so that the next calibration need not look. It holds for the same
            images, board and version, and can be deleted.

    Returns:
        The result with its verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: The motion leaves a direction of the answer open.
        ConvergenceError: The intrinsics do not come to rest.
    """
    asked = Asked(
        solver=solver,
        level=level,
        convention=convention,
        progress=progress,
        threads=threads,
        keep_corners=keep_corners,
    )
    known = known_at_first(session, **asked)
    known = replace(known, session=known.session.needing(need_mm, need_deg))
    if dense:
        return run_dense(known.session, device=device, **asked).calibration
    return result_of(run_steps(known))


@typed
def align(
    session: Session | Path | str,
    *,
    level: str = "auto",
    convention: Convention | None = None,
    need_mm: float | None = None,
    need_deg: float | None = None,
    corners: Mapping[int, Corners] | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    keep_corners: bool = False,
) -> Calibration:
    """Calibrates a whole cell: another name for `calibrate`, which takes corners, too.

    Args:
        session: A session, or the path of its folder or recording.
        level: How far each arm is calibrated; beyond `hand-eye` it takes joint angles and a model.
        convention: Of the joint table in which calibrated arms' numbers are given.
        need_mm: How near picks have to come [mm], in the place of what `[need]` declares.
        need_deg: The same in rotation [deg].
        corners: What was found in its images before, by view; None to look.
        progress: Told of long work.
        threads: As in `calibrate`.
        keep_corners: Likewise.

    Returns:
        The result with its verdict; its `between` has any frame in any other.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: A robot is tied to nothing, or the observations leave a frame open.
    """
    known = known_at_first(
        session,
        level=level,
        convention=convention,
        progress=progress,
        threads=threads,
        keep_corners=keep_corners,
    )
    needing = known.session.needing(need_mm, need_deg)
    return result_of(run_steps(replace(known, session=needing, found_before=corners)))


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
