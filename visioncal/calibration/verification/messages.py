"""Verdict of a check in sentences, and as verify.json."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.calibration.verification.change_hypotheses import (
    BOARD,
    BOTH,
    CAMERA,
    JOINT,
    LENGTH,
    NOISE,
    REPLACED,
    SIZE,
    kind_of,
)
from visioncal.calibration.verification.check import Check, Suspect
from visioncal.calibration.verification.policy import Outcome
from visioncal.core.finding_kinds import AGREEMENT
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import counted, figure, listed, mm_and_deg
from visioncal.core.transforms import exp, inverse_right_jacobian, skew
from visioncal.core.types import FloatArray
from visioncal.core.verdict import AGAIN, CALIBRATE_ANEW, PLAN, Finding, Remedy, Verdict
from visioncal.estimation.identifiability import joint_words
from visioncal.estimation.observability import axis_words
from visioncal.vision.targets import corner_positions

# Parts of a motion of fewer sigmas are not mentioned.
_MENTIONED = 3.0
# Fewest stops that locate camera and board roughly, so that more stops can be planned.
_LEAST_STOPS = 3
# Sigmas of a camera's motion that nearly every check detects.
_SURE = 6.0
_ALUMINIUM, _STEEL = 23e-6, 12e-6
_ANEW = "calibrate again; these stops make a first result, and more a good one."
_ANOTHER_BOARD = Remedy(
    "Verify with the board that was calibrated with; or measure the squares of this one, and "
    f"{_ANEW}",
    CALIBRATE_ANEW,
)
_NEXT = {
    CAMERA: Remedy(f"Fasten the camera, and {_ANEW}", CALIBRATE_ANEW),
    BOARD: Remedy(
        "Put the board back; if it was moved on purpose, verify without its place.",
        f"{AGAIN} --board-moved",
    ),
    BOTH: Remedy(f"Fasten both, and {_ANEW}", CALIBRATE_ANEW),
    SIZE: _ANOTHER_BOARD,
    REPLACED: _ANOTHER_BOARD,
    JOINT: Remedy(
        "Look whether the joint keeps its zero (a coupling that slips does so again), then "
        f"{_ANEW}",
        CALIBRATE_ANEW,
    ),
    LENGTH: Remedy(
        "Let the arm come to the temperature at which it was calibrated, or calibrate it at the "
        "one at which it works."
    ),
    NOISE: Remedy(
        "Look for play in mounts and joints, and whether the robot stood still at each image; "
        "then verify again.",
        AGAIN,
    ),
}
_WRONG_VIEW = Remedy(
    "Take that stop again, whose image and pose do not belong together; then verify again.", AGAIN
)

SCHEMA = 1
# Changes of a smaller probability are not listed.
_LISTED_SHARE = 1e-3


@dataclass(frozen=True)
class MeasuredMove:
    """Estimated motion of a camera or board."""

    mm: float  # Distance [mm].
    sigma_mm: float  # Its standard deviation [mm].
    along: str  # Its direction in words.
    deg: float  # Angle [deg].
    sigma_deg: float  # Its standard deviation [deg].
    about: str  # Its axis in words.

    @property
    def words(self) -> str:
        """The significant parts of the motion, in words."""
        shift = f"by {figure(self.mm)} mm (sigma {figure(self.sigma_mm)}) along {self.along}"
        turn = f"by {figure(self.deg)} deg (sigma {figure(self.sigma_deg)}) about {self.about}"
        parts = [f"moved {shift}"] * (self.mm > _MENTIONED * self.sigma_mm)
        parts += [f"turned {turn}"] * (self.deg > _MENTIONED * self.sigma_deg)
        return " and ".join(parts) or f"moved {shift}"


def verdict_of(check: Check) -> Verdict:
    """Verdict of a check: whether the calibration holds, what changed, and what to do."""
    doubts = tuple(_doubts(check))
    if check.passed:
        findings = (Finding(AGREEMENT, _agreement(check)), *doubts)
        return Verdict("check" if doubts else "good", findings)
    likeliest, *others = check.named
    changed = Finding(
        kind_of(likeliest.name),
        _changed(check, likeliest),
        _runnable(check, _NEXT.get(kind_of(likeliest.name), _WRONG_VIEW)),
        probability=likeliest.probability,
    )
    reasons = [changed]
    if others:
        reasons.append(_rivals(check, likeliest, others))
    if not check.explained:
        words = "Alone it does not explain the stops: something else has changed too."
        anew = _runnable(check, Remedy(_capital(_ANEW), CALIBRATE_ANEW))
        reasons.append(Finding("unexplained", words, anew))
    return Verdict("bad", (*reasons, *(doubts if others else ())))


def _runnable(check: Check, step: Remedy) -> Remedy:
    """Drops a remedy's command where these stops do not allow it."""
    session = check.predicted.observed.session
    of_images = any(view.image for view in session.views)
    is_lens_known = not of_images or session.camera is not None
    allowed = {
        CALIBRATE_ANEW: check.predicted.stops >= CheckLimits.stops and is_lens_known,
        PLAN: of_images
        and is_lens_known
        and check.predicted.stops >= _LEAST_STOPS
        and check.calibration.robot is not None,
    }
    return step if allowed.get(step.command, True) else Remedy(step.words)


