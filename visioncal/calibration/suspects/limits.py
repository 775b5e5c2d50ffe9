"""Checks of a result against its limits: by its views, motion, corners and arms."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.suspects.arm import NO_JOINTS
from visioncal.calibration.suspects.judged import Findings, JudgedArm, JudgedPair, Sensor
from visioncal.calibration.suspects.ranking import MEASURE_BOARD, add_views_remedy
from visioncal.calibration.suspects.registry import SUSPECTS
from visioncal.calibration.suspects.suspect import UNEXPLAINED
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import counted, figure, mm_and_deg, row_words, sigma_words
from visioncal.core.transforms import LEVER_M
from visioncal.core.verdict import (
    CALIBRATE,
    LEAST_NEED_MM,
    REVIEW,
    Finding,
    Remedy,
    look_at,
    without,
)
from visioncal.results import Rms, ViewResult
from visioncal.vision.boards.imaging import BLURRED

_LIMITS = CalibrationLimits()
# Views that are named.
_LISTED = 3
# From here on places disagree by more than arms, markers and lenses err [mm], where that is so many
# times as much as turns do on the lever.
_FAR_MM, _MUCH_FARTHER = 20.0, 10.0
# Levers from joints that scatter to the flange: from a wrist to a long arm [m].
_LEVERS_M = (0.1, 1.5)
_STATE_LENS = Remedy(
    "State a lens that was calibrated with more images (matrix and distortion of its [camera]), or "
    "add images of the board held by hand: near, tilted, and in the corners of the image "
    "(role = intrinsics in views.csv)."
)
_ARM_SCATTERS = (
    "Read each pose and take each picture once the arm stands still, and read poses that are "
    "measured, not commanded. Where it does, it repeats no better, as a servo arm or one whose "
    "joints have play: more views then average it in the frames, and not where it picks. Look at "
    "the worst views, too, for a board or camera that is loose."
)


def collect_findings(judged: Findings) -> list[Finding]:
    """All findings against a result, in the order of the checks."""
    robots, scatter = [*_robot_noise(judged)], [*_scatter(judged)]
    is_fatal = any(doubt.is_fatal for doubt in scatter)
    if scatter:
        # Scatter replaces the robot's noise, and is accepted up to the same need at least.
        least = max((doubt.until_mm for doubt in robots), default=0.0)
        scatter = [replace(doubt, until_mm=max(doubt.until_mm, least)) for doubt in scatter]
        if len(judged.arms) == 1 and _is_of_arm(judged, judged.arms[0]) and not is_fatal:
            words = f"{robots[0].words} {scatter[0].words}"
            scatter = [replace(scatter[0], words=words, do=robots[0].do)]
        robots = []
    # With fatal scatter, sigmas say nothing about the motion. A step inflates all of them, and more
    # views do not help: they count where they are so large that the result is of no use.
    sigmas = [] if is_fatal else [*_sigmas(judged), *_place(judged), *_workspace(judged)]
    if any("calibration" in SUSPECTS[found.kind].inflates for found in judged.warnings):
        sigmas = [replace(found, do=None) for found in sigmas if found.is_fatal]
    return [
        *scatter,
        *(doubt.of(pair.name) for pair in judged.pairs for doubt in _left_out(pair)),
        *(doubt.of(pair.name) for pair in judged.pairs for doubt in _holdout(pair)),
        *sigmas,
        *few_stops(judged, sum(view.used for view in judged.views)),
        *(doubt.of(sensor.name) for sensor in judged.sensors for doubt in _lost_views(sensor)),
        *(doubt.of(sensor.name) for sensor in judged.sensors for doubt in _corner_noise(sensor)),
        *robots,
        *(warning for warning in judged.warnings if SUSPECTS[warning.kind].is_doubt),
    ]


def _is_of_arm(judged: Findings, arm: JudgedArm) -> bool:
    """Whether noise beyond a robot's own is like that of an arm that repeats poorly.

    No pattern by posture or time is known of it, and its shifts are those of its turns by levers
    that arms have.
    """
    if not any(_robot_noise_of(arm)) or any(SUSPECTS[at.kind].is_doubt for at in judged.warnings):
        return False
    lever_m = 1e-3 * (arm.noise_mm or 0.0) / np.deg2rad(max(arm.noise_deg or 0.0, 1e-9))
    return bool(_LEVERS_M[0] < lever_m < _LEVERS_M[1])


def _scatter(judged: Findings) -> Iterator[Finding]:
    """Findings on left-out views that disagree with the others, or with views in the fit."""
    words, views, is_fatal, until_mm = [], list[ViewResult](), False, 0.0
    # A servo arm's own noise puts what is seen so far away.
    by_arm = np.max([(0.0, 0.0), *(arm.repeatability for arm in judged.arms)], axis=0)
    by_arm *= _LIMITS.repeatability * np.sqrt(3.0)
    by_arm[0] += 1e3 * LEVER_M * np.deg2rad(by_arm[1])
    for pair in judged.pairs:
        held = pair.weighted_held_out or pair.held_out
        beyond = []
        for value, unit, (check, bad), noise, of_arm in (
            (held.mm, "mm", _LIMITS.scatter_mm, pair.noise.mm, by_arm[0]),
            (held.deg or 0.0, "deg", _LIMITS.scatter_deg, pair.noise.deg or 0.0, by_arm[1]),
        ):
            least = max(check, of_arm)
            if value > max(least, _LIMITS.of_noise * noise):
                beyond.append(f"{figure(value)} {unit} (doubt begins at {figure(least)})")
                is_fatal |= value > bad
                # A turn that nothing explains is no noise of any size.
                enough = _LIMITS.good_enough * value if unit == "mm" else np.inf
                until_mm = max(until_mm, enough if value > bad else 0.0)
        if beyond:
            views += [view for view in pair.views if view.used and view.residual_mm is not None]
            words.append(" and ".join(beyond) + (f" ({pair.name})" if pair.name else ""))
    if words:
        worst = sorted(views, key=lambda view: -(view.residual_mm or 0.0))[:_LISTED]
        named = ", ".join(f"view {view.view} ({_residual(view)})" for view in worst)
        yield Finding(
            UNEXPLAINED,
            f"Where the others predict them, views are off by {', '.join(words)}, rms; the worst "
            f"are {named}.",
            Remedy(_unexplained_words(judged.held_out), REVIEW),
            tuple(view.view for view in worst),
            is_fatal=is_fatal,
            until_mm=until_mm,
        )


def _unexplained_words(away: Rms) -> str:
    """Advice where no tried cause explains left-out residuals."""
    sides = [
        "the robot's poses (commanded or rounded ones, or read before the arm stood still; a "
        "servo arm; another tool in some rows)",
        "what was seen (a marker of few pixels, blur, a lens or a board that is not as stated)",
    ]
    if away.deg is None:
        sides = [
            "the robot (a load that no column states, heat, play, commanded angles)",
            "the readings (an instrument that was moved or is not warm, another nest)",
        ]
    # Turns are seen worse than places, and arms err by both alike.
    turned_mm = 1e3 * LEVER_M * np.deg2rad(away.deg or 0.0)
    if turned_mm > away.mm:
        sides.reverse()
    tried = (
        "Other units or conventions of the poses, rows that are apart, exchanged or repeated, "
        "steps and drift were tried and do not explain it. "
    )
    # No arm, marker or lens errs by centimetres and turns as it should.
    if away.deg is not None and away.mm > _FAR_MM and _MUCH_FARTHER * turned_mm < away.mm:
        return (
            f"{tried}Turns agree, and places do not: look for a wrong length or sign in the model "
            "or table by which joint angles became the robot's poses, for a rail or lift that is "
            "in no pose, and for positions in another frame than the rotations."
        )
    return (
        f"{tried}Look at the worst views, for {sides[0]}; then for {sides[1]}, and what holds "
        "camera and board (a pole that sways, a conveyor, something under the board in some views)."
    )


def _residual(view: ViewResult) -> str:
    turned = "" if view.residual_deg is None else f", {figure(view.residual_deg)} deg"
    return f"{figure(view.residual_mm or 0.0)} mm{turned}"


def _left_out(pair: JudgedPair) -> Iterator[Finding]:
    """Finding on outlier views of a pair."""
    if not pair.outliers:
        return
    views, reason = tuple(rejection.view for rejection in pair.outliers), pair.outliers[0].reason
    words = f"View {views[0]} was left out. It {reason}."
    if len(views) > 1:
        each = ", ".join(map(str, views))
        words = f"Views {each} were left out. View {views[0]} {reason}."
    step = Remedy(
        f"Compare images and poses: repeat, or in views.csv, delete {row_words(views)}.",
        look_at(views[0]),
    )
    yield Finding("wrong_views", words, step, views, without_it=without(views, pair.held_out.words))


def _holdout(pair: JudgedPair) -> Iterator[Finding]:
    """Finding on views that the session holds back, and the result does not predict."""
    holdout, left_out = pair.holdout, pair.held_out
    if holdout is None:
        return
    ratio = max(
        one / max(other, LEAST_NEED_MM)
        for one, other in ((holdout.mm, left_out.mm), (holdout.deg or 0.0, left_out.deg or np.inf))
    )
    if ratio > _LIMITS.holdout:
        yield Finding(
            "holdout",
            f"The views that the session holds back are missed by {holdout.words}, {ratio:.0f} "
            "times worse than views left out in turn. They lie where the result does not hold, or "
            "their poses or readings are wrong.",
            Remedy("Record views where the result is to hold, with role = fit."),
        )


def _uncertainty_mm(judged: Findings) -> tuple[float, float]:
    """Sigma of what the calibration, and the boards' sizes, add to the worst picks [mm]."""
    parts = [
        (pick.budget_mm.get("calibration", 0.0), pick.budget_mm.get("board", 0.0))
        for pick in judged.picks
    ]
    return max(parts, key=lambda part: np.hypot(*part), default=(0.0, 0.0))


