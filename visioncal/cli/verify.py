"""`visioncal verify`."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import EXIT_BAD, answers, report_written
from visioncal.cli.options import AsJson, PartOptions
from visioncal.cli.parsing import named_result
from visioncal.cli.progress import shown_progress
from visioncal.interchange.outputs import REPORT, VERIFY, Written, refuse_calibration, write_check

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.calibration.verification import Check, Outcome
    from visioncal.core.verdict import Verdict

# Headings of the policy's triggers by state.
_TRIGGERED = {
    "fired": "[bold yellow]calibrate again[/] because of",
    "quiet": "no reason to calibrate again",
    "unknown": "could not be checked",
}


def verify_command(
    session: Annotated[
        Path, typer.Argument(help="Five stops or more of the same cell: a folder or an .rrd.")
    ],
    part: PartOptions,
    against: Annotated[
        Path | None,
        typer.Option(help="The calibration: an output folder of calibrate, or its .rrd."),
    ] = None,
    board_moved: Annotated[
        bool, typer.Option("--board-moved", help="The board was put elsewhere on purpose.")
    ] = False,
    collision: Annotated[
        bool, typer.Option("--collision", help="A collision was reported since.")
    ] = False,
    policy: Annotated[
        Path | None, typer.Option(help="Your own table of when to calibrate again (.toml).")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", file_okay=False, help=f"A folder for {REPORT} and {VERIFY}."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check whether a calibration still holds, and what has changed if it does not.

    Exit status 0: it holds; 3: it does not; 2: that cannot be decided, for the reason given.
    """
    from visioncal.calibration.verification import (
        facts_of,
        load_policy,
        outcomes,
        to_document,
        verdict_of,
        verify,
    )
    from visioncal.interchange.result_files import load_result
    from visioncal.results import select_matching
    from visioncal.session import Session

    against = named_result(against, "--against", "verify: the calibration to check")
    if output is not None:
        refuse_calibration(output)
    triggers = load_policy(policy)
    loaded, calibration = select_matching(Session.load(session), load_result(against), part.choice)
    with shown_progress(quiet=as_json) as progress:
        check = verify(loaded, calibration, board_placed_anew=board_moved, progress=progress)
    facts = facts_of(loaded, calibration, failed=not check.passed, collision=collision)
    fired = outcomes(triggers, facts)
    verdict = verdict_of(check).with_paths(session, against, ["visioncal", *sys.argv[1:]])
    document = json.dumps(to_document(check, fired, verdict), indent=2, allow_nan=False) + "\n"
    written = (
        Written(()) if output is None else write_check(output, check, fired, verdict, document)
    )
    if as_json:
        typer.echo(document, nl=False)
    else:
        _report(check, fired, verdict)
    report_written(written, quiet=True, status=0 if check.passed else EXIT_BAD)


def _report(check: "Check", triggers: "Sequence[Outcome]", verdict: "Verdict") -> None:
    from visioncal.cli.summary import print_steps

    console = answers()
    word, colour = ("pass", "green") if check.passed else ("fail", "red")
    name = escape(check.predicted.observed.session.name)
    against = escape(f"{check.calibration.session_name}, {check.calibration.created}")
    console.print(f"[bold {colour}]{word}[/]  {name} against {against}")
    for line in (*verdict.top, *verdict.rest, *check.predicted.warnings):
        console.print(f"  - {escape(line)}")
    print_steps(verdict.next_steps)
    for view, reason in sorted(check.predicted.observed.reasons.items()):
        console.print(f"  view {view} was not used: {escape(reason)}")
    for state, begin in _TRIGGERED.items():
        words = "; ".join(trigger.words for trigger in triggers if trigger.state == state)
        if words:
            console.print(f"{begin}: {escape(words)}")
