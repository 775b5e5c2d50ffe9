"""Whether a reading stands out, and under which mount; rows in another order.

Reported poses are `base_from_model @ FK(q) @ flange_from_tool` with two constant transforms: a base
that is turned, and an inverse that could as well be another mount, show in the robot's own joints
alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances, is_about_one_axis, robust_fit
from visioncal.calibration.guess.given import (
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
from visioncal.calibration.guess.hypothesis import HALF_TURN, ROW_ORDERS, Hypothesis
from visioncal.calibration.guess.messages import notes, sentence
from visioncal.calibration.guess.result import Candidate, Guess
from visioncal.calibration.guess.search import search
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, pose_difference, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, Mount

# Readings this near to the best are as good; of them, the one with the fewest changes is meant.
_ALIKE = 2.0
# A rival as simple as the best leaves the matter open while it is this near.
_RIVALS = 1.5
# Views beyond this many typical distances do not agree with the others.
_AGREES = 5.0
_LISTED = 12
# Of the few readings that only exchange frames one may be right though the poses are poor: with
# turns of 5 degrees of noise, say. Fewer views would close so far by chance.
_ROUGHLY, _FEWEST_ROUGH = 2.0 * CLOSING_SCORE, 8
# Poses of two readings that differ by less than this share of what is left are the same.
_SAME = 0.3
# Nominal models differ from the controller's by a few millimetres; a half turn is far from that.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Poses of this many times the scatter of the others are not those of the joints.
_CLEARLY = 3.0
_FEWEST_ROWS = 4
# A reading that is right agrees with the joints within this share of the distances.
_SAME_CHAIN = 0.02

# A view stands out from here, in the typical distance of those that agree. Exchanged back it has
# to be nearer than that, and by this many times nearer than it was.
_OUT, _NEARER = 5.0, 3.0
# A fit of all pairs of views takes time with the square of these.
_MOST_ROWS = 200
# Up to so many views every exchange is tried.
_FEW = 8
# The best exchange is meant where no other comes within this many times of it.
_BEYOND_NEXT = 2.0
# More views than this that disagree are no two rows exchanged.
_MOST = 8
# Sets of views from which the fit of an order is begun.
_STARTS = 12


@dataclass(frozen=True, eq=False)
class _Found:
    """What the search finds under one mount: the declared reading first, and the best."""

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
    """Tries every plausible reading of the poses and says which closes the chain.

    Args:
        robot: `base_from_flange` of n rows, with the reading that is declared.
        camera: `cam_from_target` of the same rows, likewise; NaN where the target was not seen.
        mount: The declared mount; None where it is not known: it then is the one of the likelier
            cell.
        chain: (n, 4, 4) `base_from_flange` through a robot's model at the recorded joints, NaN in
            rows without; it shows what no camera can.
        is_measured: Whether the camera's poses were measured from images by visioncal, so that
            only the board's stated size can be wrong about them.

    Returns:
        The readings, and whether one stands out.

    Raises:
        DataError: The rows do not match, a rotation has not as many numbers as its form, or
            the mount is not known.
        DegenerateError: Too few rows have both poses.
    """
    mounts = MOUNTS if mount is None else (mount,)
    recordings = [Recording(robot, camera, name, is_measured) for name in mounts]
    _check(recordings[0])
    with one_blas_thread():
        found = [_found(recording, chain) for recording in recordings]
        if mount is not None:
            return _guess(found[0], chain)
        chosen = _of_likelier_mount(found[0], found[1], chain)
        return _guess(chosen, chain, _mount_note(chosen))


def _found(recording: Recording, chain: FloatArray | None) -> _Found:
    declared, *others = search(recording)
    if chain is not None:
        others = [_by_chain(other, recording, chain) for other in others]
    scored = [declared, *others]
    best = _decided(recording, scored)
    if best.hypothesis.shift or best.score > CLOSING_SCORE:
        # Rows that are sorted as text follow each other by shifts, a few at a time.
        in_order = reordered(recording, declared)
        if in_order is not None and _explains_more(recording, in_order, best):
            best = in_order
            scored.append(best)
    swapped = exchanged(recording, best, is_poor=_is_poor(recording, best))
    if swapped is not None:
        best = swapped
        scored.append(best)
    if chain is not None and _is_half_turned(best.hypothesis, recording.robot, chain):
        taken = replace(best.hypothesis.robot, half_turned=True)
        turned = replace(best.hypothesis, robot=taken)
        best = replace(best, hypothesis=turned, labels=())
        scored.append(best)
    return _Found(recording, tuple(scored), best)


def _of_likelier_mount(first: _Found, second: _Found, chain: FloatArray | None) -> _Found:
    """Chooses the mount: by residuals, by the joints, by what cells look like, by the changes."""
    # An inverse of the poses closes the chain under the wrong mount as poses as they are do under
    # the right one, so that the number of changes alone says nothing.
    better, worse = sorted((first, second), key=lambda value: value.best.score)
    if better.best.score > CLOSING_SCORE or worse.best.score > STANDS_OUT * better.best.score:
        return better
    both = {found.best.hypothesis: found for found in (first, second)}
    by_joints = None if chain is None else _by_joints(tuple(both), first.recording.robot, chain)
    if by_joints is not None:
        return both[by_joints]
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
        f"{found.best.hypothesis.mount} ({_candidate(found.recording, found.best).words})"
        for found in (first, second)
    )
    raise DataError(
        f"The mount is not given, and the poses fit both ways of mounting: {readings}.",
        next_step="Say where the camera is with --mount.",
    )


def _mount_note(chosen: _Found) -> str:
    if chosen.best.score > CLOSING_SCORE:
        return ""
    on_flange_m, at_base_m = flange_and_cell_m(chosen.best)
    return (
        f"The mount was not given and is taken for {chosen.best.hypothesis.mount}: what sits on "
        f"the flange then is {1e3 * on_flange_m:.0f} mm from it, and what stands at the base "
        f"{1e3 * at_base_m:.0f} mm. --mount says another."
    )


def _check(recording: Recording) -> None:
    """Makes sure that the numbers can be paired and looked at."""
    robot, camera = recording.robot, recording.camera
    if len(robot) != len(camera):
        raise DataError(
            f"guess: {len(robot)} poses of the robot and {len(camera)} of the camera cannot be "
            "paired row by row.",
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
            f"guess: {common} rows have a pose of the robot and one of the camera; "
            f"{FEWEST_ROWS} or more are needed to distinguish readings.",
            next_step="Add views, tilted about different axes.",
        )


def _by_chain(scored: Scored, recording: Recording, chain: FloatArray) -> Scored:
    """Lets the joints choose among readings that the camera cannot distinguish."""
    chosen = _by_joints(scored.labels, recording.robot, chain)
    return scored if chosen is None else replace(scored, hypothesis=chosen)


def _decided(recording: Recording, scored: Sequence[Scored]) -> Scored:
    """The reading that stands out from the declared one and from its rivals; else the declared."""
    declared, *others = scored
    if not others:
        return declared
    least = min(other.score for other in others)
    alike = [other for other in others if other.score <= _ALIKE * least]
    alike.sort(key=lambda item: (item.cost, item.score))
    best, rivals = alike[0], alike[1:]
    if best.score > (_ROUGHLY if _is_turned_about(recording, best) else CLOSING_SCORE):
        return declared
    # Declared in units in which no camera could see the target, the chain may close as well.
    is_likely = is_likely_unit(recording, declared.hypothesis.camera.unit)
    if is_likely and declared.score <= STANDS_OUT * best.score:
        return declared
    is_open = any(
        rival.cost == best.cost
        and rival.score < _RIVALS * best.score
        and not _are_same(recording, rival, best)
        for rival in rivals
    )
    return declared if is_open or _is_poor(recording, best) else best


def _explains_more(recording: Recording, tried: Scored, best: Scored) -> bool:
    """Whether more views agree with an order of the rows than with what is best without it."""
    if _is_poor(recording, tried):
        return False
    return best.score > CLOSING_SCORE or _agreeing(tried.fit) > _agreeing(best.fit)


def _agreeing(fit: Fit) -> int:
    """How many views agree with each other."""
    return int((fit.away <= _AGREES * max(fit.score, SCORE_FLOOR)).sum())


def _is_turned_about(recording: Recording, scored: Scored) -> bool:
    """Whether a reading of many views is but an inverse or another mount."""
    tried, declared = scored.hypothesis, recording.declared
    robot = replace(tried.robot, inverse=declared.robot.inverse)
    camera = replace(tried.camera, inverse=declared.camera.inverse)
    is_same = replace(tried, robot=robot, camera=camera, mount=declared.mount) == declared
    return is_same and scored.cost <= 1 and len(scored.rows) >= _FEWEST_ROUGH


def _are_same(recording: Recording, one: Scored, other: Scored) -> bool:
    """Whether two readings have the same poses, so that it does not matter which is meant."""
    rows = np.intersect1d(one.rows, other.rows)
    (first, _), (second, _) = (
        scored.hypothesis.chain(recording.robot, recording.camera) for scored in (one, other)
    )
    away = invert(first[rows]) @ second[rows]
    shift, angle = one.fit.rms
    return bool(
        np.sqrt(np.mean(rotation_angle(away) ** 2)) <= _SAME * angle
        and np.sqrt(np.mean(np.sum(away[:, :3, 3] ** 2, axis=1))) <= _SAME * shift
    )


def _guess(found: _Found, chain: FloatArray | None, mount_note: str = "") -> Guess:
    recording, best = found.recording, found.best
    candidates = {id(scored): _candidate(recording, scored) for scored in found.scored}
    declared, chosen = candidates[id(found.scored[0])], candidates[id(best)]
    ranked = sorted(
        candidates.values(), key=lambda candidate: (candidate is not chosen, candidate.score)
    )[:_LISTED]
    if declared not in ranked:
        ranked[-1] = declared
    is_poor = _is_poor(recording, best)
    is_other = chosen is not declared
    words = notes(
        recording, best, has_chain=chain is not None, is_declared=not is_other, is_poor=is_poor
    )
    return Guess(
        declared,
        tuple(ranked),
        chosen,
        is_other,
        sentence(declared, chosen, ranked, is_poor=is_poor),
        ((mount_note,) if mount_note else ()) + tuple(words),
    )


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
        rows=len(fit.away),
        is_board=recording.is_measured,
        other_mount=() if scored.other_mount is None else recording.changes(scored.other_mount),
    )


def _is_poor(recording: Recording, best: Scored) -> bool:
    """Whether the views turn about one axis at most, by the camera's account."""
    if not best.is_readable:
        return False
    _, camera = best.hypothesis.chain(recording.robot, recording.camera)
    return is_about_one_axis(camera[best.rows[best.fit.kept], :3, :3])


