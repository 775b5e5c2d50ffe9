"""`visioncal dynamics`: its commands."""

from typing import ClassVar

import typer

from visioncal.cli.lazy import LazyGroup


class _Commands(LazyGroup):
    """Its commands, in the order of their work."""

    prefix = "dynamics_"
    listed: ClassVar = {
        "plan": "Plan the motions that determine an arm's inertias and friction.",
        "record": "Record angles, speeds and motor currents at the controller's full rate.",
        "identify": "Identify an arm's inertias and friction from the torques of its motions.",
        "validate": "Predict the torques of other motions, and say how near that comes.",
        "payload": "Weigh what the arm carries, by how much more its drives gave than without it.",
        "gains": "Find how much torque a drive's current makes, by a body that is known.",
    }


dynamics_app = typer.Typer(
    cls=_Commands,
    help="Identify an arm's inertias and friction, and weigh what it carries.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
