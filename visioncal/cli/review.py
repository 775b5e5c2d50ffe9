"""`visioncal review`."""

import shlex
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.console import say
from visioncal.core.errors import DataError
from visioncal.core.files import absence
from visioncal.core.number_format import some_of
from visioncal.interchange.outputs import PREVIEW, RECORDING

# The first bytes of every rerun recording.
_MAGIC = b"RRF2"


def review_command(
    recording: Annotated[
        Path,
        typer.Argument(help="A recording.rrd, a plan.rrd, or the folder that one was written to."),
    ],
    web: Annotated[
        bool, typer.Option("--web", help="Show it in a browser instead of a window.")
    ] = False,
    view: Annotated[
        int | None,
        typer.Option(
            help="The number of the view to open the window at. Default: the worst; in a browser "
            "the first."
        ),
    ] = None,
) -> None:
    """Open a recording in the rerun viewer, on this machine alone.

    With --web the page's URL goes to stdout, and only this machine can reach it. Ctrl-C ends.
    """
    if web and view is not None:
        raise typer.BadParameter("--view goes without --web: a browser opens at the first view.")
    file = find_recording(recording)
    # Imported late, so that --help stays fast.
    from visioncal.present.viewer import review_native, review_web

    if not web:
        review_native(file, _row(file, view))
        return

    def opened(url: str) -> None:
        say("Ctrl-C ends.")
        typer.echo(url)
        if not webbrowser.open(url):
            say("No browser could be opened; visit the address above.")

    review_web(file, opened)


def _row(file: Path, view: int | None) -> int | None:
    """Index of the view at which a recording is opened; None for the first."""
    from visioncal.interchange.result_files import load_result
    from visioncal.present.recording import read_session
    from visioncal.results.views import worst_view

    if view is None:
        # A plan and an uncalibrated session have no worst view.
        with suppress(DataError):
            result = load_result(file)
            view = worst_view(result.views, result.rms)
        if view is None:
            return None
    numbers = [other.number for other in read_session(file).views]
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
            f"{shlex.quote(str(path)) if is_session else 'SESSION'} -o OUT; then visioncal review "
            "OUT.",
        )
    why_not = absence(file)
    if why_not:
        raise DataError(f"{file} {why_not}.", culprits=[str(file)])
    try:
        with file.open("rb") as stream:
            magic = stream.read(len(_MAGIC))
    except OSError as error:
        raise DataError(
            f"{file} cannot be read: {error.strerror or error}.", culprits=[str(file)]
        ) from error
    if magic != _MAGIC:
        raise DataError(
            f"{file} is no recording: its first bytes are not those of an .rrd.",
            culprits=[str(file)],
            next_step=f"Give the {RECORDING} that visioncal calibrate wrote.",
        )
    return file
