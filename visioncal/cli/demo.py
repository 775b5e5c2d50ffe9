"""`visioncal demo`."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.console import answers, report_written, say
from visioncal.cli.options import OutFolder, Seed
from visioncal.cli.progress import shown_progress
from visioncal.interchange.outputs import write_outputs

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.simulation import CellOptions


def demo_command(
    out: OutFolder = Path("demo"),
    views: Annotated[int, typer.Option(min=3, help="Number of views.")] = 20,
    seed: Seed = 0,
) -> None:
    """Simulate a UR cell, calibrate it from its images, and compare with the truth.

    The camera's intrinsics are not given: they too are estimated from the images.
    """
    from visioncal.calibration.pipeline import run
    from visioncal.cli.summary import print_summary, truth_table
    from visioncal.session import Session
    from visioncal.simulation import CellOptions, read_truth, truth_path

    session, result = out / "session", out / "result"
    options = CellOptions(views=views, seed=seed, state_intrinsics=False)
    with shown_progress(quiet=False) as progress:
        _replace_session(
            options, session, lambda share: progress("render", round(share * views), views)
        )
        loaded = Session.load(session)
        done = run(loaded, progress=progress)
        progress("write", 0, 1)
        written = write_outputs(result, loaded, done)
    print_summary(done.calibration, verbose=True)
    truth = read_truth(session)
    answers().print(truth_table(done.calibration, truth.transforms, truth.camera))
    for file in (session, truth_path(session)):
        say(f"wrote {file}")
    report_written(written)
    say(f"Open {result / 'report.html'} in a browser to see it all.")


def _replace_session(
    options: "CellOptions", folder: Path, progress: Callable[[float], None]
) -> None:
    """Simulates a session in place of an earlier demo's; nothing else is ever removed."""
    from visioncal.simulation import simulate, truth_path, write_session

    if folder.exists() and truth_path(folder).exists():
        shutil.rmtree(folder)
    write_session(simulate(options), folder, progress)
