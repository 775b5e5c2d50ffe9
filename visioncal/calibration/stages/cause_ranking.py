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

A probability is stated if this session's data decide it. Facts, and findings of comparisons of
which the limit alone is known (`Finding.by_limit`), are only ranked by it: the same figure would
stand before each.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from visioncal.calibration.stages.need import CONTROLLER, Picks
from visioncal.core.limits import CalibrationLimits, NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Need
from visioncal.core.verdict import (
    CALIBRATE,
    EXCHANGED,
    GOOD_FOR,
    PLAN,
    REVIEW,
    SOURCES,
    Finding,
    Remedy,
    Verdict,
)
from visioncal.estimation.effects import RANDOM_EFFECTS
from visioncal.results import NeedMet

# False-alarm probabilities of remarks, which no test is behind, and of facts.
_REMARK, _FACT = float(np.exp(-1.0)), 1e-12


@dataclass(frozen=True)
class Evidence:
    """Evidence behind a kind of finding."""

    chance: float  # False-alarm probability of its test in a sound session.
    misfit: str = ""  # The misfit that it explains; causes of one misfit compete.


# Misfit of the kinematic chain: views disagree, or the flange is off.
_CHAIN = "chain"
EVIDENCE: Mapping[str, Evidence] = {
    EXCHANGED: Evidence(1e-6),
    "exchanged_names": Evidence(1e-6),
    "turned_images": Evidence(1e-6),
    "wrong_pose": Evidence(1e-3),
    "wrong_views": Evidence(1e-3),
    "something_moved": Evidence(1e-3),
    "moved_frame": Evidence(1e-4),
    "holdout": Evidence(1e-3),
    "lost_views": Evidence(_REMARK),
    "lost_rows": Evidence(_FACT),
    "shared_image": Evidence(_FACT),
    "repeated_views": Evidence(_FACT),
    "other_board": Evidence(_FACT),
    "corner_numbers": Evidence(_FACT),
    "rig_points": Evidence(_FACT),
    "other_lens": Evidence(_FACT),
    "prior": Evidence(2.7e-3),
    "untied": Evidence(_FACT),
    "too_few_stops": Evidence(_FACT),
    "board_size": Evidence(2.7e-3, _CHAIN),
    "board_shape": Evidence(1e-4, _CHAIN),
    "lens": Evidence(1e-4, _CHAIN),
    "lens_field": Evidence(1e-4, _CHAIN),
    "focus": Evidence(1e-4, _CHAIN),
    "lens_changed": Evidence(1e-4, _CHAIN),
    "corner_noise": Evidence(1e-4, "corners"),
    "moved_slowly": Evidence(1e-4, _CHAIN),
    "moved_at_once": Evidence(1e-4, _CHAIN),
    "joint_slipped": Evidence(1e-4, _CHAIN),
    "board_changed": Evidence(1e-4, _CHAIN),
    "clock_changed": Evidence(1e-4, _CHAIN),
    "correlated_errors": Evidence(1e-4, _CHAIN),
    "arm_errors": Evidence(1e-4, _CHAIN),
    "measured_turns": Evidence(1e-4, _CHAIN),
    "weak_lens": Evidence(_REMARK, "lens"),
    "misread_poses": Evidence(1e-3, _CHAIN),
    "misread_joints": Evidence(1e-3),
    "unexplained": Evidence(_REMARK, _CHAIN),
    **{effect.kind: Evidence(1e-4, _CHAIN) for effect in RANDOM_EFFECTS},
}
LENS_CHANGED = "lens_changed"
MOVED_FRAME, BOARD_CHANGED = "moved_at_once", "board_changed"
MOVED_AT_ONCE = (MOVED_FRAME, "joint_slipped", BOARD_CHANGED)
OF_CHAIN = frozenset(kind for kind, evidence in EVIDENCE.items() if evidence.misfit == _CHAIN)
_MOVED = ("moved_slowly", *MOVED_AT_ONCE)
_OF_ROBOT = ("arm_errors", "robot_noise", "robot_noise_of_pick")
_UNUSED_JOINTS = ("misread_joints", "other_arm")
# Findings measured through the robot, which mean nothing where its poses are misread.
_BY_THE_CHAIN = (
    "board_size",
    "board_shape",
    "lens",
    "lens_field",
    "corner_noise",
    "arm_errors",
    "measured_turns",
    "prior",
    *MOVED_AT_ONCE,
)
_INSPECT_VIEWS = Remedy(
    "Look at the worst views: does each pose belong to its image, did anything move?", REVIEW
)

# Findings on sigmas that have limits of their own, in order of precedence, and the probability from
# which on a mistake precedes them.
_SIGMAS, _LIKELIER = ("weak_motion", "place", "workspace"), 0.5

