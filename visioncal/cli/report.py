"""`visioncal report`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import EXIT_BAD, answers, say
from visioncal.cli.parsing import refuse_given
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.interchange.result_files import Stored


def report_command(
    calibration: Annotated[
        Path,
        typer.Argument(help="An output folder, its calibration.json, or a recording (.rrd)."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="The file; report.html or certificate.html otherwise."),
    ] = None,
    certificate: Annotated[
        bool, typer.Option("--certificate", help="One page to print and sign, instead.")
    ] = False,
    operator: Annotated[str, typer.Option(help="With --certificate: who calibrated.")] = "",
    serial: Annotated[
        list[str] | None,
        typer.Option(metavar="WHAT=NUMBER", help="With --certificate, as camera=1234."),
    ] = None,
    recompute: Annotated[
        bool,
        typer.Option(
            "--recompute", help="Calibrate the recording again: does it give the same numbers?"
        ),
    ] = False,
) -> None:
    """Make the report of an earlier calibration again, or its certificate.

    Pictures, coverage and joint angles come from the recording.rrd beside a calibration.json;
    where it is missing or belongs to another result, the report says so. Exit status of
    --recompute, which writes nothing: 0, the same numbers; 3, others.
    """
    from visioncal.interchange.result_files import load_stored

    if not certificate:
        refuse_given(
            {"--operator": operator or None, "--serial": serial},
            "they are for --certificate",
            "Give that, too, or leave it out.",
        )
    # Imported late, so that --help stays fast.
    from visioncal.present.report import write_report

    stored = load_stored(calibration)
    if recompute:
        _recompute(stored)
        return
    if certificate:
        from visioncal.present.report.certificate import CertificateEntries, write_certificate

        page = out or Path("certificate.html")
        signed = CertificateEntries(operator, dict(map(_pair, serial or ())))
        write_certificate(page, stored.calibration, stored.session, signed)
        say(f"wrote {page}")
        return
    out = out or Path("report.html")
    write_report(
        out, stored.calibration, stored.session, stored.evidence, stored.note, stored.review
    )
    # A cell's page shows nothing that a recording adds.
    if stored.note and stored.calibration.cell is None:
        say(stored.note)
    say(f"wrote {out}")


def _recompute(stored: "Stored") -> None:
    """Calibrates the recording again, and exits with the outcome."""
    from visioncal.calibration.verification.recompute import recompute

    if stored.session is None:
        raise DataError(
            stored.note,
            culprits=["--recompute"],
            next_step="Name an output folder of visioncal calibrate, with its recording.rrd.",
        )
    with shown_progress(quiet=False) as progress:
        comparison = recompute(stored.calibration, stored.session, progress=progress)
    answers().print(escape(comparison.words))
    if not comparison.is_same:
        raise typer.Exit(EXIT_BAD)


def _pair(text: str) -> tuple[str, str]:
    what, sign, number = text.partition("=")
    if not sign or not what:
        raise DataError(
            f"--serial is {text!r}; what it is of and the number are needed, as camera=1234.",
            culprits=["--serial"],
        )
    return what, number
