"""Decision whether a reading stands out, and under which mount; rows in another order.

Reported poses are `base_from_model @ FK(q) @ flange_from_tool` with two constant transforms: a
turned base, and an inverse that may as well be another mount, show only in the robot's own joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances, is_about_one_axis, robust_fit
from visioncal.calibration.guess.hypothesis import HALF_TURN, ROW_ORDERS, Hypothesis
from visioncal.calibration.guess.messages import notes, sentence
from visioncal.calibration.guess.recording import (
    CLOSING_SCORE,
    FEWEST_ROWS,
    SCORE_FLOOR,
    STANDS_OUT,
    Recording,
    Scored,
    fitted,
    flange_and_cell_m,
    is_far_likelier,
    is_likely_unit,
    likeness,
)
from visioncal.calibration.guess.result import Candidate, Guess
from visioncal.calibration.guess.search import search
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, pose_difference, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, Mount

# Ratio to the best score within which readings are equivalent; the one with the fewest changes is
# chosen.
_EQUIVALENT = 2.0
# An equally simple rival within this ratio of the best makes the reading ambiguous.
_RIVALS = 1.5
# Views within this many scores agree with the others.
_AGREES = 5.0
_LISTED = 12
# A reading that only exchanges frames may be right though the poses are poor: with 5 degrees of
# noise, say. Fewer views would close so far by chance.
_ROUGHLY, _FEWEST_ROUGH = 2.0 * CLOSING_SCORE, 8
# Poses of two readings that differ by less than this share of the residuals are the same.
_SAME = 0.3
# Nominal models differ from the controller's by a few millimetres; a half turn, by far more.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# The joints choose a reading whose score is better than the others' by this factor.
_CLEAR_RATIO = 3.0
_FEWEST_ROWS = 4
# The right reading agrees with the joints within this share of the distances.
_SAME_CHAIN = 0.02

# Outlier views have residuals beyond this many scores. Exchanged back, a residual has to be below
# that, and smaller than before by the second factor.
_OUTLIER, _NEARER = 5.0, 3.0
# Most rows that are fitted again: time grows with the square.
_MOST_ROWS = 200
# Up to this many views, every exchange is tried.
_FEW = 8
# The best exchange is taken where the next is worse by this factor.
_BEYOND_NEXT = 2.0
# More outlier views are not two rows exchanged.
_MOST_OUTLIERS = 8
# Random subsets from which the fit of an order starts.
_STARTS = 12


@dataclass(frozen=True, eq=False)
class _MountSearch:
    """Result of the search under one mount: the declared reading first, and the best."""

    recording: Recording
    scored: tuple[Scored, ...]
    best: Scored


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
    recordings = [Recording(robot, camera, name, is_measured) for name in mounts]
    _check(recordings[0])
    with one_blas_thread():
        searches = [_searched(recording, chain) for recording in recordings]
        if mount is not None:
            return _guess(searches[0], chain)
        chosen = _of_likelier_mount(searches[0], searches[1], chain)
        return _guess(chosen, chain, _mount_note(chosen))


def _searched(recording: Recording, chain: FloatArray | None) -> _MountSearch:
    declared, *others = search(recording)
    if chain is not None:
        others = [_by_chain(other, recording, chain) for other in others]
    scored = [declared, *others]
    best = _decided(recording, scored)
    if best.hypothesis.shift or best.score > CLOSING_SCORE:
        # Rows sorted as text follow each other with shifts, a few at a time.
        in_order = reordered(recording, declared)
        if in_order is not None and _explains_more(recording, in_order, best):
            best = in_order
            scored.append(best)
    swapped = exchanged(recording, best, is_poor=_is_poor(recording, best))
    if swapped is not None:
        best = swapped
        scored.append(best)
    if chain is not None and _is_half_turned(best.hypothesis, recording.robot, chain):
        turned = replace(best.hypothesis.robot, half_turned=True)
        best = replace(best, hypothesis=replace(best.hypothesis, robot=turned), labels=())
        scored.append(best)
    return _MountSearch(recording, tuple(scored), best)


def _of_likelier_mount(
    first: _MountSearch, second: _MountSearch, chain: FloatArray | None
) -> _MountSearch:
    """Chooses the mount: by residuals, by the joints, by plausibility, by the changes."""
    # Inverted poses close the chain under the wrong mount as well as the poses do under the right
    # one: the number of changes alone decides nothing.
    better, worse = sorted((first, second), key=lambda value: value.best.score)
    if better.best.score > CLOSING_SCORE or worse.best.score > STANDS_OUT * better.best.score:
        return better
    by_hypothesis = {item.best.hypothesis: item for item in (first, second)}
    if chain is not None:
        by_joints = _by_joints(tuple(by_hypothesis), first.recording.robot, chain)
        if by_joints is not None:
            return by_hypothesis[by_joints]
    other, likelier = sorted(
        (first, second),
        key=lambda value: (
            likeness(value.recording, value.best),
            -value.recording.cost(value.best.hypothesis),
        ),
    )
    is_same = other.best.hypothesis.mount == likelier.best.hypothesis.mount
    is_clear = is_far_likelier(likelier.recording, likelier.best, other.best)
    if is_same or (is_clear and not _is_poor(likelier.recording, likelier.best)):
        return likelier
    readings = " and ".join(
        f"{item.best.hypothesis.mount} ({_candidate(item.recording, item.best).words})"
        for item in (first, second)
    )
    raise DataError(
        f"The mount is not given, and the poses fit both ways of mounting: {readings}.",
        next_step="Say where the camera is with --mount.",
    )


def _mount_note(chosen: _MountSearch) -> str:
    if chosen.best.score > CLOSING_SCORE:
        return ""
    on_flange_m, at_base_m = flange_and_cell_m(chosen.best)
    return (
        f"The mount was not given and is taken for {chosen.best.hypothesis.mount}: what sits on "
        f"the flange then is {1e3 * on_flange_m:.0f} mm from it, and what stands at the base "
        f"{1e3 * at_base_m:.0f} mm. --mount says another."
    )


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


def _by_chain(scored: Scored, recording: Recording, chain: FloatArray) -> Scored:
    """Lets the joints choose among readings that the camera cannot distinguish."""
    chosen = _by_joints(scored.labels, recording.robot, chain)
    return scored if chosen is None else replace(scored, hypothesis=chosen)


def _decided(recording: Recording, scored: Sequence[Scored]) -> Scored:
    """The reading that stands out from the declared one and its rivals; else the declared one."""
    declared, *others = scored
    if not others:
        return declared
    least_score = min(other.score for other in others)
    equivalent = [other for other in others if other.score <= _EQUIVALENT * least_score]
    equivalent.sort(key=lambda item: (item.cost, item.score))
    best, rivals = equivalent[0], equivalent[1:]
    if best.score > (_ROUGHLY if _only_exchanges_frames(recording, best) else CLOSING_SCORE):
        return declared
    # In declared units in which no camera could see the target, the chain may close as well.
    is_likely = is_likely_unit(recording, declared.hypothesis.camera.unit)
    if is_likely and declared.score <= STANDS_OUT * best.score:
        return declared
    is_ambiguous = any(
        rival.cost == best.cost
        and rival.score < _RIVALS * best.score
        and not _are_same(recording, rival, best)
        for rival in rivals
    )
    return declared if is_ambiguous or _is_poor(recording, best) else best


def _explains_more(recording: Recording, tried: Scored, best: Scored) -> bool:
    """Whether more views agree under an order of the rows than under the best without."""
    if _is_poor(recording, tried):
        return False
    return best.score > CLOSING_SCORE or _agreeing(tried.fit) > _agreeing(best.fit)


def _agreeing(fit: Fit) -> int:
    """Number of views that agree with each other."""
    return int((fit.residuals <= _AGREES * max(fit.score, SCORE_FLOOR)).sum())


def _only_exchanges_frames(recording: Recording, scored: Scored) -> bool:
    """Whether a reading of many views differs only by an inverse or another mount."""
    tried, declared = scored.hypothesis, recording.declared
    robot = replace(tried.robot, inverse=declared.robot.inverse)
    camera = replace(tried.camera, inverse=declared.camera.inverse)
    is_same = replace(tried, robot=robot, camera=camera, mount=declared.mount) == declared
    return is_same and scored.cost <= 1 and len(scored.rows) >= _FEWEST_ROUGH


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


def _guess(result: _MountSearch, chain: FloatArray | None, mount_note: str = "") -> Guess:
    recording, best = result.recording, result.best
    candidates = {id(scored): _candidate(recording, scored) for scored in result.scored}
    declared, chosen = candidates[id(result.scored[0])], candidates[id(best)]
    ranked = sorted(candidates.values(), key=lambda item: (item is not chosen, item.score))[
        :_LISTED
    ]
    if declared not in ranked:
        ranked[-1] = declared
    is_poor, is_other, has_chain = (
        _is_poor(recording, best),
        chosen is not declared,
        chain is not None,
    )
    words = notes(recording, best, has_chain=has_chain, is_declared=not is_other, is_poor=is_poor)
    finding = sentence(declared, chosen, ranked, is_poor=is_poor)
    all_notes = ((mount_note,) if mount_note else ()) + tuple(words)
    return Guess(declared, tuple(ranked), chosen, is_other, finding, all_notes)


def _candidate(recording: Recording, scored: Scored) -> Candidate:
    fit = scored.fit
    shift, angle = fit.rms
    return Candidate(
        hypothesis=scored.hypothesis,
        declared=recording.declared,
        differences=recording.changes(scored.hypothesis),
        rms_mm=1e3 * shift,
        rms_deg=float(np.rad2deg(angle)),
        score=scored.score,
        agreeing=_agreeing(fit),
        rows=len(fit.residuals),
        is_board=recording.is_measured,
        other_mount=() if scored.other_mount is None else recording.changes(scored.other_mount),
    )


def _is_poor(recording: Recording, best: Scored) -> bool:
    """Whether the camera turns about one axis at most."""
    if not best.is_readable:
        return False
    _, camera = best.hypothesis.chain(recording.robot, recording.camera)
    return is_about_one_axis(camera[best.rows[best.fit.kept], :3, :3])


def _chain_fit(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> Fit | None:
    """Fits the poses of a reading to those of the joints."""
    poses = hypothesis.robot.poses(robot)
    readable = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(chain).all(axis=(1, 2))
    if readable.sum() < _FEWEST_ROWS:
        return None
    return robust_fit(invert(poses[readable]), chain[readable])


def _by_joints(
    labels: Sequence[Hypothesis], robot: PoseNumbers, chain: FloatArray
) -> Hypothesis | None:
    """The reading that the joints support, of several that close the camera's chain alike."""
    scored = [
        (fit.score, at)
        for at, label in enumerate(labels)
        if (fit := _chain_fit(label, robot, chain)) is not None
    ]
    scored.sort()
    if len(scored) < 2 or scored[1][0] < _CLEAR_RATIO * scored[0][0]:
        return None
    return labels[scored[0][1]]


