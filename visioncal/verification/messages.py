"""Verdict of a check in sentences, and as verify.json."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.core.directions import axis_words
from visioncal.core.limits import CONTRADICTION, CheckLimits
from visioncal.core.number_format import counted, figure, listed, view_words
from visioncal.core.prediction import point_jacobian, through
from visioncal.core.transforms import exp, inverse_right_jacobian
from visioncal.core.types import FloatArray
from visioncal.core.verdict import (
    AGAIN,
    AGREEMENT,
    CALIBRATE_ANEW,
    DEPTH_CHANGED,
    PLAN,
    Finding,
    Option,
    Remedy,
    Verdict,
    again,
)
from visioncal.robot.model import joint_words
from visioncal.verification.change_hypotheses import (
    BOARD,
    BOTH,
    CAMERA,
    JOINT,
    LENGTH,
    LENS,
    LOAD,
    NOISE,
    PAIRING,
    REPLACED,
    SIZE,
    VIEW,
)
from visioncal.verification.check import Check, PossibleChange
from visioncal.verification.triggers import Trigger
from visioncal.vision.targets import corner_positions

_OR_TOOL = ", or another tool was active in the controller"
_OR_JOINT = ", or a joint slipped, as rows with joint angles (q1_rad ...) would show"
_ANEW = "calibrate again; these stops make a first result, and more a good one."
_SIZE_WORDS = (
    "the {board} is {percent} % {larger} (sigma {sigma}) than it was: it was printed again or "
    "exchanged"
)
_ANOTHER_BOARD = Remedy(
    "Verify with the board that was calibrated with; or measure the squares of this one, and "
    f"{_ANEW}",
    CALIBRATE_ANEW,
)
_OTHER_POSES = Remedy(
    "Nothing in a cell moves by metres unseen: look whether the poses of these stops have the unit "
    "and the convention of the calibrated ones, which doctor finds.",
    "visioncal doctor SESSION",
)
_BELONG = Remedy(
    "Look whether poses, images and corners of each row belong together, which doctor finds; then "
    "verify again.",
    "visioncal doctor SESSION",
)
_OTHER_TOOL = Remedy(
    "Look whether the controller's tool is that of the calibrated poses, and take the stops again "
    f"with it; where the camera or the board was mounted anew, {_ANEW}"
)
_PAIR_AGAIN = Remedy(
    "Bring the images to the rows of their poses; then verify again.", "visioncal doctor SESSION"
)
# Words for each kind of change, a part of a sentence, and the advice on it.
_KINDS = {
    CAMERA: (
        "the camera {moved}{or_frame}",
        Remedy(f"Fasten the camera, and {_ANEW}", CALIBRATE_ANEW),
    ),
    LENS: (
        "the lens is {percent} % {longer} (sigma {sigma}) than it was, as where its focus or zoom "
        "was touched",
        Remedy(f"Fasten its focus, and {_ANEW}", CALIBRATE_ANEW),
    ),
    BOARD: (
        "the {name} {moved}{or_frame}",
        again(
            "Put the board back; if it was moved on purpose, verify without its place.",
            Option("board-moved"),
        ),
    ),
    BOTH: (
        "the camera {moved}; the board {other}",
        Remedy(f"Fasten both, and {_ANEW}", CALIBRATE_ANEW),
    ),
    SIZE: (_SIZE_WORDS, _ANOTHER_BOARD),
    REPLACED: (_SIZE_WORDS + "; its middle {moved}", _ANOTHER_BOARD),
    JOINT: (
        "{joint} off by {offset} from what it reads: its encoder slipped, its zero was lost, or "
        "a load bends it that was not there",
        Remedy(
            "Look whether the joint keeps its zero (a coupling that slips does so again), then "
            f"{_ANEW}",
            CALIBRATE_ANEW,
        ),
    ),
    LOAD: (
        "the load bends the arm, and the calibration has not seen it: {load}",
        Remedy(
            "Verify without it; or calibrate by stops with and without it (payload_kg in all rows, "
            "0 without), which finds how far the joints bend."
        ),
    ),
    LENGTH: (
        "all lengths of the arm are {percent} % {longer} (sigma {sigma}), as by {aluminium:.0f} K "
        "of aluminium or {steel:.0f} K of steel",
        Remedy(
            "Let the arm come to the temperature at which it was calibrated, or calibrate it at "
            "the one at which it works."
        ),
    ),
    NOISE: (
        "the robot scatters about {factor:.0f} times as much as it did{or_joint}",
        Remedy(
            "Look for play in mounts and joints, and whether the robot stood still at each image; "
            "then verify again.",
            AGAIN,
        ),
    ),
    PAIRING: ("images are in other rows than their poses: {pairs}", _PAIR_AGAIN),
    VIEW: (
        "{name} alone contradicts the calibration: its board {moved}",
        Remedy(
            "Take that stop again, whose image and pose do not belong together; then verify again.",
            AGAIN,
        ),
    ),
}


def verdict_of(check: Check) -> Verdict:
    """Verdict of a check: whether the calibration holds, what changed, and what to do."""
    bad, few = list[Finding](), list[Finding]()
    if check.calibration.verdict.status == "bad":
        words = f"The calibration itself is bad: {check.calibration.verdict.top[0]}"
        step = Remedy("Correct that first, and calibrate again: changes from it say little.")
        bad.append(Finding("bad_calibration", words, step))
    if check.predicted.stops < CheckLimits.stops:
        words = f"{_stops(check)} can hardly distinguish one change from another."
        step = _runnable(check, Remedy(f"Take {CheckLimits.stops} stops or more.", PLAN))
        few.append(Finding("few_stops", words, step))
    if check.misread is not None:
        return Verdict("bad", (*bad, check.misread, *check.depth))
    if not check.named:
        agreement = Finding(AGREEMENT, _agreement(check))
        if not check.agrees:
            agreement = Finding("unexplained", _contradiction(check), _BELONG)
        findings = (agreement, *check.depth, *bad, *few)
        if not check.passed:
            # The change comes first.
            order = sorted(findings, key=lambda found: found.kind != DEPTH_CHANGED)
            return Verdict("bad", tuple(order))
        return Verdict("check" if bad or few else "good", findings)
    likeliest, *others = check.named
    kind, words = likeliest.cause.kind, _sentence(change_words(check, likeliest))
    # Where something else has changed, too, its probability among those compared says little; and
    # beside changes that are not separated it would say that they are.
    share, is_explained = likeliest.probability, check.explained
    is_separated = all(rival.probability * CheckLimits.ruled_out >= share for rival in others)
    is_limit = not is_explained or not is_separated
    step = _step(check, likeliest)
    reasons = [Finding(kind, words, step, probability=share, by_limit=is_limit)]
    if others:
        reasons.append(_rivals(check, likeliest, others))
    if not check.explained:
        words = "Alone it does not explain the stops: something else has changed too."
        anew = _runnable(check, Remedy(_sentence(_ANEW), CALIBRATE_ANEW))
        reasons.append(Finding("unexplained", words, anew))
    return Verdict("bad", (*bad, *reasons, *check.depth, *(few if others else ())))


def _step(check: Check, change: PossibleChange) -> Remedy:
    """Advice on the likeliest change."""
    if change.cause.kind == PAIRING:
        return _exchange(change.cause.pairs)
    found = _estimates(check, change)
    move = found.get(CAMERA, found)
    # No camera or board moves farther, and no arm grows so; poses in another unit seem to.
    if move.get("moved_mm", 0.0) > 5e3 or not change.is_possible:
        return _OTHER_POSES
    if _or_frame(check, change, move) == _OR_TOOL:
        return _OTHER_TOOL
    return _runnable(check, _KINDS[change.cause.kind][1])


def _runnable(check: Check, step: Remedy) -> Remedy:
    """Drops a remedy's command where these stops do not allow it."""
    session, stops = check.predicted.observed.session, check.predicted.stops
    of_images = any(view.image for view in session.views)
    is_lens_known = session.camera is not None or not of_images
    allowed = {
        CALIBRATE_ANEW: stops >= CheckLimits.stops and is_lens_known,
        # Three stops locate camera and board roughly, so that more can be planned.
        PLAN: of_images and is_lens_known and stops >= 3 and check.calibration.robot is not None,
    }
    return step if allowed.get(step.command, True) else Remedy(step.words)


