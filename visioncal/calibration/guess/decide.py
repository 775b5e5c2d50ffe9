"""Decision which reading is right: by its posterior beside the declared one and none of these.

Reported poses are `base_from_model @ FK(q) @ flange_from_tool` with two constant transforms: a
turned base, and an inverse that may as well be another mount, show only in the robot's own joints.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import distances, is_about_one_axis
from visioncal.calibration.guess.hypothesis import HALF_TURN, ROW_ORDERS, Hypothesis
from visioncal.calibration.guess.messages import notes, sentence
from visioncal.calibration.guess.recording import (
    CLEAR,
    CLOSING_SCORE,
    EVIDENCE,
    FEWEST_ROWS,
    Recording,
    Scored,
    chain_fit,
    fitted,
    flange_and_cell_m,
    plausibility,
)
from visioncal.calibration.guess.result import Candidate, Guess
from visioncal.calibration.guess.search import search
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, pose_difference, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, Mount

_LISTED = 12
# Poses of two readings that differ by less than this share of the residuals are the same.
_SAME = 0.3
# Nominal models differ from the controller's by a few millimetres; a half turn, by far more.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Most rows that are fitted again, and most of them that are tried as exchanged.
_MOST_ROWS, _MOST_OUTLIERS = 200, 8
# Random subsets from which the fit of an order starts.
_STARTS = 12


def guess_reading(
    robot: PoseNumbers,
    camera: PoseNumbers,
    mount: Mount | None,
    *,
    chain: FloatArray | None = None,
    is_measured: bool = False,
) -> Guess:
    """Tries every plausible reading of the poses and finds the one that closes the chain.

    Args:
        robot: `base_from_flange` of n rows, with the declared reading.
        camera: `cam_from_target` of the same rows, likewise; NaN where the target was not seen.
        mount: The declared mount; None to take the one with the more plausible cell.
        chain: (n, 4, 4) `base_from_flange` by a robot's model at the recorded joints, NaN in rows
            without; it shows what no camera can.
        is_measured: Whether the camera's poses were measured from images by visioncal, so that
            only the board's stated size can be wrong about them.

    Returns:
        The readings, and whether one stands out.

    Raises:
        DataError: The rows do not match, a rotation has not as many numbers as its form, or
            both mounts fit and none was declared.
        DegenerateError: Too few rows have both poses.
    """
    mounts = MOUNTS if mount is None else (mount,)
    recordings = [Recording(robot, camera, name, is_measured, chain) for name in mounts]
    _check(recordings[0])
    with one_blas_thread():
        guesses = [(recording, *_decided(recording)) for recording in recordings]
        if mount is None:
            # Of two that find the same reading, the one that changes less.
            guesses.sort(
                key=lambda item: (-round(_beside_other_mount(*item[::2]), 3), -item[2].log_prior)
            )
            _check_mount(*((recording, best) for recording, _, best in guesses))
        return _guess(*guesses[0], is_mount_given=mount is not None)


def _check(recording: Recording) -> None:
    """Checks that the numbers can be paired and read."""
    robot, camera = recording.robot, recording.camera
    if len(robot) != len(camera):
        raise DataError(
            f"guess: {counted(len(robot), 'pose')} of the robot and {len(camera)} of the camera "
            "cannot be paired row by row.",
            next_step="Give both the same rows, empty where a pose is missing.",
        )
    for numbers in (robot, camera):
        form = ROTATION_FORMS[numbers.reading.rotation]
        if numbers.rotations.shape[1] != form.size:
            raise DataError(
                f"guess: a rotation has {numbers.rotations.shape[1]} numbers, but {form.words}, "
                f"as declared, has {form.size}.",
                culprits=list(numbers.places[:1]),
                next_step="Declare a form of rotation with as many numbers; which of them it is, "
                "will be found.",
            )
    common = len(recording.common_rows())
    if common < FEWEST_ROWS:
        raise DegenerateError(
            f"guess: {counted(common, 'row', ('has', 'have'))} a pose of the robot and one of the "
            f"camera; "
            f"{FEWEST_ROWS} or more are needed to distinguish readings.",
            next_step="Add views, tilted about different axes.",
        )


def _decided(recording: Recording) -> tuple[list[Scored], Scored]:
    """All readings, the declared one first, and the one that stands out; else the declared one."""
    declared, *others = search(recording)
    scored = [declared, *others, *_reordered(recording, declared)]
    best = _likeliest(recording, scored)
    swapped = _exchanged(recording, best)
    if swapped is not None:
        scored.append(best := swapped)
    if _is_half_turned(recording, best.hypothesis):
        turned = replace(best.hypothesis.robot, half_turned=True)
        best = replace(best, hypothesis=replace(best.hypothesis, robot=turned), labels=())
        scored.append(best)
    return scored, best


def _likeliest(recording: Recording, scored: list[Scored]) -> Scored:
    """The reading whose posterior stands out from the others' and none's; else the declared one."""
    declared, *others = sorted(
        scored, key=lambda item: (item is not scored[0], -item.log_posterior)
    )
    if not others or _is_poor(recording, others[0]):
        return declared
    best = others[0]
    rivals = [declared.log_posterior, best.log_posterior - best.log_odds]
    rivals += [item.log_posterior for item in others if not _are_same(recording, item, best)]
    return best if best.log_posterior > max(rivals) + CLEAR else declared


def _reordered(recording: Recording, declared: Scored) -> list[Scored]:
    """The declared reading with all rows in another order."""
    rows = recording.common_rows()
    rows = declared.rows if declared.is_readable else rows[:_MOST_ROWS]
    tried = (replace(declared.hypothesis, order=order) for order in ROW_ORDERS)
    return [
        item for order in tried if (item := fitted(recording, order, rows, _STARTS)).is_readable
    ]


def _exchanged(recording: Recording, scored: Scored) -> Scored | None:
    """The reading with two rows exchanged that explains two outlier views; None if unclear."""
    is_few = len(scored.rows) <= _MOST_OUTLIERS
    if not scored.is_readable or (is_few and _is_poor(recording, scored)):
        return None
    before = fitted(recording, scored.hypothesis, recording.common_rows()[:_MOST_ROWS], 0)
    robot_rows = before.hypothesis.rows(len(recording.robot))
    farthest = np.argsort(-before.fit.residuals)[:_MOST_OUTLIERS]
    pairs = combinations(np.sort(before.rows[farthest]), 2)
    swaps = (
        replace(before.hypothesis, swap=tuple(robot_rows[list(pair)].tolist())) for pair in pairs
    )
    tried = [_with_swap(recording, before, swap) for swap in swaps]
    best, second = sorted(tried, key=lambda item: -item.log_posterior)[:2]
    rival = max(before.log_posterior, second.log_posterior)
    # About one axis, the positions are closed by chance, and rotations alone show an exchange.
    if _is_poor(recording, before):
        moved = np.isin(robot_rows[before.rows], best.hypothesis.swap)
        is_turned = before.fit.angle[moved].min() > CLOSING_SCORE > best.fit.angle[moved].max()
        rival = rival if is_turned else np.inf
    else:
        rival = max(rival, best.log_posterior - best.log_odds)
    return best if best.log_posterior > rival + CLEAR else None


def _with_swap(recording: Recording, before: Scored, changed: Hypothesis) -> Scored:
    """The fit with two rows exchanged; among many, which left these out, with the same edges."""
    after, rows, fit = fitted(recording, changed, before.rows, 0), before.rows, before.fit
    if len(rows) <= _MOST_OUTLIERS:
        return after
    robot, camera = changed.chain(recording.robot, recording.camera)
    same_edges = distances(robot[rows], camera[rows], fit.lever, (fit.x, fit.z))
    return replace(after, fit=same_edges)


def _are_same(recording: Recording, best: Scored, rival: Scored) -> bool:
    """Whether two readings give the same poses, so that choosing does not matter."""
    rows = np.intersect1d(best.rows, rival.rows)
    (first, _), (second, _) = (
        item.hypothesis.chain(recording.robot, recording.camera) for item in (best, rival)
    )
    difference = invert(first[rows]) @ second[rows]
    shift, angle = best.fit.rms
    return bool(
        np.sqrt(np.mean(rotation_angle(difference) ** 2)) <= _SAME * angle
        and np.sqrt(np.mean(np.sum(difference[:, :3, 3] ** 2, axis=1))) <= _SAME * shift
    )


def _is_poor(recording: Recording, best: Scored) -> bool:
    """Whether the camera turns about one axis at most."""
    if not best.is_readable:
        return False
    _, camera = best.hypothesis.chain(recording.robot, recording.camera)
    return is_about_one_axis(camera[best.rows[best.fit.kept], :3, :3])


def _is_half_turned(recording: Recording, hypothesis: Hypothesis) -> bool:
    """Whether the base is turned by 180 degrees about z relative to the model's."""
    fit = chain_fit(recording, hypothesis)
    if fit is None or fit.score > CLOSING_SCORE:
        return False
    away_mm, away_deg = pose_difference(HALF_TURN, fit.x)
    return away_mm < _NEAR_MM and away_deg < _NEAR_DEG


