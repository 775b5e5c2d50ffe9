"""Calibrates a session of one camera and robot or of a whole cell."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.running import (
    CalibrationOptions,
    initial_state,
    run_stages,
)
from visioncal.core.arguments import typed
from visioncal.core.choices import Convention, SolverName
from visioncal.core.types import Corners, Progress
from visioncal.results import Calibration
from visioncal.session import Session


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
        dense: Whether to fit a board to all pixels of images that the template refuses.
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
        dense=dense,
    )
    state = initial_state(session, **asked)
    with_need = state.session.needing(need_mm, need_deg, corrected=corrected)
    state = replace(state, session=with_need, given_corners=corners)
    return result_of(run_stages(state))
