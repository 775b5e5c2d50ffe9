"""Results of many sessions as rows: what stands out among them, and what changed since a time."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.results.result import Calibration

State: TypeAlias = Literal["done", "kept", "failed"]

# Of fewer robots of one model there is no usual one.
_FEWEST = 5
# Robust standard scores beyond which a value is none of its fleet's (Iglewicz and Hoaglin 1993).
_LIMIT = 3.5
# Levels of noise of sound cells differ by so much (of their logarithm), even where all that are
# compared agree better; focal lengths of lenses of one type by so much.
_SPREAD, _LENS_SPREAD = 0.2, 0.01
# Of a normal distribution, the standard deviation in median absolute deviations.
_MAD = 1.4826
# A model that so few sessions have, beside one that most have, is the odd one.
_FEW, _MOST = 0.2, 0.5
_ODD_MODEL = 100.0


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """What became of one session of a batch; texts are empty and figures None where there is none.

    Attributes:
        name: Of the session, and of its result's folder.
        session: Its path.
        state: `done`, `kept` of an earlier run, or `failed`.
        verdict: good, check or bad.
        words: The verdict's first sentence, or why there is no result.
        error: The class of the error.
        next_step: What to do about it.
        session_sha256: Digest of its facts.
        visioncal: The version that calibrated it.
        created: When, in ISO 8601.
        robot: Its model.
        mount: Where the camera is.
        camera: The image's size.
        views: How many there are.
        used: How many the fit used.
        residual_mm: Root mean square over these.
        residual_deg: Likewise.
        residual_px: Likewise.
        noise_mm: Standard deviation of the robot's place, per axis; of poses, both noises together.
        noise_deg: Of its rotation.
        noise_px: Of a corner.
        sigma_mm: Of the camera's place.
        sigma_deg: Of its rotation.
        radius95_mm: Within which 95 % of points are placed where the views look.
        arm_mm: Typical error of the arm's links.
        drift_mm: How far the arm's drift with temperature went.
        focal_px: Mean focal length.
        error_mm: How far the camera's place is from the truth, of a simulated cell.
        seconds: How long it took.
        has_picture: Whether there is a picture of it in its folder.
        has_report: Whether there is a report.
        score: How far it is from its fleet, in robust standard deviations; 0 within the limit.
        stands_out: By what.
        changed: Whether its result differs from an earlier one by more than that one's sigmas.
        change: By what.
    """

    name: str
    session: str
    state: State
    verdict: str = ""
    words: str = ""
    error: str = ""
    next_step: str = ""
    session_sha256: str = ""
    visioncal: str = ""
    created: str = ""
    robot: str = ""
    mount: str = ""
    camera: str = ""
    views: int | None = None
    used: int | None = None
    residual_mm: float | None = None
    residual_deg: float | None = None
    residual_px: float | None = None
    noise_mm: float | None = None
    noise_deg: float | None = None
    noise_px: float | None = None
    sigma_mm: float | None = None
    sigma_deg: float | None = None
    radius95_mm: float | None = None
    arm_mm: float | None = None
    drift_mm: float | None = None
    focal_px: float | None = None
    error_mm: float | None = None
    seconds: float | None = None
    has_picture: bool = False
    has_report: bool = False
    score: float = 0.0
    stands_out: str = ""
    changed: bool | None = None
    change: str = ""

    @property
    def group(self) -> str:
        """The folder that it shares with other sessions, as those of one robot; empty for none."""
        return self.name.rpartition("/")[0]


def row_of(name: str, session: str, found: Calibration, version: str) -> FleetRow:
    """The row of a result."""
    size = None if found.camera is None else found.camera.camera.resolution
    matrix = None if found.camera is None else found.camera.camera.matrix
    known, arm, drift = found.budget, found.arm_errors, found.thermal
    edge = found.edges[camera_edge(found)]
    noise = {key: value for key, value in found.noise.items() if math.isfinite(value)}
    return FleetRow(
        name=name,
        session=session,
        state="done",
        verdict=found.verdict.status,
        words=next(iter(found.verdict.reasons), found.verdict.headline),
        session_sha256=found.session_sha256,
        visioncal=version,
        created=found.created,
        robot="" if found.robot is None else found.robot.name,
        mount=found.mount,
        camera="" if size is None else f"{size[0]} x {size[1]}",
        views=len(found.views),
        used=sum(view.used for view in found.views),
        residual_mm=found.rms.mm,
        residual_deg=found.rms.deg,
        residual_px=found.rms.px,
        noise_mm=noise.get("robot_translation_mm", noise.get("combined_translation_mm")),
        noise_deg=noise.get("robot_rotation_deg", noise.get("combined_rotation_deg")),
        noise_px=noise.get("pixel_px"),
        sigma_mm=edge.sigma_mm,
        sigma_deg=edge.sigma_deg if edge.oriented else None,
        radius95_mm=None if known is None else known.radius95_mm,
        arm_mm=None if arm is None else arm.sigma_mm,
        drift_mm=None
        if drift is None
        else max((point.drift_mm for point in drift.course), default=0.0),
        focal_px=None if matrix is None else float(np.mean(matrix[:2])),
    )


def camera_edge(found: Calibration) -> str:
    """The name of the transform that places the camera, or what is observed in its place."""
    placed = (edge for edge in found.edges if edge.rpartition("_from_")[2].startswith("cam"))
    return next(placed, next(iter(found.edges)))


@dataclass(frozen=True)
class CellFigures:
    """What many simulated cells of one kind came to; figures are None where none has a result.

    Attributes:
        name: What they have in common.
        count: How many there are.
        results: How many have a result.
        good: How many of them are good.
        radius95_mm: Predicted: within which 95 % of points are placed; the median.
        sigma_mm: Predicted: of the camera's place; the median.
        error_mm: True: how far 95 % of the cameras' places are off at most.
    """

    name: str
    count: int
    results: int
    good: int
    radius95_mm: float | None
    sigma_mm: float | None
    error_mm: float | None


def cell_figures(rows: Sequence[FleetRow]) -> list[CellFigures]:
    """The figures of simulated cells by what they have in common."""
    groups: dict[str, list[FleetRow]] = defaultdict(list)
    for item in sorted(rows, key=lambda row: row.name):
        groups[item.group].append(item)

    def share(some: Sequence[FleetRow], field: str, percent: float) -> float | None:
        values = [value for row in some if (value := getattr(row, field)) is not None]
        return float(np.percentile(values, percent)) if values else None

    return [
        CellFigures(
            name,
            len(some),
            sum(row.state != "failed" for row in some),
            sum(row.verdict == "good" for row in some),
            share(some, "radius95_mm", 50.0),
            share(some, "sigma_mm", 50.0),
            share(some, "error_mm", 95.0),
        )
        for name, some in groups.items()
    ]


@dataclass(frozen=True)
class _Measure:
    """Something that the sessions of one fleet have in common.

    Attributes:
        words: What it is.
        unit: Its unit.
        spread: What sound ones differ by, of the logarithm.
        is_worse_above: Whether only more of it is odd.
    """

    words: str
    unit: str
    spread: float = _SPREAD
    is_worse_above: bool = True


_MEASURES: Mapping[str, _Measure] = {
    "noise_mm": _Measure("noise of the robot", "mm"),
    "noise_deg": _Measure("noise of its rotation", "deg"),
    "noise_px": _Measure("noise of the corners", "px"),
    "residual_mm": _Measure("residual", "mm"),
    "arm_mm": _Measure("errors of the arm", "mm"),
    "drift_mm": _Measure("drift of the arm", "mm"),
    "focal_px": _Measure("focal length", "px", _LENS_SPREAD, is_worse_above=False),
}


def with_outliers(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """The rows with what stands out of each, those first that stand out the most.

    Sessions of one robot's model are compared, lenses also by the image's size: the logarithm of
    each figure by its median and median absolute deviation, which half of a fleet cannot shift.
    """
    scores: dict[str, float] = defaultdict(float)
    words: dict[str, list[str]] = defaultdict(list)
    for name, score, sentence in [*_odd_models(rows), *_odd_figures(rows)]:
        scores[name] = max(scores[name], score)
        words[name].append(sentence)
    found = [replace(row, score=scores[row.name], stands_out="; ".join(words[row.name]))
             for row in rows]  # fmt: skip
    order = {"": 0, "bad": 1, "check": 2, "good": 3}
    return sorted(found, key=lambda value: (-value.score, order.get(value.verdict, 0), value.name))


def _odd_models(rows: Sequence[FleetRow]) -> list[tuple[str, float, str]]:
    counts = Counter(row.robot for row in rows if row.robot)
    if not counts:
        return []
    usual, most = counts.most_common(1)[0]
    total = sum(counts.values())
    if total < _FEWEST or most < _MOST * total:
        return []
    return [
        (row.name, _ODD_MODEL, f"its robot is a {row.robot}, where {most} of {total} are {usual}")
        for row in rows
        if row.robot and row.robot != usual and counts[row.robot] <= _FEW * total
    ]


def _odd_figures(rows: Sequence[FleetRow]) -> list[tuple[str, float, str]]:
    found = []
    for field, measure in _MEASURES.items():
        groups: dict[tuple[str, str], list[tuple[str, float]]] = defaultdict(list)
        for row in rows:
            value = getattr(row, field)
            if value is not None and value > 0.0:
                camera = row.camera if field == "focal_px" else ""
                groups[row.robot, camera].append((row.name, value))
        for members in groups.values():
            if len(members) >= _FEWEST:
                found += _beyond(members, measure)
    return found


def _beyond(
    members: Sequence[tuple[str, float]], measure: _Measure
) -> list[tuple[str, float, str]]:
    logs = np.log([value for _, value in members])
    middle = float(np.median(logs))
    spread = max(_MAD * float(np.median(np.abs(logs - middle))), measure.spread)
    scores = (logs - middle) / spread
    if not measure.is_worse_above:
        scores = np.abs(scores)
    usual = float(np.exp(middle))
    return [
        (
            name,
            score,
            f"{measure.words} {figure(value)} {measure.unit}, "
            f"where {figure(usual)} {measure.unit} is usual",
        )
        for (name, value), score in zip(members, scores.tolist(), strict=True)
        if score > _LIMIT
    ]


def with_changes(
    rows: Sequence[FleetRow],
    before: Callable[[str], Calibration | None],
    after: Callable[[str], Calibration | None],
) -> list[FleetRow]:
    """The rows with how each result differs from an earlier one of the same session.

    Args:
        rows: The rows.
        before: The earlier result by name; None where there is none.
        after: The present one; likewise.
    """
    found = []
    for row in rows:
        old, new = before(row.name), after(row.name)
        if old is None and new is None:
            found.append(row)
            continue
        change = _change(old, new)
        found.append(replace(row, changed=bool(change), change=change))
    return found


def _change(old: Calibration | None, new: Calibration | None) -> str:
    """What differs by more than the earlier result's sigmas; empty for nothing."""
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
