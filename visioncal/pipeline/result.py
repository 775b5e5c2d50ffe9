"""Running the stages, and putting their results together as a Calibration."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration import Calibration, Edge, SolverResult, Validation
from visioncal.errors import DataError
from visioncal.estimator.observability import edge_names
from visioncal.evidence import ViewEvidence
from visioncal.pipeline.known import Known
from visioncal.pipeline.steps import STAGES, rms_of
from visioncal.pipeline.views import holdout_rms, view_evidence, view_results
from visioncal.session import Session
from visioncal.stages.handeye import SOLVER_NAMES
from visioncal.types import FloatArray, Progress, SolverName

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
    for at, stage in enumerate(STAGES):
        if progress is not None:
            progress(stage.name, at, len(STAGES))
        known = stage.run(known)
    return Run(_calibration(known), view_evidence(known))


def _calibration(known: Known) -> Calibration:
    held, rms, verdict = known.held_out, known.rms, known.verdict
    if held is None or rms is None or verdict is None:
        raise DataError("pipeline: a stage is missing.")
    session, result = known.session, known.solved
    x_name, z_name = edge_names(session.mount)
    spread = result.covariance
    return Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=session.mount,
        edges={
            x_name: Edge(_transform(result.x), spread[:6, :6]),
            z_name: Edge(_transform(result.z), spread[6:, 6:]),
        },
        joint_covariance=spread,
        solvers={
            name: SolverResult(
                {x_name: _transform(it.x), z_name: _transform(it.z)},
                1e3 * it.rms_m,
                float(np.rad2deg(it.rms_rad)),
            )
            for name, it in result.solutions.items()
        },
        noise=_noise(known),
        views=view_results(known),
        rms=rms,
        validation=Validation(
            held.method, rms_of(held.away_m, held.away_rad, held.rms_px), holdout_rms(known)
        ),
        verdict=verdict,
        camera=known.camera,
        robot=known.robot,
    )


def _noise(known: Known) -> dict[str, float]:
    """Standard deviations per axis; sensor and robot are told apart only in the pixels."""
    noise = known.solved.noise
    pixel = {} if known.pixel_px is None else {"pixel_px": known.pixel_px}
    return pixel | {
        "combined_translation_mm": 1e3 * noise.sigma_m,
        "combined_rotation_deg": float(np.rad2deg(noise.sigma_rad)),
    }


def _transform(matrix: FloatArray) -> RigidTransform:
    return RigidTransform.from_matrix(matrix)
