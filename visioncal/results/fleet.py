"""Results of many sessions as rows, and outliers among them."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.number_format import figure
from visioncal.results.result import Calibration

State: TypeAlias = Literal["done", "kept", "failed"]

# Smallest number of results that are compared with each other.
FEWEST = 5
# Robust standard score beyond which a value is an outlier (Iglewicz and Hoaglin 1993).
_LIMIT = 3.5
# Smallest standard deviations of logarithms in the score: of noise levels, and of focal lengths of
# one type of lens.
_SPREAD, _LENS_SPREAD = 0.2, 0.01
# Ratio of standard deviation to median absolute deviation of a normal distribution.
_MAD = 1.4826


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
    score: float = 0.0  # Largest robust standard score among its fleet; 0 within the limit.
    stands_out: str = ""  # What the score is of, in words.

    @property
    def group(self) -> str:
        """Parent folder that it shares with other sessions, as those of one robot; or empty."""
        return self.name.rpartition("/")[0]


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


# Figures that are compared among the sessions of a fleet, in words, with their units.
_MEASURES = {
    "noise_mm": ("noise of the robot", "mm"),
    "noise_deg": ("noise of its rotation", "deg"),
    "noise_px": ("noise of the corners", "px"),
    "residual_mm": ("residual", "mm"),
    "arm_mm": ("errors of the arm", "mm"),
    "drift_mm": ("drift of the arm", "mm"),
    "focal_px": ("focal length", "px"),
}


def with_outliers(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """The rows with their outlier scores, largest scores first.

    Sessions of one robot model are compared (lenses also of one image size): the score is that of
    each figure's logarithm by median and median absolute deviation, robust to half of a fleet.
    """
    scores: dict[str, float] = defaultdict(float)
    words: dict[str, list[str]] = defaultdict(list)
    for name, score, sentence in _outliers(rows):
        scores[name] = max(scores[name], score)
        words[name].append(sentence)
    scored = [replace(row, score=scores[row.name], stands_out="; ".join(words[row.name]))
             for row in rows]  # fmt: skip
    order = {"": 0, "bad": 1, "check": 2, "good": 3}
    return sorted(scored, key=lambda value: (-value.score, order.get(value.verdict, 0), value.name))


def _outliers(rows: Sequence[FleetRow]) -> Iterator[tuple[str, float, str]]:
    """Names of outlying rows with their scores, and what these are of, in words."""
    for field, (words, unit) in _MEASURES.items():
        is_lens, groups = field == "focal_px", defaultdict[tuple[str, str], list[FleetRow]](list)
        for row in rows:
            if (getattr(row, field) or 0.0) > 0.0:
                groups[row.robot, row.camera if is_lens else ""].append(row)
        for members in groups.values():
            if len(members) < FEWEST:
                continue
            logs = np.log([getattr(row, field) for row in members])
            median = float(np.median(logs))
            spread = _MAD * float(np.median(np.abs(logs - median)))
            scores = (logs - median) / max(spread, _LENS_SPREAD if is_lens else _SPREAD)
            # Of noise and errors, only large ones are outliers.
            for row, score in zip(members, (np.abs(scores) if is_lens else scores), strict=True):
                if score > _LIMIT:
                    value, usual = figure(getattr(row, field)), figure(math.exp(median))
                    reason = f"{words} {value} {unit}, where {usual} {unit} is usual"
                    yield row.name, float(score), reason