def _rivals(check: Check, best: Suspect, others: Sequence[Suspect]) -> Finding:
    """Finding on the changes that cannot be distinguished from the likeliest."""
    named = listed([change_words(check, other) for other in others])
    robot = check.calibration.calibrated_robot
    if robot is not None and best.name in (f"{JOINT} 1", f"{JOINT} {robot.joint_count}"):
        # A rotation of the base about the first axis, or of the tool about the last, is equivalent.
        return Finding("rivals", f"No stops separate that from {named}.", Remedy("Look at both."))
    these = (
        "This stop does"
        if check.predicted.stops == 1
        else f"These {check.predicted.stops} stops do"
    )
    words = f"{these} not separate that from {named}."
    step = _runnable(check, Remedy("Verify with stops all over the workspace.", PLAN))
    return Finding("rivals", words, step)


def change_document(check: Check, suspect: Suspect) -> dict[str, Any]:
    """Estimates of a change for the JSON document: millimetres, degrees, shares."""
    kind = kind_of(suspect.name)
    values, sigmas = suspect.explained.values, np.sqrt(np.diag(suspect.explained.covariance))
    if kind == NOISE:
        return {"noise_factor": suspect.explained.noise_factor}
    if kind in (LENGTH, SIZE):
        return {"share": float(values[0]), "sigma": float(sigmas[0])}
    if kind == JOINT:
        value, sigma, unit = _joint_figures(check, suspect)
        return {f"offset_{unit}": value, f"sigma_{unit}": sigma}
    documents: dict[str, Any] = {
        name: {
            "moved_mm": motion.mm,
            "sigma_mm": motion.sigma_mm,
            "along": motion.along,
            "turned_deg": motion.deg,
            "sigma_deg": motion.sigma_deg,
            "about": motion.about,
        }
        for name, motion in motions(check, suspect).items()
    }
    if kind == REPLACED:
        return {**documents[suspect.name], "share": float(values[6]), "sigma": float(sigmas[6])}
    return documents if kind == BOTH else documents[suspect.name]


def motions(check: Check, suspect: Suspect) -> dict[str, MeasuredMove]:
    """Estimated motions of the camera, a board, or the board of one view, by name."""
    names = (CAMERA, BOARD) if kind_of(suspect.name) == BOTH else (suspect.name,)
    values, covariance = suspect.explained.values, suspect.explained.covariance
    parts = [slice(6 * at, 6 * at + 6) for at in range(len(names))]
    grown = float(values[6]) if kind_of(suspect.name) == REPLACED else 0.0
    return {
        name: _motion(check, name, values[part], covariance[part, part], grown)
        for name, part in zip(names, parts, strict=True)
    }


def _motion(
    check: Check, name: str, twist: FloatArray, covariance: FloatArray, grown: float
) -> MeasuredMove:
    """Motion of a camera, or of the middle of a board that also grew by a share."""
    x, *boards = check.prior.state.edges
    in_hand = check.calibration.mount == "eye-in-hand"
    if name == CAMERA:
        rotation, point, parent = x[:3, :3], np.zeros(3), "tool" if in_hand else "base"
    else:
        board = _board(check, name)
        rotation, point = boards[board][:3, :3], _middle(check, board)
        parent = "base" if in_hand else "tool"
    moved = exp(twist)
    shift = moved[:3, :3] @ point * (1.0 + grown) + moved[:3, 3] - point
    # Jacobian of the point with respect to the twist, through its right perturbation.
    right = np.linalg.inv(inverse_right_jacobian(twist))
    jacobian = moved[:3, :3] @ np.concatenate([-skew(point), np.eye(3)], axis=1) @ right
    metres, sigma_m = _length(shift, jacobian @ covariance @ jacobian.T)
    rad, sigma_rad = _length(twist[:3], covariance[:3, :3])
    return MeasuredMove(
        1e3 * metres,
        1e3 * sigma_m,
        f"the {parent}'s {_signed_axis(rotation @ shift)}",
        float(np.rad2deg(rad)),
        float(np.rad2deg(sigma_rad)),
        f"the {parent}'s {_signed_axis(rotation @ twist[:3])}",
    )


