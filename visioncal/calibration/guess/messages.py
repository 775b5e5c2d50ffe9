"""Sentences and notes of a guess."""

from collections.abc import Iterator, Sequence

from visioncal.calibration.guess.recording import CLEAR, Recording, Scored
from visioncal.calibration.guess.result import Candidate


def sentence(
    declared: Candidate, best: Candidate, ranked: Sequence[Candidate], *, is_poor: bool
) -> str:
    """States the finding, with its figures.

    `best` is the declared reading where none stands out, `ranked` has the best readings first, and
    `is_poor` is whether the views turn about one axis at most.
    """
    if best is not declared:
        return _best_sentence(declared, best)
    if not declared.is_readable:
        return (
            "As declared, the rotations of the robot or of the camera are none, and no other "
            "reading of the numbers stands out."
        )
    rivals = [candidate for candidate in ranked if candidate is not declared]
    others = f"the next, {rivals[0].words}, to {_figures(rivals[0])}" if rivals else ""
    if is_poor:
        return (
            "The motion cannot distinguish readings: all views turn about one axis at most. As "
            f"declared, the chain closes to {_figures(declared)}{others and f'; {others}'}. Add "
            "views tilted about different axes."
        )
    is_beaten = any(rival.log_posterior > declared.log_posterior + CLEAR for rival in rivals)
    if not declared.closes or is_beaten:
        return (
            "No reading that was tried stands out: as declared, the chain closes to "
            f"{_figures(declared)}{others and f'; {others}'}."
        )
    return (
        f"The poses fit as declared: the chain closes to {_figures(declared)}; "
        f"{others or 'no other reading comes near'}."
    )


def _best_sentence(declared: Candidate, best: Candidate) -> str:
    closes = f"With {best.words}, the chain closes to {_figures(best)}"
    if not declared.is_readable:
        return f"{closes}; as declared, the numbers are no rotations."
    if best.hypothesis.robot.half_turned:
        return (
            f"{closes}, and the poses are those of the joint angles; as declared, the chain closes "
            f"to {_figures(declared)}."
        )
    if best.hypothesis.swap and best.changes == 1:
        return f"{closes}; as declared, {declared.agreeing} of {declared.rows} views agree."
    return f"{closes} instead of {_figures(declared)}{_other_mount(best)}."


def _other_mount(best: Candidate) -> str:
    other = "; ".join(name for name in best.other_mount if name not in best.differences)
    own = "; ".join(
        difference for difference in best.differences if difference not in best.other_mount
    )
    return f"; {other} in place of {own} fits as well" if other else ""


def _figures(candidate: Candidate) -> str:
    agreeing, rows = candidate.agreeing, candidate.rows
    return f"{candidate.figures}{'' if agreeing == rows else f' in {agreeing} of {rows} views'}"


def notes(recording: Recording, best: Scored, *, is_declared: bool, is_poor: bool) -> Iterator[str]:
    """States what residuals cannot show here.

    Args:
        recording: The recorded poses.
        best: The chosen reading.
        is_declared: Whether the chosen reading is the declared one.
        is_poor: Whether the views turn about one axis at most.
    """
    # Other units for both sides only scale the cell.
    units = best.hypothesis.robot.unit, best.hypothesis.camera.unit
    others = [
        label
        for label in best.labels
        if label != best.hypothesis and (label.robot.unit, label.camera.unit) == units
    ]
    also = " or with ".join("; ".join(recording.changes(other)) for other in others)
    if also and not is_declared:
        yield (
            f"The views close the chain in the same way with {also}. It was chosen by what lies "
            "nearer to the flange, or by the joints."
        )
    elif also and not is_poor:
        yield (
            f"The views close the chain in the same way with {also}, which is likelier: as "
            "declared, what sits on the flange is far from it, or the target behind the camera."
        )
    if best.hypothesis.robot.signs == "mirror":
        yield (
            "Mirrored images look the same, and are the usual cause: turn those back instead of "
            "changing poses that are right."
        )
        yield (
            "Which axis is mirrored cannot be seen in the views: another one turns the base and "
            "the flange by half a turn. y was taken."
        )
    if recording.chain is None:
        yield (
            "A base turned about its z (base_link for base) does not show without joint angles "
            "and the robot's model."
        )
