"""`visioncal dynamics`: its commands."""

import typer

from visioncal.cli.dynamics_gains import dynamics_gains_command
from visioncal.cli.dynamics_identify import dynamics_identify_command, dynamics_validate_command
from visioncal.cli.dynamics_payload import dynamics_payload_command
from visioncal.cli.dynamics_plan import dynamics_plan_command
from visioncal.cli.dynamics_record import dynamics_record_command

dynamics_app = typer.Typer(
    help="Identify an arm's inertias and friction: plan the motions that tell them, fit their "
    "torques, see what that predicts, and weigh what the arm carries.",
    no_args_is_help=True,
)
dynamics_app.command("plan")(dynamics_plan_command)
dynamics_app.command("record")(dynamics_record_command)
dynamics_app.command("identify")(dynamics_identify_command)
dynamics_app.command("validate")(dynamics_validate_command)
dynamics_app.command("payload")(dynamics_payload_command)
dynamics_app.command("gains")(dynamics_gains_command)
