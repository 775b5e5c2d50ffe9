"""Results of many sessions as rows."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from visioncal.results.result import Calibration

State: TypeAlias = Literal["done", "kept", "failed"]


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """Result of one session of a batch; absent texts are empty and absent figures None."""

    name: str  # Name of the session and of its result's folder.
    session: str  # Path of the session.
    state: State  # `done`, `kept` of an earlier run, or `failed`.
    verdict: str = ""  # good, check or bad.
    words: str = ""  # The verdict's first sentence, or why there is no result.
    error: str = ""  # Class of the error.
    next_step: str = ""  # Remedy of the error.
    session_sha256: str = ""  # Digest of the session.
    visioncal: str = ""  # Version that calibrated it.
    created: str = ""  # Time of creation, ISO 8601.
    robot: str = ""  # Model of the robot.
    mount: str = ""  # Mount of the camera.
    camera: str = ""  # Size of its images.
    views: int | None = None  # Number of views.
    used: int | None = None  # Number of views in the fit.
    residual_mm: float | None = None  # Root mean square residual of these [mm].
    residual_deg: float | None = None  # The same in rotation [deg].
    residual_px: float | None = None  # The same of corners [px].
    # Noise of the robot's position per axis, or of robot and camera combined [mm].
    noise_mm: float | None = None
    noise_deg: float | None = None  # The same in rotation [deg].
    noise_px: float | None = None  # Noise of a corner [px].
    sigma_mm: float | None = None  # Sigma of the camera's position [mm].
    sigma_deg: float | None = None  # Sigma of its rotation [deg].
    # Error of located points that 95 % do not exceed, where the views look [mm].
    radius95_mm: float | None = None
    arm_mm: float | None = None  # Standard deviation of the arm's link errors [mm].
    drift_mm: float | None = None  # Largest thermal drift of the arm [mm].
    focal_px: float | None = None  # Mean focal length [px].
    seconds: float | None = None  # Duration of the calibration [s].
    has_report: bool = False  # Whether its folder has a report.


def row_of(name: str, session: str, calibration: Calibration, version: str) -> FleetRow:
    """Row of a result."""
    size = None if calibration.camera is None else calibration.camera.camera.resolution
    matrix = None if calibration.camera is None else calibration.camera.camera.matrix
    budget, arm, drift = calibration.budget, calibration.arm_errors, calibration.thermal
    # Of a cell without a camera, the first transform.
    cameras = (name for name in calibration.edges if "_from_cam" in name)
    edge = calibration.edges[next(cameras, next(iter(calibration.edges)))]
    noise = {key: value for key, value in calibration.noise.items() if math.isfinite(value)}
    return FleetRow(
        name=name,
        session=session,
        state="done",
        verdict=calibration.verdict.status,
        words=next(iter(calibration.verdict.reasons), calibration.verdict.headline),
        session_sha256=calibration.session_sha256,
        visioncal=version,
        created=calibration.created,
        robot="" if calibration.robot is None else calibration.robot.name,
        mount=calibration.mount,
        camera="" if size is None else f"{size[0]} x {size[1]}",
        views=len(calibration.views),
        used=sum(view.used for view in calibration.views),
        residual_mm=calibration.rms.mm,
        residual_deg=calibration.rms.deg,
        residual_px=calibration.rms.px,
        noise_mm=noise.get("robot_translation_mm", noise.get("combined_translation_mm")),
        noise_deg=noise.get("robot_rotation_deg", noise.get("combined_rotation_deg")),
        noise_px=noise.get("pixel_px"),
        sigma_mm=edge.sigma_mm,
        sigma_deg=edge.sigma_deg if edge.oriented else None,
        radius95_mm=None if budget is None else budget.radius95_mm,
        arm_mm=None if arm is None else arm.sigma_mm,
        drift_mm=None
        if drift is None
        else max((point.drift_mm for point in drift.course), default=0.0),
        focal_px=None if matrix is None else float(np.mean(matrix[:2])),
    )


def worst_first(rows: Iterable[FleetRow]) -> tuple[FleetRow, ...]:
    """The rows by their verdicts, those without a result first, then by name."""
    order = {"": 0, "bad": 1, "check": 2, "good": 3}
    return tuple(sorted(rows, key=lambda row: (order.get(row.verdict, 0), row.name)))
