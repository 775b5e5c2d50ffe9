"""Results as they are summed up for people, and beside the truth of a simulated cell."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from rich.markup import escape
from rich.table import Table

from visioncal.cli.console import answers
from visioncal.core.files import some_of
from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Camera, FloatArray
from visioncal.live.rehearsal.witness import edge_errors
from visioncal.results import Alignment, Calibration, Sight, Step, Verdict, ViewResult

_COLOURS = {"good": "bold green", "check": "bold yellow", "bad": "bold red"}
# Beyond any image, what is predicted is nowhere [px].
_MOST_PX = 1e4
# Levels of noise that are nearer to what is said are not mentioned.
_SHOWN_LEVEL = 1.2
_Seen = TypeVar("_Seen", ViewResult, Sight)
_SAME_REASON = 20  # more views of one reason share a line


def print_verdict(verdict: Verdict, name: str) -> None:
    """Prints whether something can be trusted, and why."""
    console, colour = answers(), _COLOURS[verdict.status]
    console.print(f"[{colour}]{verdict.status}[/]  {escape(name)}")
    for line in verdict.top:
        console.print(f"  - {escape(line)}")
    print_steps(verdict.next_steps)
    if verdict.rest:
        console.print("What else was found:")
    for line in verdict.rest:
        console.print(f"  - {escape(line)}")


def print_steps(steps: Sequence[Step]) -> None:
    """Prints what to do next, each command on a line of its own."""
    console = answers()
    if steps:
        console.print("What to do next:")
    for at, step in enumerate(steps, 1):
        console.print(f"  {at}. {escape(step.words)}")
        if step.command:
            console.print(f"     [bold]{escape(step.command)}[/]")


def print_summary(calibration: Calibration, *, verbose: bool) -> None:
    """Prints a result for people: the verdict first, then the figures it rests on."""
    console, cell = answers(), calibration.cell
    print_verdict(calibration.verdict, calibration.session_name)
    if cell is not None:
        console.print(f"the cell's frame is that of {cell.reference}")
    for name, edge in calibration.edges.items():
        unturned = "" if edge.oriented else ", its rotation not measured"
        console.print(f"{name}: {edge.place_words()}, {edge.sigma_words}{unturned}")
    if cell is not None:
        _print_cell(cell)
        return
    used = sum(view.used for view in calibration.views)
    held = calibration.validation.held_out
    console.print(
        f"{used} of {len(calibration.views)} views used; left out of the fit they are predicted to "
        f"{figure(held.mm)} mm"
        + ("" if held.deg is None else f", {figure(held.deg)} deg")
        + (f", {figure(held.px)} px" if held.px and held.px < _MOST_PX else "")
    )
    for words in unused_words(unsaid(calibration.verdict, calibration.views)):
        console.print(f"  {escape(words)}")
    if verbose:
        console.print(_solver_table(calibration))


def _print_cell(cell: Alignment) -> None:
    """Prints the noise of a whole cell, what was left out, and what is known worst."""
    console = answers()
    for name, levels in cell.noise.items():
        words = [
            f"{figure(value)} {key.rpartition('_')[2]}"
            for key, value in levels.items()
            if key != "level"
        ]
        level = levels.get("level", 1.0)
        if level > _SHOWN_LEVEL or not words:
            words.append(f"{figure(level)} times what is said of it")
        console.print(f"noise of {name}: {', '.join(words)}")
    for unused in unused_words(unsaid(cell.verdict, cell.sights)):
        console.print(escape(f"  {unused}"))
    console.print(escape(cell.weakest))


def unsaid(verdict: Verdict, views: Iterable[_Seen]) -> Iterator[_Seen]:
    """The views about which the verdict does not say already why they were left out."""
    left_out = [it for it in verdict.findings if it.without_it]
    for view in views:
        about = [it for it in left_out if view.view in it.views]
        if not any(it.kind != "wrong_views" or view.reason in it.words for it in about):
            yield view


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


def truth_table(
    calibration: Calibration, transforms: Mapping[str, FloatArray], camera: Camera
) -> Table:
    """Errors against the truth, in millimetres and degrees and in units of the sigma.

    Args:
        calibration: The result.
        transforms: (4, 4) the true edges by name.
        camera: The true lens.
    """
    table = Table("against the truth", "error", "sigma", "error / sigma", box=None)
    for name, it in edge_errors(calibration, transforms).items():
        for error, sigma, unit in ((it.mm, it.sigma_mm, "mm"), (it.deg, it.sigma_deg, "deg")):
            table.add_row(
                name, f"{error:.3f} {unit}", f"{sigma:.3f} {unit}", f"{error / sigma:.2f}"
            )
    if calibration.camera is not None and calibration.camera.covariance is not None:
        sigmas = np.sqrt(np.diag(calibration.camera.covariance))[:4]
        errors = calibration.camera.camera.matrix - camera.matrix
        for name, error, sigma in zip(("fx", "fy", "cx", "cy"), errors, sigmas, strict=True):
            table.add_row(name, f"{error:+.2f} px", f"{sigma:.2f} px", f"{abs(error) / sigma:.2f}")
    return table