def _is_of_board(judged: Findings) -> bool:
    """Whether most uncertainty is that of boards' stated sizes, which no view reduces."""
    calibration_mm, board_mm = _uncertainty_mm(judged)
    return board_mm > calibration_mm


def remedy_for_uncertainty(judged: Findings) -> Remedy | None:
    """Remedy that makes a result less uncertain; None where a finding on the arm has it."""
    if _is_of_board(judged):
        return MEASURE_BOARD
    if any(warning.do == NO_JOINTS for warning in judged.warnings):
        return None
    return _more_views(judged, "Add views from other poses of the robot.")


def _more_views(judged: Findings, words: str, purpose: str = "", count: int = 5) -> Remedy:
    return add_views_remedy(words, modelled=judged.plannable, purpose=purpose, count=count)


def _tilted(judged: Findings) -> Remedy:
    count = max(5, *(_LIMITS.stops[0] - arm.stops for arm in judged.arms))
    how = "tilted by 20 to 40 degrees about different axes"
    if not all(arm.can_tilt for arm in judged.arms):
        how = "all over the workspace and turned as far as the arm turns"
    return _more_views(judged, f"Add {count} views or more, {how}.", count=count)


def _against_lasting(judged: Findings) -> Remedy:
    """Advice against errors that last from view to view."""
    words = "More views alike will not help: "
    if all(sensor.pixel_px is None for sensor in judged.sensors):
        words += "give images in place of poses of a marker, or a larger marker; then "
    if all(arm.modelled for arm in judged.arms):
        return Remedy(f"{words}look whether camera, target and base hold still, and record again.")
    return Remedy(f"{words}record joint angles with the arm's model.")


