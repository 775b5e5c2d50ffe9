"""Decision which reading is right: by its posterior beside the declared one and mixed rows.

Inverting the robot's poses, inverting the camera's, and changing the mount all exchange the unknown
edges: no residual distinguishes them. The robot's joints do, and plausibility: what is mounted on
the flange is near it, and the target is in front of the camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import STARTS, Fit, is_about_one_axis, robust_fits
from visioncal.calibration.guess.recording import (
    CLEAR,
    EVIDENCE,
    FEWEST_ROWS,
    IMPOSSIBLE,
    Candidate,
    Recording,
    chains,
    fitted,
    thinned,
)
from visioncal.calibration.guess.search import search, search_by_half, search_ends
from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import counted, figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, Mount

# Random orders of the rows, by which a reading closes the chain by chance.
_SHUFFLES = 8
# Log prior odds by the logarithm of the ratio of the edges' lengths, and their bound.
_BY_LENGTH = 10.0
# How the sentence begins where the motion leaves the reading open.
ONE_AXIS = "All views turn about one axis"
NO_READING = "No reading that was tried stands out"
# How a person states what several readings leave open, in options of `convert`.
POSE_OPTIONS = "--robot-form, --robot-unit, --robot-inverse, or --robot-columns in the right order"
# Poses of two readings that differ by less than this share of the residuals are the same.
_SAME = 0.3


@dataclass(frozen=True, eq=False)
class Guess:
    """The reading of the poses that is right, and its rivals."""

    declared: Candidate  # The declared reading.
    # The best reading, the declared one, then others, the likeliest first; each represents all
    # readings that residuals cannot distinguish from it.
    candidates: tuple[Candidate, ...]
    best: Candidate  # The reading that stands out; the declared one where none does.
    sentence: str  # The finding, with its figures.
    notes: tuple[str, ...] = ()  # Limits of the residuals here, in sentences.

    @property
    def stands_out(self) -> bool:
        """Whether another reading than the declared one is clearly right."""
        return self.best is not self.declared

    @property
    def is_open(self) -> bool:
        """Whether several readings close the chain alike, and the declared one does not."""
        return not self.stands_out and bool(_alike(self.declared, self.candidates))

    @property
    def positions(self) -> str:
        """Sums for `convert --positions` by the reading of those alike that changes these alone."""
        declared = self.declared.hypothesis
        for item in _alike(self.declared, self.candidates):
            axes, signs = item.hypothesis.robot.axes, item.hypothesis.robot.signs
            if item.hypothesis == replace(
                declared, robot=replace(declared.robot, axes=axes, signs=signs)
            ):
                each = zip(axes, signs, strict=True)
                return ",".join(f"{'-' if sign < 0 else ''}{'xyz'[at]}" for at, sign in each)
        return ""


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
        DataError: Both mounts fit, and none was declared.
        DegenerateError: Too few rows have both poses.
    """
    mounts = MOUNTS if mount is None else (mount,)
    recordings = [Recording(robot, camera, name, is_measured, chain) for name in mounts]
    common = len(recordings[0].common_rows)
    if common < FEWEST_ROWS:
        raise DegenerateError(
            f"guess: {counted(common, 'row', ('has', 'have'))} a pose of the robot and one of the "
            f"camera, but it takes {FEWEST_ROWS} or more to distinguish readings.",
            next_step="Add views, tilted about different axes.",
        )
    with one_blas_thread():
        found = [_likeliest(search(recording)) for recording in recordings]
        if mount is not None and not found[0][1].fit.closes:
            found = _of_some_rows(recordings[0]) or found
        if mount is None:
            # A reading of another mount is that mount's, as it is declared there.
            same_mount = [
                item for item in found if item[1].hypothesis.mount == item[1].recording.mount
            ]
            found = sorted(same_mount or found, key=lambda item: -_beside_other_mount(item[1]))
            _check_mount([best for _, best in found])
        (declared, *others), best = found[0]
        tried = [best, *(item for item in (declared, *others) if item is not best)]
        notes = tuple(_notes(best, is_mount_given=mount is not None))
        return Guess(declared, tuple(tried), best, _sentence(declared, best, tried), notes)


def _of_some_rows(recording: Recording) -> list[tuple[list[Candidate], Candidate]]:
    """The readings that close the chain of half of the rows, or of one end; empty for none."""
    for searched in (map(search_by_half, [recording]), search_ends(recording)):
        likely = map(_likeliest, searched)
        found = [item for item in likely if item[1] is not item[0][0] and item[1].fit.closes]
        if found:
            return [min(found, key=lambda item: item[1].hypothesis.cost)]
    return []