def _rivals(check: Check, best: PossibleChange, others: Sequence[PossibleChange]) -> Finding:
    """Finding on the changes that cannot be distinguished from the likeliest."""
    named = listed([change_words(check, other) for other in others])
    robot = check.calibration.calibrated_robot
    if robot is not None and best.name in (f"{JOINT} 1", f"{JOINT} {robot.joint_count}"):
        # A rotation of the base about the first axis, or of the tool about the last, is equivalent.
        return Finding("rivals", f"No stops separate that from {named}.", Remedy("Look at both."))
    step = _runnable(check, Remedy("Verify with stops all over the workspace.", PLAN))
    return Finding("rivals", f"{_stops(check)} cannot separate that from {named}.", step)


def change_words(check: Check, change: PossibleChange) -> str:
    """A change with its estimates, as a part of a sentence."""
    found, robot = _estimates(check, change), check.calibration.calibrated_robot
    share, sigma = found.get("share", 0.0), found.get("sigma", 0.0)
    has_joints = any(other.cause.kind == JOINT for other in check.compared)
    # Thermal expansion of aluminium and steel, in shares a kelvin.
    facts = {
        "or_frame": _or_frame(check, change, found),
        "or_joint": "" if has_joints else _OR_JOINT,
        "name": change.name,
        "board": f"board {change.cause.of}".strip(),
        "moved": _moved_words(found.get(CAMERA, found)),
        "other": _moved_words(found.get(BOARD, {})),
        "larger": "larger" if share > 0.0 else "smaller",
        "longer": "longer" if share > 0.0 else "shorter",
        "percent": figure(1e2 * abs(share)),
        "sigma": figure(1e2 * sigma),
        "aluminium": abs(share) / 23e-6,
        "steel": abs(share) / 12e-6,
        "factor": found.get("noise_factor", 1.0),
        "pairs": _pair_words(change.cause.pairs),
        "load": _load_words(check),
    }
    if change.cause.kind == JOINT:
        unit = "mm" if "offset_mm" in found else "deg"
        offset, sigma = found[f"offset_{unit}"], found[f"sigma_{unit}"]
        sign = "+" if offset > 0.0 else "-"
        facts |= {
            "joint": change.name if robot is None else joint_words(change.cause.at, robot),
            "offset": f"{sign}{figure(abs(offset))} {unit} (sigma {figure(sigma)})",
        }
    return _KINDS[change.cause.kind][0].format(**facts)


