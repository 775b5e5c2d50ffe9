"""`visioncal dynamics`: its commands."""

import typer

from visioncal.cli.dynamics_plan import dynamics_plan_command

dynamics_app = typer.Typer(
    help="Identify an arm's inertias and friction: plan the motions that tell them.",
    no_args_is_help=True,
)
dynamics_app.command("plan")(dynamics_plan_command)
