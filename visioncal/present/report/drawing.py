"""Single figures of the report, for notebooks."""

from dataclasses import dataclass
from pathlib import Path

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.present.report import plots
from visioncal.results import Calibration

FIGURES = ("residuals", "budget", "directions")
# Colours that the report's page defines, for a figure on its own.
_COLOURS = (
    "--ink:#1c2733;--muted:#5c6b7a;--line:#cfd6dd;--accent:#1f6fb2;--good:#2e7d32;--bad:#c62828;"
    "--check:#b26a00;--card:#ffffff;background:#fff"
)


@dataclass(frozen=True)
class Drawing:
    """A figure of the report."""

    name: str  # What it shows.
    markup: str  # Markup to embed in pages.

    def __repr__(self) -> str:
        return f"Drawing of {self.name}; save it as .svg, or show it in a notebook"

    def _repr_html_(self) -> str:
        return f'<div style="{_COLOURS};max-width:52em">{self.markup}</div>'

    @typed
    def save(self, path: Path | str) -> None:
        """Writes the figure as an .svg file, whole or not at all."""
        opening = f'<svg style="{_COLOURS};font-family:sans-serif"'
        write_atomically(Path(path), self.markup.replace("<svg", opening, 1))


def draw(calibration: Calibration, what: str) -> Drawing:
    """Draws one figure of a calibration's report; see `Calibration.plot`."""
    budget = calibration.budget
    markup = ""
    if what == "residuals":
        markup = str(plots.residuals(calibration))
    elif what in FIGURES and budget is not None:
        markup = str((plots.budget if what == "budget" else plots.directions)(budget))
    if not markup:
        raise DataError(
            f"There is no figure {what!r} of this calibration.",
            culprits=[what],
            next_step=f"The figures are {', '.join(FIGURES)}; the last two need a budget.",
        )
    return Drawing(what, markup)
