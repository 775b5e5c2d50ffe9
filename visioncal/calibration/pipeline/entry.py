"""Calibrating a session of any cell: of one camera and one robot, or of many."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from visioncal.calibration.pipeline.dense_corners import run_dense
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.running import Asked, known_at_first, run_steps
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
