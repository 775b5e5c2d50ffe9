"""Verdict whether a result can be trusted, in plain sentences."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from visioncal.calibration.stages.need import Picks, least_precise, need_met
from visioncal.calibration.suspects.judged import Findings
from visioncal.calibration.suspects.limits import collect_findings, remedy_for_uncertainty
from visioncal.calibration.suspects.ranking import correcting, is_negligible, rank_causes
from visioncal.calibration.suspects.registry import SUSPECTS
from visioncal.calibration.suspects.suspect import UNEXPLAINED
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, percent, rounded_up
from visioncal.core.verdict import (
    AGREEMENT,
    LEAST_LIKELY,
    NO_ACCURACY,
    NOTE,
    SURE,
    Finding,
    Verdict,
    VerdictStatus,
    remarks,
)
from visioncal.results import NeedMet
from visioncal.results.conditions import uncorrected_words
from visioncal.robot.model import REPEATABILITY

# Kinds of doubts that what was seen is not as modelled, however it moves.
_MISFITS = (UNEXPLAINED, "corner_noise")


def judge(findings: Findings) -> Verdict:
    """Decides whether the result can be trusted, why, and what to do next.

    Returns:
        `bad` with a fatal finding, `check` with doubts, `good` without. Where the task states its
        need, the probability that picks are within it decides: good from 0.95, check from 0.5, bad
        below, and never good with something unexplained.

    Raises:
        KeyError: A finding is of a kind that is no suspect of the registry.
    """
    picks, warnings = findings.picks, list(findings.warnings)
    small = [warning for warning in warnings if is_negligible(warning, picks)]
    notes = remarks((*findings.notes, *(finding.in_words().words for finding in small)), NOTE)
    findings = replace(findings, warnings=[found for found in warnings if found not in small])
    found = collect_findings(findings)
    # Mere effects of what a need judges are judged with it.
    judged = (doubt.kind for doubt in found if np.isfinite(doubt.until_mm))
    effects = {*chain.from_iterable(SUSPECTS[kind].hides for kind in judged)}
    found = [replace(at, until_mm=0.0) if at.kind in effects else at for at in found]
    met = need_met(findings.need, findings.judged_picks)
    is_met = met is not None and met.probability >= NeedLimits.probability[0]
    enough_mm = (met.need.mm or 0.0) if met is not None and is_met else -1.0
    doubts = [doubt for doubt in found if doubt.until_mm > enough_mm]
    status = _status_of(doubts, met)
    is_calibrated = any(pick.uncorrected is not None for pick in picks)
    # Sigmas are those of a model, and say nothing where it does not explain what was seen.
    is_misfit = any(doubt.is_fatal and doubt.kind in _MISFITS for doubt in doubts)
    if is_unknown := is_misfit and status == "bad":
        warnings = [found for found in warnings if not SUSPECTS[found.kind].of_result]
        doubts = [doubt for doubt in doubts if not SUSPECTS[doubt.kind].of_result]
        findings, picks = replace(findings, warnings=warnings, picks=()), ()
    uncorrected_picks = [pick.uncorrected or pick for pick in picks] if is_calibrated else []
    worst, uncorrected = (
        least_precise(some) if some else None for some in (picks, uncorrected_picks)
    )
    good_for_mm, uncorrected_mm = (_good_for_mm(pick, found) for pick in (worst, uncorrected))
    stated: list[Finding] = sorted(doubts, key=lambda doubt: not doubt.is_fatal)
    if status != "good":
        stated = [
            *rank_causes(
                stated,
                picks if met is None else findings.judged_picks,
                met,
                more=remedy_for_uncertainty(findings),
                left_out_mm=findings.held_out.mm,
                repeats=max((arm.repeatability for arm in findings.arms), default=REPEATABILITY),
            )
        ]
    if is_unknown:
        words = "How accurate it is cannot be said: no fit explains what was seen."
        stated.append(Finding(NO_ACCURACY, words))
    elif met is not None:
        stated.insert(len(stated) * is_met, Finding("need", _need_words(findings, met)))
    elif worst and good_for_mm is not None and good_for_mm < 1e3 * worst.distance_m / 10.0:
        # A need of a tenth of the distance is none of a calibration.
        stated.append(_good_for(worst, good_for_mm, status, stated))
    if not doubts:
        stated.append(_agreement(findings, is_enough=status == "good"))
    stated += [warning for warning in warnings if not SUSPECTS[warning.kind].is_doubt]
    stated += notes
    verdict = Verdict(status, (), good_for_mm, uncorrected_mm)
    if is_calibrated:
        step = None if findings.corrects_targets else correcting(findings.need)
        stated.append(Finding("calibrated_arm", uncorrected_words(verdict), step))
    return replace(verdict, findings=in_reading_order(stated, status))


def _status_of(doubts: Sequence[Finding], met: NeedMet | None) -> VerdictStatus:
    """The judgement by doubts, and by a need."""
    enough, least = NeedLimits.probability
    if met is not None and met.probability < enough:
        return "check" if met.probability >= least else "bad"
    if met is None and any(doubt.is_fatal for doubt in doubts):
        return "bad"
    return "check" if doubts else "good"


def in_reading_order(findings: Sequence[Finding], status: VerdictStatus) -> tuple[Finding, ...]:
    """Missing images, the likeliest cause, its cost, other likely causes, then the rest."""

    def by_likelihood(finding: Finding) -> tuple[float, int, bool, bool, float]:
        # Of what is as good as certain, a cure that was tried precedes what merely passes a limit,
        # and one that clearly lowers the misfit all others.
        most, order = -finding.probability, SUSPECTS[finding.kind].order
        return max(most, -SURE), order, finding.by_limit, not finding.is_apart, most

    likely = (finding for finding in findings if finding.probability >= LEAST_LIKELY)
    causes = sorted(likely, key=by_likelihood)
    sized = (finding for finding in findings if SUSPECTS[finding.kind].size)
    costs = sorted(sized, key=lambda finding: SUSPECTS[finding.kind].size)
    missing = [finding for finding in findings if finding.kind == "missing_images"]
    # Not where the result is of no use.
    of_use = [] if status == "bad" else findings
    to_correct = [finding for finding in of_use if finding.kind == "calibrated_arm"]
    # Sources of what picks err by come behind that.
    first = [cause for cause in causes[:1] if not cause.is_share]
    ordered = [*missing, *first, *to_correct, *costs[:1], *causes, *findings]
    return tuple({id(finding): finding for finding in ordered}.values())


def _good_for_mm(worst: Picks | None, doubts: Sequence[Finding]) -> float | None:
    """The least need that all pairs would meet; None without one, or where unknown."""
    least = max((doubt.until_mm for doubt in doubts), default=0.0)
    return None if worst is None or np.isinf(least) else max(least, worst.good_for_mm)


def _good_for(
    worst: Picks, good_for_mm: float, status: VerdictStatus, stated: Sequence[Finding]
) -> Finding:
    verb = "would be" if status == "bad" else "is"
    is_read = worst.camera.startswith("instrument")
    # Where no corners were, a lens that the views determine says little.
    where = "at" if is_read else "where the views looked, at"
    sensor = "instrument" if is_read else "camera"
    corrected = "" if worst.uncorrected is None else ", with corrected targets"
    limit, picks_limit = (figure(rounded_up(mm)) for mm in (good_for_mm, worst.good_for_mm))
    without_doubts = ""
    likely = [found for found in stated if found.probability >= LEAST_LIKELY]
    if picks_limit != limit:
        # The doubts decide, not the predicted picks.
        without_doubts = f", whatever is behind the doubts; if mere noise is, of {picks_limit} mm"
    elif any(
        "calibration" in SUSPECTS[found.kind].inflates
        for found in in_reading_order(likely, status)[:1]
    ):
        without_doubts = ", and of less once the first cause is mended: till then, what is like it "
        without_doubts += "counts as off by as much"
    return Finding(
        "good_for",
        f"It {verb} good for tasks of {limit} mm and more {where} {figure(worst.distance_m)} m "
        f"from the {sensor}{corrected}{without_doubts}.",
    )


def _need_words(findings: Findings, met: NeedMet) -> str:
    """States the probability that picks are within the need."""
    need, picks = met.need, findings.judged_picks
    worst = min(picks, key=lambda pick: pick.probability(need))
    within = [f"{value:g} {unit}" for value, unit in ((need.mm, "mm"), (need.deg, "deg")) if value]
    where = "where the views looked" if need.at == "views" else f"at {list(need.at)} m in the base"
    who = f" by robot {worst.robot} of what {worst.camera} sees" if len(picks) > 1 else ""
    by = "by the controller's own poses " if worst.offsets is not None else ""
    by = "with corrected targets " if worst.uncorrected is not None else by
    return (
        f"A pick{who} {by}{where} lands within {' and '.join(within)} with a probability of "
        f"{percent(met.probability)}; 95 % land within {worst.stays_within(need)}."
    )


def _agreement(findings: Findings, *, is_enough: bool) -> Finding:
    total, used = len(findings.views), sum(view.used for view in findings.views)
    of_total = f" of {total}" if used < total else ""
    worst_known = "".join(
        f"; {worst.words}, its least certain direction, is known to {figure(1e3 * worst.sigma)} mm"
        for worst in findings.worst[:1]
    )
    return Finding(
        AGREEMENT,
        f"All {used} used views{of_total} agree. Checked with views that were not used in the fit: "
        f"{findings.held_out.words} (rms){worst_known}.",
        findings.use if is_enough else None,
    )
