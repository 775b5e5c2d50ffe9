"""What the commands share: messages to stderr, results to stdout, progress between."""

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from visioncal.core.errors import VisioncalError
from visioncal.core.files import some_of
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Progress as Identifiability
from visioncal.interchange.outputs import Written
from visioncal.results import Calibration, Sight, Verdict, ViewResult

# 0: a result, with a verdict; 1: a bug of ours; 2: the input cannot give a result; 3: a check said
# no (verify).
_EXIT_BUG, EXIT_NO_RESULT = 1, 2
_COLOURS = {"good": "bold green", "check": "bold yellow", "bad": "bold red"}
_LISTED_CULPRITS = 10
_SAME_REASON = 20  # more views of one reason share a line
_SHORT = 12  # culprits of fewer letters share a line


def messages() -> Console:
    """The console for messages: stderr."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def shown_progress(quiet: bool) -> Iterator[Identifiability]:
    """Shows a bar of the stage at work, where somebody looks at a terminal."""
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    console = messages()
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as bar:
        task = bar.add_task("", total=None)

        def told(stage: str, done: int, total: int) -> None:
            bar.update(task, description=stage, completed=done, total=total)

        yield told


def report_error(error: VisioncalError, *, as_json: bool) -> None:
    """Prints an error: one message to stderr, or a JSON object to stdout."""
    if as_json:
        document = {
            "class": type(error).__name__,
            "message": error.message,
            "culprits": list(error.culprits),
            "next": error.next_step,
        }
        typer.echo(json.dumps({"error": document}, indent=2))
        return
    console = messages()
    console.print(f"[bold red]error:[/] {escape(error.message)}")
    unsaid = [it for it in error.culprits if it not in error.message]
    if all(len(it) < _SHORT for it in unsaid):
        unsaid = [", ".join(unsaid)] if unsaid else []
    for culprit in unsaid[:_LISTED_CULPRITS]:
        console.print(f"  - {escape(culprit)}")
    if len(unsaid) > _LISTED_CULPRITS:
        console.print(f"  - and {len(unsaid) - _LISTED_CULPRITS} more")
    if error.next_step:
        console.print(escape(error.next_step))


def print_verdict(verdict: Verdict, name: str) -> None:
    """Prints whether something can be trusted, and why."""
    console, colour = messages(), _COLOURS[verdict.status]
    console.print(f"[{colour}]{verdict.status}[/]  {escape(name)}")
    for line in verdict.lines:
        console.print(f"  - {escape(line)}")


def print_summary(calibration: Calibration, *, verbose: bool) -> None:
    """Prints a result for people: the verdict first, then the figures it rests on."""
    console = messages()
    print_verdict(calibration.verdict, calibration.session_name)
    for name, edge in calibration.edges.items():
        x, y, z = 1e3 * edge.transform.translation
        console.print(
            f"{name}: ({x:.2f}, {y:.2f}, {z:.2f}) mm, sigma {edge.sigma_mm:.2g} mm"
            + (f" and {edge.sigma_deg:.2g} deg" if edge.oriented else ", its rotation not measured")
        )
    used = sum(view.used for view in calibration.views)
    held = calibration.validation.held_out
    console.print(
        f"{used} of {len(calibration.views)} views used; left out of the fit they are predicted to "
        f"{held.mm:.2g} mm"
        + ("" if held.deg is None else f", {held.deg:.2g} deg")
        + (f", {held.px:.2g} px" if held.px else "")
    )
    for words in unused_words(calibration.views):
        console.print(f"  {escape(words)}")
    if verbose:
        console.print(_solver_table(calibration))


def tell_written(written: Written, *, quiet: bool = False, status: int = 0) -> None:
    """Says which files were written, and ends the command where there is more to say than that.

    Args:
        written: The files.
        quiet: Whether to say only what is missing.
        status: The exit status of the command's answer. Where that is 0, a file that could not be
            drawn makes it 1.

    Raises:
        typer.Exit: The status is not 0.
    """
    console = messages()
    for file in () if quiet else written.files:
        console.print(escape(f"wrote {file}"))
    for it in written.undrawn:
        console.print(
            f"[bold red]bug:[/] {escape(f'{it.file} could not be drawn ({it.cause}).')}\n"
            f"The result is safe in {escape(str(written.files[0]))}. Please report this, with the "
            "session if it can be given away."
        )
    if status or written.undrawn:
        raise typer.Exit(status or _EXIT_BUG)


def unused_words(views: Iterable[ViewResult | Sight]) -> Iterator[str]:
    """The views that are not used, each with its reason; many of one reason in one line."""
    found: dict[tuple[str, str], list[int]] = defaultdict(list)
    for it in views:
        of = f" ({it.seer} of {it.seen})" if isinstance(it, Sight) else ""
        if not it.used:
            found[of, it.reason].append(it.view)
    for (of, reason), mine in found.items():
        if len(mine) > _SAME_REASON:
            yield f"{len(mine)} views ({some_of([*map(str, mine)], 3)}){of}: {reason}"
        else:
            yield from (f"view {view}{of}: {reason}" for view in mine)


def _solver_table(calibration: Calibration) -> Table:
    differences = [f"{name} differs by" for name in calibration.edges]
    table = Table("solver", "rms, mm", "rms, deg", *differences, box=None)
    for name, result in calibration.solvers.items():
        away = [
            pose_difference(edge.transform.as_matrix(), result.transforms[it].as_matrix())
            for it, edge in calibration.edges.items()
        ]
        cells = [f"{mm:.3f} mm, {deg:.4f} deg" for mm, deg in away]
        deg = "" if result.rms_deg is None else f"{result.rms_deg:.4f}"
        table.add_row(name, f"{result.rms_mm:.3f}", deg, *cells)
    return table
