"""Search of the table of readings: two mistakes at once, and a unit, all fitted together.

The angle of a relative motion between two views is the same for robot and camera, whatever the
unknown edges are (Chen 1991, "A screw motion approach to uniqueness analysis of head-eye
geometry"). So forms of rotations and orders of rows are screened without solving for anything. The
angle is also the same for a pose and its inverse: inverses, and all that concerns positions, are
distinguished by the fits.
"""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain, combinations, product
from typing import TypeAlias

import numpy as np

from visioncal.calibration.guess.fit import (
    CLOSING_SCORE,
    CONCENTRATED,
    HALF_SHARE,
    STARTS,
    distance_factor,
    distances,
    kept_count,
)
from visioncal.calibration.guess.readings import (
    ROW_ORDERS,
    Change,
    Hypothesis,
    SideReading,
    as_written,
    changes,
    rewritten,
)
from visioncal.calibration.guess.recording import (
    FEWEST_ROWS,
    Candidate,
    Recording,
    chains,
    fitted,
    thinned,
)
from visioncal.calibration.guess.unwrapping import unwrapped
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import upper_pairs

# Turns of robot and camera agree from here on [rad].
_TURNS_AGREE_RAD = 0.1
# Fields of a reading by which its turns from view to view change.
_TURNING = frozenset(("rotation", "written", "terms", "angle_unit", "order"))
# Form of rotations, that of which they were written, terms and unit of angles of a reading.
_Rotations: TypeAlias = tuple[str, str, tuple[int, ...], float]
# Readings that are handed on have scores near the best one's but for a quarter of a degree, which
# noisy poses of few views add to any bound.
_SLACK = 5e-3
# No flange is farther from its base [m], in most rows.
_FARTHEST_M = 5.0
# Quantile of the pairs' mismatch: with a quarter of the views wrong, 56 % of pairs are right.
PAIRS_SHARE = 0.35


def search_by_half(recording: Recording) -> list[Candidate]:
    """Finds single readings that close the chain of half of the rows, as `search`.

    The others may be rows apart, or wrong for another reason.
    """
    rows, declared = thinned(recording.common_rows), recording.declared
    every = [*changes(declared, recording.is_measured, 0)]
    every += rewritten(recording.robot.rows(rows), by_makers=True)
    single = _undone(declared, product((None,), every))
    tried = [declared, *filter(recording.is_likely, single)]
    first, *others = fitted(recording, tried, rows, 3 * STARTS, HALF_SHARE)
    classes: dict[Hashable, list[Hypothesis]] = {}
    for item in others:
        classes.setdefault(item.hypothesis.chain_class, []).append(item.hypothesis)
    others = [replace(item, labels=(*classes[item.hypothesis.chain_class],)) for item in others]
    others.sort(key=lambda item: -item.log_posterior)
    whole = _row_by_row(recording, others[0], rows) if others else None
    return [first, *([] if whole is None else [whole]), *others]


def _row_by_row(recording: Recording, best: Candidate, rows: IntArray) -> Candidate | None:
    """The reading whose angles are of one of two triples of a rotation, row by row.

    Of the two triples of angles of a rotation, each row has the one that the camera confirms. None
    where that closes no chain.
    """
    robot = best.hypothesis.robot
    if not robot.written.startswith("euler") or not best.fit.closes:
        return None
    triples = [replace(robot, folded=folded) for folded in (False, True)]
    every = recording.common_rows
    numbers = recording.robot.rows(every)
    tried = [replace(best.hypothesis, robot=side) for side in triples]
    chained, seen = chains(recording, tried, every)
    lever, edges = best.fit.lever, (best.fit.x, best.fit.z)
    pairs = zip(chained, seen, strict=True)
    away = np.array([distances(*sides, lever, edges).residuals for sides in pairs])
    rotations = np.array([side.rotations(numbers) for side in triples])
    chosen = rotations[np.nan_to_num(away, nan=np.inf).argmin(axis=0), np.arange(len(every))]
    by_place = tuple(zip(numbers.places, map(tuple, chosen.reshape(-1, 9).tolist()), strict=True))
    side = replace(recording.declared.robot, by_place=by_place)
    (whole,) = fitted(recording, [replace(best.hypothesis, robot=side)], rows, STARTS)
    return whole if whole.fit.closes else None


