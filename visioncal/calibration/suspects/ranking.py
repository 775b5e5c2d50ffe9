"""Ranking of findings by the probability that each is the cause of a bad result.

The probability depends on the kind of finding:

- Test results: by the false-alarm probability p of the test. With even prior odds, the odds of a
  fault against "nothing is wrong" are at least 1 to -e p ln p (Sellke, Bayarri and Berger 2001).
  Findings that explain the same misfit compete: their odds are normalised, together with "none of
  these", which is the cause `unexplained`. A finding that moves picks by less than left-out views
  disagree explains at most the squared ratio of both.
- Error sources that are too large with nothing wrong: by their share of a pick's mean squared
  error.
- Facts, such as an unconnected frame: probability one. Remarks without a test, and sigmas beyond
  their limits, are facts that are causes only where there is no other.

A probability is stated where a cure, applied and refitted, proves the cause (`contest`). All others
are only ranked by theirs (`Finding.by_limit`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit, log_ndtr, logit

from visioncal.calibration.stages.need import CONTROLLER, Picks, least_precise
from visioncal.calibration.suspects.arm import NO_JOINTS
from visioncal.calibration.suspects.registry import SUSPECTS
from visioncal.calibration.suspects.suspect import ARM_ERRORS, CHAIN, FACT, UNEXPLAINED
from visioncal.core.limits import CalibrationLimits, NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.types import Need
from visioncal.core.verdict import ADD_VIEWS, CALIBRATE, REVIEW, Finding, Remedy
from visioncal.results import NeedMet
from visioncal.robot.model import REPEATABILITY

# Probability from which on a mistake precedes sigmas beyond their limits.
_LIKELIER = 0.5
# Kinds of errors that are in the fit, or inflate no sigma, where no test of their own says more.
_ACCOUNTED = ("board_shape", "lens", "tool_frame")
# Removing a source with a smaller share of the variance would reduce a pick's error by under 5 %.
_LEAST_SHARE = 0.1

MEASURE_BOARD = Remedy(
    "Measure the board with a caliper over its whole width, and state square_m, the side of one "
    "square (of a marker size_m, its side), and square_sigma_m, how well it is known, of the "
    "target: more views determine neither."
)
# Error sources of picks: kind of the finding, words, and remedy.
_SOURCES: Mapping[str, tuple[str, str, Remedy | None]] = {
    "calibration": ("calibration", "the calibration itself", None),
    "board": ("unmeasured_board", "the board, whose size is not known better", MEASURE_BOARD),
    "look": (
        "robot_noise",
        "the robot's own noise where it looks, which more views do not change",
        Remedy("Look several times from different stops, and take the mean."),
    ),
    "pick": (
        "robot_noise_of_pick",
        "the robot's own noise where it picks, which no calibration changes",
        Remedy("Take a robot that repeats better, or a gripper that tolerates more."),
    ),
    CONTROLLER: (
        "uncorrected_targets",
        "the controller's own model of the arm, which the calibration corrects",
        None,
    ),
    "arm": (ARM_ERRORS, "the arm's own errors, which more views do not change", NO_JOINTS),
    "left out": (
        UNEXPLAINED,
        "errors of left-out views that the prediction does not explain",
        Remedy(
            "Look at the worst views: does each pose belong to its image, did anything move?",
            REVIEW,
        ),
    ),
}


def correcting(need: Need | None) -> Remedy:
    """Advice to correct targets for a calibrated arm; with a need, to have it judged so."""
    words = "Correct targets for the calibrated arm before they are sent"
    correct = "visioncal correct targets.csv --against OUT -o corrected.csv"
    if need is None:
        return Remedy(f"{words}.", correct)
    return Remedy(
        f"{words}; with --corrected, the verdict is about them.",
        f"{CALIBRATE} --corrected && {correct}",
    )


def add_views_remedy(words: str, *, modelled: bool, purpose: str = "", count: int = 5) -> Remedy:
    """Advice to add views, with the command that proposes them (and its options, `purpose`)."""
    if modelled:
        return Remedy(words, f"{ADD_VIEWS} {count}{purpose}")
    model = "With [robot] model in session.toml, visioncal plan proposes them."
    return Remedy(f"{words} {model}")


def rank_causes(
    doubts: Sequence[Finding],
    picks: Sequence[Picks],
    met: NeedMet | None,
    *,
    more: Remedy | None = None,
    left_out_mm: float = 0.0,
    repeats: tuple[float, float] = REPEATABILITY,
) -> tuple[Finding, ...]:
    """Ranks findings by their probability of being the cause, and adds too large error sources.

    Args:
        doubts: All findings, of kinds in the registry.
        picks: Error budgets of picks.
        met: The required accuracy and the probability of meeting it; None where none is stated.
        more: Remedy that makes the calibration less uncertain.
        left_out_mm: Disagreement of left-out views [mm].
        repeats: What the worst robot repeats to [mm, deg].

    Raises:
        KeyError: A kind is not in the registry.
    """
    found = _with_probabilities(doubts, left_out_mm)
    sigmas = [finding for finding in found if SUSPECTS[finding.kind].is_sigma]
    sigma = min(sigmas, key=lambda finding: SUSPECTS[finding.kind].size, default=None)
    # A sigma far beyond its limit alone makes a result bad, with no likely mistake. Errors
    # that the fit accounts for inflate none.
    is_likely = any(
        finding.probability >= _LIKELIER
        and (finding.kind not in _ACCOUNTED or finding.mahalanobis_sq > 0.0)
        for finding in found
    )
    decides = met is None and not is_likely and any(finding.is_fatal for finding in sigmas)
    enough, limit = NeedLimits.probability[0], Need(mm=CalibrationLimits.sigma_mm[0])
    unmet = met is not None and met.probability < enough
    too_large = any(pick.probability(limit) < enough for pick in picks)
    is_sized = any(doubt.until_mm == 0.0 or doubt.kind == UNEXPLAINED for doubt in doubts)
    if picks and not decides and (unmet or (met is None and too_large and is_sized)):
        causes = {finding.kind for finding in found if finding.probability}
        known = causes.union(*(SUSPECTS[kind].inflates for kind in causes))
        for source in _sources(picks, met, more, repeats):
            if source.kind in known:
                continue
            found.append(source)
            # An uncertain calibration is due to weak motion, if more views make it better.
            adds = more is not None and more != MEASURE_BOARD
            if source.kind == "calibration" and source.probability >= _LIKELIER and adds:
                weak = [finding for finding in found if finding.kind == "weak_motion"]
                for finding in weak[:1]:
                    found.remove(finding)
                    found.insert(0, replace(finding, probability=source.probability))
                    found[-1] = replace(source, do=finding.do)
    if decides or not any(finding.probability for finding in found):
        return tuple(
            replace(finding, probability=1.0 - FACT, by_limit=True, do=finding.do or more)
            if finding is sigma or not (decides or finding in sigmas)
            else finding
            for finding in found
        )
    return tuple(found)


def _with_probabilities(doubts: Sequence[Finding], left_out_mm: float) -> list[Finding]:
    """Findings with their probabilities among rivals; only the first of a kind is a cause."""
    first: dict[str, Finding] = {}
    for finding in doubts:
        if SUSPECTS[finding.kind].chance:
            first.setdefault(finding.kind, finding)
    misfit_mm = left_out_mm if UNEXPLAINED in first else 0.0
    hidden = {*_hidden({doubt.kind: doubt for doubt in reversed(doubts)}, misfit_mm)}
    log_odds = {
        name: 0.0 if name in hidden else _log_odds(finding, misfit_mm)
        for name, finding in first.items()
    }

    def weighed(finding: Finding) -> Finding:
        name, of_chain = finding.kind, SUSPECTS[finding.kind].of_chain
        competes = of_chain and not finding.is_apart
        found = replace(finding, do=None) if name in hidden else finding
        if first.get(name) is not finding or (name in hidden and not of_chain):
            return found
        rivals = [
            rival
            for rival, other in first.items()
            if competes and SUSPECTS[rival].of_chain and (name == UNEXPLAINED or not other.is_apart)
        ] or [name]
        among = [log_odds[rival] for rival in rivals]
        # "None of these" has odds one, unless `unexplained` stands for it as a finding.
        if UNEXPLAINED not in rivals:
            among.append(0.0)
        probability = float(np.exp(log_odds[name] - np.logaddexp.reduce(among)))
        return replace(found, probability=probability, by_limit=not finding.is_proven)

    return [weighed(doubt) for doubt in doubts]


def _hidden(first: Mapping[str, Finding], misfit_mm: float) -> Iterator[str]:
    """Kinds of findings that are mere effects of another, which can be as large as a misfit."""
    for name, finding in first.items():
        if finding.up_to_mm < misfit_mm:
            continue
        if name == "lens" and not finding.mahalanobis_sq:
            # It was refined with the rest.
            continue
        for kind in first.keys() - {name}:
            of_chain = SUSPECTS[kind].of_chain and CHAIN in SUSPECTS[name].hides
            if of_chain or kind in SUSPECTS[name].hides:
                yield kind


def _log_odds(doubt: Finding, misfit_mm: float = 0.0) -> float:
    """Lower bound of a fault's log odds, and of its share of the misfit that it can explain."""
    # By its chi-square, or the limit of its test.
    log_chance = float(np.log(SUSPECTS[doubt.kind].chance))
    if doubt.mahalanobis_sq:
        log_chance = min(np.log(2.0) + float(log_ndtr(-np.sqrt(doubt.mahalanobis_sq))), log_chance)
    log_chance = max(log_chance, np.finfo(float).min)
    log_odds = float(-1.0 - log_chance - np.log(-log_chance))
    is_part = bool(misfit_mm or doubt.mahalanobis_sq or doubt.kind == ARM_ERRORS)
    share = doubt.explains if is_part else 1.0
    share = min(share, (doubt.up_to_mm / misfit_mm) ** 2) if misfit_mm else share
    return log_odds if share == 1.0 else float(logit(share * expit(log_odds)))


