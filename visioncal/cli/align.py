"""`visioncal align`, another name for `calibrate`, and what that does with a whole cell."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from visioncal.cli.calibrate import calibrate_command
from visioncal.cli.console import answers, messages, naming, report_written
from visioncal.cli.options import WorkOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.number_format import figure
from visioncal.interchange.outputs import write_alignment

# Help does not wait for them.
if TYPE_CHECKING:
    from visioncal.calibration.pipeline.running import Asked
    from visioncal.results import Alignment
    from visioncal.session import Session

# Levels of noise that are nearer to what is said are not mentioned.
_SHOWN_LEVEL = 1.2


align_command = calibrate_command


def align_into(
    path: Path, session: "Session", out: Path, asked: "Asked", work: WorkOptions, *, quiet: bool
) -> "Alignment":
    """Aligns the cell of a session from some path, writes the result and reports it."""
    from visioncal.calibration.pipeline.running import known_at_first, run_steps
    from visioncal.calibration.pipeline.whole import alignment_of
    from visioncal.interchange.merge_results import leftover

    left = leftover(out)
    with naming(path, out), shown_progress(quiet=quiet) as progress:
        known = known_at_first(session, **(asked | {"progress": progress}))
        result = alignment_of(run_steps(known))
    result = replace(result, verdict=result.verdict.with_paths(path, out))
    if left is not None:
        left.keep()
    written = write_alignment(out, session, result, without=work.left_out, images=work.images)
    if not quiet:
        _report(result)
    if left is not None:
        messages().print(escape(left.words))
    report_written(written, quiet=quiet)
    return result


def _report(result: "Alignment") -> None:
    from visioncal.cli.summary import print_verdict, unsaid, unused_words

    console = answers()
    print_verdict(result.verdict, result.session_name)
    console.print(f"the cell's frame is that of {result.reference}")
    for name, edge in result.edges.items():
        x, y, z = 1e3 * edge.transform.translation
        turned = f" and {figure(edge.sigma_deg)} deg" if edge.oriented else ""
        console.print(
            f"{name}: ({x:.2f}, {y:.2f}, {z:.2f}) mm, sigma {figure(edge.sigma_mm)} mm{turned}"
        )
    for name, levels in result.noise.items():
        words = [
            f"{figure(value)} {key.rpartition('_')[2]}"
            for key, value in levels.items()
            if key != "level"
        ]
        level = levels.get("level", 1.0)
        if level > _SHOWN_LEVEL or not words:
            words.append(f"{figure(level)} times what is said of it")
        console.print(f"noise of {name}: {', '.join(words)}")
    for unused in unused_words(unsaid(result.verdict, result.sights)):
        console.print(escape(f"  {unused}"))
    console.print(escape(result.weakest))
