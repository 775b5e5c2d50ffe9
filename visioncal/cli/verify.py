"""`visioncal verify`."""

import json
import sys

import typer
from rich.markup import escape

from visioncal.calibration.verification import (
    facts_of,
    load_policy,
    outcomes,
    to_document,
    verdict_of,
    verify,
)
from visioncal.cli.console import EXIT_BAD, answers, report_written
from visioncal.cli.parsing import named_result
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import VerifyOptions
from visioncal.cli.summary import print_steps
from visioncal.interchange.outputs import Written, refuse_calibration, write_check
from visioncal.interchange.result_files import load_result
from visioncal.results import select_matching
from visioncal.session import Session

# Headings of the policy's triggers by state.
_TRIGGERED = {
    "fired": "[bold yellow]calibrate again[/] because of",
    "quiet": "no reason to calibrate again",
    "unknown": "could not be checked",
}


def verify_command(options: VerifyOptions) -> None:
    """Runs `visioncal verify`."""
    against = named_result(options.against, "--against", "verify: the calibration to check")
    if options.output is not None:
        refuse_calibration(options.output)
    triggers = load_policy(options.policy)
    loaded, calibration = select_matching(
        Session.load(options.session), load_result(against), options.part.choice
    )
    with shown_progress(quiet=options.as_json) as progress:
        check = verify(
            loaded, calibration, board_placed_anew=options.board_moved, progress=progress
        )
    facts = facts_of(loaded, calibration, failed=not check.passed, collision=options.collision)
    fired = outcomes(triggers, facts)
    verdict = verdict_of(check).with_paths(options.session, against, ["visioncal", *sys.argv[1:]])
    document = json.dumps(to_document(check, fired, verdict), indent=2, allow_nan=False) + "\n"
    written = (
        Written(())
        if options.output is None
        else write_check(options.output, check, fired, verdict, document)
    )
    if options.as_json:
        typer.echo(document, nl=False)
    else:
        console = answers()
        word, colour = ("pass", "green") if check.passed else ("fail", "red")
        name = escape(check.predicted.observed.session.name)
        reference = escape(f"{check.calibration.session_name}, {check.calibration.created}")
        console.print(f"[bold {colour}]{word}[/]  {name} against {reference}")
        for line in (*verdict.top, *verdict.rest, *check.predicted.warnings):
            console.print(f"  - {escape(line)}")
        print_steps(verdict.next_steps)
        for view, reason in sorted(check.predicted.observed.reasons.items()):
            console.print(f"  view {view} was not used: {escape(reason)}")
        for state, begin in _TRIGGERED.items():
            words = "; ".join(trigger.words for trigger in fired if trigger.state == state)
            if words:
                console.print(f"{begin}: {escape(words)}")
    report_written(written, quiet=True, status=0 if check.passed else EXIT_BAD)
