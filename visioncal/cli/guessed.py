"""The table of readings, for people."""

from rich.markup import escape
from rich.table import Table

from visioncal.calibration.guess import Guess
from visioncal.cli.console import messages


def print_guess(guess: Guess) -> None:
    """Prints the readings, the best first, what was found, and what the views leave open."""
    console = messages()
    table = Table("reading", "chain closes to", "views that agree", box=None, pad_edge=False)
    for it in guess.candidates:
        cells = (it.words, it.figures, f"{it.agreeing} of {it.rows}")
        table.add_row(*map(escape, cells), style="bold green" if it is guess.best else "")
    console.print(table)
    console.print(escape(guess.sentence))
    for note in guess.notes:
        console.print(escape(f"note: {note}"))
