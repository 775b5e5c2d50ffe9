"""`visioncal verify`."""

import json
import sys

import typer

from visioncal.cli.console import EXIT_BAD, answer, report_written, with_run_paths
from visioncal.cli.history import enter
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import VerifyOptions
from visioncal.cli.summary import print_steps
from visioncal.interchange.outputs import (
    Written,
    refuse_calibration,
    write_check,
    write_performance,
)
from visioncal.interchange.result_files import load_result
from visioncal.results import select_matching
from visioncal.results.history import entry_of_check
from visioncal.session import Session
from visioncal.verification import to_document, triggers_of, verdict_of, verify
from visioncal.verification.triggers import LIMITS

# Headings of the triggers by state, with their styles.
_TRIGGERED = {
    "fired": ("calibrate again because of: ", "bold yellow"),
    "quiet": ("no reason to calibrate again; looked for: ", ""),
    "unknown": ("could not be checked: ", ""),
}


def verify_command(options: VerifyOptions) -> None:
    """Runs `visioncal verify`."""
    against = options.against
    if options.page:
        # NiceGUI comes with an extra.
        from visioncal.cli.page import verify_on_page

        verify_on_page(options)
        return
    if options.standard is not None:
        _verify_performance(options)
        return
    if options.output is not None:
        refuse_calibration(options.output)
    loaded, calibration = select_matching(
        Session.load(options.session), load_result(against), options
    )
    with (
        shown_progress(quiet=options.as_json) as progress,
        with_run_paths(options.session, against),
    ):
        check = verify(
            loaded, calibration, board_placed_anew=options.board_moved, progress=progress
        )
    triggers = triggers_of(
        loaded,
        calibration,
        failed=not check.passed,
        collision=options.collision,
        limits={
            "ambient_change_k": options.most_kelvin,
            "payload_change_kg": options.most_kg,
            "age_days": options.most_days,
        },
    )
    verdict = verdict_of(check).with_paths(options.session, against, ["visioncal", *sys.argv[1:]])
    content = to_document(check, triggers, verdict)
    document = json.dumps(content, indent=2, allow_nan=False) + "\n"
    written = (
        Written(())
        if options.output is None
        else write_check(options.output, check, triggers, verdict, document)
    )
    enter(options, options.session, [entry_of_check(content)], options.output or "")
    if options.as_json:
        typer.echo(document, nl=False)
    else:
        word, colour = ("pass", "green") if check.passed else ("fail", "red")
        name, against_result = check.predicted.observed.session.name, check.calibration
        reference = f"{against_result.session_name}, {against_result.created}"
        answer(f"  {name} against {reference}", word, f"bold {colour}")
        for line in (*verdict.top, *verdict.rest, *check.predicted.warnings):
            answer(f"  - {line}")
        print_steps(verdict.next_steps)
        for view, reason in sorted(check.predicted.observed.reasons.items()):
            answer(f"  view {view} was not used: {reason}")
        # An unknown one names its column, which nobody misses who never had it.
        had = {*calibration.means}.union(*(view.numbers for view in loaded.views))
        for state, (begin, style) in _TRIGGERED.items():
            words = "; ".join(
                trigger.words
                for trigger in triggers
                if trigger.state == state
                and (state != "unknown" or LIMITS[trigger.quantity][3] in had)
            )
            if words:
                answer(words, begin, style)
    report_written(written, quiet=True, status=0 if check.passed else EXIT_BAD)


def _verify_performance(options: VerifyOptions) -> None:
    """Measures the arm's performance by ISO 9283; without a need it neither passes nor fails."""
    # Few checks are by the standard.
    from visioncal.verification.iso9283 import performance

    loaded, calibration = select_matching(
        Session.load(options.session), load_result(options.against), options
    )
    with shown_progress(quiet=options.as_json):
        tested = performance(loaded, calibration)
    if options.as_json:
        typer.echo(json.dumps(tested.document(), indent=2))
    else:
        for line in tested.sentences():
            answer(line)
    if options.output is not None:
        written = write_performance(options.output, tested, loaded.name, calibration.session_name)
        report_written(written, quiet=options.as_json)