def _is_half_turned(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> bool:
    """Whether the base is turned by 180 degrees about z relative to the model's."""
    fit = _chain_fit(hypothesis, robot, chain)
    if fit is None or fit.score > _SAME_CHAIN:
        return False
    away_mm, away_deg = pose_difference(HALF_TURN, fit.x)
    return away_mm < _NEAR_MM and away_deg < _NEAR_DEG


def reordered(recording: Recording, declared: Scored) -> Scored | None:
    """Finds the order of all rows in which a chain closes that does not as declared.

    Returns:
        The declared reading with its rows in that order; None where none closes the chain.
    """
    rows = recording.common_rows()[:_MOST_ROWS]
    hypotheses = (replace(declared.hypothesis, order=order) for order in ROW_ORDERS)
    fits = (fitted(recording, hypothesis, rows, _STARTS) for hypothesis in hypotheses)
    best = min(fits, key=lambda scored: scored.score)
    is_clear = best.score <= CLOSING_SCORE and STANDS_OUT * best.score < declared.score
    return replace(best, cost=recording.cost(best.hypothesis)) if is_clear else None


def exchanged(recording: Recording, scored: Scored, *, is_poor: bool) -> Scored | None:
    """Finds the exchange of two rows that makes two outlier views agree.

    Args:
        recording: The recorded poses.
        scored: The reading under which most views agree.
        is_poor: Whether the motion is so poor that few views agree with anything.

    Returns:
        The reading with the rows exchanged; None where no exchange, or several, explain the
        outliers.
    """
    if not scored.is_readable:
        return None
    scored = _on_all_rows(recording, scored)
    fit, tried = scored.fit, scored.hypothesis
    if len(fit.residuals) <= _FEW and fit.score > CLOSING_SCORE:
        return None if is_poor else _exchanged_among_few(recording, scored)
    typical = max(fit.score, SCORE_FLOOR)
    outliers = np.flatnonzero(fit.residuals > _OUTLIER * typical)
    if not 2 <= len(outliers) <= min(_MOST_OUTLIERS, len(fit.residuals) - 4):
        return None
    robot_rows, swaps = tried.rows(len(recording.robot)), []
    for pair in combinations(outliers, 2):
        rows = tuple(robot_rows[scored.rows[list(pair)]].tolist())
        refit = _with_edges(recording, scored, replace(tried, swap=rows))
        before, after = fit.residuals[list(pair)], refit.fit.residuals[list(pair)]
        if after.max() < _OUTLIER * typical and (after < before / _NEARER).all():
            swaps.append((float(after.max()), refit))
    swaps.sort(key=lambda value: value[0])
    if not swaps or (len(swaps) > 1 and swaps[1][0] < _BEYOND_NEXT * swaps[0][0]):
        return None
    return swaps[0][1]


def _on_all_rows(recording: Recording, scored: Scored) -> Scored:
    """Fits the rows, too, that the search skipped: any two may be exchanged."""
    rows = recording.common_rows()[:_MOST_ROWS]
    if len(rows) <= len(scored.rows):
        return scored
    refit = fitted(recording, scored.hypothesis, rows, starts=0)
    return replace(scored, fit=refit.fit, rows=refit.rows)


def _exchanged_among_few(recording: Recording, scored: Scored) -> Scored | None:
    """Tries every exchange: among few views the right ones are no majority."""
    tried, swaps = scored.hypothesis, []
    robot_rows = tried.rows(len(recording.robot))
    for pair in combinations(scored.rows, 2):
        rows = tuple(robot_rows[list(pair)].tolist())
        changed = replace(tried, swap=rows)
        robot, camera = changed.chain(recording.robot, recording.camera)
        fit = robust_fit(robot[scored.rows], camera[scored.rows])
        swaps.append(Scored(changed, fit, scored.rows))
    swaps.sort(key=lambda item: item.score)
    best, second = swaps[:2]
    is_clear = best.score < CLOSING_SCORE and second.score > _BEYOND_NEXT * best.score
    return best if is_clear and scored.score > _NEARER * best.score else None


def _with_edges(recording: Recording, scored: Scored, changed: Hypothesis) -> Scored:
    """The same edges, with rows exchanged."""
    robot, camera = changed.chain(recording.robot, recording.camera)
    fit, rows = scored.fit, scored.rows
    again = distances(robot[rows], camera[rows], fit.lever, (fit.x, fit.z))
    return Scored(changed, again, rows)