# Remedies where the size of a board limits a result.
TILTED = Remedy("Add views tilted by 30 to 45 degrees.")
MEASURE_BOARD = Remedy(
    "Measure the board with a caliper over its whole width, and state square_m, the side of one "
    "square (of a marker size_m, its side), and square_sigma_m, how well it is known, of the "
    "target: more views tell neither."
)

# Remedy for a given lens that is held and not known better.
REFINE_LENS = Remedy(
    'In [camera], set intrinsics = "refine", best with more views and a board of many corners, or '
    "state a smaller matrix_sigma_px where fx, fy, cx, cy are known better."
)
_STATED_BETTER = (MEASURE_BOARD, REFINE_LENS)

# Remedy for errors of an arm whose joints are not known.
NO_JOINTS = Remedy(
    "Record joint angles with the poses, and name the arm as [robot] model in session.toml: "
    "calibrate then estimates the arm, too."
)


def correcting(need: Need | None) -> Remedy:
    """Advice to correct targets for a calibrated arm; with a need, to have it judged so."""
    words = "Correct targets for the calibrated arm before they are sent"
    correct = "visioncal correct targets.csv --against OUT -o corrected.csv"
    if need is None:
        return Remedy(f"{words}.", correct)
    limits = (("mm", need.mm), ("deg", need.deg))
    options = "".join(f" --need-{unit} {limit:g}" for unit, limit in limits if limit is not None)
    return Remedy(
        f"{words}; with --corrected, the verdict is about them.",
        f"{CALIBRATE} --corrected{options} && {correct}",
    )


def add_views_remedy(words: str, *, modelled: bool, purpose: str = "") -> Remedy:
    """Advice to add views, with the command that proposes them (and its options, `purpose`)."""
    if modelled:
        return Remedy(words, f"{PLAN}{purpose}")
    model = "With [robot] model in session.toml, visioncal plan proposes them."
    return Remedy(f"{words} {model}")


def with_misread(verdict: Verdict, found: Finding) -> Verdict:
    """Verdict in which the finding of misread poses comes first, as it explains the others."""
    if verdict.causes and verdict.causes[0].kind == EXCHANGED:
        # The views themselves show the exchange; the finding's command undoes it.
        words = "Write a copy of the session with these rows exchanged, and calibrate it."
        step = found.do and replace(found.do, words=words)
        # Findings with a probability of their own keep their remedy.
        findings = (
            replace(finding, do=step)
            if finding.do and (finding.kind == EXCHANGED or not finding.probability)
            else finding
            for finding in verdict.findings
        )
        return replace(verdict, findings=tuple(findings))
    odds = _odds(EVIDENCE[found.kind].chance)
    rest = (
        replace(finding, probability=finding.probability / (1.0 + odds), do=None)
        for finding in verdict.findings
        if finding.kind not in (GOOD_FOR, *SOURCES, *_BY_THE_CHAIN)
        and finding.words not in found.words
    )
    cause = replace(found, probability=odds / (1.0 + odds), by_limit=True)
    return replace(verdict, findings=(cause, *rest))


def with_other_board(verdict: Verdict, found: Finding) -> Verdict:
    """Verdict in which the finding that images show another board comes first."""
    odds = _odds(EVIDENCE[found.kind].chance)
    cause = replace(found, probability=odds / (1.0 + odds), by_limit=True)
    rest = (finding for finding in verdict.findings if finding.kind != "lost_views")
    return replace(verdict, findings=(cause, *rest))


def rank_causes(
    doubts: Sequence[Finding],
    picks: Sequence[Picks],
    met: NeedMet | None,
    *,
    more: Remedy | None = None,
    left_out_mm: float = 0.0,
    is_scattered: bool = False,
) -> tuple[Finding, ...]:
    """Ranks findings by their probability of being the cause, and adds too large error sources.

    Args:
        doubts: All findings.
        picks: Error budgets of picks.
        met: The required accuracy and the probability of meeting it; None where none is stated.
        more: Remedy that makes the calibration less uncertain.
        left_out_mm: Disagreement of left-out views [mm].
        is_scattered: Whether that is more than in a sound cell.
    """
    findings = _with_probabilities(doubts, left_out_mm)
    if met is None and (deciding := _deciding(findings)) is not None:
        rest = (finding for finding in findings if finding is not deciding)
        return (_as_fact(deciding, more), *rest)
    unmet = met is not None and met.probability < NeedLimits.probability[0]
    too_large = met is None and any(
        pick.good_for_mm > CalibrationLimits.sigma_mm[0] for pick in picks
    )
    sized = is_scattered or any(doubt.until_mm == 0.0 for doubt in doubts)
    if picks and (unmet or (too_large and sized)):
        known = {finding.kind for finding in findings if finding.probability}
        # A motion inflates the arm's errors by posture and time, too, which are no cause then, ...
        known |= {"arm_errors"} if known & {*_MOVED, LENS_CHANGED} else set()
        # ... and the calibration's uncertainty.
        known |= {"calibration"} if known & {*MOVED_AT_ONCE, LENS_CHANGED} else set()
        # Badly measured rotations inflate all apparent errors of the robot.
        known |= {*_OF_ROBOT} if "measured_turns" in known else set()
        findings += [source for source in _sources(picks, met, more) if source.kind not in known]
    return tuple(_with_facts(_with_weak_motion(_with_misread_joints(findings), more), more))


