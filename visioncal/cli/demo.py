"""`visioncal demo`."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from visioncal.cli.console import EXIT_BAD, answers, exit_status, report_written, say
from visioncal.cli.options import OutFolder, Seed
from visioncal.cli.progress import shown_progress
from visioncal.core.choices import Faults
from visioncal.interchange.outputs import write_outputs
from visioncal.live.drivers.extras import client_library

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.results import Calibration
    from visioncal.simulation import Truth

# False-alarm probability of that test, and factor on the sigmas: errors of one board's corners are
# correlated by hundredths of a pixel, and joints deviate from their encoders, which a covariance of
# independent noise underestimates.
_CHANCE, _SIGMA_FACTOR = 1e-3, 1.5


def demo_command(
    out: OutFolder = Path("demo"),
    views: Annotated[int, typer.Option(min=5, max=200, help="Number of views.")] = 20,
    seed: Seed = 0,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Plan the stops and record them, with a UR's own client library and a simulated "
            "controller.",
        ),
    ] = False,
    fault: Annotated[
        Faults | None,
        typer.Option(
            metavar="FAULT",
            help=f"With --live, let this happen half way: {', '.join(get_args(Faults))}.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Simulate a UR cell, calibrate it from its images, and compare with the truth.

    The camera's intrinsics are not given: they too are estimated from the images. With --live the
    arm has joint offsets and the stops are planned from rough guesses; nothing real moves. Exit
    status 0: the result is as near to the truth as it says; 3: it is not, or its verdict is
    bad.
    """
    from visioncal.calibration.pipeline import run
    from visioncal.cli.summary import print_summary, truth_table
    from visioncal.session import Session
    from visioncal.simulation import CellOptions, read_truth, simulate, truth_path, write_session

    if fault is not None and not live:
        raise typer.BadParameter("--fault belongs to --live.")
    if live:
        client_library("rtde_control", "ur")
    session, result = out / "session", out / "result"
    if truth_path(session).exists():
        # An earlier demonstration's; nothing else is ever removed.
        shutil.rmtree(session, ignore_errors=True)
    if live:
        from visioncal.cli.live_demo import record_simulated

        record_simulated(session, out / "plan", views, seed, fault)
    with shown_progress(quiet=False) as progress:
        if not live:
            cell = simulate(CellOptions(views=views, seed=seed, state_intrinsics=False))
            write_session(
                cell, session, lambda share: progress("render", round(share * views), views)
            )
        loaded = Session.load(session)
        done = run(loaded, progress=progress).with_paths(session, result)
        progress("write", 0, 1)
        written = write_outputs(result, loaded, done)
    print_summary(done.calibration, verbose=True)
    truth = read_truth(session)
    answers().print(truth_table(done.calibration, truth.transforms, truth.camera))
    squared, limit = chi_square(done.calibration, truth)
    verb = "is explained by" if squared <= limit else "is more than"
    answers().print(
        f"the error {verb} the sigmas: chi-square {squared:.1f}, and up to {limit:.0f} is believed"
    )
    for file in (session, truth_path(session)):
        say(f"wrote {file}")
    say(f"Open {result / 'report.html'} in a browser to see it all.")
    agrees = squared <= limit
    report_written(written, status=exit_status(done.calibration.verdict) if agrees else EXIT_BAD)


def chi_square(calibration: "Calibration", truth: "Truth") -> tuple[float, float]:
    """Squared Mahalanobis distance of the errors of both transforms, and the limit of its test."""
    import numpy as np

    from visioncal.core.quantiles import chi2_limit
    from visioncal.core.transforms import invert, log

    errors = [
        log(invert(truth.transforms[name]) @ edge.matrix)
        for name, edge in calibration.edges.items()
    ]
    twists = np.concatenate(errors)
    squared = float(twists @ np.linalg.solve(calibration.joint_covariance, twists))
    return squared, _SIGMA_FACTOR**2 * float(chi2_limit(_CHANCE, twists.size))
