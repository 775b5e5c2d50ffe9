"""Running the stages, and putting their results together as a Calibration."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from visioncal.calibration import Calibration, CameraResult, Edge, SolverResult, Validation
from visioncal.errors import DataError, VisioncalError
from visioncal.estimator.observability import edge_names
from visioncal.evidence import ViewEvidence
from visioncal.pipeline.guessing import is_suspect, reading_hint
from visioncal.pipeline.known import Known
from visioncal.pipeline.steps import STAGES
from visioncal.pipeline.views import view_evidence
from visioncal.session import Session
from visioncal.stages.handeye import SOLVER_NAMES
from visioncal.stages.validate import changed_lens
from visioncal.types import Progress, SolverName

_LEVELS = ("auto", "hand-eye")


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration with what was seen and computed on the way to it.

    Attributes:
        calibration: The result.
        evidence: One entry for each view of the session.
    """

    calibration: Calibration
    evidence: tuple[ViewEvidence, ...]


def calibrate(
    session: Session | Path | str,
    *,
    solver: SolverName = "joint",
    level: str = "auto",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrates a session.

    Args:
        session: A session, or the path of its folder or recording.
        solver: `joint` for the fit of both edges, or the name of a closed form.
        level: How far to go: `auto` for all that the data allows, or `hand-eye`.
        progress: Told of long work.

    Returns:
        The result with its verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: The motion leaves a direction of the answer open.
        ConvergenceError: The intrinsics do not come to rest.
    """
    return run(session, solver=solver, level=level, progress=progress).calibration


def run(
    session: Session | Path | str,
    *,
    solver: SolverName = "joint",
    level: str = "auto",
    progress: Progress | None = None,
) -> Run:
    """Calibrates a session and keeps the evidence; see `calibrate`."""
    if solver not in SOLVER_NAMES:
        raise DataError(f"solver {solver!r} is not one of {', '.join(SOLVER_NAMES)}.")
    if level not in _LEVELS:
        raise DataError(f"level {level!r} is not one of {', '.join(_LEVELS)}.")
    loaded = session if isinstance(session, Session) else Session.load(session)
    known = Known(loaded, solver, progress)
    seen: Known | None = None
    for at, stage in enumerate(STAGES):
        if progress is not None:
            progress(stage.name, at, len(STAGES))
        try:
            known = stage.run(known)
        except VisioncalError as error:
            # Views that are out of the game are often why the rest does not suffice.
            more = [it for it in known.lost_views if it not in error.culprits]
            raise _with_hint(error.with_culprits(more), seen) from error
        if stage.name == "pnp":
            seen = known
    return Run(_calibration(_with_reading(known, seen)), view_evidence(known))


def _with_hint(error: VisioncalError, seen: Known | None) -> VisioncalError:
    """Adds to an error, once the target's poses are known, how the robot's should be read."""
    hint = "" if seen is None else reading_hint(seen)
    if not hint:
        return error
    return type(error)(
        error.message, culprits=error.culprits, next_step=f"{hint} {error.next_step}".strip()
    )


def _with_reading(known: Known, seen: Known | None) -> Known:
    """Adds to a poor verdict how the poses should be read, where that explains it."""
    if known.verdict is None or seen is None or not is_suspect(known):
        return known
    hint = reading_hint(seen)
    if not hint:
        return known
    return replace(known, verdict=replace(known.verdict, reasons=(hint, *known.verdict.reasons)))


def _calibration(known: Known) -> Calibration:
    held, findings, verdict = known.held_out, known.findings, known.verdict
    if held is None or findings is None or verdict is None:
        raise RuntimeError("a stage is missing")
    session, result = known.session, known.solved
    x_name, z_name = edge_names(session.mount)
    spread = result.covariance
    return Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=session.mount,
        edges={
            x_name: Edge(result.edges.x, spread[:6, :6]),
            z_name: Edge(result.edges.z, spread[6:12, 6:12]),
        },
        joint_covariance=spread[:12, :12],
        solvers={
            name: SolverResult(
                {x_name: it.x, z_name: it.z},
                1e3 * it.rms_m,
                float(np.rad2deg(it.rms_rad)),
            )
            for name, it in result.solutions.items()
        },
        noise=_noise(known),
        views=tuple(findings.views),
        rms=findings.rms,
        validation=Validation(held.method, findings.held_out, findings.holdout),
        verdict=verdict,
        camera=_camera(known),
        robot=known.robot,
    )


def _camera(known: Known) -> CameraResult | None:
    """The camera as the whole chain left it."""
    result, camera = known.solved, known.camera
    if camera is None or not len(result.edges.lens):
        return camera
    return CameraResult(
        changed_lens(camera.camera, result.edges.lens),
        estimated=True,
        covariance=result.covariance[12:, 12:],
    )


def _noise(known: Known) -> dict[str, float]:
    """Standard deviations per axis: of corners and flange, or of both as one without corners."""
    noise = known.solved.noise
    of = "combined" if known.robot_noise is None else "robot"
    pixel = {} if known.pixel_px is None else {"pixel_px": known.pixel_px}
    return pixel | {
        f"{of}_translation_mm": 1e3 * noise.sigma_m,
        f"{of}_rotation_deg": float(np.rad2deg(noise.sigma_rad)),
    }
