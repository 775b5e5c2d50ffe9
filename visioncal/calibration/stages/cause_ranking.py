"""What may be why a result is not good, ranked: how likely each finding is the cause.

How likely a cause is rests on what is computed today:

- Of what a test found, by the chance p with which sound data pass its limit: against "nothing is
  wrong" its odds are at least 1 to -e p ln p (Sellke, Bayarri and Berger 2001), both alike
  beforehand. What explains the same misfit competes: odds are put in proportion, "none of these"
  among them, which is the cause `unexplained`. What is known to move picks by less than left-out
  views disagree explains no more of that than its square.
- Of errors that are too large with nothing wrong, by the share of a pick's mean squared error that
  comes from them.
- Of what is a fact, as a frame that nothing ties, it is one; remarks that no test is behind are no
  causes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from visioncal.calibration.stages.need import Picks
from visioncal.core.limits import CalibrationLimits, NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.quantiles import chi2_limit
from visioncal.core.verdict import (
    EXCHANGED,
    GOOD_FOR,
    PLAN,
    REVIEW,
    SOURCES,
    Finding,
    Remedy,
    Verdict,
)
from visioncal.results import NeedMet

# The limits of tests that are passed by chance: none is behind the first, the last is a fact.
_REMARK, _FACT = float(np.exp(-1.0)), 1e-12


@dataclass(frozen=True)
class Evidence:
    """What is behind a kind of finding.

    Attributes:
        chance: With which a sound session shows as much: the limit of the test that found it.
        misfit: What it explains; causes of one misfit compete.
    """

    chance: float
    misfit: str = ""


# The misfit that errors of the chain as a whole explain: views disagree, the flange errs.
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
}
LENS_CHANGED = "lens_changed"
MOVED_FRAME, BOARD_CHANGED = "moved_at_once", "board_changed"
MOVED_AT_ONCE = (MOVED_FRAME, "joint_slipped", BOARD_CHANGED)
OF_CHAIN = frozenset(kind for kind, evidence in EVIDENCE.items() if evidence.misfit == _CHAIN)
_MOVED = ("moved_slowly", *MOVED_AT_ONCE)
_OF_ROBOT = ("arm_errors", "robot_noise", "robot_noise_of_pick")
_UNUSED_JOINTS = ("misread_joints", "other_arm")
# What is measured by way of the robot says nothing where its poses are misread.
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
LOOK = Remedy(
    "Look at the worst views: does each pose belong to its image, did anything move?", REVIEW
)

# Sigmas that have a limit of their own, what others come from first, and how likely mistakes are
# that come before them.
_SIGMAS, _LIKELIER = ("weak_motion", "place", "workspace"), 0.5

# What helps where the size of a board limits a result.
TILTED = Remedy("Add views tilted by 30 to 45 degrees.")
MEASURE_BOARD = Remedy(
    "Measure the board with a caliper over its whole width, and state square_m, the side of one "
    "square, and square_sigma_m, how well it is known, of the target: more views tell neither."
)

# What helps where an arm errs whose joints are not known.
NO_JOINTS = Remedy(
    "Record joint angles with the poses, and name the arm as [robot] model in session.toml: "
    "calibrate then estimates the arm, too."
)


def adding(words: str, *, modelled: bool, purpose: str = "") -> Remedy:
    """Advice to add views, with the command that proposes them where the arm's model is known.

    Args:
        words: Which views.
        modelled: Whether it is.
        purpose: Options of the command.
    """
    if modelled:
        return Remedy(words, f"{PLAN}{purpose}")
    model = "With [robot] model in session.toml, visioncal plan proposes them."
    return Remedy(f"{words} {model}")


def with_misread(verdict: Verdict, found: Finding) -> Verdict:
    """A verdict on poses that are better read otherwise, which explains all else that is wrong.

    Args:
        verdict: On the poses as they are declared.
        found: That they are misread.
    """
    if verdict.causes and verdict.causes[0].kind == EXCHANGED:
        # The same, found by the views themselves; the command exchanges the rows.
        words = "Write a copy of the session with these rows exchanged, and calibrate it."
        step = found.do and replace(found.do, words=words)
        # What is likely by itself keeps its own step.
        said = (
            replace(finding, do=step)
            if finding.do and (finding.kind == EXCHANGED or not finding.probability)
            else finding
            for finding in verdict.findings
        )
        return replace(verdict, findings=tuple(said))
    odds = _odds(EVIDENCE[found.kind].chance)
    rest = (
        replace(finding, probability=finding.probability / (1.0 + odds), do=None)
        for finding in verdict.findings
        if finding.kind not in (GOOD_FOR, *SOURCES, *_BY_THE_CHAIN)
        and finding.words not in found.words
    )
    return replace(verdict, findings=(replace(found, probability=odds / (1.0 + odds)), *rest))


def with_other_board(verdict: Verdict, found: Finding) -> Verdict:
    """A verdict on images that show another board than the declared one, which is said first.

    Args:
        verdict: As the board is declared.
        found: What the images show.
    """
    odds = _odds(EVIDENCE[found.kind].chance)
    named = replace(found, probability=odds / (1.0 + odds))
    rest = (finding for finding in verdict.findings if finding.kind != "lost_views")
    return replace(verdict, findings=(named, *rest))


def ranked(
    doubts: Sequence[Finding],
    picks: Sequence[Picks],
    met: NeedMet | None,
    *,
    more: Remedy | None = None,
    left_out_mm: float = 0.0,
    is_scattered: bool = False,
) -> tuple[Finding, ...]:
    """Doubts with how likely each is the cause, and the sources of errors that are too large.

    Args:
        doubts: All there are.
        picks: What picks err by.
        met: What is needed, and how likely it is met; None where nothing is.
        more: What makes the calibration less uncertain.
        left_out_mm: By how much left-out views disagree [mm].
        is_scattered: Whether that is more than a sound cell's do.
    """
    found = _tested(doubts, left_out_mm)
    if met is None and (deciding := _deciding(found)) is not None:
        rest = (finding for finding in found if finding is not deciding)
        return (replace(deciding, probability=1.0 - _FACT), *rest)
    unmet = met is not None and met.probability < NeedLimits.probability[0]
    too_large = met is None and any(
        pick.good_for_mm > CalibrationLimits.sigma_mm[0] for pick in picks
    )
    sized = is_scattered or any(doubt.until_mm == 0.0 for doubt in doubts)
    if picks and (unmet or (too_large and sized)):
        known = {finding.kind for finding in found if finding.probability}
        # What moved is in the arm's errors by posture and time, too, which are no cause then.
        known |= {"arm_errors"} if known & {*_MOVED, LENS_CHANGED} else set()
        # ... and in the calibration's uncertainty.
        known |= {"calibration"} if known & {*MOVED_AT_ONCE, LENS_CHANGED} else set()
        # What was measured badly is in all that the robot seems to err by.
        known |= {*_OF_ROBOT} if "measured_turns" in known else set()
        found += [source for source in _sources(picks, met, more) if source.kind not in known]
    return tuple(_with_weak_motion(_with_joints_at_hand(found), more))


def _deciding(found: Sequence[Finding]) -> Finding | None:
    """What alone makes a result bad: a sigma far beyond its limit, where no mistake is likelier."""
    sigmas = [finding for finding in found if finding.kind in _SIGMAS]
    likelier = any(finding.probability >= _LIKELIER for finding in found)
    if likelier or not any(finding.is_fatal for finding in sigmas):
        return None
    return min(sigmas, key=lambda finding: _SIGMAS.index(finding.kind))


def _with_weak_motion(found: Sequence[Finding], more: Remedy | None) -> Sequence[Finding]:
    """The same where the motion is why the calibration is uncertain: one cause, and one advice."""
    weak = next((finding for finding in found if finding.kind == "weak_motion"), None)
    source = next((finding for finding in found if finding.kind == "calibration"), None)
    if weak is None or source is None or source.probability < 0.5 or more in (None, MEASURE_BOARD):
        return found
    first = replace(weak, probability=source.probability)
    rest = (finding for finding in found if finding is not weak)
    return [
        first,
        *(
            replace(finding, do=weak.do) if finding.do in (more, TILTED) else finding
            for finding in rest
        ),
    ]


def _with_joints_at_hand(found: Sequence[Finding]) -> Sequence[Finding]:
    """The same where joint angles that would explain an arm's errors are there, but misread."""
    unused = next(
        (finding for finding in found if finding.kind in _UNUSED_JOINTS and finding.do is not None),
        None,
    )
    errors = [finding for finding in found if finding.do is NO_JOINTS]
    if unused is None or not errors:
        return found
    first = replace(unused, probability=max(error.probability for error in errors))
    rest = [finding for finding in found if finding is not unused]
    return [
        first,
        *(
            replace(finding, do=first.do) if finding.do is NO_JOINTS else finding
            for finding in rest
        ),
    ]


