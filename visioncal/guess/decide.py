"""Whether a reading stands out, and in which words."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from visioncal.conventions import ROTATION_FORMS, PoseNumbers
from visioncal.errors import DataError, DegenerateError
from visioncal.estimator.linalg import one_blas_thread
from visioncal.guess.chain import by_chain, is_half_turned
from visioncal.guess.given import CLOSES, FEWEST_ROWS, FLOOR, Recording, Scored, is_plausible
from visioncal.guess.result import Candidate, Guess
from visioncal.guess.search import search
from visioncal.guess.swaps import exchanged
from visioncal.types import FloatArray, Mount

# How many times better than the declared reading another has to close the chain. Where views turn
# about two axes a sound reading is beaten by none, and a wrong one by ten times and more: see
# tests/benchmarks/guess.py.
_STANDS_OUT = 3.0
# Readings this near to the best are as good; of them, the one with the fewest changes is meant.
_ALIKE = 2.0
# A rival as simple as the best leaves the matter open while it is this near.
_RIVALS = 1.5
# Views beyond this many typical distances do not agree with the others.
_AGREES = 5.0
# Turns about a second axis that are smaller, than the largest or at all, are noise of the poses.
_SECOND_AXIS, _LEAST_TURN_RAD = 0.05, 0.01
_LISTED = 12
_LONG_MM, _WHOLE = 1000.0, 99.0


def guess_reading(
    robot: PoseNumbers,
    camera: PoseNumbers,
    mount: Mount,
    *,
    chain: FloatArray | None = None,
    is_measured: bool = False,
) -> Guess:
    """Tries every plausible reading of the poses and says which closes the chain.

    Args:
        robot: `base_from_flange` of n rows, with the reading that is declared.
        camera: `cam_from_target` of the same rows, likewise; NaN where the target was not seen.
        mount: The declared mount.
        chain: (n, 4, 4) `base_from_flange` through a robot's model at the recorded joints, NaN in
            rows without; it tells what no camera can.
        is_measured: Whether the camera's poses were measured from images by visioncal, so that
            only the board's stated size can be wrong about them.

    Returns:
        The readings, and whether one stands out.

    Raises:
        DataError: The rows do not match, or a rotation has not as many numbers as its form.
        DegenerateError: Too few rows have both poses.
    """
    recording = Recording(robot, camera, mount, is_measured)
    _check(recording)
    with one_blas_thread():
        scored = search(recording)
        if chain is not None:
            scored = [_by_chain(it, recording, chain) for it in scored]
        best = _decided(recording, scored)
        swapped = exchanged(recording, best, is_poor=_is_poor(recording, best))
        if swapped is not None:
            best, scored = swapped, [*scored, swapped]
        if chain is not None and is_half_turned(best.hypothesis, robot, chain):
            taken = replace(best.hypothesis.robot, half_turned=True)
            turned = replace(best.hypothesis, robot=taken)
            best = replace(best, hypothesis=turned, labels=())
            scored = [*scored, best]
    return _guess(recording, scored, best, chain)


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
            f"{FEWEST_ROWS} or more are needed to tell readings apart.",
            next_step="Add views, tilted about different axes.",
        )


def _by_chain(scored: Scored, recording: Recording, chain: FloatArray) -> Scored:
    """Lets the joints choose among readings that the camera cannot tell apart."""
    chosen = by_chain(scored.labels, recording.robot, chain)
    return scored if chosen is None else replace(scored, hypothesis=chosen)


def _decided(recording: Recording, scored: Sequence[Scored]) -> Scored:
    """The reading that stands out from the declared one and from its rivals; else the declared."""
    declared, *others = scored
    if not others:
        return declared
    least = min(it.score for it in others)
    alike = [it for it in others if it.score <= _ALIKE * least]
    alike.sort(key=lambda it: (it.cost, it.score))
    best, rivals = alike[0], alike[1:]
    if best.score > CLOSES:
        return declared
    # Declared in units in which no camera could see the target, the chain may close as well.
    if is_plausible(recording, declared.hypothesis) and declared.score <= _STANDS_OUT * best.score:
        return declared
    is_open = any(it.cost == best.cost and it.score < _RIVALS * best.score for it in rivals)
    return declared if is_open or _is_poor(recording, best) else best


def _guess(
    recording: Recording,
    scored: Sequence[Scored],
    best: Scored,
    chain: FloatArray | None,
) -> Guess:
    candidates = {id(it): _candidate(recording, it) for it in scored}
    declared, chosen = candidates[id(scored[0])], candidates[id(best)]
    ranked = sorted(candidates.values(), key=lambda it: (it is not chosen, it.score))[:_LISTED]
    if declared not in ranked:
        ranked[-1] = declared
    is_poor = _is_poor(recording, best)
    return Guess(
        declared,
        tuple(ranked),
        chosen,
        chosen is not declared,
        _sentence(declared, chosen, ranked, is_poor=is_poor),
        tuple(_notes(recording, best, chain)),
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
        agreeing=int((fit.away <= _AGREES * max(fit.score, FLOOR)).sum()),
        rows=len(fit.away),
        is_board=recording.is_measured,
    )


def _sentence(
    declared: Candidate, best: Candidate, ranked: Sequence[Candidate], *, is_poor: bool
) -> str:
    if best is not declared:
        return _found(declared, best)
    rivals = [it for it in ranked if it is not declared]
    others = f"the next, {rivals[0].words}, to {_figures(rivals[0])}" if rivals else ""
    if is_poor:
        return (
            "The motion cannot tell readings apart: all views turn about one axis at most. As "
            f"declared, the chain closes to {_figures(declared)}{others and f'; {others}'}. Add "
            "views tilted about different axes."
        )
    if not declared.closes or any(_is_far_better(it, declared) for it in rivals):
        return (
            "No reading that was tried stands out: as declared, the chain closes to "
            f"{_figures(declared)}{others and f'; {others}'}."
        )
    return (
        f"The poses fit as declared: the chain closes to {_figures(declared)}; "
        f"{others or 'no other reading comes near'}."
    )


def _is_far_better(it: Candidate, declared: Candidate) -> bool:
    return _STANDS_OUT * it.score < declared.score


def _found(declared: Candidate, best: Candidate) -> str:
    closes = f"With {best.words}, the chain closes to {_figures(best)}"
    if best.hypothesis.robot.half_turned:
        return (
            f"{closes}, and the poses are those of the joint angles; as declared, the chain closes "
            f"to {_figures(declared)}."
        )
    if best.hypothesis.swap and best.changes == 1:
        return f"{closes}; as declared, {declared.agreeing} of {declared.rows} views agree."
    return f"{closes} instead of {_figures(declared)}."


def _figures(it: Candidate) -> str:
    views = "" if it.agreeing == it.rows else f" in {it.agreeing} of {it.rows} views"
    is_long = it.rms_mm > _LONG_MM
    length = f"{_short(1e-3 * it.rms_mm)} m" if is_long else f"{_short(it.rms_mm)} mm"
    return f"{length} and {_short(it.rms_deg)} deg{views}"


def _short(value: float) -> str:
    """Two digits; whole numbers from a hundred on."""
    return f"{value:.0f}" if value > _WHOLE else f"{value:.2g}"


def _notes(recording: Recording, best: Scored, chain: FloatArray | None) -> Iterator[str]:
    others = [it for it in best.labels if it != best.hypothesis]
    if others:
        also = " or with ".join("; ".join(recording.changes(it)) for it in others)
        yield (
            f"The views close the chain in the same way with {also}. It was chosen by what lies "
            "nearer to the flange, or by the joints."
        )
    if best.hypothesis.robot.signs == "mirror":
        yield (
            "Which axis is mirrored cannot be told from the views: another one turns the base and "
            "the flange by half a turn. y was taken."
        )
    if chain is None:
        yield (
            "A base turned about its z (base_link for base) does not show without joint angles "
            "and the robot's model."
        )


def _is_poor(recording: Recording, best: Scored) -> bool:
    """Whether the views turn about one axis at most, by the camera's account."""
    _, camera = best.hypothesis.chain(recording.robot, recording.camera)
    rotations = camera[best.rows[best.fit.kept], :3, :3]
    # Turning about one axis leaves what lies along it in place: the last value vanishes.
    spread = np.linalg.svd((rotations - rotations.mean(axis=0)).reshape(-1, 3), compute_uv=False)
    spread /= np.sqrt(len(rotations))
    return bool(spread[2] < max(_SECOND_AXIS * spread[0], _LEAST_TURN_RAD))