def _or_frame(check: Check, change: PossibleChange, move: Mapping[str, Any]) -> str:
    """The frame of the poses whose change looks the same as that of a camera or board."""
    is_camera = change.cause.kind == CAMERA
    # All that stands before the robot moves alike in its base, and all on its flange in that.
    if change.cause.kind not in (CAMERA, BOARD) or not (is_camera or len(check.prior.targets) < 2):
        return ""
    if not _is_carried(check, is_camera):
        return ", or the robot's base was pushed"
    # Where the arm was calibrated, joint angles say where the flange is. A mount that gives way
    # farther hangs, and another tool of the controller is mostly farther away.
    is_far = move["moved_mm"] > 20.0 or move["turned_deg"] > 5.0
    return _OR_TOOL if is_far and check.prior.model is None else ""


def _load_words(check: Check) -> str:
    """The loads that the rows state, and the calibration's."""
    rows = [view.numbers for view in check.predicted.observed.session.views]
    kg = [row.get("payload_kg", 0.0) for row in rows]
    was = check.calibration.means.get("payload_kg", 0.0)
    has_force = any(row.get(f"force_{axis}_n") for row in rows for axis in "xyz")
    force = " and forces" if has_force else ""
    return f"payload_kg up to {max(kg):g}{force}, and {was:g} kg when it was calibrated"


def _is_carried(check: Check, is_camera: bool) -> bool:
    """Whether the robot carries the camera, or else the board."""
    return (check.calibration.mount == "eye-in-hand") == is_camera


def _pair_words(pairs: Sequence[tuple[int, int]]) -> str:
    """Images, and the rows of their poses."""
    images, rows = ([pair[at] for pair in pairs] for at in (0, 1))
    if pairs and set(images) == set(rows) and len(pairs) == 2:
        return f"those of views {images[0]} and {images[1]} are exchanged"
    return f"those of {view_words(images)} fit the poses of {view_words(rows)}"


def _exchange(pairs: Sequence[tuple[int, int]]) -> Remedy:
    """The command that exchanges two images again, where only pairs are exchanged."""
    if {(b, a) for a, b in pairs} != set(pairs):
        return _PAIR_AGAIN
    option = ",".join(f"{a},{b}" for a, b in pairs if a < b)
    command = f"visioncal convert SESSION FIXED --exchange {option}"
    return Remedy(_PAIR_AGAIN.words, f"{command} && visioncal verify FIXED --against OUT")


