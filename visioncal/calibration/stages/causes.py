"""What may be why a result is not good, ranked: the one place that turns doubts into causes.

How likely a cause is rests on what is computed today:

- Of what a test found, by the chance p with which sound data pass its limit: against "nothing is
  wrong" its odds are at least 1 to -e p ln p (Sellke, Bayarri and Berger 2001), both alike
  beforehand. What explains the same misfit competes: odds are put in proportion, "none of these"
  among them, which is the cause `unexplained`.
- Of errors that are too large with nothing wrong, by the share of a pick's mean squared error that
  comes from them.
- Of what is a fact, as a frame that nothing ties, it is one; of remarks that no test is behind,
  one half.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from visioncal.calibration.stages.need import GOOD, Picks
from visioncal.core.number_format import figure, percent
from visioncal.results import Cause, NeedMet, Verdict

# Nothing weighs such a remark: its odds are one. A fact is beyond doubt.
_REMARK, _FACT = float(np.exp(-1.0)), 1e-12
_PLAN = "visioncal plan SESSION --add 5 proposes them."


@dataclass(frozen=True)
class Evidence:
    """What stands behind a cause.

    Attributes:
        chance: With which a sound session shows as much: the limit of the test that found it.
        misfit: What it explains; causes of one misfit compete.
        do: What to do about it.
        until_mm: See `Doubt`.
    """

    chance: float
    misfit: str
    do: str
    until_mm: float = np.inf


# The misfit that errors of the chain as a whole explain: views disagree, the flange errs.
_CHAIN = "chain"
EVIDENCE: Mapping[str, Evidence] = {
    "exchanged_views": Evidence(
        1e-6, "", "Exchange these rows in views.csv, then visioncal calibrate SESSION."
    ),
    "wrong_pose": Evidence(1e-3, "", "Correct the pose in views.csv, or leave the stop out."),
    "wrong_views": Evidence(
        1e-3, "", "Look at their images and poses: repeat them, or take them out of views.csv."
    ),
    "something_moved": Evidence(
        1e-3, "", "Fasten what moved, and calibrate the views before and after it apart."
    ),
    "moved_frame": Evidence(1e-4, "", "Fasten it, and record again."),
    "holdout": Evidence(1e-3, "", "Record views where the result is to hold, with role = fit."),
    "lost_views": Evidence(_REMARK, "", "Look at the first of them, and repeat what is missing."),
    "untied": Evidence(_FACT, "", "Add stops in which it is seen together with what is tied."),
    "board_size": Evidence(
        2.7e-3, _CHAIN, "Measure over many squares; mend square_m and square_sigma_m."
    ),
    "board_shape": Evidence(1e-4, _CHAIN, "Put the board on a stiff, flat plate, or measure it."),
    "lens": Evidence(
        1e-4,
        _CHAIN,
        "Leave matrix and distortion out of session.toml, or calibrate the camera anew.",
    ),
    "corner_noise": Evidence(
        1e-4, "corners", "Look for blur, glare, and a lens or a board that is not as stated."
    ),
    "moved_slowly": Evidence(
        1e-4, _CHAIN, "Fasten base and target, let the arm warm up, and record again."
    ),
    "correlated_errors": Evidence(
        1e-4, _CHAIN, "Record again, with the stops in an order of chance."
    ),
    # Counted in what is predicted of picks.
    "arm_errors": Evidence(
        1e-4,
        _CHAIN,
        "Record joint angles, name the arm's model, then visioncal calibrate SESSION --level "
        "kinematics.",
        until_mm=0.0,
    ),
    "weak_lens": Evidence(_REMARK, "lens", "Vary distance and tilt of the views.", until_mm=0.0),
    "misread_poses": Evidence(
        1e-3, _CHAIN, "Read them so: visioncal convert SESSION FIXED --guess, and calibrate FIXED."
    ),
    "unexplained": Evidence(
        _REMARK,
        _CHAIN,
        "Try how the poses are meant: visioncal convert SESSION FIXED --guess. Then look at the "
        "worst views.",
    ),
    "remark": Evidence(_REMARK, "", ""),
}
# How stages begin, or what they say, of what they warn of.
_SAID: Mapping[str, str] = {
    "are exchanged": "exchanged_views",
    "did not stand at stop": "wrong_pose",
    "disagree with those before": "something_moved",
    "the result has it where it stood last": "moved_frame",
    "is tied to nothing": "untied",
    "which is not what is stated": "board_size",
    r"is not flat|lies .* from where its table has it": "board_shape",
    "given intrinsics do not fit": "lens",
    "corners scatter by": "corner_noise",
    "esiduals drift with time": "moved_slowly",
    "eighbouring stops err alike": "correlated_errors",
    "esiduals follow the arm's posture": "arm_errors",
    "orners alone tell|ll views are from one distance": "weak_lens",
}


@dataclass(frozen=True)
class Doubt:
    """A reason not to trust the result.

    Attributes:
        sentence: What it is.
        is_fatal: Whether it settles the matter.
        until_mm: The need of a task from which on it is none [mm]: zero where it says how large
            errors are, which any need says better than a limit; infinite where it is of what is
            not explained.
        cause: Which it speaks of; empty where it says no more than how large errors are.
        without_it: What the result is without it, in a sentence.
    """

    sentence: str
    is_fatal: bool = False
    until_mm: float = np.inf
    cause: str = ""
    without_it: str = ""


def warned(sentence: str, without_it: str) -> Doubt:
    """The doubt that a stage has warned of.

    Args:
        sentence: What it says.
        without_it: What the result is without views that are left out.
    """
    found = (it for words, it in _SAID.items() if re.search(words, sentence))
    cause = next(found, "remark")
    left_out = cause in ("exchanged_views", "wrong_pose", "something_moved")
    return Doubt(
        sentence,
        until_mm=EVIDENCE[cause].until_mm,
        cause=cause,
        without_it=without_it if left_out else "",
    )


def with_misread(verdict: Verdict, sentence: str) -> Verdict:
    """A verdict on poses that are better read otherwise, which explains all else that is wrong.

    Args:
        verdict: On the poses as they are declared.
        sentence: How they are better read.
    """
    odds, name = _odds(EVIDENCE["misread_poses"].chance), "misread_poses"
    probability = odds / (1.0 + odds)
    rest = (replace(it, probability=it.probability / (1.0 + odds)) for it in verdict.causes)
    found = (Cause(name, probability, sentence, do=EVIDENCE[name].do), *rest)
    return replace(verdict, reasons=(sentence, *verdict.reasons), causes=found)


def ranked(
    doubts: Sequence[Doubt], picks: Sequence[Picks], met: NeedMet | None
) -> tuple[Cause, ...]:
    """The causes of doubts, likeliest first.

    Args:
        doubts: All there are.
        picks: What picks err by.
        met: What is needed, and how likely it is met; None where nothing is.
    """
    found = _tested(doubts)
    too_large = met.probability < GOOD if met else any(it.until_mm == 0.0 for it in doubts)
    if too_large and picks:
        known = {it.cause for it in found}
        found += [it for it in _sources(picks, met) if it.cause not in known]
    return tuple(sorted(found, key=lambda it: -it.probability))


def _tested(doubts: Sequence[Doubt]) -> list[Cause]:
    """What was found wrong, each against what explains the same; of one cause, the first doubt."""
    first: dict[str, Doubt] = {}
    for it in doubts:
        if it.cause:
            first.setdefault(it.cause, it)
    odds = {name: _odds(_chance(it)) for name, it in first.items()}
    causes = []
    for name, doubt in first.items():
        evidence = EVIDENCE[name]
        rivals = sum(
            odds[it]
            for it in first
            if it != name and evidence.misfit and EVIDENCE[it].misfit == evidence.misfit
        )
        # None of these is what is unexplained: a cause of its own where it shows, of odds one.
        none = float(name != "unexplained" and not (rivals and "unexplained" in first))
        probability = odds[name] / (none + odds[name] + rivals)
        causes.append(Cause(name, probability, doubt.sentence, doubt.without_it, evidence.do))
    return causes


# What a sentence says of the strength of its evidence: sigmas of a board's size, and twice a gain
# in log-likelihood.
_BOARD_SIZE = re.compile(
    r"is ([\d.]+) % \w+ than stated \(sigma ([\d.]+) %\).*to within ([\d.]+) %"
)
_GAIN = re.compile(r"likelihood ratio ([\d.]+)")
_LEAST_CHANCE = 1e-12


def _chance(doubt: Doubt) -> float:
    """With which chance a sound session shows it: by its figures, or the limit of its test."""
    square = 0.0
    if doubt.cause == "board_size" and (found := _BOARD_SIZE.search(doubt.sentence)):
        away, *sigmas = map(float, found.groups())
        square = away**2 / sum(it**2 for it in sigmas)
    elif doubt.cause == "arm_errors" and (found := _GAIN.search(doubt.sentence)):
        square = float(found[1])
    limit = EVIDENCE[doubt.cause].chance
    return min(max(float(chdtrc(1.0, square)), _LEAST_CHANCE), limit) if square else limit


def _odds(chance: float) -> float:
    """The least odds of a finding against nothing, by its chance (under 1 / e)."""
    return float(-1.0 / (np.e * chance * np.log(chance)))


# What picks are limited by, as causes, and what helps.
_SOURCES: Mapping[str, tuple[str, str, str]] = {
    "calibration": (
        "calibration",
        "the calibration itself",
        f"Add views in which the robot stands otherwise: {_PLAN}",
    ),
    "look": (
        "robot_noise",
        "the robot's own noise where it looks, which more views do not change",
        "Look several times from different stops, and take the mean.",
    ),
    "pick": (
        "robot_noise_of_pick",
        "the robot's own noise where it picks, which no calibration changes",
        "Take a robot that repeats better, or a gripper that forgives.",
    ),
    "arm": (
        "arm_errors",
        "the arm's own errors, which more views do not change",
        EVIDENCE["arm_errors"].do,
    ),
    "left out": (
        "unexplained",
        "what left-out views err by beyond what is predicted",
        EVIDENCE["unexplained"].do,
    ),
}


def _sources(picks: Sequence[Picks], met: NeedMet | None) -> list[Cause]:
    """What makes errors as large as they are, by the worst camera and robot."""
    if met is None:
        worst = max(picks, key=lambda it: it.good_for_mm)
    else:
        worst = min(picks, key=lambda it: it.probability(met.need))
    budget, causes = worst.budget_mm, []
    total = budget.pop("total")
    for name, mm in budget.items():
        cause, words, do = _SOURCES[name]
        rest = worst.without(name)
        without = f"Without it 95 % of picks land within {figure(rest.good_for_mm)} mm"
        if met is not None:
            without += f", and {percent(rest.probability(met.need))} within what is needed"
        causes.append(
            Cause(
                cause,
                mm**2 / total**2,
                f"Of the {figure(total)} mm that picks err by (sigma), {figure(mm)} mm come from "
                f"{words}.",
                f"{without}.",
                do,
            )
        )
    return causes