def _beside_other_mount(recording: Recording, best: Scored) -> float:
    """Log posterior by which the mount is chosen; the changes alone decide nothing."""
    # Inverted poses close the chain under the wrong mount as well as the poses do under the right
    # one.
    return EVIDENCE * best.fit.log_likelihood + plausibility(recording, best)


def _check_mount(likelier: tuple[Recording, Scored], other: tuple[Recording, Scored]) -> None:
    """Refuses a choice between two mounts that fit alike."""
    first, second = likelier[1].hypothesis.mount, other[1].hypothesis.mount
    is_clear = _beside_other_mount(*likelier) > _beside_other_mount(*other) + CLEAR
    closes = likelier[1].fit.score <= CLOSING_SCORE
    if first == second or not closes or (is_clear and not _is_poor(*likelier)):
        return
    pair = sorted((likelier, other), key=lambda item: MOUNTS.index(item[0].mount))
    readings = " and ".join(
        f"{best.hypothesis.mount} ({_candidate(recording, best).words})" for recording, best in pair
    )
    raise DataError(
        f"The mount is not given, and the poses fit both ways of mounting: {readings}.",
        next_step="Say where the camera is with --mount.",
    )


def _guess(
    recording: Recording, scored: list[Scored], best: Scored, *, is_mount_given: bool
) -> Guess:
    candidates = {id(item): _candidate(recording, item) for item in scored}
    declared, chosen = candidates[id(scored[0])], candidates[id(best)]
    ranked = sorted(candidates.values(), key=lambda item: (item is not chosen, -item.log_posterior))
    ranked = ranked[:_LISTED]
    if declared not in ranked:
        ranked[-1] = declared
    is_poor, is_other = _is_poor(recording, best), chosen is not declared
    words = tuple(notes(recording, best, is_declared=not is_other, is_poor=is_poor))
    if not is_mount_given and best.fit.score <= CLOSING_SCORE:
        on_flange_m, at_base_m = flange_and_cell_m(best)
        mount = (
            f"The mount was not given and is taken for {best.hypothesis.mount}: what sits on the "
            f"flange then is {1e3 * on_flange_m:.0f} mm from it, and what stands at the base "
            f"{1e3 * at_base_m:.0f} mm. --mount says another."
        )
        words = (mount, *words)
    finding = sentence(declared, chosen, ranked, is_poor=is_poor)
    return Guess(declared, tuple(ranked), chosen, is_other, finding, words)


def _candidate(recording: Recording, scored: Scored) -> Candidate:
    shift, angle = scored.fit.rms
    other = scored.other_mount
    return Candidate(
        hypothesis=scored.hypothesis,
        declared=recording.declared,
        differences=recording.changes(scored.hypothesis),
        rms_mm=1e3 * shift,
        rms_deg=float(np.rad2deg(angle)),
        score=scored.fit.score,
        log_posterior=scored.log_posterior,
        agreeing=scored.fit.agreeing,
        rows=len(scored.fit.residuals),
        is_board=recording.is_measured,
        other_mount=() if other is None else recording.changes(other),
    )