def search(recording: Recording) -> list[Candidate]:
    """Finds the readings that close the chain best.

    Returns:
        The declared reading first; then others, the likeliest first, one for each class of readings
        that residuals cannot distinguish.
    """
    rows, declared = thinned(recording.common_rows), recording.declared
    mismatch = _mismatch(recording, rows)
    plain = recording.changes
    near = list[Hypothesis]()
    # One maker's angles in reverse order, taken for another's, are the inverse in a mirrored frame,
    # as is a quaternion in another order with two signs of positions: the former is likelier. Other
    # rewritten rotations are tried where no reading is sure; all may turn by the same angles.
    some = recording.robot.rows(rows)
    of_makers = [*rewritten(some, by_makers=True)]
    # With another unit of positions that no robot reaches, any two others may go together.
    units = [*_units_of_far(plain, some.positions)]
    of_poses = [one for one in (*plain, *of_makers) if "unit" not in one.fields]
    for firsts, pairs in (
        ([declared], [*product((None,), (*plain, *of_makers)), *combinations(plain, 2)]),
        ([declared], [*product((None, *plain), [*rewritten(some)])]),
        ([unit.of(declared) for unit in units], [*combinations(of_poses, 2)]),
    ):
        undone = chain.from_iterable(_undone(first, pairs) for first in firsts)
        likely = [*filter(recording.is_likely, undone)]
        near += _near(likely, [*map(mismatch, likely)]) if likely else []
        classes: dict[Hashable, list[Hypothesis]] = {}
        for reading in sorted([declared, *near], key=lambda item: item.cost):
            of_class = classes.setdefault((reading.chain_class, recording.is_likely(reading)), [])
            of_class.append(reading)
        labels = {of_class[0]: tuple(of_class) for of_class in classes.values()}
        scores = [item.fit.score for item in fitted(recording, labels, rows, 0)]
        if min(scores) <= _SLACK:
            break
    near = _near([*labels], scores)
    refined = [declared, *(reading for reading in near if reading != declared)]
    if min(scores) > CLOSING_SCORE and (away := mismatch(declared)) > _SLACK:
        for change in _unwrapped(recording, keep_turns=away < _TURNS_AGREE_RAD):
            reading = change.of(declared)
            labels[reading] = (reading,)
            refined.append(reading)
    found = fitted(recording, refined, rows, STARTS)
    first, *others = (replace(item, labels=labels[item.hypothesis]) for item in found)
    if first.fit.closes:
        # Two changes that turn both frames leave the chain as it is declared.
        others = [
            item
            for item in others
            if recording.is_likely(item.hypothesis) != recording.is_likely(declared)
            or not np.isclose(item.fit.score, first.fit.score, rtol=1e-6)
        ]
    others += _of_another_size(recording, [first, *others], rows)
    others.sort(key=lambda item: -item.log_posterior)
    return [first, *others]


def _units_of_far(plain: Iterable[Change], positions: FloatArray) -> Iterator[Change]:
    """Changes of the robot's unit alone, of (n, 3) positions that no robot reaches in metres."""
    if np.nanmedian(np.linalg.norm(positions, axis=1)) > _FARTHEST_M:
        yield from (one for one in plain if one.part == "robot" and one.fields.keys() == {"unit"})


def search_ends(recording: Recording) -> Iterator[list[Candidate]]:
    """Finds the readings that close the chain of the first rows, and of the last, as `search`.

    The others have a mistake of their own, so that fewer than half of the rows are right. Nothing
    where one end closes as declared.
    """
    ends = [*recording.ends]
    as_read = (fitted(end, [end.declared], end.common_rows, STARTS)[0].fit for end in ends)
    if not any(fit.closes for fit in as_read):
        yield from map(search, ends)


def turns_alike(recording: Recording) -> bool:
    """Whether robot and camera may turn alike under a reading of `search` or `search_by_half`.

    Where they do not, none of these closes the chain, which takes ten times as long to find. Too
    few rows rule nothing out.
    """
    rows, declared = thinned(recording.common_rows), recording.declared
    if len(rows) < FEWEST_ROWS:
        return True
    turning = [each for each in recording.changes if not _TURNING.isdisjoint(each.fields)]
    some = recording.robot.rows(rows)
    pairs = [*product((None, *turning), rewritten(some)), *product((None,), turning)]
    pairs += [*combinations(turning, 2)]
    single = [*product((None,), (*turning, *rewritten(some, by_makers=True)))]
    for changed, by_half in ((pairs, False), (single, True)):
        mismatch = _mismatch(recording, rows, by_half=by_half)
        tried = (declared, *_undone(declared, changed))
        if any(mismatch(reading) < _TURNS_AGREE_RAD for reading in tried):
            return True
    # Rotations that lost whole turns are found by the positions.
    return any(_unwrapped(recording, keep_turns=False))


