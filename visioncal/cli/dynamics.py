"""`visioncal dynamics`: its commands."""

import typer

from visioncal.cli.dynamics_identify import dynamics_identify_command, dynamics_validate_command
from visioncal.cli.dynamics_plan import dynamics_plan_command

dynamics_app = typer.Typer(
    help="Identify an arm's inertias and friction: plan the motions that tell them, fit their "
    "torques, and see what that predicts.",
    no_args_is_help=True,
)
dynamics_app.command("plan")(dynamics_plan_command)
dynamics_app.command("identify")(dynamics_identify_command)
dynamics_app.command("validate")(dynamics_validate_command)
