"""Plots of tools and fixtures."""

from markupsafe import Markup

from visioncal.present.report import bars, svg
from visioncal.present.report.axes import Margins, boxes
from visioncal.present.report.bars import Bar
from visioncal.present.report.svg import Figure
from visioncal.results import Frame, Observation

_WIDTH_IN, _HEIGHT_IN = 5.0, 1.7
# More characters than this below the bars run into each other, so their labels stand upright.
_MOST_CHARACTERS, _LONGEST = 36, 12
_MOST_LABELS = 24
# Mean width of a letter.
_LETTER_IN = 0.068


def frame_plot(name: str, frame: Frame) -> Markup:
    """Bars of what each observation is off; the wrong ones in red."""
    if all(observation.residual_mm is None for observation in frame.observations):
        return Markup("")
    labels = [_short(observation.name) for observation in frame.observations]
    upright = sum(map(len, labels)) > _MOST_CHARACTERS
    shown = [
        Bar(label, observation.residual_mm, observation.used, _colour(observation))
        for label, observation in zip(labels, frame.observations, strict=True)
    ]
    below_in = 0.25 + _LETTER_IN * max(map(len, labels)) if upright else 0.3
    figure = Figure(_WIDTH_IN, _HEIGHT_IN + (0.4 if upright else 0.0))
    ((box,),) = boxes(figure, 1, 1, Margins(0.65, 0.65, below_in))
    bars.draw(figure, box, shown, frame.rms_mm, _MOST_LABELS, titles=("", "off by [mm]"),
              turned=upright)  # fmt: skip
    return figure.inline(f"Bars: what each observation of {name} is off")


def _colour(observation: Observation) -> str:
    if not observation.used:
        return svg.BAD
    return svg.CHECK if observation.reason else svg.ACCENT


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}\N{HORIZONTAL ELLIPSIS}"
