"""The table of readings, for people."""

from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import messages
from visioncal.guess import Candidate, Guess

_LONG_MM = 1000.0


def print_guess(guess: Guess) -> None:
    """Prints the readings, the best first, what was found, and what the views cannot tell."""
    console = messages()
    table = Table("reading", "chain closes to", "", "views that agree", box=None, pad_edge=False)
    for candidate in guess.candidates:
        style = "bold green" if candidate is guess.best else ""
        table.add_row(*map(escape, _cells(candidate)), style=style)
    console.print(table)
    console.print(escape(guess.sentence))
    for note in guess.notes:
        console.print(escape(f"note: {note}"))


def _cells(candidate: Candidate) -> tuple[str, str, str, str]:
    millimetres = candidate.rms_mm
    length = f"{1e-3 * millimetres:.3g} m" if millimetres > _LONG_MM else f"{millimetres:.3g} mm"
    return (
        candidate.words,
        length,
        f"{candidate.rms_deg:.2g} deg",
        f"{candidate.agreeing} of {candidate.rows}",
    )