def _unwrapped(recording: Recording, *, keep_turns: bool) -> Iterator[Change]:
    """The reading of rotations whose numbers were taken for others and lost whole turns."""
    rows, declared = recording.common_rows, recording.declared
    numbers = recording.robot.rows(rows)
    poses = declared.robot.poses(numbers)
    seen = declared.camera.poses(recording.camera.rows(rows))
    is_complete = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(seen).all(axis=(1, 2))
    sides = poses[is_complete, :3, :3], poses[is_complete, :3, 3], seen[is_complete]
    found = unwrapped(*sides, recording.mount, keep_turns=keep_turns)
    if found is None:
        return
    (taken, form), rotations = found
    places = (numbers.places[at] for at in np.flatnonzero(is_complete))
    by_place = zip(places, map(tuple, rotations.reshape(-1, 9).tolist()), strict=True)
    was, other = ROTATION_FORMS[form].words, ROTATION_FORMS[taken].words
    other = "radians" if form.endswith("deg") else other
    words = f"the robot's rotations as {was}, which were taken for {other}"
    yield Change(words, "robot", {"rotation": form, "by_place": tuple(by_place)}, 2)


def _of_another_size(
    recording: Recording, candidates: Sequence[Candidate], rows: IntArray
) -> list[Candidate]:
    """The readings whose turns agree and whose distances do, once the camera's are multiplied.

    The first candidate is the declared reading.
    """
    scaled: dict[Hypothesis, tuple[Hypothesis, ...]] = {}
    as_stated, declared = dict[Hypothesis, float](), candidates[0]
    for item in candidates:
        if item.fit.rms[1] > _TURNS_AGREE_RAD:
            continue
        # Signs and mirrors that turn both frames leave the chain as it is declared.
        changed = not np.isclose(item.fit.score, declared.fit.score, rtol=1e-3)
        (robot,), (camera,) = chains(item.recording, [item.hypothesis], item.of_rows)
        found_factor = distance_factor(robot, camera, item.fit)
        if found_factor is None:
            continue
        scale, _ = found_factor
        # A print differs by less than the first logarithm from its stated size; a fit follows the
        # second.
        if abs(np.log(scale)) < (0.03 if changed else 0.2):
            continue
        subject = (
            "the board" if recording.is_measured else "the camera's distances, and so the board,"
        )
        change = Change(f"{subject} {scale:.4g} times as large", "camera", {"scale": scale}, 2)
        scaled[change.of(item.hypothesis)] = (*map(change.of, item.labels),)
        as_stated[change.of(item.hypothesis)] = min(item.misfit, declared.misfit)
    found = fitted(recording, scaled, rows, STARTS) if scaled else []
    # Larger distances make any misfit a smaller share of them, and a fitted number any misfit less.
    return [
        replace(item, labels=scaled[item.hypothesis])
        for item in found
        if item.fit.closes and CLEAR_RATIO * item.misfit < as_stated[item.hypothesis]
    ]


def in_one_turn(robot: FloatArray, camera: FloatArray) -> IntArray | None:
    """Chooses the rivals of a target's poses that turn from view to view as the robot does.

    Args:
        robot: (m, 3, 3) rotations of the robot.
        camera: (m, c, 3, 3) those of the target by its c rivals in the camera, the likeliest first.

    Returns:
        (m,) indices of the rivals. Turns of the target that are the same in all views stay open.
        None where rows do not turn alike, as of misread angles.
    """
    count, rivals = camera.shape[:2]
    some = thinned(np.arange(count))
    by_robot, by_camera = (
        np.einsum("iab,jab->ij", side.reshape(-1, 3, 3), side[some].reshape(-1, 3, 3))
        for side in (robot, camera)
    )
    turns = [np.arccos(np.clip(0.5 * (each - 1.0), -1.0, 1.0)) for each in (by_robot, by_camera)]
    away = np.abs(turns[1].reshape(count, rivals, -1, rivals) - turns[0][:, None, :, None])
    away = np.minimum(away, _TURNS_AGREE_RAD)
    best, least = np.zeros(count, dtype=np.int64), np.inf
    for reference in range(len(some)):
        chosen = away[:, :, reference, 0].argmin(axis=1)
        for _ in range(CONCENTRATED):
            costs = np.take_along_axis(away, chosen[some][None, None, :, None], 3).sum(axis=(2, 3))
            chosen = costs.argmin(axis=1)
        if (total := float(costs.min(axis=1).sum())) < least:
            best, least = chosen, total
    return best if least < 0.5 * _TURNS_AGREE_RAD * count * len(some) else None


