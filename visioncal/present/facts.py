"""What a result says, as facts and rows that pages and recordings show."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import decimals_for, matched, significant
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Target
from visioncal.present.words import level_reason
from visioncal.results import Calibration, Rms, SolverResult
from visioncal.results.arm import ArmErrorsResult, ArmResult, ElasticResult
from visioncal.results.sections import BoardResult, UncertaintyResult

PLUS_MINUS = "\N{PLUS-MINUS SIGN}"
_UNITS = {"_px": "px", "_mm": "mm", "_deg": "deg"}
# What would lower each source's part.
_REMEDIES = {
    "pixels": "sharper images, or a board that fills more of them, would lower it",
    "instrument": "a nearer or a better instrument would lower it",
    "robot": "more stops would lower it",
    "poses": "more poses would lower it",
    "intrinsics": "views with the board near the image's edges would lower it",
    "board": "squares measured over the whole board would lower it",
    "arm": "what of it looks the same in all views stays, and a calibrated arm's poses make up "
    "for it",
    "temperature": "more views while the arm warms up would lower it",
    "priors": "measuring more exactly by hand would lower it",
    "held_values": "stating lens and board better, or letting them move, would lower it",
    "noise_level": "more stops would lower it",
    "lens_field": "a model that fits the lens would lower it, more views would not",
    "misfit": "a cell that has warmed up and settled would lower it",
}


@dataclass(frozen=True)
class Fact:
    """A labelled figure or phrase."""

    label: str
    value: str
    note: str = ""


def frame_words(frame: str) -> str:
    """What a frame is the frame of."""
    return {"cam": "the camera", "base": "the robot's base"}.get(frame, f"the {frame}")


def answering_solver(calibration: Calibration) -> str | None:
    """The solver whose transforms are the result; None where none's are."""
    for name, result in calibration.solvers.items():
        if all(
            edge in result.matrices and np.array_equal(result.matrices[edge], it.matrix)
            for edge, it in calibration.edges.items()
        ):
            return name
    return None


def solver_rows(
    calibration: Calibration,
) -> Iterator[tuple[str, SolverResult, list[tuple[float | None, float | None]]]]:
    """The solvers by label, each with its distances from the result's edges [mm], [deg]."""
    answer = answering_solver(calibration)
    for name, result in calibration.solvers.items():
        if name == answer:
            yield f"{name} (result)", result, [(None, None)] * len(calibration.edges)
            continue
        yield (
            name,
            result,
            [
                pose_difference(edge.matrix, result.matrices[it])
                if it in result.matrices
                else (None, None)
                for it, edge in calibration.edges.items()
            ],
        )


def residual_rows(calibration: Calibration) -> list[tuple[str, Rms]]:
    """Residuals of the fit, of views left out in turn, and of the declared hold-out set."""
    validation = calibration.validation
    sets = [
        ("used views, as fitted", calibration.rms),
        (f"left out in turn ({validation.method})", validation.held_out),
        ("declared hold-out views", validation.holdout),
    ]
    return [(label, rms) for label, rms in sets if rms is not None]


def summary(calibration: Calibration, found: UncertaintyResult) -> tuple[str, ...]:
    """Sentences: how well a point is placed where the views look, and what limits it."""
    parent, _, sensor = next(iter(calibration.edges)).partition("_from_")
    where = "the views look" if calibration.camera is not None else "it was measured"
    sentences = [
        f"A point where {where}, {significant(found.distance_m)} m from {frame_words(sensor)}, is "
        f"placed in the frame of {frame_words(parent)} with a sigma of "
        f"{significant(found.total_mm)} mm; 95 % of such results are right to within "
        f"{significant(found.radius95_mm)} mm."
    ]
    if found.total_mm > 0.0:
        largest = next(iter(found.parts_mm))
        remedy = f"; {_REMEDIES[largest]}" if largest in _REMEDIES else ""
        sentences.append(
            f"The largest part, {found.percent(largest)} of the variance, comes from the "
            f"{largest.replace('_', ' ')}{remedy}."
        )
    return tuple(sentences)


def noise_facts(calibration: Calibration) -> tuple[Fact, ...]:
    """The noise's levels, with the intervals that they lie in with 95 % where these are known."""
    known = calibration.uncertainty
    intervals = {} if known is None else known.noise_95
    return tuple(
        _noise_fact(name, value, intervals.get(name)) for name, value in calibration.noise.items()
    )


def _noise_fact(name: str, value: float, interval: tuple[float, float] | None) -> Fact:
    stem, unit = name, ""
    for suffix, word in _UNITS.items():
        if name.endswith(suffix):
            stem, unit = name.removesuffix(suffix), word
    note = ""
    if interval is not None:
        low, high = interval
        note = f"95 %: {significant(low)} to {significant(high)}"
    return Fact(stem.replace("_", " "), f"{significant(value)} {unit}".strip(), note)


