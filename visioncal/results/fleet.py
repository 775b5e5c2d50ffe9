"""Results of many sessions as rows: outliers among them, and changes since earlier results."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
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
# Largest share of an outlying robot model, smallest share of the usual one, and the former's score.
_FEW, _MOST = 0.2, 0.5
_MODEL_SCORE = 100.0


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
    has_picture: bool = False  # Whether its folder has a picture.
    has_report: bool = False  # Whether its folder has a report.
    score: float = 0.0  # Largest robust standard score among its fleet; 0 within the limit.
    stands_out: str = ""  # What the score is of, in words.
    # Whether its result differs from an earlier one by more than that one's sigmas.
    changed: bool | None = None
    change: str = ""  # What differs, in words.

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


@dataclass(frozen=True)
class _Measure:
    """Figure that is compared among the sessions of a fleet."""

    words: str  # Its name in messages.
    unit: str  # Its unit.
    spread: float = _SPREAD  # Smallest standard deviation of its logarithm.
    is_worse_above: bool = True  # Whether only large values are outliers.
    most: float = math.inf  # Largest value that is possible, whatever the rest of the fleet has.


_MEASURES: Mapping[str, _Measure] = {
    # A robot with more than a refused result's sigma is one whose poses are misread.
    "noise_mm": _Measure("noise of the robot", "mm", most=1e3 * SIGMA_LIMIT_M),
    "noise_deg": _Measure("noise of its rotation", "deg", most=math.degrees(SIGMA_LIMIT_RAD)),
    "noise_px": _Measure("noise of the corners", "px"),
    "residual_mm": _Measure("residual", "mm"),
    "arm_mm": _Measure("errors of the arm", "mm"),
    "drift_mm": _Measure("drift of the arm", "mm"),
    "focal_px": _Measure("focal length", "px", _LENS_SPREAD, is_worse_above=False),
}


def with_outliers(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """The rows with their outlier scores, largest scores first.

    Sessions of one robot model are compared (lenses also of one image size): the score is that of
    each figure's logarithm by median and median absolute deviation, robust to half of a fleet.
    Noise that no robot has is an outlier in any fleet.
    """
    scores: dict[str, float] = defaultdict(float)
    words: dict[str, list[str]] = defaultdict(list)
    for name, score, sentence in [*_model_outliers(rows), *_figure_outliers(rows)]:
        scores[name] = max(scores[name], score)
        words[name].append(sentence)
    scored = [replace(row, score=scores[row.name], stands_out="; ".join(words[row.name]))
             for row in rows]  # fmt: skip
    order = {"": 0, "bad": 1, "check": 2, "good": 3}
    return sorted(scored, key=lambda value: (-value.score, order.get(value.verdict, 0), value.name))


def _model_outliers(rows: Sequence[FleetRow]) -> list[tuple[str, float, str]]:
    counts = Counter(row.robot for row in rows if row.robot)
    if not counts:
        return []
    usual, most = counts.most_common(1)[0]
    total = sum(counts.values())
    if total < FEWEST or most < _MOST * total:
        return []
    return [
        (row.name, _MODEL_SCORE, f"its robot is a {row.robot}, where {most} of {total} are {usual}")
        for row in rows
        if row.robot and row.robot != usual and counts[row.robot] <= _FEW * total
    ]


def _figure_outliers(rows: Sequence[FleetRow]) -> list[tuple[str, float, str]]:
    outliers: list[tuple[str, float, str]] = []
    for field, measure in _MEASURES.items():
        groups: dict[tuple[str, str], list[tuple[str, float]]] = defaultdict(list)
        for row in rows:
            value = getattr(row, field)
            if value is not None and value > measure.most:
                words = f"{measure.words} {figure(value)} {measure.unit}, where no robot has more "
                reason = f"{words}than {figure(measure.most)} {measure.unit}: {row.words}"
                outliers.append((row.name, _MODEL_SCORE * value / measure.most, reason))
            elif value is not None and value > 0.0:
                camera = row.camera if field == "focal_px" else ""
                groups[row.robot, camera].append((row.name, value))
        for members in groups.values():
            if len(members) < FEWEST:
                continue
            logs = np.log([value for _, value in members])
            median = float(np.median(logs))
            spread = max(_MAD * float(np.median(np.abs(logs - median))), measure.spread)
            scores = (logs - median) / spread
            scores = scores if measure.is_worse_above else np.abs(scores)
            usual = f"where {figure(math.exp(median))} {measure.unit} is usual"
            outliers += [
                (name, score, f"{measure.words} {figure(value)} {measure.unit}, {usual}")
                for (name, value), score in zip(members, scores.tolist(), strict=True)
                if score > _LIMIT
            ]
    return outliers


def with_changes(
    rows: Sequence[FleetRow],
    before: Callable[[str], Calibration | None],
    after: Callable[[str], Calibration | None],
) -> list[FleetRow]:
    """The rows with each result's difference from an earlier one of the same session.

    `before` and `after` give the earlier and the present result by name, None where there is none.
    """
    compared = []
    for row in rows:
        old, new = before(row.name), after(row.name)
        if old is None and new is None:
            compared.append(row)
            continue
        change = _change(old, new)
        compared.append(replace(row, changed=bool(change), change=change))
    return compared


def _change(old: Calibration | None, new: Calibration | None) -> str:
    """Differences larger than the earlier result's sigmas, in words; empty for none."""
    if old is None:
        return "there was no result"
    if new is None:
        return "there is no result any more"
    words = []
    if old.verdict.status != new.verdict.status:
        words.append(f"verdict {new.verdict.status}, was {old.verdict.status}")
    gone = [edge for edge in old.edges if edge not in new.edges]
    words += [f"{name} is gone" for name in gone]
    for name, edge in old.edges.items():
        if name in gone:
            continue
        moved_mm, moved_deg = pose_difference(edge.matrix, new.edges[name].matrix)
        for moved, sigma, unit in (
            (moved_mm, edge.sigma_mm, "mm"),
            (moved_deg, edge.sigma_deg if edge.oriented else math.inf, "deg"),
        ):
            if moved > sigma:
                words.append(
                    f"{name} moved by {figure(moved)} {unit} (sigma {figure(sigma)} {unit})"
                )
    return "; ".join(words)