def _undone(
    declared: Hypothesis, pairs: Iterable[tuple[Change | None, Change]]
) -> list[Hypothesis]:
    """The readings with one mistake, or two that go together, undone."""
    last, without, found = None, declared, list[Hypothesis]()
    for first, second in pairs:
        if first is not last:
            last, without = first, declared if first is None else first.of(declared)
        if (
            first is None
            or first.part != second.part
            or first.fields.keys().isdisjoint(second.fields)
        ):
            found.append(second.of(without))
    return found


def _near(tried: Sequence[Hypothesis], scores: Sequence[float]) -> list[Hypothesis]:
    """The readings whose scores are near the least, the best and simplest first."""
    limit = CLEAR_RATIO * min(scores) + _SLACK
    near = [
        ((score + _SLACK) * (1.0 + reading.cost), at)
        for at, (reading, score) in enumerate(zip(tried, scores, strict=True))
        if score <= limit
    ]
    # The screening and the first fits hand on at most so many readings.
    return [tried[at] for _, at in sorted(near)[:400]]


def _mismatch(
    recording: Recording, rows: IntArray, *, by_half: bool = False
) -> Callable[[Hypothesis], float]:
    """Low quantile of the differences [rad] by which robot and camera turn under a reading.

    `by_half`, the least by which as many rows as `search_by_half` needs agree with as many: a low
    quantile of all pairs would be small in other motions, too.
    """
    of_camera, pairs = recording.camera.rows(rows), upper_pairs(len(rows))
    rows_of = {name: order(len(recording.robot))[rows] for name, order in ROW_ORDERS.items()}
    used = np.unique(np.maximum(np.concatenate([*rows_of.values()]), 0))
    of_form = cache(partial(as_written, recording.robot.rows(used)))

    # Transposed or mirrored rotations turn by the same angles.
    @cache
    def traces(fields: _Rotations) -> FloatArray:
        rotation, written, terms, angle_unit = fields
        reading = SideReading(rotation, terms=terms, angle_unit=angle_unit)
        rotations = reading.rotations(of_form(written))
        return _traces(np.append(rotations, np.full((1, 3, 3), np.nan), axis=0))

    @cache
    def places(order: str) -> tuple[IntArray, IntArray]:
        at = rows_of[order]
        # The last is missing.
        of_rows = np.where(at < 0, len(used), np.searchsorted(used, at))
        return of_rows[pairs[0]], of_rows[pairs[1]]

    @cache
    def by_robot(fields: _Rotations, order: str) -> FloatArray:
        return _angles(traces(fields)[places(order)])

    @cache
    def by_camera(rotation: str) -> FloatArray:
        return relative_angles(SideReading(rotation).rotations(of_camera))

    @cache
    def away(fields: _Rotations, order: str, of_camera: str) -> float:
        difference = np.abs(by_robot(fields, order) - by_camera(of_camera))
        if by_half:
            square = np.zeros((len(rows), len(rows)))
            square[pairs] = difference
            rank = kept_count(len(rows), HALF_SHARE) - 1
            difference = np.partition(square + square.T, rank, axis=1)[:, rank]
        else:
            rank = int(PAIRS_SHARE * len(difference))
        # NaN is the largest.
        found = float(np.partition(difference, rank)[rank])
        return np.inf if np.isnan(found) else found

    def mismatch(reading: Hypothesis) -> float:
        robot = reading.robot
        fields = robot.rotation, robot.written, robot.terms, robot.angle_unit
        return away(fields, reading.order, reading.camera.rotation)

    return mismatch


def relative_angles(rotations: FloatArray) -> FloatArray:
    """(p,) angles [rad] of the relative rotations of all pairs of (n, 3, 3) rotations."""
    return _angles(_traces(rotations)[upper_pairs(len(rotations))])


def _traces(rotations: FloatArray) -> FloatArray:
    """(n, n) traces of the relative rotations of (n, 3, 3) rotations."""
    flat = rotations.reshape(-1, 9)
    return np.asarray(flat @ flat.T)


def _angles(traces: FloatArray) -> FloatArray:
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