def is_negligible(found: Finding, picks: Sequence[Picks]) -> bool:
    """Whether removing the cause of a finding would hardly reduce the error of picks."""
    least_mm = min((pick.budget_mm["total"] for pick in picks), default=0.0)
    return found.up_to_mm**2 < _LEAST_SHARE * least_mm**2


def _sources(
    picks: Sequence[Picks], met: NeedMet | None, more: Remedy | None, repeats: tuple[float, float]
) -> Iterator[Finding]:
    """Dominant error sources of the worst pair of camera and robot."""
    need = None if met is None else met.need
    worst = (
        least_precise(picks)
        if need is None
        else min(picks, key=lambda pick: pick.probability(need))
    )
    in_mm = need is None or need.mm is not None
    budget, unit = (worst.budget_mm, "mm") if in_mm else (worst.budget_deg, "deg")
    total = budget.pop("total")
    # More than an arm errs by, or repeats to, is not blamed on it.
    most = max(CalibrationLimits.arm_errors[1 - in_mm], 6.0 * repeats[1 - in_mm])
    sources = dict[str, list[str]]()
    for name, size in budget.items():
        is_of_arm = name in ("arm", "look", "pick")
        sources.setdefault("left out" if is_of_arm and size > most else name, []).append(name)
    for source, names in sources.items():
        size = float(np.linalg.norm([budget[name] for name in names]))
        if size**2 < _LEAST_SHARE * total**2:
            continue
        kind, words, do = _SOURCES[source]
        without = ""
        if len(budget) > len(names):
            rest = worst.without(*names)
            without = f"Without this part 95 % of picks land within {rest.stays_within(need)}"
            if need is not None:
                without += f", and {percent(rest.probability(need))} within what is needed"
            without += "."
        yield Finding(
            kind,
            f"Picks err by {figure(total)} {unit} (sigma); {figure(size)} {unit} of this come from "
            f"{words}.",
            correcting(need) if source == CONTROLLER else do or more,
            probability=size**2 / total**2,
            is_share=True,
            without_it=without,
            until_mm=0.0,
        )
