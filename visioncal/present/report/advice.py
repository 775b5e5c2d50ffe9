"""Which views to look at, and what to do next."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.judge import Limits
from visioncal.core.number_format import significant
from visioncal.results import Calibration, ViewResult

# Views whose residual is this many times the median are named, as by the verdict.
_STANDS_OUT = Limits.outlier
# Sentences of a verdict that start so say what to do.
_IMPERATIVE = re.compile("(Add|Check|Compare|Let|Look|Measure|Move|Print|Record|Take|Use) ")
# And one that starts so is about views that disagree.
_CAUSES = "Possible causes: "
# So begins the reason of a view that was left out because pose and image do not go together.
_CONTRADICTS = "disagrees with the other views"


@dataclass(frozen=True)
class Suspects:
    """Views that share what is to be said of them.

    Attributes:
        views: Their numbers.
        used: Whether they are in the fit nevertheless.
        why: What is wrong with them, in words.
    """

    views: tuple[int, ...]
    used: bool
    why: str

    @property
    def contradict(self) -> bool:
        """Whether they were left out because they contradict the others."""
        return not self.used and self.why.startswith(_CONTRADICTS)


def suspects(calibration: Calibration) -> tuple[Suspects, ...]:
    """The used views that stand out, and then those that were not used, by their reasons.

    In a good result none stands out: that one view sees the board less well than others is no
    doubt.
    """
    outlying = {} if calibration.verdict.status == "good" else _outlying(calibration.views)
    by_reason: dict[str, list[int]] = {}
    for view in calibration.views:
        if not view.used:
            by_reason.setdefault(view.reason, []).append(view.view)
    return (
        *(Suspects((view,), used=True, why=why) for view, why in outlying.items()),
        *(Suspects(tuple(it), used=False, why=why) for why, it in by_reason.items()),
    )


def outlying_views(found: Sequence[Suspects]) -> tuple[int, ...]:
    """Numbers of the used views among suspects, ascending."""
    return tuple(sorted(view for it in found if it.used for view in it.views))


def contradicts(view: ViewResult) -> bool:
    """Whether a view was left out because it contradicts the others."""
    return not view.used and view.reason.startswith(_CONTRADICTS)


def _outlying(views: Sequence[ViewResult]) -> dict[int, str]:
    """Words for the used views whose residual is many times as long as the median, by view."""
    kinds: list[tuple[str, Callable[[ViewResult], float | None]]] = [
        ("mm", lambda view: view.residual_mm),
        ("deg", lambda view: view.residual_deg),
    ]
    words: dict[int, list[str]] = {}
    for unit, value_of in kinds:
        values = {
            view.view: value
            for view in views
            if view.used and (value := value_of(view)) is not None
        }
        median = float(np.median(list(values.values()))) if values else 0.0
        for view, value in values.items():
            if value > _STANDS_OUT * median > 0.0:
                words.setdefault(view, []).append(
                    f"{significant(value)} {unit} (median {significant(median)})"
                )
    return {view: f"off by {' and '.join(it)}" for view, it in words.items()}


def next_steps(calibration: Calibration, found: Sequence[Suspects]) -> tuple[str, ...]:
    """What to do next: the verdict's own advice, and the views that it is about by number.

    Args:
        calibration: The result.
        found: Its suspects.

    Returns:
        Sentences, the most pressing first.
    """
    of_frames = [
        f"Settle what is said of {name} under Tools and fixtures before it is used."
        for name, frame in calibration.frames.items()
        if frame.verdict.status != "good"
    ]
    if calibration.verdict.status == "good":
        return (*_when_good(calibration), *of_frames)
    outlying = outlying_views(found)
    advice = list(
        dict.fromkeys(
            sentence
            for sentence in _sentences(calibration.verdict.lines)
            if _IMPERATIVE.match(sentence)
        )
    )
    causes = [
        sentence.removeprefix(_CAUSES)
        for sentence in _sentences(calibration.verdict.reasons)
        if sentence.startswith(_CAUSES)
    ]
    if outlying:
        advice.insert(
            0,
            f"Look at {listed(outlying)}: does the pose belong to the image, and did anything "
            "move? Repeat wrong views or take them out of views.csv, and calibrate again.",
        )
    elif causes:
        advice.insert(0, f"No view stands out, so look for what all of them share: {causes[0]}")
    contradicting = [view.view for view in calibration.views if contradicts(view)]
    if contradicting:
        advice.insert(
            0,
            f"Find out what went wrong with {listed(contradicting)}, which the result does not "
            "use: does the pose belong to the image, and did anything move? Repeat them where the "
            "others leave gaps.",
        )
    return (*(advice or ["Settle the points above, and calibrate again."]), *of_frames)


def _when_good(calibration: Calibration) -> Iterator[str]:
    wanted = next(iter(calibration.edges))
    arm = ", and the poses of the calibrated arm" if calibration.arm_is_calibrated else ""
    is_read = calibration.mount == "instrument"
    moved = "instrument from a moved probe" if is_read else "camera from a moved board"
    yield f"Use {wanted} as it stands in calibration.json, with its covariance{arm}."
    yield (
        "Keep calibration.json: visioncal diff tells a later calibration's change from noise, and "
        f"a moved {moved}."
    )


def _sentences(reasons: Sequence[str]) -> Iterator[str]:
    for reason in reasons:
        yield from re.split(r"(?<=[.!?])\s+(?=[A-Z])", reason)


def listed(views: Sequence[int]) -> str:
    """Names views in a sentence: `view 3`, or `views 3, 6 and 9`."""
    if len(views) == 1:
        return f"view {views[0]}"
    return f"views {', '.join(map(str, views[:-1]))} and {views[-1]}"