def _deciding(found: Sequence[Finding]) -> Finding | None:
    """The sigma that alone makes a result bad: far beyond its limit, with no likely mistake."""
    likelier = any(finding.probability >= _LIKELIER for finding in found)
    if likelier or not any(finding.is_fatal for finding in found if finding.kind in _SIGMAS):
        return None
    return _first_sigma(found)


def _first_sigma(found: Sequence[Finding]) -> Finding | None:
    """The sigma beyond its limit that precedes the others, as it explains them."""
    sigmas = [finding for finding in found if finding.kind in _SIGMAS]
    return min(sigmas, key=lambda finding: _SIGMAS.index(finding.kind), default=None)


def _as_fact(found: Finding, more: Remedy | None) -> Finding:
    """A finding as a cause with the probability of a fact."""
    return replace(found, probability=1.0 - _FACT, by_limit=True, do=found.do or more)


def _with_facts(found: Sequence[Finding], more: Remedy | None) -> Sequence[Finding]:
    """Findings with the facts among them as causes, where there is no other cause."""
    if any(finding.probability for finding in found):
        return found
    sigma = _first_sigma(found)
    return [
        _as_fact(finding, more) if finding is sigma or finding.kind not in _SIGMAS else finding
        for finding in found
    ]


def _with_weak_motion(found: Sequence[Finding], more: Remedy | None) -> Sequence[Finding]:
    """Findings with weak motion as the cause, and its remedy, of an uncertain calibration."""
    weak = next((finding for finding in found if finding.kind == "weak_motion"), None)
    source = next((finding for finding in found if finding.kind == "calibration"), None)
    if weak is None or source is None or source.probability < 0.5:
        return found
    if more is None or more in _STATED_BETTER:
        return found
    return [
        replace(weak, probability=source.probability),
        *(
            replace(finding, do=weak.do) if finding.do in (more, TILTED) else finding
            for finding in found
            if finding is not weak
        ),
    ]


def _with_misread_joints(found: Sequence[Finding]) -> Sequence[Finding]:
    """Findings with misread joint angles as the cause of the arm errors that they explain."""
    unused = next(
        (finding for finding in found if finding.kind in _UNUSED_JOINTS and finding.do is not None),
        None,
    )
    errors = [finding for finding in found if finding.do is NO_JOINTS]
    if unused is None or not errors:
        return found
    return [
        replace(unused, probability=max(error.probability for error in errors)),
        *(
            replace(finding, do=unused.do) if finding.do is NO_JOINTS else finding
            for finding in found
            if finding is not unused
        ),
    ]


def _with_probabilities(doubts: Sequence[Finding], left_out_mm: float) -> list[Finding]:
    """Findings with their probabilities among rivals; only the first of a kind is a cause."""
    first: dict[str, Finding] = {}
    for finding in doubts:
        if finding.kind in EVIDENCE:
            first.setdefault(finding.kind, finding)
    misfit_mm = left_out_mm if "unexplained" in first else 0.0
    odds = {name: _explaining_odds(finding, misfit_mm) for name, finding in first.items()}
    odds |= dict.fromkeys(_feigned(first) & odds.keys(), 1.0)
    weighted = []
    for doubt in doubts:
        name = doubt.kind
        if first.get(name) is not doubt:
            weighted.append(doubt)
            continue
        rivals = sum(
            odds[rival]
            for rival in first
            if rival != name
            and EVIDENCE[rival].misfit
            and EVIDENCE[rival].misfit == EVIDENCE[name].misfit
        )
        # "None of these" has odds one, unless `unexplained` stands for it as a finding of its own.
        none = float(name != "unexplained" and not (rivals and "unexplained" in first))
        probability = odds[name] / (none + odds[name] + rivals)
        weighted.append(replace(doubt, probability=probability, by_limit=not doubt.mahalanobis_sq))
    return weighted