def _tested(doubts: Sequence[Finding], left_out_mm: float) -> list[Finding]:
    """Doubts, each weighed against what explains the same; of one kind, the first is the cause."""
    first: dict[str, Finding] = {}
    for finding in doubts:
        if finding.kind in EVIDENCE:
            first.setdefault(finding.kind, finding)
    misfit_mm = left_out_mm if "unexplained" in first else 0.0
    odds = {name: _explaining(finding, misfit_mm) for name, finding in first.items()}
    odds |= dict.fromkeys(_feigned(first) & odds.keys(), 1.0)
    weighed = []
    for doubt in doubts:
        name = doubt.kind
        if first.get(name) is not doubt:
            weighed.append(doubt)
            continue
        rivals = sum(
            odds[word]
            for word in first
            if word != name
            and EVIDENCE[word].misfit
            and EVIDENCE[word].misfit == EVIDENCE[name].misfit
        )
        # None of these is what is unexplained: a cause of its own where it shows, of odds one.
        none = float(name != "unexplained" and not (rivals and "unexplained" in first))
        weighed.append(replace(doubt, probability=odds[name] / (none + odds[name] + rivals)))
    return weighed


def _feigned(first: Mapping[str, Finding]) -> set[str]:
    """Kinds of findings that another one of these passes for."""
    # What moves along a camera's axis passes for changes of its focus, which are random in the fit;
    # a focus that changes does not go by the time, and is found moving in one session of ten
    # thousand. Before and after a step, errors by posture and time are alike because of it, and it
    # is found beside these. What a held lens that the corners contradict does to views passes for a
    # board of another size or shape, and, with the views' postures, for an arm that errs; the
    # corners alone do not show the size, and the lens is tested beside all three. What is left of a
    # clock's jump passes for motion.
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
    if "lens" in first and first["lens"].mahalanobis_sq:
        feigned |= {"board_size", "board_shape", "arm_errors"}
    return feigned


