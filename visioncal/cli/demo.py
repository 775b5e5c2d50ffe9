"""`visioncal demo`; with `--live` it drives a simulated cell by the real client library."""

import shutil
from contextlib import ExitStack, closing, suppress
from importlib.metadata import version
from pathlib import Path

import numpy as np
import typer

from visioncal.calibration.run import run
from visioncal.cli.console import EXIT_BAD, answer, exit_status, print_table, report_written, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.record import check_all, record_driven, say_line
from visioncal.cli.recover import recover_command
from visioncal.cli.result_options import RecoverOptions
from visioncal.cli.session_options import DemoOptions
from visioncal.cli.summary import print_summary, truth_rows
from visioncal.core.extras import client_library
from visioncal.core.quantiles import chi2_limit
from visioncal.core.threads import signals_as_interrupts
from visioncal.core.transforms import invert, log, pose_difference
from visioncal.interchange.outputs import write_outputs, write_plan
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import CaptureFacts, Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.recording import CaptureEvent
from visioncal.live.simulated.cell import Bench
from visioncal.planning.messages import summary_of
from visioncal.planning.plan import PlanRequest, make_plan
from visioncal.planning.plan_file import PlanFile, plan_document, read_plan
from visioncal.planning.purposes import purpose_of
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import CellOptions, Truth, read_truth, simulate, truth_path, write_session
from visioncal.simulation.arms import arm_named, forward
from visioncal.simulation.records import truth_of, write_truth

# The default speed of a UR's program; nobody stands beside this one.
_TAKING = CaptureOptions(speed=1.05, acceleration=1.4)
# A rehearsed slip of an encoder: of the elbow, by a tooth of its gear.
_SLIPPED, _SLIP_DEG = 2, 0.4


def _record(options: DemoOptions, session: Path) -> None:
    """Plans stops from rough poses and records them, with the truth beside the new session."""
    bench, folder = Bench(options.seed), options.out / "plan"
    folder.parent.mkdir(parents=True, exist_ok=True)
    # From the begin, so that the next demonstration replaces one that was interrupted.
    write_truth(session, truth_of(bench.truth))
    # Fewer candidates than for a real plan, as a demonstration should be short.
    request = PlanRequest(purpose_of("hand-eye"), options.views, candidates=600, seed=options.seed)
    with shown_progress(quiet=False) as progress:
        plan = make_plan(bench.known, request, progress=progress)
        written = write_plan(folder, plan, plan_document(plan, {"kind": "demo"}))
    report_written(written, quiet=True)
    say(f"plan: {summary_of(plan)}")
    # Read back, as a recording does.
    _drive(bench, read_plan(folder), session)


def _drive(bench: Bench, planned: PlanFile, session: Path) -> None:
    """Drives a simulated arm to planned stops, and records them."""
    # The arm begins so near to the first stop, as if guided there by hand [rad].
    bench.start(planned.stops[0].q + 2e-3)
    with closing(bench):
        host = bench.controller.host
        say(f"simulated controller at {host}, driven by ur-rtde {version('ur-rtde')}")

        def watch(step: CaptureEvent) -> None:
            say_line(step)
            bench.note(step)

        with ExitStack() as opened, signals_as_interrupts():
            cell = opened.enter_context(bench.connected())
            facts = CaptureFacts.of(cell, session.name, planned.cell, planned)
            journal = Journal.begin(session, facts, cell.clock.unix_offset_s(), len(planned.stops))
            steps = record_driven(cell, planned, journal, _TAKING, Consent(None), watch)
            check_all(journal, steps)
    flange = np.array([state.base_from_flange[0] for _, state in bench.views])
    x, z = bench.truth.transforms.values()
    poses = {"base_from_flange": flange, "cam_from_target": invert(flange @ x) @ z}
    write_truth(session, truth_of(bench.truth) | poses)
    q = np.array([view.state.q for view, _ in bench.views])
    recorded = forward(bench.truth.robot.true_arm, q)
    away_mm = max(pose_difference(*pair)[0] for pair in zip(recorded, flange, strict=True))
    say(f"where views were taken the flange was within {1e3 * away_mm:.0f} um of what was recorded")


def demo_command(options: DemoOptions) -> None:
    """Runs `visioncal demo`."""
    if options.live:
        client_library("rtde_control", "ur")
    session, result = options.out / "session", options.out / "result"
    if truth_path(session).exists():
        # An earlier demonstration's; nothing else is ever removed.
        shutil.rmtree(session, ignore_errors=True)
    if options.live:
        _record(options, session)
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
    print_summary(done.calibration, done.evidence, verbose=True)
    truth = read_truth(session)
    rows = truth_rows(done.calibration, truth.transforms, truth.camera)
    print_table(("against the truth", "error", "sigma", "error / sigma"), rows)
    squared, limit = chi_square(done.calibration, truth)
    verb = "is explained by" if squared <= limit else "is more than"
    answer(
        f"the error {verb} the sigmas: chi-square {squared:.1f}, and up to {limit:.0f} is expected"
    )
    for file in (session, truth_path(session)):
        say(f"wrote {file}")
    say(f"Open {result / 'report.html'} in a browser to see it all.")
    agrees = squared <= limit
    report_written(written, status=exit_status(done.calibration.verdict) if agrees else EXIT_BAD)
    if options.fault is None:
        return
    # A joint's encoder slips, and the calibration is recovered as a user does.
    folder = options.out / "recovery"
    shutil.rmtree(folder, ignore_errors=True)
    answer(f"the encoder of joint {_SLIPPED + 1} slips by {_SLIP_DEG:g} deg")
    recover_options = RecoverOptions(folder=folder, against=result)
    # Ends where the stops are to be recorded.
    with suppress(typer.Exit):
        recover_command(recover_options)
    slip_rad = np.zeros(len(arm_named("ur5e").offset))
    slip_rad[_SLIPPED] = np.deg2rad(_SLIP_DEG)
    bench = Bench(options.seed, tuple(slip_rad.tolist()))
    _drive(bench, read_plan(folder / "plan"), folder / "stops")
    recover_command(recover_options)


def chi_square(calibration: Calibration, truth: Truth) -> tuple[float, float]:
    """Squared Mahalanobis distance of the errors of both transforms, and the limit of its test."""
    edges = calibration.edges.items()
    twists = np.concatenate([log(invert(truth.transforms[name]) @ at.matrix) for name, at in edges])
    squared = float(twists @ np.linalg.solve(calibration.joint_covariance, twists))
    # Errors of one board's corners are correlated by hundredths of a pixel, and joints deviate from
    # their encoders: a covariance of independent noise underestimates by up to 1.5.
    return squared, 1.5**2 * float(chi2_limit(1e-3, twists.size))
