"""`visioncal demo`."""

import shutil

import numpy as np
import typer

from visioncal.calibration.pipeline import run
from visioncal.cli.console import EXIT_BAD, answers, exit_status, report_written, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import DemoOptions
from visioncal.cli.summary import print_summary, truth_table
from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert, log
from visioncal.interchange.outputs import write_outputs
from visioncal.live.drivers.extras import client_library
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import CellOptions, Truth, read_truth, simulate, truth_path, write_session

# False-alarm probability of that test, and factor on the sigmas: errors of one board's corners are
# correlated by hundredths of a pixel, and joints deviate from their encoders, which a covariance of
# independent noise underestimates.
_CHANCE, _SIGMA_FACTOR = 1e-3, 1.5


def demo_command(options: DemoOptions) -> None:
    """Runs `visioncal demo`."""
    if options.fault is not None and not options.live:
        raise typer.BadParameter("--fault belongs to --live.")
    if options.live:
        client_library("rtde_control", "ur")
    session, result = options.out / "session", options.out / "result"
    if truth_path(session).exists():
        # An earlier demonstration's; nothing else is ever removed.
        shutil.rmtree(session, ignore_errors=True)
    if options.live:
        from visioncal.cli.live_demo import record_simulated

        record_simulated(session, options.out / "plan", options.views, options.seed, options.fault)
    with shown_progress(quiet=False) as progress:
        if not options.live:
            cell = simulate(
                CellOptions(views=options.views, seed=options.seed, state_intrinsics=False)
            )
            write_session(
                cell,
                session,
                lambda share: progress("render", round(share * options.views), options.views),
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


def chi_square(calibration: Calibration, truth: Truth) -> tuple[float, float]:
    """Squared Mahalanobis distance of the errors of both transforms, and the limit of its test."""
    errors = [
        log(invert(truth.transforms[name]) @ edge.matrix)
        for name, edge in calibration.edges.items()
    ]
    twists = np.concatenate(errors)
    squared = float(twists @ np.linalg.solve(calibration.joint_covariance, twists))
    return squared, _SIGMA_FACTOR**2 * float(chi2_limit(_CHANCE, twists.size))