def _sigmas(judged: Findings) -> Iterator[Finding]:
    """Finding on directions of the unknown edges that are known too little."""
    # Those of a calibrated arm are as undetermined as the errors of its first and last links, which
    # compensate them in all poses: of it the workspace counts.
    if all(arm.workspace_mm is not None for arm in judged.arms):
        return
    weak, offsets, is_fatal = list[str](), list[float](), False
    for direction in judged.worst:
        scale, unit, (check, bad) = 1e3, "mm", _LIMITS.sigma_mm
        if direction.is_rotation:
            scale, unit, (check, bad) = float(np.rad2deg(1.0)), "deg", _LIMITS.sigma_deg
        if (sigma := direction.sigma * scale) > check:
            weak.append(f"{direction.words} ({sigma_words(sigma, unit)})")
            is_fatal |= sigma > bad
            offsets += [] if direction.is_rotation else [direction.sigma]
    if not weak:
        return
    step, by = _tilted(judged), "by the motion"
    # The greater part of their variances, where views see the board; no size turns anything.
    board_m = 1e-3 * _uncertainty_mm(judged)[1]
    is_of_board = bool(offsets) and all(board_m > 0.7 * sigma for sigma in offsets)
    if any(warning.do == NO_JOINTS for warning in judged.warnings):
        step, by = NO_JOINTS, "by the arm's own errors"
    elif any(arm.are_lasting for arm in judged.arms):
        # They are no finding where chance may explain them, or no arm errs by as much.
        step, by = _against_lasting(judged), "by errors that last from view to view"
    elif judged.by_lens:
        step, by = _STATE_LENS, "by how well the views determine the lens"
    elif _is_of_board(judged) and is_of_board:
        step, by = MEASURE_BOARD, "by how well the board's size is stated"
    words = (
        f"Weakly determined {by}, with their sigmas: {', '.join(weak)}; doubt begins at "
        f"{_LIMITS.sigma_mm[0]:g} mm and {_LIMITS.sigma_deg[0]:g} deg."
    )
    yield Finding("weak_motion", words, step, is_fatal=is_fatal, until_mm=0.0)