def _board(check: Check, name: str) -> int:
    """Index, among the calibration's boards, of the board of a cause."""
    kind, _, which = name.partition(" ")
    prior, predicted = check.prior, check.predicted
    if kind in (BOARD, REPLACED):
        names = list(prior.targets)
        return prior.boards.index(names.index(which)) if which in names else 0
    return int(predicted.boards[[int(which) in views for views in predicted.views]][0])


def _middle(check: Check, board: int) -> FloatArray:
    """(3,) middle of one of the calibration's boards, in its frame [m]."""
    targets = tuple(check.prior.targets.values())
    if not targets:
        return np.zeros(3)
    return np.asarray(corner_positions(targets[check.prior.boards[board]]).mean(axis=0))


def _length(vector: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Length of a (3,) vector, and its standard deviation along the vector."""
    length = float(np.linalg.norm(vector))
    unit = vector / length if length > 0.0 else np.full(3, 1.0 / np.sqrt(3.0))
    return length, float(np.sqrt(max(float(unit @ covariance @ unit), 0.0)))


def _signed_axis(vector: FloatArray) -> str:
    """Names a direction with its sign: `-x`, or `direction (-0.71, 0.71, 0.00)`."""
    length = float(np.linalg.norm(vector))
    unit = vector / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    words = axis_words(unit)
    if len(words) == 1:
        return words if unit["xyz".index(words)] > 0.0 else f"-{words}"
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*unit)


def _changed(check: Check, suspect: Suspect) -> str:
    kind = kind_of(suspect.name)
    if kind in (JOINT, LENGTH, NOISE, SIZE, REPLACED):
        return f"{_capital(change_words(check, suspect))}."
    moved = motions(check, suspect)
    if kind in (CAMERA, BOARD, BOTH):
        return f"{_capital('; '.join(f'the {name} {move.words}' for name, move in moved.items()))}."
    return (
        f"{_capital(suspect.name)} alone contradicts the calibration, by "
        f"{_size_words(moved[suspect.name])}; the other stops agree with it."
    )


def change_words(check: Check, suspect: Suspect) -> str:
    """A change with its estimates, as a part of a sentence."""
    kind, explained = kind_of(suspect.name), suspect.explained
    if kind == JOINT:
        value, sigma, unit = _joint_figures(check, suspect)
        robot = check.calibration.calibrated_robot
        joint = int(suspect.name.partition(" ")[2]) - 1
        named = suspect.name if robot is None else joint_words(joint, robot)
        sign = "+" if value > 0.0 else "-"
        return (
            f"{named} off by {sign}{figure(abs(value))} {unit} (sigma {figure(sigma)}) from what "
            "it reads: its encoder slipped, or its zero was lost"
        )
    if kind == LENGTH:
        share, sigma = float(explained.values[0]), float(np.sqrt(explained.covariance[0, 0]))
        kelvins = [f"{abs(share) / value:.0f} K" for value in (_ALUMINIUM, _STEEL)]
        grown = "longer" if share > 0.0 else "shorter"
        return (
            f"all lengths of the arm {grown} by {figure(1e2 * abs(share))} % (sigma "
            f"{figure(1e2 * sigma)}), as {kelvins[0]} do to aluminium and {kelvins[1]} to steel"
        )
    if kind in (SIZE, REPLACED):
        return _other_board(check, suspect)
    if kind == NOISE:
        return f"the robot scatters about {explained.noise_factor:.0f} times as much as it did"
    if kind in (CAMERA, BOARD, BOTH):
        moved = motions(check, suspect)
        return listed([f"the {name} moved by {_size_words(move)}" for name, move in moved.items()])
    return f"{suspect.name} alone being wrong"


def _other_board(check: Check, suspect: Suspect) -> str:
    """A board of another size, in words, with its displacement where it also moved."""
    kind, _, which = suspect.name.partition(" ")
    share = float(suspect.explained.values[-1])
    sigma = float(np.sqrt(suspect.explained.covariance[-1, -1]))
    size = "larger" if share > 0.0 else "smaller"
    board = f"the board {which}".strip()
    words = (
        f"{board} is {figure(1e2 * abs(share))} % {size} (sigma {figure(1e2 * sigma)}) than it "
        "was: it was printed again or exchanged"
    )
    if kind == SIZE:
        return words
    moved = motions(check, suspect)[suspect.name]
    return f"{words}; its middle lies {_size_words(moved)} elsewhere"


def _size_words(moved: MeasuredMove) -> str:
    return mm_and_deg(moved.mm, moved.deg)


def _joint_figures(check: Check, suspect: Suspect) -> tuple[float, float, str]:
    """Offset of a joint, its standard deviation, and their unit."""
    joint = int(suspect.name.partition(" ")[2]) - 1
    robot = check.calibration.calibrated_robot
    value = float(suspect.explained.values[0])
    sigma = float(np.sqrt(suspect.explained.covariance[0, 0]))
    if robot is not None and robot.chain.prismatic[joint]:
        return 1e3 * value, 1e3 * sigma, "mm"
    return float(np.rad2deg(value)), float(np.rad2deg(sigma)), "deg"


def _agreement(check: Check) -> str:
    turn, shift = np.sqrt(np.mean(np.sum(check.residuals.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
    chance = f"{figure(100 * check.p_value)} %"
    sure, verb = _SURE * check.camera_sigma, "agrees" if check.predicted.stops == 1 else "agree"
    off_deg, off_mm = figure(float(np.rad2deg(turn))), figure(1e3 * float(shift))
    return (
        f"{_stops(check)} {verb} with the calibration: off by {off_mm} mm and {off_deg} deg (rms); "
        f"by chance alone it is more in {chance} of checks. A camera that had moved by "
        f"{figure(1e3 * float(sure[3:].max()))} mm or {figure(float(np.rad2deg(sure[:3].max())))} "
        "deg would have shown."
    )


def _doubts(check: Check) -> Iterator[Finding]:
    if check.predicted.stops < CheckLimits.stops:
        verb = "distinguishes" if check.predicted.stops == 1 else "distinguish"
        words = f"{_stops(check)} hardly {verb} one change from another."
        step = _runnable(check, Remedy(f"Take {CheckLimits.stops} stops or more.", PLAN))
        yield Finding("few_stops", words, step)


def _stops(check: Check) -> str:
    return counted(check.predicted.stops, "stop")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def to_document(
    check: Check, triggers: Sequence[Outcome], verdict: Verdict | None = None
) -> dict[str, Any]:
    """Converts a check to a JSON document; unknown values are absent.

    Args:
        check: The check.
        triggers: Evaluation of the policy's triggers.
        verdict: Its verdict, with the paths of the run; that of `verdict_of` where None.
    """
    calibration, observed, verdict = (
        check.calibration,
        check.predicted.observed,
        verdict or verdict_of(check),
    )
    return {
        "schema": SCHEMA,
        "passed": check.passed,
        "calibration": {
            "session": calibration.session_name,
            "sha256": calibration.session_sha256,
            "created": calibration.created,
        },
        "session": {"name": observed.session.name, "sha256": observed.session.digest()},
        "sentences": list(verdict.reasons),
        "next": [vars(step) for step in verdict.next_steps],
        "changes": [_change(check, suspect) for suspect in check.named],
        "others": [
            _change(check, suspect)
            for suspect in listed_suspects(check)
            if suspect not in check.named
        ],
        "explained": check.explained,
        "log10_evidence": check.log_evidence / float(np.log(10.0)),
        "misfit": check.misfit,
        "degrees_of_freedom": check.freedom,
        "p_value": check.p_value,
        "camera_sigma": {
            "rotation_deg": np.rad2deg(check.camera_sigma[:3]).tolist(),
            "translation_mm": (1e3 * check.camera_sigma[3:]).tolist(),
        },
        "stops": [
            {
                "views": list(views),
                "off_mm": 1e3 * float(np.linalg.norm(away[3:])),
                "off_deg": float(np.rad2deg(np.linalg.norm(away[:3]))),
                "left_mm": 1e3 * float(np.linalg.norm(left[3:])),
                "left_deg": float(np.rad2deg(np.linalg.norm(left[:3]))),
            }
            for views, away, left in zip(
                check.predicted.views, check.residuals, check.remaining, strict=True
            )
        ],
        "not_used": [
            {"view": view, "reason": reason} for view, reason in sorted(observed.reasons.items())
        ],
        "warnings": list(check.predicted.warnings),
        "recalibrate": any(trigger.state == "fired" for trigger in triggers),
        "triggers": [_trigger(trigger) for trigger in triggers],
    }


def listed_suspects(check: Check) -> tuple[Suspect, ...]:
    """Changes to list: those that are named, and others that are not unlikely."""
    others = (suspect for suspect in check.suspects if suspect not in check.named)
    return (*check.named, *(other for other in others if other.probability > _LISTED_SHARE))


def _change(check: Check, suspect: Suspect) -> dict[str, Any]:
    return {
        "cause": suspect.name,
        "probability": suspect.probability,
        **change_document(check, suspect),
    }


def _trigger(outcome: Outcome) -> dict[str, Any]:
    trigger = outcome.trigger
    figures = {"limit": trigger.limit, "value": outcome.value}
    return {
        "quantity": trigger.quantity,
        "state": outcome.state,
        **{name: figure for name, figure in figures.items() if figure is not None},
        "words": outcome.words,
    }