def _likeliest(tried: list[Candidate]) -> tuple[list[Candidate], Candidate]:
    """All readings, and the one whose posterior stands out from the others' and chance's.

    The declared reading, the first, where none does.
    """
    declared, *others = tried
    best = others[0] if others else declared
    beaten = best.log_posterior - CLEAR
    # From this score on it explains nothing, as of a board that looks the same after half a turn.
    if (
        beaten <= declared.log_posterior
        or best.fit.score > 0.3
        or not _brings_nearer(best, declared)
        or _turns_about_one_axis(best)
        or any(other.log_posterior > beaten and not _are_same(best, other) for other in others)
        or beaten <= EVIDENCE * _by_other_rows(best)
    ):
        return tried, declared
    chosen = _with_likeliest_label(best)
    return [chosen if item is best else item for item in tried], chosen


def _brings_nearer(item: Candidate, declared: Candidate) -> bool:
    """Whether places agree clearly better, where turns are the same: units alone shrink figures."""
    # Turns of two readings that differ by less, as a share, are alike.
    if declared.fit.closes or not np.isclose(item.fit.rms[1], declared.fit.rms[1], rtol=0.1):
        return True
    return CLEAR_RATIO * item.misfit < declared.misfit


def _by_other_rows(best: Candidate) -> float:
    """Log-likelihood of a reading whose positions, or rotations, are those of other rows."""
    (robot,), (camera,) = chains(best.recording, [best.hypothesis], best.of_rows)
    rng, mixed = np.random.default_rng(0), np.tile(robot, (2 * _SHUFFLES, 1, 1, 1))
    for at in range(_SHUFFLES):
        order = rng.permutation(len(robot))
        mixed[2 * at, :, :3, 3] = robot[order, :3, 3]
        mixed[2 * at + 1, :, :3, :3] = robot[order, :3, :3]
    fits = robust_fits(mixed, np.broadcast_to(camera, mixed.shape), STARTS, best.fit.share)
    return max(replace(fit, lost=best.fit.lost).log_likelihood for fit in fits)


def _with_likeliest_label(best: Candidate) -> Candidate:
    """Chooses the reading with the most plausible cell among those of one class."""
    labels = tuple(label for label in best.labels if label.cost == best.hypothesis.cost)
    if len(labels) < 2:
        return best
    inliers = np.sort(best.of_rows[best.fit.kept])
    likeliest = max(fitted(best.recording, labels, inliers, 0), key=_plausibility).hypothesis
    rows, share = thinned(best.recording.common_rows), best.fit.share
    return replace(fitted(best.recording, [likeliest], rows, 3 * STARTS, share)[0], labels=labels)


def _plausibility(candidate: Candidate) -> float:
    """Log odds of the cell that a reading gives, beside readings that close the chain alike."""
    if not candidate.fit.is_readable:
        return -np.inf
    _, (camera,) = chains(candidate.recording, [candidate.hypothesis], candidate.of_rows)
    in_front = IMPOSSIBLE * bool(np.median(camera[:, 2, 3]) > 0.0)
    lengths_m = np.linalg.norm([candidate.fit.x[:3, 3], candidate.fit.z[:3, 3]], axis=1)
    nearer = float(np.diff(np.log(np.maximum(lengths_m, 1e-6)))[0])
    if candidate.hypothesis.mount == "eye-to-hand":
        nearer = -nearer
    by_length = np.clip(_BY_LENGTH * nearer, -_BY_LENGTH, _BY_LENGTH)
    fit = _by_joints(candidate)
    return float(in_front + by_length + (0.0 if fit is None else fit.log_likelihood))


def _by_joints(candidate: Candidate) -> Fit | None:
    """Fits the poses of a reading to those of the joints; None with too few of these."""
    recording = candidate.recording
    if recording.chain is None:
        return None
    is_paired = recording.robot.present & np.isfinite(recording.chain).all(axis=(1, 2))
    rows = thinned(np.flatnonzero(is_paired))
    poses = candidate.hypothesis.robot.poses(recording.robot.rows(rows))
    readable = np.isfinite(poses).all(axis=(1, 2))
    if readable.sum() < FEWEST_ROWS:
        return None
    return robust_fits(invert(poses[None, readable]), recording.chain[None, rows[readable]])[0]


def _are_same(best: Candidate, rival: Candidate) -> bool:
    """Whether two readings give the same poses, so that choosing does not matter."""
    rows = np.intersect1d(best.of_rows, rival.of_rows)
    first, second = chains(best.recording, [best.hypothesis, rival.hypothesis], rows)[0]
    difference = invert(first) @ second
    shift, angle = best.fit.rms
    return bool(
        np.sqrt(np.mean(rotation_angle(difference) ** 2)) <= _SAME * angle
        and np.sqrt(np.mean(np.sum(difference[:, :3, 3] ** 2, axis=1))) <= _SAME * shift
    )