def _place(judged: Findings) -> Iterator[Finding]:
    """Finding on the places of things where the views look."""
    check, bad = _LIMITS.sigma_mm
    sigma_mm = float(np.hypot(*_uncertainty_mm(judged)))
    if sigma_mm > check and any(arm.workspace_mm is None for arm in judged.arms):
        yield Finding(
            "place",
            f"Where the views look, things are placed to {figure(sigma_mm)} mm (sigma; doubt "
            f"begins at {check:g}).",
            MEASURE_BOARD if _is_of_board(judged) else None,
            is_fatal=sigma_mm > bad,
            until_mm=0.0,
        )


def _workspace(judged: Findings) -> Iterator[Finding]:
    """Findings on the accuracy of calibrated arms over their workspace."""
    check, bad = _LIMITS.sigma_mm
    placed_mm = float(np.hypot(*_uncertainty_mm(judged)))
    for arm in judged.arms:
        if arm.workspace_mm is None or arm.workspace_mm <= check:
            continue
        yield Finding(
            "workspace",
            f"All over the workspace the calibrated arm places its tool to "
            f"{figure(arm.workspace_mm)} mm (sigma, in the median; doubt begins at {check:g}). A "
            "board's size counts in it: measure its squares, and state square_sigma_m.",
            _more_views(
                judged,
                "Add views with other postures of the arm, all over the workspace.",
                " --for kinematics",
            ),
            # Where the views look, the arm may be as sure as it is not elsewhere.
            is_fatal=min(arm.workspace_mm, placed_mm) > bad,
            until_mm=0.0,
        ).of(arm.name)


