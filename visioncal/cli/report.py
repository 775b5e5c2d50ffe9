"""`visioncal report`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from visioncal.cli.console import messages
from visioncal.interchange.result_files import load_stored


def report_command(
    calibration: Annotated[
        Path,
        typer.Argument(
            help="An output folder, its calibration.json or alignment.json, or a recording (.rrd)."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file to write.")] = Path(
        "report.html"
    ),
) -> None:
    """Make the report of an earlier calibration again.

    Pictures, coverage and joint angles come from the recording.rrd beside a calibration.json;
    where it is missing or belongs to another result, the report says so.
    """
    # Plots take half a second to import, which help need not wait for.
    from visioncal.present.report import write_report

    stored = load_stored(calibration)
    if stored.calibration.cell is not None:
        from visioncal.present.report.cells import write_cell_report

        write_cell_report(out, stored.calibration.cell)
        messages().print(f"wrote {escape(str(out))}")
        return
    write_report(out, stored.calibration, stored.session, stored.evidence, stored.note)
    if stored.note:
        messages().print(escape(stored.note))
    messages().print(f"wrote {escape(str(out))}")