def _feigned(first: Mapping[str, Finding]) -> set[str]:
    """Kinds of findings that are mere effects of another finding."""
    # Motion along a camera's axis looks like changes of its focus, which are random in the fit; a
    # changing focus does not follow time, and looks like motion in one session of ten thousand.
    # A step makes errors by posture and time correlate before and after it, and is tested beside
    # them. A held lens that the corners contradict looks like a board of another size or shape,
    # and, by the views' postures, like arm errors; the corners alone do not show the size, and the
    # lens is tested beside all three. The remainder of a clock's jump looks like motion.
    feigned: set[str] = set()
    if moved := [first[name].mahalanobis_sq for name in _MOVED if name in first]:
        feigned.add("focus")
        arm = first.get("arm_errors")
        if arm and (first.keys() & {*MOVED_AT_ONCE} or max(moved) > arm.mahalanobis_sq):
            feigned.add("arm_errors")
    if BOARD_CHANGED in first:
        feigned |= {"board_size", "board_shape"}
    if "clock_changed" in first:
        feigned |= {*_MOVED, "arm_errors", "correlated_errors"}
    if LENS_CHANGED in first:
        feigned |= OF_CHAIN - {LENS_CHANGED}
        # Errors of the arm that are more evident are no effect of what the corners alone show.
        arm = first.get("arm_errors")
        if arm and arm.mahalanobis_sq > first[LENS_CHANGED].mahalanobis_sq:
            feigned.discard("arm_errors")
    if "lens" in first and first["lens"].mahalanobis_sq:
        feigned |= {"board_size", "board_shape", "arm_errors"}
    return feigned


def _explaining_odds(doubt: Finding, misfit_mm: float) -> float:
    """Odds of a finding, bounded by the share of the misfit that it can explain."""
    odds = _odds(_chance(doubt))
    if doubt.up_to_mm >= misfit_mm:
        return odds
    most = (doubt.up_to_mm / misfit_mm) ** 2 * odds / (1.0 + odds)
    return most / (1.0 - most)


_LEAST_CHANCE = 1e-12


def _chance(doubt: Finding) -> float:
    """False-alarm probability of a finding: by its chi-square, or the limit of its test."""
    limit, square = EVIDENCE[doubt.kind].chance, doubt.mahalanobis_sq
    return min(max(float(chdtrc(1.0, square)), _LEAST_CHANCE), limit) if square else limit


# Fewest consecutive left-out views that count as a run, and not as chance.
LEAST_RUN = 3


def run_evidence(count: int, of: int) -> float:
    """Chi-square (one degree of freedom) of `count` consecutive left-out views among `of` views."""
    # Views that are wrong independently are equally likely to be any of them.
    chance = EVIDENCE["something_moved"].chance * (of - count + 1) / math.comb(of, count)
    return float(chi2_limit(max(chance, _LEAST_CHANCE), 1))


def _odds(chance: float) -> float:
    """Lower bound of the odds of a fault by a false-alarm probability (under 1 / e)."""
    return float(-1.0 / (np.e * chance * np.log(chance)))


# Removing a source with a smaller share of the variance would reduce a pick's error by under 5 %.
_LEAST_SHARE = 0.1


def is_negligible(found: Finding, picks: Sequence[Picks]) -> bool:
    """Whether removing the cause of a finding would hardly reduce the error of picks."""
    least_mm = min((pick.budget_mm["total"] for pick in picks), default=0.0)
    return found.up_to_mm**2 < _LEAST_SHARE * least_mm**2


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
        Remedy("Take a robot that repeats better, or a gripper that forgives."),
    ),
    CONTROLLER: (
        "uncorrected_targets",
        "the controller's own model of the arm, which the calibration corrects",
        None,
    ),
    "arm": ("arm_errors", "the arm's own errors, which more views do not change", NO_JOINTS),
    "left out": (
        "unexplained",
        "errors of left-out views that the prediction does not explain",
        _INSPECT_VIEWS,
    ),
}


def _sources(picks: Sequence[Picks], met: NeedMet | None, more: Remedy | None) -> list[Finding]:
    """Dominant error sources of the worst pair of camera and robot."""
    if met is None:
        worst = max(picks, key=lambda pick: pick.good_for_mm)
    else:
        worst = min(picks, key=lambda pick: pick.probability(met.need))
    need = None if met is None else met.need
    in_mm, causes = need is None or need.mm is not None, []
    budget, unit = (worst.budget_mm, "mm") if in_mm else (worst.budget_deg, "deg")
    total = budget.pop("total")
    for name, size in budget.items():
        if size**2 < _LEAST_SHARE * total**2:
            continue
        kind, words, do = _SOURCES[name]
        do = correcting(need) if name == CONTROLLER else do
        rest = worst.without(name)
        without = f"Without this part 95 % of picks land within {rest.stays_within(need)}"
        if met is not None:
            without += f", and {percent(rest.probability(met.need))} within what is needed"
        causes.append(
            Finding(
                kind,
                f"Picks err by {figure(total)} {unit} (sigma); {figure(size)} {unit} of this come "
                f"from {words}.",
                do or more,
                probability=size**2 / total**2,
                without_it=f"{without}.",
                until_mm=0.0,
            )
        )
    return causes
