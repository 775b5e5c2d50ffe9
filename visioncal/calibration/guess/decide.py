"""Decision which reading is right: by its posterior beside the declared one and none of these.

Inverting the robot's poses, inverting the camera's, and changing the mount all exchange the unknown
edges: no residual distinguishes them. The robot's joints do, and plausibility: what is mounted on
the flange is near it, and the target is in front of the camera. A base that is turned shows in the
joints alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import (
    CLOSING_SCORE,
    STARTS,
    Fit,
    distances,
    is_about_one_axis,
    robust_fit,
)
from visioncal.calibration.guess.readings import HALF_TURN, HALF_TURNED, of_exchanged_rows
from visioncal.calibration.guess.search import (
    EVIDENCE,
    FEWEST_ROWS,
    IMPOSSIBLE,
    Candidate,
    Recording,
    chains,
    fitted,
    search,
    thinned,
)
from visioncal.core.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, pose_difference, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, Mount

# Log posterior odds from which one reading is preferred to another.
_CLEAR = 3.0
# Log prior odds by the logarithm of the ratio of the edges' lengths, and their bound.
_BY_LENGTH, _MOST_BY_LENGTH = 10.0, 10.0
_LISTED = 12
# Poses of two readings that differ by less than this share of the residuals are the same.
_SAME = 0.3
# Nominal models differ from the controller's by a few millimetres; a half turn, by far more.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Most outlier rows that are tried as exchanged.
_MOST_OUTLIERS = 8


@dataclass(frozen=True, eq=False)
class Guess:
    """The reading of the poses that is right, and its rivals."""

    declared: Candidate  # The declared reading.
    # The best readings, best first, with the declared one; each represents all readings that
    # residuals cannot distinguish from it.
    candidates: tuple[Candidate, ...]
    best: Candidate  # The reading that stands out; the declared one where none does.
    sentence: str  # The finding, with its figures.
    notes: tuple[str, ...] = ()  # What residuals cannot show here, in sentences.

    @property
    def stands_out(self) -> bool:
        """Whether another reading than the declared one is clearly right."""
        return self.best is not self.declared


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
        found = [_decided(recording) for recording in recordings]
        if mount is None:
            # Of two that find the same reading, the one that changes less.
            found.sort(
                key=lambda item: (-round(_beside_other_mount(item[1]), 3), -item[1].log_prior)
            )
            _check_mount(*(best for _, best in found))
        return _guess(*found[0], is_mount_given=mount is not None)


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
    common = len(recording.common_rows)
    if common < FEWEST_ROWS:
        raise DegenerateError(
            f"guess: {counted(common, 'row', ('has', 'have'))} a pose of the robot and one of the "
            f"camera; {FEWEST_ROWS} or more are needed to distinguish readings.",
            next_step="Add views, tilted about different axes.",
        )


def _decided(recording: Recording) -> tuple[list[Candidate], Candidate]:
    """All readings, the declared one first, and the one that stands out; else the declared one."""
    tried = search(recording)
    best = _likeliest(tried)
    if best is not tried[0]:
        tried[tried.index(best)] = best = _with_likeliest_label(best)
    swapped = _exchanged(best)
    if swapped is not None:
        tried.append(best := swapped)
    fit = _by_joints(best)
    if fit is not None and fit.closes:
        away_mm, away_deg = pose_difference(HALF_TURN, fit.x)
        if away_mm < _NEAR_MM and away_deg < _NEAR_DEG:
            best = replace(best, hypothesis=HALF_TURNED.of(best.hypothesis), labels=())
            tried.append(best)
    return tried, best


def _likeliest(tried: Sequence[Candidate]) -> Candidate:
    """The reading whose posterior stands out from the others' and none's; else the declared one."""
    declared, *others = tried
    best = max(others, key=lambda item: item.log_posterior, default=declared)
    if _is_poor(best):
        return declared
    rivals = [declared.log_posterior, best.log_posterior - best.log_odds]
    rivals += [
        other.log_posterior
        for other in others
        if other.log_posterior > best.log_posterior - _CLEAR and not _are_same(best, other)
    ]
    return best if best.log_posterior > max(rivals) + _CLEAR else declared


def _with_likeliest_label(best: Candidate) -> Candidate:
    """Chooses the reading with the most plausible cell among those of one class."""
    labels = tuple(label for label in best.labels if label.cost == best.hypothesis.cost)
    if not labels:
        return best
    tried = fitted(best.recording, labels, thinned(best.recording.common_rows), STARTS)
    likely = [_plausibility(item) for item in tried]
    return replace(tried[int(np.argmax(likely))], labels=labels)


def _plausibility(candidate: Candidate) -> float:
    """Log odds of the cell that a reading gives, beside readings that close the chain alike."""
    if not candidate.fit.is_readable:
        return -np.inf
    _, (camera,) = chains(candidate.recording, [candidate.hypothesis], candidate.of_rows)
    in_front = IMPOSSIBLE * bool(np.median(camera[:, 2, 3]) > 0.0)
    on_flange_m, at_base_m = np.log(np.maximum(_flange_and_cell_m(candidate), 1e-6))
    by_length = _BY_LENGTH * (at_base_m - on_flange_m)
    fit = _by_joints(candidate)
    by_joints = 0.0 if fit is None else fit.log_likelihood
    return float(in_front + np.clip(by_length, -_MOST_BY_LENGTH, _MOST_BY_LENGTH) + by_joints)


def _flange_and_cell_m(candidate: Candidate) -> tuple[float, float]:
    """Lengths of the unknown edge on the flange and of the one at the base [m]."""
    edges = candidate.fit.x, candidate.fit.z
    on_flange, at_base = edges if candidate.hypothesis.mount == "eye-in-hand" else edges[::-1]
    return float(np.linalg.norm(on_flange[:3, 3])), float(np.linalg.norm(at_base[:3, 3]))


def _by_joints(candidate: Candidate) -> Fit | None:
    """Fits the poses of a reading to those of the joints; None with too few of these."""
    recording = candidate.recording
    if recording.chain is None:
        return None
    both = recording.robot.present & np.isfinite(recording.chain).all(axis=(1, 2))
    rows = thinned(np.flatnonzero(both))
    poses = candidate.hypothesis.robot.poses(recording.robot.rows(rows))
    readable = np.isfinite(poses).all(axis=(1, 2))
    if readable.sum() < FEWEST_ROWS:
        return None
    return robust_fit(invert(poses[readable]), recording.chain[rows[readable]])


def _exchanged(best: Candidate) -> Candidate | None:
    """The reading with two rows exchanged that explains two outlier views; None if unclear."""
    recording, rows = best.recording, best.recording.common_rows
    if not best.fit.is_readable or (len(rows) <= _MOST_OUTLIERS and _is_poor(best)):
        return None
    robot, camera = (side[0] for side in chains(recording, [best.hypothesis], rows))
    residuals = distances(robot, camera, best.fit.lever, (best.fit.x, best.fit.z)).residuals
    farthest = np.argsort(-np.nan_to_num(residuals, nan=-1.0))[:_MOST_OUTLIERS]
    of_robot = best.hypothesis.rows(len(recording.robot))
    swaps = [
        of_exchanged_rows(tuple(of_robot[list(pair)].tolist()), recording.robot.places)
        for pair in combinations(np.sort(rows[farthest]), 2)
        if (of_robot[list(pair)] >= 0).all()
    ]
    looked = np.union1d(thinned(rows), rows[farthest])
    readings = [best.hypothesis, *(swap.of(best.hypothesis) for swap in swaps)]
    before, *tried = fitted(recording, readings, looked, 0)
    if len(tried) < 2 or before.fit.agreeing == before.rows:
        return None
    found, second = sorted(tried, key=lambda item: -item.log_posterior)[:2]
    if _is_poor(before):
        # About one axis, the positions are closed by chance, and rotations alone show an exchange.
        moved = np.isin(of_robot[before.of_rows], found.hypothesis.swap)
        if not before.fit.angle[moved].min() > CLOSING_SCORE > found.fit.angle[moved].max():
            return None
        none = -np.inf
    else:
        none = found.log_posterior - found.log_odds
    rival = max(before.log_posterior, second.log_posterior, none)
    return found if found.log_posterior > rival + _CLEAR else None


def _are_same(best: Candidate, rival: Candidate) -> bool:
    """Whether two readings give the same poses, so that choosing does not matter."""
    rows = np.intersect1d(best.of_rows, rival.of_rows)
    pair = [best.hypothesis, rival.hypothesis]
    first, second = chains(best.recording, pair, rows)[0]
    difference = invert(first) @ second
    shift, angle = best.fit.rms
    return bool(
        np.sqrt(np.mean(rotation_angle(difference) ** 2)) <= _SAME * angle
        and np.sqrt(np.mean(np.sum(difference[:, :3, 3] ** 2, axis=1))) <= _SAME * shift
    )


def _is_poor(best: Candidate) -> bool:
    """Whether the camera turns about one axis at most."""
    if not best.fit.is_readable:
        return False
    kept = best.recording.camera.rows(best.of_rows[best.fit.kept])
    return is_about_one_axis(best.hypothesis.camera.poses(kept)[:, :3, :3])


def _beside_other_mount(best: Candidate) -> float:
    """Log posterior by which the mount is chosen; the changes alone decide nothing."""
    # Inverted poses close the chain under the wrong mount as well as the poses do under the right
    # one.
    return EVIDENCE * best.fit.log_likelihood + _plausibility(best)


def _check_mount(likelier: Candidate, other: Candidate) -> None:
    """Refuses a choice between two mounts that fit alike."""
    first, second = likelier.hypothesis.mount, other.hypothesis.mount
    is_clear = _beside_other_mount(likelier) > _beside_other_mount(other) + _CLEAR
    if first == second or not likelier.fit.closes or (is_clear and not _is_poor(likelier)):
        return
    pair = sorted((likelier, other), key=lambda item: MOUNTS.index(item.declared.mount))
    readings = " and ".join(f"{best.hypothesis.mount} ({best.words})" for best in pair)
    raise DataError(
        f"The mount is not given, and the poses fit both ways of mounting: {readings}.",
        next_step="Say where the camera is with --mount.",
    )


def _guess(tried: list[Candidate], best: Candidate, *, is_mount_given: bool) -> Guess:
    declared = tried[0]
    ranked = sorted(tried, key=lambda item: (item is not best, -item.log_posterior))[:_LISTED]
    if declared not in ranked:
        ranked[-1] = declared
    notes = tuple(_notes(best, is_mount_given=is_mount_given))
    return Guess(declared, tuple(ranked), best, _sentence(declared, best, ranked), notes)


def _sentence(declared: Candidate, best: Candidate, ranked: Sequence[Candidate]) -> str:
    """States the finding, with its figures."""
    if best is not declared:
        return _best_sentence(declared, best)
    if not declared.fit.is_readable:
        return (
            "As declared, the rotations of the robot or of the camera are none, and no other "
            "reading of the numbers stands out."
        )
    rivals = [candidate for candidate in ranked if candidate is not declared]
    others = f"the next, {rivals[0].words}, to {_figures(rivals[0])}" if rivals else ""
    closes = f"the chain closes to {_figures(declared)}"
    if _is_poor(declared):
        return (
            "The motion cannot distinguish readings: all views turn about one axis at most. As "
            f"declared, {closes}{others and f'; {others}'}. Add views tilted about different axes."
        )
    is_beaten = any(rival.log_posterior > declared.log_posterior + _CLEAR for rival in rivals)
    if not declared.fit.closes or is_beaten:
        return (
            f"No reading that was tried stands out: as declared, {closes}"
            f"{others and f'; {others}'}."
        )
    return f"The poses fit as declared: {closes}; {others or 'no other reading comes near'}."


def _best_sentence(declared: Candidate, best: Candidate) -> str:
    closes = f"With {best.words}, the chain closes to {_figures(best)}"
    if best.hypothesis.robot.half_turned:
        closes += ", and the poses are those of the joint angles,"
    if best.hypothesis.swap and len(best.differences) == 1:
        return f"{closes}; as declared, {declared.fit.agreeing} of {declared.rows} views agree."
    return f"{closes} instead of {_figures(declared)}."


def _figures(candidate: Candidate) -> str:
    agreeing, rows = candidate.fit.agreeing, candidate.rows
    return f"{candidate.fit.figures}{'' if agreeing == rows else f' in {agreeing} of {rows} views'}"


def _notes(best: Candidate, *, is_mount_given: bool) -> Iterator[str]:
    """States what residuals cannot show here."""
    if not is_mount_given and best.fit.closes:
        on_flange_mm, at_base_mm = (1e3 * length_m for length_m in _flange_and_cell_m(best))
        yield (
            f"The mount was not given and is taken for {best.hypothesis.mount}: what sits on the "
            f"flange then is {on_flange_mm:.0f} mm from it, and what stands at the base "
            f"{at_base_mm:.0f} mm. --mount says another."
        )
    # Other units for both sides only scale the cell.
    reading, unit = best.hypothesis, best.hypothesis.robot.unit
    labels = (label for label in best.labels if label != reading and label.robot.unit == unit)
    if also := " or with ".join("; ".join(label.changes) for label in labels if reading.changes):
        yield (
            f"The views close the chain in the same way with {also}. It was chosen by what lies "
            "nearer to the flange, or by the joints."
        )
    if reading.robot.mirrored:
        yield (
            "Mirrored images look the same, and are the usual cause: turn those back instead of "
            "changing poses that are right. Which axis is mirrored cannot be seen in the views: "
            "another one turns the base and the flange by half a turn. y was taken."
        )
    if best.recording.chain is None:
        yield (
            "A base turned about its z (base_link for base) does not show without joint angles "
            "and the robot's model."
        )
