"""A recording in words: a line a view."""

from visioncal.core.number_format import figure
from visioncal.live.capture.core import Step
from visioncal.live.capture.take import Missed
from visioncal.live.planning.accuracy import Accuracy
from visioncal.live.planning.messages import accuracy_words


def line_of(step: Step) -> str:
    """Says what became of a view: `[3/30] view 2: 54 corners, ...; coverage 45 % -> next: ...`."""
    found, place = step.found, f"[{step.place}{f'/{step.count}' if step.count else ''}]"
    onward = f" -> next: {step.advice}" if step.advice else ""
    if isinstance(found, Missed):
        return f"{place} view {step.view}: not taken: {found.reason}{onward}"
    return (
        f"{place} view {step.view}: {len(found.corners.ids)} corners, edges "
        f"{found.corners.blur_px:.1f} px, {found.motion_px:.2f} px still; {step.covered}"
        f"{_accuracy(step.accuracy)}{onward}"
    )


def note_of(step: Step) -> str:
    """The same in Markdown, for the viewer."""
    sigma = "" if step.accuracy is None else f"\n\nPredicted sigma: {accuracy_words(step.accuracy)}"
    return f"**View {step.view}**\n\n{step.covered}{sigma}\n\nNext: {step.advice or 'anything new'}"


def _accuracy(found: Accuracy | None) -> str:
    if found is None:
        return ""
    if found.is_open:
        return "; predicted sigma: not determined yet"
    return f"; predicted sigma {figure(found.mm)} mm"
