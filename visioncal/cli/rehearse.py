"""`visioncal rehearse`."""

import shlex
import shutil
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from visioncal.cli.console import print_json, report_written, say
from visioncal.cli.options import AsJson, OutFolder, Seed, View
from visioncal.core.choices import CameraMount, Faults
from visioncal.core.errors import DataError, DriverError
from visioncal.core.files import write_json
from visioncal.core.version import __version__
from visioncal.live.drivers.extras import refuse_without

# Exit status of a failed check: the error is larger than the sigmas explain.
EXIT_WRONG = 3
_SUMMARY = "rehearsal.json"


def rehearse_command(
    out: OutFolder = Path("rehearsal"),
    robot: Annotated[
        Literal["ur3e", "ur5e", "ur10e"], typer.Option(help="The simulated arm.")
    ] = "ur5e",
    mount: Annotated[CameraMount, typer.Option(help="Where the camera is.")] = "eye-in-hand",
    views: Annotated[int, typer.Option(min=5, max=200, help="Number of planned stops.")] = 16,
    seed: Seed = 0,
    fault: Annotated[
        Faults | None,
        typer.Option(
            metavar="FAULT",
            help=f"Let this happen half way: {', '.join(get_args(Faults))}.",
            show_default=False,
        ),
    ] = None,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Plan, record and calibrate a simulated cell by the real client libraries.

    The controller is a process on this machine that speaks a UR's protocols, with an arm that is
    not quite as it should be; the camera draws what that arm sees. Nothing real moves. Exit status
    0: the result is as near to the truth as it says; 3: it is not.
    """
    from visioncal.cli.rehearsal import rehearse
    from visioncal.live.rehearsal.cell import RehearsalOptions

    # Without depthai, pictures come straight from the simulated camera.
    refuse_without("ur", {"ur": "rtde_control", "oak": "depthai"})
    _make_place(out)
    try:
        whole = rehearse(RehearsalOptions(robot, mount, views, seed), out, fault, view=view)
    except DriverError as error:
        if "Ctrl-C" not in error.culprits:
            raise
        again = "A rehearsal begins anew: repeat the command."
        raise DriverError(error.message, culprits=error.culprits, next_step=again) from error
    document = whole.document()
    write_json(out / _SUMMARY, document)
    if as_json:
        print_json(document)
    else:
        whole.report()
    say(f"wrote {out / _SUMMARY}; look: visioncal review {shlex.quote(str(out / 'result'))}")
    report_written(whole.written, quiet=True, status=0 if whole.error.passed else EXIT_WRONG)


def _make_place(out: Path) -> None:
    """Clears an earlier rehearsal; nothing else is ever removed."""
    mark, session = out / _SUMMARY, out / "session"
    if session.exists():
        if not mark.is_file():
            raise DataError(
                f"{session} is not of a rehearsal.",
                culprits=[str(session)],
                next_step="Choose another folder with -o.",
            )
        shutil.rmtree(session)
    out.mkdir(parents=True, exist_ok=True)
    # A placeholder until the end: an interrupted rehearsal is replaced by the next.
    write_json(mark, {"schema": 1, "visioncal": __version__})