def _turns_about_one_axis(best: Candidate) -> bool:
    """Whether the camera turns about one axis at most."""
    kept = best.recording.camera.rows(best.of_rows[best.fit.kept])
    return is_about_one_axis(best.hypothesis.camera.poses(kept)[:, :3, :3])


def _beside_other_mount(best: Candidate) -> float:
    """Log posterior by which the mount is chosen; the changes alone decide nothing."""
    # Inverted poses close the chain under the wrong mount as well as the poses do under the right
    # one.
    return EVIDENCE * best.fit.log_likelihood + _plausibility(best)


def _check_mount(likely: Sequence[Candidate]) -> None:
    """Refuses a choice between two mounts that fit alike, the likelier one first."""
    first, *others = likely
    least = _beside_other_mount(first) - CLEAR
    is_clear = all(_beside_other_mount(other) < least for other in others)
    if not first.fit.closes or (is_clear and not _turns_about_one_axis(first)):
        return
    pair = sorted(likely, key=lambda item: MOUNTS.index(item.hypothesis.mount))
    readings = " and ".join(f"{best.hypothesis.mount} ({best.words})" for best in pair)
    raise DataError(
        f"The mount is not given, and the poses fit both ways of mounting: {readings}.",
        next_step="Say where the camera is with --mount.",
    )


def _sentence(declared: Candidate, best: Candidate, ranked: Sequence[Candidate]) -> str:
    """States the finding, with its figures."""
    closes = f"robot and camera agree to {_figures(best)}"
    if best is not declared:
        otherwise = f"to {_figures(declared)}" if declared.fit.agreeing else "in no view"
        of_end, places = "", best.recording.robot.places
        if best.recording.is_end:
            of_end = f" So it is from {places[0]} to {places[-1]}: the other rows have another "
            of_end += "mistake beside it, which comes next."
        return f"With {best.words}, {closes}; as first read, {otherwise}.{of_end}"
    if not declared.fit.is_readable:
        return (
            "As first read, the rotations of the robot or of the camera are none, and no other "
            "reading of the numbers stands out."
        )
    rivals = [candidate for candidate in ranked if candidate is not declared]
    if rivals:
        closes += f"; the next, {rivals[0].words}, to {_figures(rivals[0])}"
    if _turns_about_one_axis(declared):
        return f"{ONE_AXIS} at most, which cannot distinguish readings. As first read, {closes}."
    if alike := _alike(declared, ranked):
        words = (
            f"{', '.join(item.hypothesis.changes)} (to {_figures(item)}; the camera is then at "
            f"({', '.join(figure(1e3 * part) for part in item.fit.x[:3, 3].tolist())}) mm)"
            for item in alike[:3]
        )
        listed = "; or with ".join(words)
        return (
            f"Robot and camera agree with {listed}. Nothing decides between these. As first read, "
            f"they agree to {_figures(declared)}."
        )
    if not declared.fit.closes:
        return f"{NO_READING}: as first read, {closes}."
    return f"The poses fit as first read: {closes}."


def _alike(declared: Candidate, ranked: Sequence[Candidate]) -> list[Candidate]:
    """Readings that close the chain as well as the best, where the declared one does not.

    A quaternion whose numbers are in another order turns as its inverse between two fixed frames,
    so that two mistakes of rotations may look like axes of positions that are exchanged.
    """
    if declared.fit.closes or _turns_about_one_axis(declared):
        return []
    others = (item for item in ranked if item is not declared and item.fit.closes)
    rivals = [item for item in others if _brings_nearer(item, declared)]
    most = max((item.log_posterior for item in rivals), default=np.inf)
    alike = list[Candidate]()
    for item in rivals:
        near = item.log_posterior > most - CLEAR
        if near and not any(_are_same(other, item) for other in alike):
            alike.append(item)
    return alike


def _figures(candidate: Candidate) -> str:
    agreeing, rows = candidate.fit.agreeing, len(candidate.of_rows)
    return f"{candidate.fit.figures}{'' if agreeing == rows else f' in {agreeing} of {rows} views'}"


def _notes(best: Candidate, *, is_mount_given: bool) -> Iterator[str]:
    """States what residuals cannot show here."""
    if not is_mount_given and best.fit.closes:
        yield (
            f"The mount was not given and is taken for {best.hypothesis.mount}, by what lies "
            "nearer to the flange; --mount says another."
        )
    # Other units for both sides only scale the cell.
    reading, unit = best.hypothesis, best.hypothesis.robot.unit
    labels = (label for label in best.labels if label != reading and label.robot.unit == unit)
    if also := " or with ".join("; ".join(label.changes) for label in labels if reading.changes):
        yield (
            f"The views close the chain in the same way with {also}. It was chosen by what lies "
            "nearer to the flange, or by the joints."
        )
