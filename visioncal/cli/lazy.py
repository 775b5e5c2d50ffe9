"""Groups of commands that are imported when they are asked for."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group


class LazyGroup(TyperGroup):
    """A group that lists its commands without an import, and imports the one that is asked for.

    Attributes:
        listed: By the names of the commands, the first paragraphs of their own helps.
        prefix: What comes before a name: the command `plan` of prefix `dynamics_` is the function
            `dynamics_plan_command` of the module `dynamics_plan`; a group is the `target_app` of
            `target`.
    """

    listed: ClassVar[Mapping[str, str]]
    prefix: ClassVar[str] = ""

    def __init__(self, **attributes: Any) -> None:  # noqa: ANN401 - typer's
        super().__init__(**attributes)
        for name, words in self.listed.items():
            self.add_command(TyperCommand(name, help=words))

    def resolve_command(self, *arguments: Any) -> Any:  # noqa: ANN401 - of typer's own types
        """Imports the command that the first argument names."""
        name, command, rest = super().resolve_command(*arguments)
        return name, command and self.imported(str(name)), rest

    @classmethod
    def imported(cls, name: str) -> Any:  # noqa: ANN401 - a command of typer's
        """A command of this group, with its parameters."""
        own = f"{cls.prefix}{name}"
        module = import_module(f"visioncal.cli.{own}")
        if hasattr(module, f"{own}_app"):
            return get_group(getattr(module, f"{own}_app"))
        app = typer.Typer(add_completion=False)
        app.command(name)(getattr(module, f"{own}_command"))
        return get_command(app)