def _explaining(doubt: Finding, misfit_mm: float) -> float:
    """The odds of a finding, which explains no more of a misfit than it moves picks by."""
    odds = _odds(_chance(doubt))
    if doubt.up_to_mm >= misfit_mm:
        return odds
    most = (doubt.up_to_mm / misfit_mm) ** 2 * odds / (1.0 + odds)
    return most / (1.0 - most)


_LEAST_CHANCE = 1e-12


def _chance(doubt: Finding) -> float:
    """With which chance a sound session shows it: by its figures, or the limit of its test."""
    limit, square = EVIDENCE[doubt.kind].chance, doubt.mahalanobis_sq
    return min(max(float(chdtrc(1.0, square)), _LEAST_CHANCE), limit) if square else limit


# So many views in a row are not left out by chance.
LEAST_RUN = 3


def run_evidence(count: int, of: int) -> float:
    """What it says that views which were left out follow each other, as a chi-square of one.

    Args:
        count: How many were left out.
        of: Of how many views.
    """
    # Views that are wrong one by one are any of them.
    chance = EVIDENCE["something_moved"].chance * (of - count + 1) / math.comb(of, count)
    return float(chi2_limit(max(chance, _LEAST_CHANCE), 1))


def _odds(chance: float) -> float:
    """The least odds of a finding against nothing, by its chance (under 1 / e)."""
    return float(-1.0 / (np.e * chance * np.log(chance)))


# Without a source of a smaller share of the variance picks err by hardly less: by 5 %.
_LEAST_SHARE = 0.1


def is_negligible(found: Finding, picks: Sequence[Picks]) -> bool:
    """Whether picks would err by hardly less without what was found, however sure it is."""
    least_mm = min((pick.budget_mm["total"] for pick in picks), default=0.0)
    return found.up_to_mm**2 < _LEAST_SHARE * least_mm**2


# What picks are limited by: as a kind, in words, and what helps.
_SOURCES: Mapping[str, tuple[str, str, Remedy | None]] = {
    "calibration": (
        "calibration",
        "the calibration itself",
        None,
    ),
    "board": (
        "unmeasured_board",
        "the board, whose size is not known better",
        MEASURE_BOARD,
    ),
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
    "arm": (
        "arm_errors",
        "the arm's own errors, which more views do not change",
        NO_JOINTS,
    ),
    "left out": (
        "unexplained",
        "errors of left-out views that the prediction does not explain",
        LOOK,
    ),
}


def _sources(picks: Sequence[Picks], met: NeedMet | None, more: Remedy | None) -> list[Finding]:
    """What makes errors as large as they are, by the worst camera and robot."""
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
        rest = worst.without(name)
        without = f"Without this part 95 % of picks land within {rest.stays_within(need)}"
        if met is not None:
            without += f", and {percent(rest.probability(met.need))} within what is needed"
        found = Finding(
            kind,
            f"Picks err by {figure(total)} {unit} (sigma); {figure(size)} {unit} of this come from "
            f"{words}.",
            do or more,
            probability=size**2 / total**2,
            without_it=f"{without}.",
            until_mm=0.0,
        )
        causes.append(found)
    return causes
