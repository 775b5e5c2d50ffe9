"""`visioncal show`."""

import shlex
import webbrowser
from contextlib import suppress
from pathlib import Path

import typer

from visioncal.cli.console import say
from visioncal.cli.result_options import ShowOptions
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import check_own, read_text
from visioncal.core.number_format import some_of
from visioncal.core.parsing import refuse_given
from visioncal.interchange.outputs import PERFORMANCE, PREVIEW, RECORDING
from visioncal.interchange.result_files import load_result, load_stored
from visioncal.results.views import worst_view


def show_command(options: ShowOptions) -> None:
    """Runs `visioncal show`."""
    if not options.viewer:
        from visioncal.present.report.page import write_certificate, write_report

        stored = load_stored(options.result)
        if options.certificate:
            folder = options.result if options.result.is_dir() else options.result.parent
            out = options.out or folder / "certificate.html"
            check_own(out)
            signed = {"operator": options.operator} if options.operator else {}
            signed |= dict(options.serial or ())
            measured = folder / PERFORMANCE
            tested = parse_stored(read_text(measured), str(measured)) if measured.exists() else None
            write_certificate(out, stored.calibration, stored.session, signed, tested)
        else:
            out = options.out or Path("report.html")
            check_own(out)
            write_report(
                out, stored.calibration, stored.session, stored.evidence, stored.note, stored.review
            )
            # A cell's page shows nothing that a recording adds.
            if stored.note and stored.calibration.cell is None:
                say(stored.note)
        say(f"wrote {out}")
        return
    if options.web and options.view is not None:
        raise typer.BadParameter("--view goes without --web: a browser opens at the first view.")
    refuse_given({"--out": options.out}, "--viewer writes no page", "Leave it out.")
    file = find_recording(options.result)
    # Imported late, so that --help stays fast.
    from visioncal.present.viewer import review_native, review_web

    if not options.web:
        review_native(file, _row(file, options.view))
        return

    def opened(url: str) -> None:
        say("Ctrl-C ends.")
        typer.echo(url)
        if not webbrowser.open(url):
            say("No browser could be opened; visit the address above.")

    review_web(file, opened)


def _row(file: Path, view: int | None) -> int | None:
    """Index of the view at which a recording is opened; None for the first."""
    from visioncal.session import Session

    if view is None:
        # A plan and an uncalibrated session have no worst view.
        with suppress(DataError):
            result = load_result(file)
            view = worst_view(result.views, result.rms)
        if view is None:
            return None
    numbers = [other.number for other in Session.load(file).views]
    if view not in numbers:
        raise DataError(
            f"{file} has no view {view}; it has {some_of([*map(str, numbers)])}.",
            culprits=["--view"],
        )
    return numbers.index(view)


def find_recording(path: Path) -> Path:
    """Path of a recording: an `.rrd`, or the recording.rrd, else plan.rrd, in a folder.

    Raises:
        DataError: There is none, or it is something else, such as a session's folder.
    """
    file = path / RECORDING if path.is_dir() else path
    if path.is_dir() and not file.is_file() and (path / PREVIEW).is_file():
        file = path / PREVIEW
    if path.is_dir() and not file.is_file():
        is_session = (path / "session.toml").is_file()
        raise DataError(
            f"{path} is a session, which has no recording yet."
            if is_session
            else f"{path} holds no {RECORDING}.",
            culprits=[str(path)],
            next_step="Calibrate first: visioncal calibrate "
            f"{shlex.quote(str(path)) if is_session else 'SESSION'} -o OUT; then visioncal show "
            "OUT --viewer.",
        )
    # Imported late, so that --help stays fast.
    from visioncal.present.recording.rrd_messages import scan

    scan(file)
    return file
