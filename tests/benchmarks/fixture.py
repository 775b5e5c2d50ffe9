"""A fixture's frame from its points: accuracy, sigma, wrong points and exchanged ones.

Parts of 40 cm lie anywhere; every point has its own, uneven noise (0.05 mm, and 0.5 mm along one
direction, as a camera sees points), or an even one of 0.1 mm that nobody tells the fit. The
Cramer-Rao bound is computed from central differences, by code of its own. The unweighted fit is
scipy's Rotation.align_vectors of the centred points.

    PYTHONPATH=tests python tests/benchmarks/fixture.py
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from results import few, write_section
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from scipy.stats import f as f_distribution
from support.parts import (
    away,
    even,
    feature_bound,
    noise_of,
    pairs_of,
    placed,
    point_bound,
    some_drawing,
    some_frame,
    some_touches,
    uneven,
)

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.estimation.features import fit_features
from visioncal.estimation.pointfit import PointPairs, fit_points

COUNTS, SEEDS = (3, 4, 6, 12), few(300, 3)
EVEN_M, SLIPS_M = 1e-4, (1e-3, 3e-3)
FEATURES = {
    "2 of each": ("origin", "x", "xy") * 2,
    "4 of each": ("origin", "x", "xy") * 4,
    "1, 2, 6": ("origin", "x", "x", *("xy",) * 6),
}


@dataclass(frozen=True)
class Trial:
    """One fit: squared errors (2,) of rotation and offset, those of the bound, and the rest.

    `mahalanobis_sq` is the squared error over the covariance, and `inside` whether the 95 % region
    holds the true frame: of chi-square, or of F where the noise's level is estimated.
    """

    squares: FloatArray
    bounds: FloatArray
    plain: FloatArray
    mahalanobis_sq: float
    inside: bool
    accused: int


def unweighted(pairs: PointPairs) -> FloatArray:
    centres = pairs.measured.mean(axis=0), pairs.nominal.mean(axis=0)
    turn, _ = Rotation.align_vectors(pairs.measured - centres[0], pairs.nominal - centres[1])
    frame = np.eye(4)
    frame[:3, :3] = turn.as_matrix()
    frame[:3, 3] = centres[0] - turn.apply(centres[1])
    return frame


def parts_of(square: FloatArray) -> FloatArray:
    return np.array([square[:3].sum(), square[3:].sum()])


def f_limit(freedom: int) -> float:
    return 6.0 * float(f_distribution.ppf(0.95, 6, freedom))


def trial(seed: int, count: int, known: bool) -> Trial:
    rng = np.random.default_rng(seed)
    frame, nominal = some_frame(rng), some_drawing(rng, count)
    spreads = uneven(rng, count) if known else even(count, EVEN_M)
    pairs = pairs_of(
        nominal, placed(frame, nominal) + noise_of(spreads, rng), spreads if known else None
    )
    found = fit_points(pairs)
    error = away(found.base_from_fixture, frame)
    mahalanobis_sq = float(error @ np.linalg.solve(found.covariance, error))
    limit = chi2.ppf(0.95, 6) if known else f_limit(found.agreement.fit.freedom)
    return Trial(
        parts_of(error**2),
        parts_of(np.diag(point_bound(frame, nominal, spreads))),
        parts_of(away(unweighted(pairs), frame) ** 2),
        mahalanobis_sq,
        bool(mahalanobis_sq < limit),
        int(np.sum(~found.agreement.mask)),
    )


def feature_trial(seed: int, kinds: Sequence[str]) -> Trial:
    rng = np.random.default_rng(seed)
    frame = some_frame(rng)
    exact = some_touches(rng, frame, kinds)
    found = fit_features(
        replace(exact, points=exact.points + EVEN_M * rng.normal(size=(len(exact), 3)))
    )
    error = away(found.base_from_fixture, frame)
    mahalanobis_sq = float(error @ np.linalg.solve(found.agreement.fit.covariance, error))
    return Trial(
        parts_of(error**2),
        parts_of(np.diag(feature_bound(frame, exact, EVEN_M))),
        np.full(2, np.nan),
        mahalanobis_sq,
        bool(mahalanobis_sq < f_limit(found.agreement.fit.freedom)),
        int(np.sum(~found.agreement.mask)),
    )


def accuracy_row(name: str, trials: Sequence[Trial], expected: str) -> str:
    bounds = np.mean([item.bounds for item in trials], axis=0)
    share = np.sqrt(np.mean([item.squares for item in trials], axis=0) / bounds)
    plain = np.sqrt(np.mean([item.plain for item in trials], axis=0) / bounds)
    beside = "-" if np.isnan(plain[0]) else f"{plain[0]:.2f}, {plain[1]:.2f}"
    mahalanobis_sq = np.mean([item.mahalanobis_sq for item in trials])
    alarms = sum(item.accused > 0 for item in trials)
    inside = 100 * np.mean([item.inside for item in trials])
    return (
        f"| {name} | {share[0]:.2f}, {share[1]:.2f} | {beside} "
        f"| {mahalanobis_sq:.2f} ({expected}) | {inside:.1f} % | {alarms} in {len(trials)} |"
    )


def expected_mahalanobis_sq(freedom: int) -> str:
    """Mean of six times F(6, freedom), where it has one."""
    # Under five degrees it has no variance, and no sample's mean comes near it.
    return f"{6 * freedom / (freedom - 2):.2f}" if freedom > 4 else "without a variance"


def outcome(pairs: PointPairs) -> tuple[tuple[int, ...], str]:
    """Points that were left out, and what was refused."""
    try:
        found = fit_points(pairs)
    except DataError as error:
        return (), error.message
    return tuple(np.flatnonzero(~found.agreement.mask)), ""


def slipped(count: int, slip_m: float) -> str:
    """How often just the one wrong point of a set is left out, and how often others are."""
    named = others = refused = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        frame, nominal, at = some_frame(rng), some_drawing(rng, count), int(rng.integers(count))
        points = placed(frame, nominal) + EVEN_M * rng.normal(size=(count, 3))
        turn = rng.normal(size=3)
        points[at] += slip_m * turn / np.linalg.norm(turn)
        left_out, message = outcome(pairs_of(nominal, points))
        named += left_out == (at,)
        others += bool(set(left_out) - {at})
        refused += bool(message)
    return f"{percent(named)} ({percent(others)}, {percent(refused)})"


def reordered(count: int, order: Callable[[int], Sequence[int]]) -> str:
    """How often a wrong order is named: refused, or told while just its points are left out."""
    named = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        frame, nominal, chosen = some_frame(rng), some_drawing(rng, count), list(order(count))
        points = placed(frame, nominal[chosen]) + EVEN_M * rng.normal(size=(count, 3))
        left_out, message = outcome(pairs_of(nominal, points))
        moved = tuple(np.flatnonzero(np.array(chosen) != np.arange(count)))
        named += any(name in message for name in ("exchanged", "shifted")) or left_out == moved
    return percent(named)


def mirrored(count: int) -> str:
    refused = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        frame, nominal = some_frame(rng), some_drawing(rng, count)
        points = placed(frame, nominal) + EVEN_M * rng.normal(size=(count, 3))
        refused += "mirror" in outcome(pairs_of(nominal * [1.0, -1.0, 1.0], points))[1]
    return percent(refused)


def percent(hits: int) -> str:
    return f"{100 * hits / SEEDS:.4g} %"


def accuracy() -> list[str]:
    rows = [
        "| points or touches | error over bound: rotation, offset | unweighted | NEES (expected) | "
        "in the 95 % region | sound ones accused |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for count in COUNTS:
        known = [trial(seed, count, known=True) for seed in range(SEEDS)]
        rows.append(accuracy_row(f"{count} points, uneven noise, known", known, "6, or less"))
        unknown = [trial(seed, count, known=False) for seed in range(SEEDS)]
        expected = expected_mahalanobis_sq(3 * count - 6)
        rows.append(accuracy_row(f"{count} points, even noise, unknown", unknown, expected))
    for name, kinds in FEATURES.items():
        touched = [feature_trial(seed, kinds) for seed in range(SEEDS)]
        freedom = sum({"origin": 3, "x": 2, "xy": 1}[kind] for kind in kinds) - 6
        rows.append(
            accuracy_row(
                f"origin, x, xy: {name}, unknown", touched, expected_mahalanobis_sq(freedom)
            )
        )
    return rows


def mistakes() -> list[str]:
    slips = [f"slip of {1e3 * slip:g} mm: named (another accused, refused)" for slip in SLIPS_M]
    rows = [
        f"| points | {' | '.join(slips)} | two exchanged | all shifted | mirrored |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for count in COUNTS:
        cells = [slipped(count, slip) for slip in SLIPS_M]
        cells.append(reordered(count, lambda n: [1, 0, *range(2, n)]))
        cells.append(reordered(count, lambda n: [*range(1, n), 0]))
        cells.append("in one plane: cannot be told" if count == 3 else mirrored(count))
        rows.append(f"| {count} | {' | '.join(cells)} |")
    return rows


def main() -> None:
    """Prints the tables and keeps them."""
    with one_blas_thread():
        text = "\n".join(
            (
                f"{SEEDS} parts of 40 cm a row; root mean square over all of them. If the noise "
                "level is estimated from few residuals, the squared error over the "
                "covariance (NEES) is six times an F variable, with a mean above 6.\n",
                *accuracy(),
                "",
                "Wrong points and wrong orders, with uniform noise of 0.1 mm that is unknown to "
                "the fit:\n",
                *mistakes(),
            )
        )
    print(text)
    write_section("Fixture", "PYTHONPATH=tests python tests/benchmarks/fixture.py", text)


if __name__ == "__main__":
    main()
