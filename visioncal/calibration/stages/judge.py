"""Verdict whether a result can be trusted, in plain sentences."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.cause_ranking import correcting, is_negligible, rank_causes
from visioncal.calibration.stages.doubts import (
    collect_findings,
    is_scattered,
    remedy_for_uncertainty,
)
from visioncal.calibration.stages.findings import Findings
from visioncal.calibration.stages.need import Picks, need_met
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, percent, rounded_up
from visioncal.core.verdict import (
    AGREEMENT,
    CALIBRATED_ARM,
    GOOD_FOR,
    NEED,
    NO_DOUBTS,
    NOTE,
    Finding,
    Verdict,
    VerdictStatus,
    remarks,
)
from visioncal.results import NeedMet
from visioncal.results.conditions import uncorrected_words


def judge(findings: Findings) -> Verdict:
    """Decides whether the result can be trusted, why, and what to do next.

    Returns:
        `bad` with a fatal finding, `check` with doubts, `good` without. Where the task states its
        need, the probability that picks are within it decides: good from 0.95, check from 0.5, bad
        below, and never good with something unexplained.
    """
    small = [warning for warning in findings.warnings if is_negligible(warning, findings.picks)]
    warnings = [warning for warning in findings.warnings if warning not in small]
    notes = (*findings.notes, *(finding.words for finding in small))
    findings = replace(findings, warnings=warnings, notes=notes)
    doubts = collect_findings(findings)
    good_for_mm = _good_for_mm(findings.picks, doubts)
    uncorrected = [pick.uncorrected or pick for pick in findings.picks]
    is_calibrated = any(pick.uncorrected is not None for pick in findings.picks)
    uncorrected_mm = _good_for_mm(uncorrected, doubts) if is_calibrated else None
    met = need_met(findings.need, findings.judged_picks)
    status: VerdictStatus = "good" if not doubts else "check"
    if met is None:
        status = "bad" if any(doubt.is_fatal for doubt in doubts) else status
    elif met.probability >= NeedLimits.probability[0]:
        need_mm = met.need.mm or 0.0
        doubts = [doubt for doubt in doubts if doubt.until_mm > need_mm]
        status = "check" if doubts else "good"
    else:
        status = "check" if met.probability >= NeedLimits.probability[1] else "bad"
    ordered: Sequence[Finding] = sorted(doubts, key=lambda doubt: not doubt.is_fatal)
    if status != "good":
        ordered = rank_causes(
            ordered,
            findings.picks if met is None else findings.judged_picks,
            met,
            more=remedy_for_uncertainty(findings),
            left_out_mm=findings.held_out.mm,
            is_scattered=is_scattered(findings),
        )
    stated = list(ordered)
    if met is None:
        stated += _good_for(findings, good_for_mm, status)
    else:
        place = len(stated) * (met.probability >= NeedLimits.probability[0])
        stated.insert(place, Finding(NEED, _need_words(findings, met)))
    stated += [] if doubts else [_agreement(findings, is_enough=status == "good")]
    stated += [warning for warning in findings.warnings if warning.kind in NO_DOUBTS]
    verdict = Verdict(
        status, (*stated, *remarks(findings.notes, NOTE)), good_for_mm, uncorrected_mm
    )
    if not is_calibrated:
        return verdict
    step = None if findings.corrects_targets else correcting(findings.need)
    found = Finding(CALIBRATED_ARM, uncorrected_words(verdict), step)
    return replace(verdict, findings=(*verdict.findings, found))


def _good_for_mm(picks: Sequence[Picks], doubts: Sequence[Finding]) -> float | None:
    """The least need that all pairs would meet; None without one, or where unknown."""
    least = max((doubt.until_mm for doubt in doubts), default=0.0)
    if not picks or np.isinf(least):
        return None
    return max(least, *(pick.good_for_mm for pick in picks))


def _good_for(
    findings: Findings, good_for_mm: float | None, status: VerdictStatus
) -> tuple[Finding, ...]:
    if good_for_mm is None:
        return ()
    verb = "would be" if status == "bad" else "is"
    worst = max(findings.picks, key=lambda pick: pick.good_for_mm)
    sensor = "instrument" if worst.camera.startswith("instrument") else "camera"
    words = (
        f"It {verb} good for tasks of {figure(rounded_up(good_for_mm))} mm and more at "
        f"{figure(worst.distance_m)} m from the {sensor}"
        f"{'' if worst.uncorrected is None else ', with corrected targets'}."
    )
    return (Finding(GOOD_FOR, words),)


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
    used = sum(view.used for view in findings.views)
    worst_known = "".join(
        f", and {worst.words}, its worst direction, is known to {figure(1e3 * worst.sigma)} mm"
        for worst in findings.worst[:1]
    )
    return Finding(
        AGREEMENT,
        f"All {used} used views agree: left out of the fit, they are predicted to "
        f"{findings.held_out.words} (rms){worst_known}.",
        findings.use if is_enough else None,
    )