def _moved_words(move: Mapping[str, Any]) -> str:
    """The significant parts of a motion, in words."""
    if "moved_mm" not in move:
        return ""
    (is_shifted, shift), (is_turned, turn) = (
        (size > CONTRADICTION * sigma, f"by {figure(size)} {unit} (sigma {figure(sigma)}) {way}")
        for size, sigma, unit, way in (
            (move["moved_mm"], move["sigma_mm"], "mm", f"along {move['along']}"),
            (move["turned_deg"], move["sigma_deg"], "deg", f"about {move['about']}"),
        )
    )
    parts = [f"moved {shift}"] * (is_shifted or not is_turned) + [f"turned {turn}"] * is_turned
    return " and ".join(parts)


def _estimates(check: Check, change: PossibleChange) -> dict[str, Any]:
    """Estimates of a change for verify.json: millimetres, degrees, shares."""
    kind, explained = change.cause.kind, change.explained
    if kind == NOISE:
        return {"noise_factor": explained.noise_factor}
    if kind == LOAD:
        return {}
    if kind == PAIRING:
        return {"pairs": change.cause.pairs}
    if kind == BOTH:
        return {CAMERA: _motion(check, change, 0), BOARD: _motion(check, change, 6)}
    value, sigma = float(explained.values[-1]), float(np.sqrt(explained.covariance[-1, -1]))
    if kind == JOINT:
        robot = check.calibration.calibrated_robot
        is_prismatic = robot is not None and robot.chain.prismatic[change.cause.at]
        unit, scale = ("mm", 1e3) if is_prismatic else ("deg", float(np.rad2deg(1.0)))
        return {f"offset_{unit}": scale * value, f"sigma_{unit}": scale * sigma}
    share = {"share": value, "sigma": sigma} if kind in (LENGTH, LENS, SIZE, REPLACED) else {}
    return share | (_motion(check, change, 0) if kind not in (LENGTH, LENS, SIZE) else {})


def _motion(check: Check, change: PossibleChange, first: int) -> dict[str, Any]:
    """Estimated motion of a camera or board, by the six values of a change from `first` on."""
    cause, explained, edges = change.cause, change.explained, check.prior.state.edges
    part, targets = slice(first, first + 6), [*check.prior.targets.values()]
    is_camera, point = cause.kind in (CAMERA, BOTH) and first == 0, np.zeros(3)
    if targets and not is_camera:
        # A board's motion is that of its middle.
        point = corner_positions(targets[check.prior.boards[cause.at]]).mean(axis=0)
    rotation = edges[0 if is_camera else 1 + cause.at, :3, :3]
    parent = "tool" if _is_carried(check, is_camera) else "base"
    twist, covariance = explained.values[part], explained.covariance[part, part]
    grown = float(explained.values[6]) if cause.kind == REPLACED else 0.0
    moved = exp(twist)
    shift = moved[:3, :3] @ point * (1.0 + grown) + moved[:3, 3] - point
    # Jacobian of the point with respect to the twist, through its right perturbation.
    right = np.linalg.inv(inverse_right_jacobian(twist))
    jacobian = point_jacobian(moved, point) @ right
    metres, sigma_m, along = _length(shift, through(jacobian, covariance), rotation)
    rad, sigma_rad, about = _length(twist[:3], covariance[:3, :3], rotation)
    return {
        "moved_mm": 1e3 * metres,
        "sigma_mm": 1e3 * sigma_m,
        "along": f"the {parent}'s {along}",
        "turned_deg": float(np.rad2deg(rad)),
        "sigma_deg": float(np.rad2deg(sigma_rad)),
        "about": f"the {parent}'s {about}",
    }


def _length(
    vector: FloatArray, covariance: FloatArray, rotation: FloatArray
) -> tuple[float, float, str]:
    """Length of a (3,) vector, its standard deviation, and its direction in the parent frame."""
    length = float(np.linalg.norm(vector))
    unit = vector / length if length > 0.0 else np.full(3, 1.0 / np.sqrt(3.0))
    sigma = float(np.sqrt(max(float(unit @ covariance @ unit), 0.0)))
    return length, sigma, signed_axis(rotation @ unit)


