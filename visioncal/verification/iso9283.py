"""Pose performance of an arm by ISO 9283:1998, section 7, from cycles of commanded poses.

Accuracy AP is the distance of the mean attained pose from the commanded one, repeatability
RP = mean + 3 s of the distances from that mean, in rotation 3 s about each axis. The device's own
noise is known and taken off: a repeatability under its sigma is a bound. Intervals are of 95 %.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, invert, log, mean_transform
from visioncal.core.types import FloatArray, IntArray
from visioncal.results import Calibration
from visioncal.session import Session, View
from visioncal.session.table import reported_matrices
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.loaded import predict_readings
from visioncal.verification.prediction import predict_stops

POSES, CYCLES = 5, 30  # By the standard.
# Estimate, and the ends of its interval of 95 % [mm] or [deg].
Interval: TypeAlias = tuple[float, float, float]
_ENDS = np.array([0.025, 0.975])
# Draws of errors, fewest rows of a pose, and largest difference of one pose [m, rad].
_DRAWS, _LEAST, _SAME = 20_000, 5, 1e-3


@dataclass(frozen=True)
class PosePerformance:
    """Performance at one commanded pose; rotations are None where they were not measured."""

    pose: str  # Its name: column group, or P1, P2 ... by commanded pose.
    cycles: int
    accuracy_mm: Interval  # AP.
    repeatability_mm: Interval  # RP, without the device's own noise.
    measured_repeatability_mm: float  # RP as the standard has it, with that noise.
    device_mm: float  # RP that the device alone would show.
    accuracy_deg: tuple[Interval, ...] | None = None  # AP about the base's x, y and z.
    repeatability_deg: tuple[Interval, ...] | None = None  # RP about these.
    variation_mm: float | None = None  # vAP, where column direction names several.
    drift_mm: float | None = None  # dAP of the last from the first third, where stamps are known.

    @property
    def is_bound(self) -> bool:
        """Whether the repeatability is known as an upper bound alone."""
        return self.repeatability_mm[1] == 0.0


@dataclass(frozen=True)
class Performance:
    """Performance of an arm."""

    poses: tuple[PosePerformance, ...]
    # Distance accuracy AD between two poses, by their names: estimate and interval [mm].
    distances_mm: Mapping[str, Interval]
    device: str  # The measuring device.
    stated: Mapping[str, str]  # Load, speed, temperature and serial number as the session has them.

    def document(self) -> dict[str, Any]:
        """Content of iso9283.json."""
        rows = [
            {key: value for key, value in asdict(pose).items() if value is not None}
            for pose in self.poses
        ]
        return {"standard": "ISO 9283:1998", **asdict(replace(self, poses=())), "poses": rows}

    def sentences(self) -> list[str]:
        """The performance in words, with what it does not cover."""
        lines = [_words(pose) for pose in self.poses]
        for name, (value, low, high) in self.distances_mm.items():
            lines.append(
                f"distance {name}: AD {figure(value)} mm ({figure(low)} to {figure(high)})"
            )
        few = [pose for pose in self.poses if pose.cycles < CYCLES]
        if len(self.poses) < POSES or few:
            least = min(pose.cycles for pose in self.poses)
            lines.append(
                f"The standard asks for {POSES} poses in {CYCLES} cycles; these are "
                f"{len(self.poses)} in {least} and more: the figures are no certificate by it."
            )
        missing = [name for name in ("load", "speed", "temperature") if name not in self.stated]
        stated = ", ".join(f"{name} {value}" for name, value in self.stated.items())
        lines.append(f"Conditions: {stated or 'none stated'}.")
        if missing:
            lines[-1] += f" The standard asks for {', '.join(missing)} as well."
        return [*lines, "Path accuracy and repeatability (AT, RT) were not measured."]


def _words(pose: PosePerformance) -> str:
    value, low, high = pose.accuracy_mm
    rp, least, most = pose.repeatability_mm
    words = f"{pose.pose}, {pose.cycles} cycles: AP {figure(value)} mm ({figure(low)} to "
    words += f"{figure(high)}), RP "
    if pose.is_bound:
        words += f"at most {figure(most)} mm, as the device alone shows {figure(pose.device_mm)}"
    else:
        words += f"{figure(rp)} mm ({figure(least)} to {figure(most)})"
    if pose.repeatability_deg is not None:
        turns = [
            f"at most {figure(end)}" if start == 0.0 else f"{figure(at)}"
            for at, start, end in pose.repeatability_deg
        ]
        words += f", in rotation {', '.join(turns)} deg"
    if pose.variation_mm is not None:
        words += f", vAP {figure(pose.variation_mm)} mm"
    if pose.drift_mm is not None:
        words += f", dAP {figure(pose.drift_mm)} mm"
    return words


@dataclass(frozen=True, eq=False)
class Attained:
    """Attained and commanded poses of m views, in the base."""

    views: tuple[View, ...]
    poses: FloatArray  # (m, 4, 4) attained [m].
    commanded: FloatArray  # (m, 4, 4).
    noise: FloatArray  # (m, 6, 6) covariance of one measurement, in the base's axes.
    frames: FloatArray  # (m, 6, k) what an error of the calibration's frames moves, likewise.
    covariance: FloatArray  # (k, k) of these.
    has_rotation: bool
    device: str


def attained_by(session: Session, calibration: Calibration) -> Attained:
    """Measures the poses of a session by a calibrated camera or instrument; raises DataError."""
    by_number = {view.number: view for view in session.views}
    if session.mount == "instrument":
        seen = predict_readings(session, calibration)
        x, z = seen.prior.state.edges[:2]
        poses, device = x @ seen.read, session.instruments[""].name or "instrument"
        views = tuple(by_number[number] for number in seen.views)
        local, has_rotation = seen.reading_variances[:, :, None] * np.eye(6), len(seen.axes) == 6
        by_frames = np.concatenate(
            [adjoint(invert(seen.read)), -np.tile(np.eye(6), (len(views), 1, 1))], axis=2
        )
        prior, tool = seen.prior, z
    else:
        prior = CalibrationPrior.of(calibration)
        stops = predict_stops(session, prior)
        problem, (x, z) = stops.problem, prior.state.edges[:2]
        measured, covariance = problem.measured(prior.state), problem.observations.covariance
        if session.mount == "eye-in-hand":
            poses = z @ invert(measured) @ invert(x)
            turn = adjoint(x @ measured)
            by_frames = np.concatenate([-np.tile(adjoint(x), (len(measured), 1, 1)), turn], axis=2)
        else:
            poses = x @ measured @ invert(z)
            turn = np.tile(adjoint(z), (len(measured), 1, 1))
            by_frames = np.concatenate([adjoint(z @ invert(measured)), -turn], axis=2)
        local, tool, device, has_rotation = (
            turn @ covariance @ np.swapaxes(turn, 1, 2),
            np.eye(4),
            "camera",
            True,
        )
        views = tuple(by_number[number] for number in stops.views)
    axes = np.zeros((len(views), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = poses[:, :3, :3]
    frames = axes @ by_frames
    return Attained(
        views,
        poses,
        _commanded(session, calibration, views) @ tool,
        axes @ local @ np.swapaxes(axes, 1, 2),
        frames,
        prior.covariance[:12, :12],
        has_rotation,
        device,
    )


def _commanded(session: Session, calibration: Calibration, views: Sequence[View]) -> FloatArray:
    """(m, 4, 4) commanded poses of the flange: as the controller reports them, or by its model."""
    reported = reported_matrices(views)
    if len(reported) == len(views):
        return np.array([reported[view.number] for view in views])
    joints = [view.joints_rad for view in views]
    if calibration.robot is None or any(q is None for q in joints):
        raise DataError(
            f"session {session.name!r}: rows have neither the controller's pose (x_m ...) nor the "
            "joint angles of a known arm: what was commanded is not known.",
            culprits=["views.csv: x_m"],
            next_step="Record x_m ... qw, or q1_rad ..., with every row.",
        )
    return calibration.robot.base_from_flange(np.array(joints))


def performance(session: Session, calibration: Calibration) -> Performance:
    """Evaluates the cycles of a session by a calibrated camera or instrument.

    Args:
        session: Rows of each commanded pose, one a cycle; column `group` names the pose, else rows
            of equal commands are of one. `direction` may name the side that it came from.
        calibration: Of the same cell, which measures.

    Raises:
        DataError: The session is of another cell, or no pose has five cycles.
    """
    seen = attained_by(session, calibration)
    rows: dict[str, list[int]] = {}
    for at, (view, pose) in enumerate(zip(seen.views, seen.commanded, strict=True)):
        # Controllers report a command again to some hundredths of a millimetre.
        same = (key for key, each in rows.items()
                if np.abs(seen.commanded[each[0]] - pose).max() < _SAME)  # fmt: skip
        name = view.text.get("group", "") or next(same, f"P{len(rows) + 1}")
        rows.setdefault(name, []).append(at)
    rows = {name: each for name, each in rows.items() if len(each) >= _LEAST}
    if not rows:
        raise DataError(
            f"session {session.name!r}: no commanded pose has {_LEAST} rows or more.",
            culprits=["views.csv: group"],
            next_step="Drive to each of five poses in turn, 30 times: visioncal plan ROBOT "
            "--standard iso9283 writes them.",
        )
    names = list(rows)
    parts = [np.array(each) for each in rows.values()]
    poses = tuple(_pose(name, seen, part) for name, part in zip(names, parts, strict=True))
    distances = {
        f"{names[a]}-{names[b]}": _distance(seen, parts[a], parts[b])
        for a, b in combinations(range(len(parts)), 2)
        if b == a + 1
    }
    return Performance(poses, distances, seen.device, _stated(session, seen.views))


def _pose(name: str, seen: Attained, rows: IntArray) -> PosePerformance:
    """Performance at one pose of some rows."""
    count, poses = len(rows), seen.poses[rows]
    mean = mean_transform(poses)
    # Deviations in the base's axes (rotation, position).
    turns = log(invert(mean) @ poses)[:, :3] @ mean[:3, :3].T
    moves = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    noise = seen.noise[rows].mean(axis=0)
    away = np.linalg.norm(moves, axis=1)
    spread = moves.T @ moves / (count - 1)
    low, value, high, device_rp = _repeatability(spread, noise[3:, 3:], count)
    # The mean's own error, and that of the frames.
    frames = seen.frames[rows].mean(axis=0)
    by_frames = frames @ seen.covariance @ frames.T
    commanded = seen.commanded[rows].mean(axis=0)
    off = poses[:, :3, 3].mean(axis=0) - commanded[:3, 3]
    accuracy = _length(off, by_frames[3:, 3:] + spread / count)
    found = PosePerformance(
        pose=name,
        cycles=count,
        accuracy_mm=_scaled(1e3, accuracy),
        repeatability_mm=_scaled(1e3, (value, low, high)),
        measured_repeatability_mm=1e3 * float(away.mean() + 3.0 * away.std(ddof=1)),
        device_mm=1e3 * device_rp,
        **_over_time(seen, rows),
    )
    if not seen.has_rotation:
        return found
    off_rad = log(mean @ invert(seen.commanded[rows[0]]))[:3]
    sigmas = np.sqrt(np.diag(by_frames)[:3] + turns.var(axis=0, ddof=1) / count)
    device_variances = np.diag(noise)[:3].tolist()
    turned = [
        _repeatability(np.diag([square, 0, 0]), np.diag([of_device, 0, 0]), count, single=True)
        for square, of_device in zip(
            turns.var(axis=0, ddof=1).tolist(), device_variances, strict=True
        )
    ]
    degrees = float(np.rad2deg(1.0))
    return replace(
        found,
        accuracy_deg=tuple(
            _scaled(degrees, (at, at - 1.96 * sigma, at + 1.96 * sigma))
            for at, sigma in zip(off_rad.tolist(), sigmas.tolist(), strict=True)
        ),
        repeatability_deg=tuple(
            _scaled(degrees, (value, low, high)) for low, value, high, _ in turned
        ),
    )


def _repeatability(
    spread: FloatArray, noise: FloatArray, count: int, *, single: bool = False
) -> tuple[float, float, float, float]:
    """RP of a spread (3, 3) less a device's noise: low end, estimate, high end, and of the device.

    The trace follows a chi-square whose degrees of freedom are those of the spread's shape
    (Satterthwaite 1946); RP over its root is that of a normal distribution of this shape.
    """
    trace, noise_trace = float(np.trace(spread)), float(np.trace(noise))
    freedom = (count - 1) * trace**2 / max(float(np.sum(spread**2)), 1e-30)
    low, high = (freedom / chi2_limit(1.0 - end, freedom) for end in _ENDS[::-1])
    shape = 3.0 if single else _shape(spread)
    # A spread below the device's noise, by chance, bounds no better than that noise.
    parts = (low * trace, trace, high * max(trace, noise_trace))
    ends = [shape * float(np.sqrt(max(part - noise_trace, 0.0))) for part in parts]
    return (
        ends[0],
        ends[1],
        ends[2],
        (3.0 if single else _shape(noise)) * float(np.sqrt(noise_trace)),
    )


def _shape(spread: FloatArray) -> float:
    """RP of a normal distribution of some covariance, over the root of its trace."""
    values = np.maximum(np.linalg.eigvalsh(spread), 0.0)
    draws = np.random.default_rng(0).standard_normal((_DRAWS, 3)) * np.sqrt(values)
    away = np.linalg.norm(draws, axis=1)
    return float((away.mean() + 3.0 * away.std()) / np.sqrt(max(values.sum(), 1e-30)))


def _length(vector: FloatArray, covariance: FloatArray) -> Interval:
    """Length of a measured vector (3,), and its interval by what its error may be."""
    values, axes = np.linalg.eigh(covariance)
    draws = np.random.default_rng(0).standard_normal((_DRAWS, 3))
    errors = (draws * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    low, high = np.quantile(np.linalg.norm(vector + errors, axis=1), _ENDS).tolist()
    length = float(np.linalg.norm(vector))
    # A vector within its own error may be none at all.
    known = vector @ np.linalg.pinv(covariance, hermitian=True) @ vector
    return length, 0.0 if known < chi2_limit(0.05, 3) else low, high


def _distance(seen: Attained, first: IntArray, second: IntArray) -> Interval:
    """AD of two poses: mean attained less commanded distance, and its interval [mm]."""
    means = [seen.poses[rows][:, :3, 3].mean(axis=0) for rows in (first, second)]
    goals = [seen.commanded[rows][:, :3, 3].mean(axis=0) for rows in (first, second)]
    between = means[1] - means[0]
    length = float(np.linalg.norm(between))
    frames = (seen.frames[second].mean(axis=0) - seen.frames[first].mean(axis=0))[3:]
    of_means = [np.cov(seen.poses[rows][:, :3, 3].T) / len(rows) for rows in (first, second)]
    covariance = frames @ seen.covariance @ frames.T + of_means[0] + of_means[1]
    sigma = float(np.sqrt(between @ covariance @ between)) / max(length, 1e-9)
    off = length - float(np.linalg.norm(goals[1] - goals[0]))
    return _scaled(1e3, (off, off - 1.96 * sigma, off + 1.96 * sigma))


def _over_time(seen: Attained, rows: IntArray) -> dict[str, Any]:
    """Variation between directions, and drift, where the rows have them [mm]."""
    found, places = dict[str, Any](), 1e3 * seen.poses[rows][:, :3, 3]
    sides = np.array([seen.views[row].text.get("direction", "") for row in rows])
    if len(set(sides)) > 1:
        means = [places[sides == side].mean(axis=0) for side in sorted(set(sides))]
        found["variation_mm"] = max(float(np.linalg.norm(a - b)) for a, b in combinations(means, 2))
    stamps = [seen.views[row].stamp_s for row in rows]
    if all(stamp is not None for stamp in stamps):
        order, third = np.argsort(np.array(stamps, dtype=float)), max(len(rows) // 3, 1)
        drift = places[order[-third:]].mean(axis=0) - places[order[:third]].mean(axis=0)
        found["drift_mm"] = float(np.linalg.norm(drift))
    return found


def _scaled(unit: float, interval: Interval) -> Interval:
    return (unit * interval[0], unit * interval[1], unit * interval[2])


def _stated(session: Session, views: Sequence[View]) -> dict[str, str]:
    """Load, speed, temperature and serial number, as the session states them."""
    stated = dict[str, str]()
    for name, column, unit in (
        ("load", "payload_kg", "kg"),
        ("temperature", "ambient_c", "deg C"),
        ("speed", "speed_percent", "%"),
    ):
        cells = [view.cell(column) for view in views if column in session.columns]
        numbers = [float(cell) for cell in cells if cell]
        if numbers:
            ends = dict.fromkeys(f"{end:g}" for end in (min(numbers), max(numbers)))
            stated[name] = f"{' to '.join(ends)} {unit}"
    serial = session.document.get("robot", {}).get("serial")
    return stated | ({"serial number": str(serial)} if serial else {})
