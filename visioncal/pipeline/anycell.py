"""Calibrating a session of any cell: of one camera and one robot, or of many."""

from pathlib import Path

from visioncal.calibration import Calibration
from visioncal.errors import DataError
from visioncal.pipeline.denser import run_dense
from visioncal.pipeline.result import run
from visioncal.pipeline.whole import align
from visioncal.robot import Convention
from visioncal.session import Session
from visioncal.session.single import is_whole_cell
from visioncal.types import Progress, SolverName


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
        convention: Of the joint table in which a calibrated arm's numbers are told: `standard`,
            `modified` or `hayati`; None for the stated one, or Hayati's where axes are parallel.
        need_mm: How near picks have to come [mm], in the place of what `[need]` declares.
        need_deg: The same in rotation [deg].
        progress: Told of long work.
        dense: Whether to fit corners by all pixels around them, for blurred, moving and badly lit
            images; needs the extra `dense`. They are kept only where views that were left out
            are predicted no worse.
        device: What that works on: `auto` for a GPU where there is one, `cpu` or `cuda`.

    Returns:
        The result with its verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: The motion leaves a direction of the answer open.
        ConvergenceError: The intrinsics do not come to rest.
    """
    loaded = session if isinstance(session, Session) else Session.load(session)
    loaded = loaded.needing(need_mm, need_deg)
    if is_whole_cell(loaded):
        check_whole(solver, dense=dense)
        found = align(loaded, level=level, convention=convention, progress=progress)
        return Calibration.whole(found)
    if dense:
        return run_dense(
            loaded,
            device=device,
            solver=solver,
            level=level,
            convention=convention,
            progress=progress,
        ).calibration
    return run(
        loaded, solver=solver, level=level, convention=convention, progress=progress
    ).calibration


def check_whole(solver: SolverName, *, dense: bool = False) -> None:
    """Refuses what is not asked of a whole cell.

    Raises:
        DataError: A whole cell is not calibrated that way.
    """
    if solver != "joint":
        raise DataError(
            f"solver {solver} cannot be asked of a whole cell: it has the joint solver.",
            culprits=["--solver"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    if dense:
        raise DataError(
            "dense corners cannot be asked of a whole cell.",
            culprits=["--dense"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