def signed_axis(unit: FloatArray) -> str:
    """Names a direction with its sign: `-x`, or `direction (-0.71, 0.71, 0.00)`."""
    words = axis_words(unit)
    if len(words) == 1:
        return words if unit["xyz".index(words)] > 0.0 else f"-{words}"
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*unit)


def _agreement(check: Check) -> str:
    # Nearly every check detects twice as many sigmas as a part of a motion is mentioned from.
    sure = 2.0 * CONTRADICTION * check.camera_sigma
    again = f" ({check.repeated} of them where the calibration's stood)" if check.repeated else ""
    verb = "agrees" if check.predicted.stops == 1 else "agree"
    return (
        f"{_stops(check)}{again} {verb} with the calibration: {_off(check)}. A camera "
        f"that had moved by {figure(1e3 * float(sure[3:].max()))} mm or "
        f"{figure(float(np.rad2deg(sure[:3].max())))} deg would have shown."
    )


def _contradiction(check: Check) -> str:
    verb = "contradicts" if check.predicted.stops == 1 else "contradict"
    return (
        f"{_stops(check)} {verb} the calibration, and no change that was looked for explains "
        f"that: {_off(check)}."
    )


def _off(check: Check) -> str:
    """How far the stops are off, and how often they are farther by chance."""
    turn, shift = np.sqrt(np.mean(np.sum(check.residuals.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
    off_deg, off_mm = figure(float(np.rad2deg(turn))), figure(1e3 * float(shift))
    return (
        f"off by {off_mm} mm and {off_deg} deg (rms); by chance alone it is more in "
        f"{figure(100 * check.p_value)} % of checks"
    )


def _stops(check: Check) -> str:
    return counted(check.predicted.stops, "stop")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def to_document(
    check: Check, triggers: Sequence[Trigger], verdict: Verdict | None = None
) -> dict[str, Any]:
    """Converts a check to a JSON document; unknown values are absent.

    Args:
        check: The check.
        triggers: Evaluation of the reasons to calibrate again.
        verdict: Its verdict, with the paths of the run; that of `verdict_of` where None.
    """
    calibration, observed = check.calibration, check.predicted.observed
    verdict = verdict or verdict_of(check)
    others = [change for change in listed_changes(check) if change not in check.named]
    return {
        "schema": 1,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "passed": check.passed,
        "status": verdict.status,
        "calibration": {
            "session": calibration.session_name,
            "sha256": calibration.session_sha256,
            "created": calibration.created,
        },
        "session": {"name": observed.session.name, "sha256": observed.session.digest()},
        "sentences": list(verdict.reasons),
        "next": [{"words": at.words, "command": at.command} for at in verdict.next_steps],
        "changes": [_change(check, change) for change in check.named],
        "others": [_change(check, change) for change in others],
        "explained": check.explained,
        "misfit": check.unchanged.misfit,
        "degrees_of_freedom": check.unchanged.freedom,
        "p_value": check.p_value,
        "repeated_stops": check.repeated,
        "camera_sigma": {
            "rotation_deg": np.rad2deg(check.camera_sigma[:3]).tolist(),
            "translation_mm": (1e3 * check.camera_sigma[3:]).tolist(),
        },
        "stops": [
            {
                "views": [view],
                "off_mm": 1e3 * float(np.linalg.norm(away[3:])),
                "off_deg": float(np.rad2deg(np.linalg.norm(away[:3]))),
                "left_mm": 1e3 * float(np.linalg.norm(left[3:])),
                "left_deg": float(np.rad2deg(np.linalg.norm(left[:3]))),
            }
            for view, away, left in zip(
                check.predicted.views, check.residuals, check.remaining, strict=True
            )
        ],
        "not_used": [
            {"view": view, "reason": reason} for view, reason in sorted(observed.reasons.items())
        ],
        "warnings": list(check.predicted.warnings),
        "recalibrate": any(trigger.state == "fired" for trigger in triggers),
        "triggers": [trigger.document for trigger in triggers],
    }


def listed_changes(check: Check) -> tuple[PossibleChange, ...]:
    """Changes to list: those that are named, and others that are not unlikely."""
    others = (change for change in check.compared if change not in check.named)
    # Changes of a smaller probability are not listed.
    return (*check.named, *(other for other in others if other.probability > 1e-3))


def _change(check: Check, change: PossibleChange) -> dict[str, Any]:
    """A change for the JSON document, with its estimates."""
    estimates = _estimates(check, change)
    return {"cause": change.name, "probability": change.probability, **estimates}