def few_stops(judged: Findings, used: int) -> Iterator[Finding]:
    """Findings on arms whose stops, of `used` views, are too few to check a result."""
    check, bad = _LIMITS.stops
    for arm in judged.arms:
        if arm.stops < check:
            is_fatal, thing = arm.stops < bad, "view" if arm.stops == used else "stop"
            yield Finding(
                "too_few_stops" if is_fatal else "few_stops",
                f"Only {counted(arm.stops, thing, ('is', 'are'))} used, but a check of the "
                f"result needs {check} or more.",
                _tilted(judged),
                is_share=True,
                is_fatal=is_fatal,
                until_mm=0.0,
            ).of(arm.name)


def _lost_views(sensor: Sensor) -> Iterator[Finding]:
    count, (check, bad) = len(sensor.lost), _LIMITS.lost_share
    total = sensor.used + sensor.spared + count
    share = count / max(total, 1)
    # Outliers have a finding of their own.
    others = [rejection for rejection in sensor.lost if rejection.view not in sensor.outliers]
    if share <= check or not others:
        return
    step = Remedy(
        "Correct the first of them and those like it, or repeat what is missing.",
        look_at(others[0].view),
    )
    if 2 * sum(BLURRED in other.reason for other in others) > len(others):
        words = "Focus, and let the arm stand still before each image; these are read by --dense."
        step = Remedy(words, f"{CALIBRATE} --dense")
    yield Finding(
        "lost_views",
        f"{count} of {total} views {'is' if count == 1 else 'are'} not used. The first that is "
        f"no outlier: view {others[0].view}, {others[0].reason}.",
        step,
        tuple(rejection.view for rejection in sensor.lost),
        is_fatal=share > bad,
    )


def _corner_noise(sensor: Sensor) -> Iterator[Finding]:
    (check, bad), noise = _LIMITS.pixel_px, sensor.pixel_px
    if noise is None:
        return
    if noise > check:
        yield Finding(
            "corner_noise",
            f"Corners deviate by {figure(noise)} px from any pose of a flat board (doubt begins at "
            f"{check:g}): the intrinsics do not fit this camera, the board is not flat, or images "
            "are blurred.",
            Remedy("Look for blur, glare, and a lens or a board that is not as stated."),
            is_fatal=noise > bad,
        )


def _robot_noise(judged: Findings) -> Iterator[Finding]:
    """Findings on implausible noise of arms, which usually has another cause."""
    for arm in judged.arms:
        for ratio, limit_mm in _robot_noise_of(arm):
            words = (
                "The residuals would take a flange that is off by "
                f"{mm_and_deg(arm.noise_mm or 0.0, arm.noise_deg or 0.0)} from stop to stop; such "
                f"arms repeat to {mm_and_deg(*arm.repeatability)}."
            )
            do = Remedy(_unexplained_words(judged.held_out))
            if _is_of_arm(judged, arm):
                words += (
                    " They follow neither posture nor time, and shifts go with turns as an arm's."
                )
                do = Remedy(_ARM_SCATTERS, REVIEW)
            until_mm = _LIMITS.good_enough * ratio * limit_mm
            yield Finding(UNEXPLAINED, words, do, until_mm=until_mm).of(arm.name)


def _robot_noise_of(arm: JudgedArm) -> Iterator[tuple[float, float]]:
    """How many times an arm's noise is above its limit, and the limit [mm], where it clearly is."""
    if arm.noise_mm is None or arm.noise_deg is None or arm.has_posture_errors:
        return
    limit_mm, limit_deg = _LIMITS.repeatability * np.array(arm.repeatability)
    # Only noise whose confidence interval is above the limit counts.
    least_mm, least_deg = arm.lower_bounds or (arm.noise_mm, arm.noise_deg)
    if max(least_mm / limit_mm, least_deg / limit_deg) > 1.0:
        yield max(arm.noise_mm / limit_mm, arm.noise_deg / limit_deg), float(limit_mm)