def board_facts(
    calibration: Calibration, board: BoardResult, target: Target | None
) -> tuple[Fact, ...]:
    """The board's size and shape, stated and found; empty where nothing was looked for."""
    if not board.sigma:
        return ()
    if answering_solver(calibration) not in (None, "joint"):
        return (Fact("size and shape", "as stated", "a closed form takes them as they are"),)
    facts = [] if target is None else list(_size_facts(board, target))
    if board.is_bent:
        facts.append(Fact("bend", f"{significant(board.bend_mm)} mm", "of depth over its corners"))
    else:
        facts.append(Fact("bend", "none", "flat within what is seen"))
    if "shear" in board.estimated:
        angle, sigma = np.rad2deg([board.shape["shear"], board.sigma["shear"]])
        known = f"{PLUS_MINUS} {significant(sigma)}"
        angle_deg = f"{90 - angle:.{decimals_for(sigma)}f} deg"
        facts.append(Fact("angle of rows and columns", angle_deg, known))
    return tuple(facts)


def _size_facts(board: BoardResult, target: Target) -> tuple[Fact, ...]:
    sigma_mm = 1e3 * target.square_sigma_m
    stated = Fact(
        "squares, stated",
        f"{matched(1e3 * target.square_m, sigma_mm)} mm",
        f"{PLUS_MINUS} {significant(sigma_mm)}",
    )
    moved = {"scale", "aspect"} & set(board.estimated)
    if not moved:
        return (stated, Fact("squares, found", "as stated", "nothing speaks against it"))
    known_mm = 1e3 * target.square_m * board.sigma.get("scale", target.square_sigma_m)
    decimals = decimals_for(known_mm)
    x_mm, y_mm = (f"{1e3 * it:.{decimals}f}" for it in board.squares_m(target))
    note = f"{PLUS_MINUS} {significant(known_mm)}"
    if "scale" in moved:
        note += ", between what is stated and what the robot's motion measures"
    found = f"{x_mm} \N{MULTIPLICATION SIGN} {y_mm} mm"
    return (stated, Fact("squares, found", found, note))


def arm_facts(arm: ArmErrorsResult) -> tuple[Fact, ...]:
    """The size of the errors that follow the arm's posture."""
    treated = (
        ("estimated along with the result", "what looks the same in all views is left, see above")
        if arm.estimated
        else ("not taken out", "no joint angles with a known robot model: only their size is known")
    )
    away: tuple[Fact, ...] = ()
    if arm.away_mm is not None and arm.away_deg is not None:
        predicted = (
            f"{significant(arm.away_predicted_mm)} mm, {significant(arm.away_predicted_deg)} deg"
        )
        away = (
            Fact(
                "at postures away from the views it errs by",
                f"{significant(arm.away_mm)} mm, {significant(arm.away_deg)} deg",
                f"parts of the postures left out in turn; predicted {predicted}",
            ),
        )
    return (
        Fact(
            f"{'the flange' if arm.of else 'a link'} is typically off by",
            f"{significant(arm.sigma_mm)} mm, {significant(arm.sigma_deg)} deg",
        ),
        *away,
        Fact("likelihood ratio", f"{arm.likelihood_ratio:.0f}", "noise alone stays under 15"),
        Fact("its errors were", *treated),
    )


def arm_sentences(found: ArmResult) -> list[str]:
    """Which level of the arm was taken and why, and how accurate it is."""
    sentences, sigma = [level_reason(found)], found.workspace_sigma_mm
    if sigma is not None:
        median, p95 = significant(sigma.median), significant(sigma.p95)
        sentences.append(
            f"All over the workspace, a tool's place is predicted with a sigma of {median} mm "
            f"(median; 95 % of the places: under {p95} mm)."
        )
    if found.carries_over is not None:
        sentences.append(found.carries_over.words)
    return sentences


def identifiability_facts(found: ArmResult) -> Iterator[Fact]:
    """How many directions the stops determine, and how well."""
    known = found.observability
    if known is not None:
        count = f"{known.determined} of {known.identifiable}"
        yield Fact("directions determined", count, "that any stops could determine")
        if known.condition is not None:
            note = "best over worst determined, scaled"
            yield Fact("condition", significant(known.condition), note)


def spring_facts(elastic: ElasticResult) -> Iterator[Fact]:
    """What the loads of the stops do."""
    median, most = significant(elastic.sag_mm.median), significant(elastic.sag_mm.most)
    yield Fact("the flange gives way by", f"{median} mm", f"median; at most {most} mm")
    low, high = map(significant, elastic.payload_kg)
    if elastic.payload_kg[1] > 0.0:
        yield Fact("payload", f"{low} to {high} kg")
    if elastic.payload_factor is not None:
        factor = elastic.payload_factor
        note = f"\N{PLUS-MINUS SIGN} {significant(factor.sigma)}; 1 where load and bend fit"
        yield Fact("load as stated, times", f"{factor.value:.2f}", note)