def _chain_fit(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> Fit | None:
    """Compares the poses of a reading with those of the joints."""
    poses = hypothesis.robot.poses(robot)
    there = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(chain).all(axis=(1, 2))
    if there.sum() < _FEWEST_ROWS:
        return None
    return robust_fit(invert(poses[there]), chain[there])


def _by_joints(
    labels: Sequence[Hypothesis], robot: PoseNumbers, chain: FloatArray
) -> Hypothesis | None:
    """The reading, of several that close the camera's chain alike, that the joints speak for."""
    scored = [
        (fit.score, at)
        for at, label in enumerate(labels)
        if (fit := _chain_fit(label, robot, chain)) is not None
    ]
    scored.sort()
    if len(scored) < 2 or scored[1][0] < _CLEARLY * scored[0][0]:
        return None
    return labels[scored[0][1]]


def _is_half_turned(hypothesis: Hypothesis, robot: PoseNumbers, chain: FloatArray) -> bool:
    """Whether the poses are in a base that is turned by 180 degrees about z against the model's."""
    fit = _chain_fit(hypothesis, robot, chain)
    if fit is None or fit.score > _SAME_CHAIN:
        return False
    away_mm, away_deg = pose_difference(HALF_TURN, fit.x)
    return away_mm < _NEAR_MM and away_deg < _NEAR_DEG


def reordered(recording: Recording, declared: Scored) -> Scored | None:
    """Finds the order of all rows in which a chain closes that does not as declared.

    Args:
        recording: What was recorded.
        declared: The declared reading.

    Returns:
        The same reading with its rows in that order; None where none of them closes the chain.
    """
    rows = recording.common_rows()[:_MOST_ROWS]
    ways = (replace(declared.hypothesis, order=order) for order in ROW_ORDERS)
    best = min((fitted(recording, way, rows, _STARTS) for way in ways), key=lambda way: way.score)
    is_clear = best.score <= CLOSING_SCORE and STANDS_OUT * best.score < declared.score
    return replace(best, cost=recording.cost(best.hypothesis)) if is_clear else None


def exchanged(recording: Recording, scored: Scored, *, is_poor: bool) -> Scored | None:
    """Finds the exchange of two rows that makes two views agree which stood out.

    Args:
        recording: What was recorded.
        scored: The reading under which most views agree.
        is_poor: Whether the motion is so poor that few views agree with anything.

    Returns:
        The same reading with the rows exchanged; None where no exchange explains anything, or
        several do.
    """
    if not scored.is_readable:
        return None
    scored = _on_all_rows(recording, scored)
    fit, tried = scored.fit, scored.hypothesis
    if len(fit.away) <= _FEW and fit.score > CLOSING_SCORE:
        return None if is_poor else _exchanged_among_few(recording, scored)
    typical = max(fit.score, SCORE_FLOOR)
    out = np.flatnonzero(fit.away > _OUT * typical)
    if not 2 <= len(out) <= min(_MOST, len(fit.away) - 4):
        return None
    of_robot, found = tried.rows(len(recording.robot)), []
    for pair in combinations(out, 2):
        rows = tuple(of_robot[scored.rows[list(pair)]].tolist())
        again = _with(recording, scored, replace(tried, swap=rows))
        before, after = fit.away[list(pair)], again.fit.away[list(pair)]
        if after.max() < _OUT * typical and (after < before / _NEARER).all():
            found.append((float(after.max()), again))
    found.sort(key=lambda value: value[0])
    if not found or (len(found) > 1 and found[1][0] < _BEYOND_NEXT * found[0][0]):
        return None
    return found[0][1]


def _on_all_rows(recording: Recording, scored: Scored) -> Scored:
    """The same with the rows that the search left out to save time: any two may be exchanged."""
    rows = recording.common_rows()[:_MOST_ROWS]
    if len(rows) <= len(scored.rows):
        return scored
    whole = fitted(recording, scored.hypothesis, rows, starts=0)
    return replace(scored, fit=whole.fit, rows=whole.rows)


def _exchanged_among_few(recording: Recording, scored: Scored) -> Scored | None:
    """Tries every exchange: among few views the right ones are no majority to be seen by."""
    tried, found = scored.hypothesis, []
    of_robot = tried.rows(len(recording.robot))
    for pair in combinations(scored.rows, 2):
        rows = tuple(of_robot[list(pair)].tolist())
        changed = replace(tried, swap=rows)
        robot, camera = changed.chain(recording.robot, recording.camera)
        fit = robust_fit(robot[scored.rows], camera[scored.rows])
        found.append(Scored(changed, fit, scored.rows))
    found.sort(key=lambda item: item.score)
    best, second = found[:2]
    is_clear = best.score < CLOSING_SCORE and second.score > _BEYOND_NEXT * best.score
    return best if is_clear and scored.score > _NEARER * best.score else None


def _with(recording: Recording, scored: Scored, changed: Hypothesis) -> Scored:
    """The same edges, with rows exchanged."""
    robot, camera = changed.chain(recording.robot, recording.camera)
    fit, rows = scored.fit, scored.rows
    again = distances(robot[rows], camera[rows], fit.lever, (fit.x, fit.z))
    return Scored(changed, again, rows)
