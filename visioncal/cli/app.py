"""The application: its commands, and how their ends become exit statuses."""

import sys
from errno import ENAMETOOLONG
from typing import Annotated

import typer

from visioncal.cli.align import align_command
from visioncal.cli.calibrate import calibrate_command
from visioncal.cli.console import EXIT_NO_RESULT, report_error
from visioncal.cli.convert import convert_command
from visioncal.cli.correct import correct_command
from visioncal.cli.demo import demo_command
from visioncal.cli.diff import diff_command
from visioncal.cli.dynamics import dynamics_app
from visioncal.cli.export import export_command
from visioncal.cli.fixture import fixture_command
from visioncal.cli.locate import locate_command
from visioncal.cli.plan import plan_command
from visioncal.cli.record import record_command
from visioncal.cli.rehearse import rehearse_command
from visioncal.cli.report import report_command
from visioncal.cli.review import review_command
from visioncal.cli.simulate import simulate_command
from visioncal.cli.streams import guarded_streams
from visioncal.cli.target import target_app
from visioncal.cli.tcp import tcp_command
from visioncal.cli.verify import verify_command
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.version import __version__

app = typer.Typer(
    name="visioncal",
    help="Calibrates vision-guided robot cells with a printed board, and says how far the result "
    "can be trusted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo_command)
app.command("plan")(plan_command)
app.command("record")(record_command)
app.command("rehearse")(rehearse_command)
app.command("calibrate")(calibrate_command)
app.command("align")(align_command)
app.command("report")(report_command)
app.command("verify")(verify_command)
app.command("diff")(diff_command)
app.command("convert")(convert_command)
app.command("export")(export_command)
app.command("tcp")(tcp_command)
app.command("locate")(locate_command)
app.command("fixture")(fixture_command)
app.command("correct")(correct_command)
app.command("review")(review_command)
app.command("simulate")(simulate_command)
app.add_typer(target_app, name="target")
app.add_typer(dynamics_app, name="dynamics")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Options of the application itself."""


def main() -> None:
    """Runs the command line; an error of the user's input ends with status 2 and one message."""
    with guarded_streams():
        try:
            app()
        except VisioncalError as error:
            report_error(error, as_json="--json" in sys.argv[1:])
            sys.exit(EXIT_NO_RESULT)
        except OSError as error:
            if error.errno != ENAMETOOLONG:
                raise
            named = DataError(f"{error.filename} is longer than the name of any file.")
            report_error(named, as_json="--json" in sys.argv[1:])
            sys.exit(EXIT_NO_RESULT)
