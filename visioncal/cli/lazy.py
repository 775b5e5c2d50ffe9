"""Commands with plain-text help, and groups that import a command on demand."""

import inspect
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, TypeGuard, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of

# As shells report a program ended by SIGINT.
_EXIT_CTRL_C = 128 + 2
# Base class of usage errors; typer exports only a subclass.
_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]


class PlainCommand(TyperCommand):
    """A command whose help lists its options under the headings of their panels.

    Without markup, which reads `[mm]` as a style, and without columns, which do not fit a terminal
    of 80 columns.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - typer's own
        """Parses the options; with `--json`, a usage error becomes a DataError."""
        wants_json = "--json" in args
        typed = list(args)
        try:
            rest = super().parse_args(ctx, args)
        except _USAGE_ERROR as error:
            if not wants_json:
                raise
            param, unknown = getattr(error, "param", None), getattr(error, "option_name", "")
            names = [*param.opts] if param else [unknown] if unknown else []
            raise DataError(
                error.format_message(),
                culprits=names[-1:],
                next_step=f"{ctx.command_path} --help lists what it takes.",
            ) from None
        self._refuse_empty_paths(ctx, typed)
        return rest

    def _refuse_empty_paths(self, ctx: Any, typed: list[str]) -> None:  # noqa: ANN401 - typer's own
        """Refuses empty paths, as from an unset shell variable."""
        paths = (param for param in self.params if isinstance(ctx.params.get(param.name), Path))
        path_options = {opt for path in paths for opt in path.opts}
        for option, value in (
            *pairwise(typed),
            *(name.split("=", 1) for name in typed if "=" in name),
        ):
            if option in path_options and not value:
                raise DataError(
                    f"{option} is empty; a path is needed.",
                    culprits=[option],
                    next_step="Write . for the folder where you are; or look whether a variable of "
                    "the shell is set.",
                )

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - typer's own types
        """Runs the command; on Ctrl-C, lists the files that it has written."""
        start_s = time.time()
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            paths = [param for param in ctx.params.values() if isinstance(param, Path)]
            written = sorted(str(file) for path in paths for file in _written_since(path, start_s))
            words = f"written so far: {some_of(written)}" if written else "nothing was written"
            typer.echo(f"stopped by Ctrl-C; {words}", err=True)
            raise typer.Exit(_EXIT_CTRL_C) from None

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - typer's own types
        """Writes the options by panel."""
        panels: dict[str, list[tuple[str, str]]] = defaultdict(list)
        for param in self.get_params(ctx):
            if record := param.get_help_record(ctx):
                named = getattr(param, "rich_help_panel", None)
                panels[named or f"{param.param_type_name.capitalize()}s"].append(record)
        for name, records in panels.items():
            with formatter.section(name):
                formatter.write_dl(records)


def _written_since(path: Path, since_s: float) -> Iterator[Path]:
    """The files at a path that were written since a time [s]."""
    for file in (path, *path.rglob("*")):
        # File systems may round times this coarsely.
        if file.is_file() and file.stat().st_mtime > since_s - 0.01:
            yield file


class LazyGroup(TyperGroup):
    """A group that lists its commands without imports, and imports a command on demand."""

    listed: ClassVar[Mapping[str, str]]  # First paragraphs of the commands' help, by name.
    # Prefix of module names: the command `plan` of prefix `dynamics_` is the function
    # `dynamics_plan_command` of the module `dynamics_plan`; a group is the `target_app` of
    # `target`.
    prefix: ClassVar[str] = ""

    def __init__(self, **attributes: Any) -> None:  # noqa: ANN401 - typer's
        super().__init__(**attributes)
        for name, words in self.listed.items():
            self.add_command(TyperCommand(name, help=words))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401, ARG002 - typer's
        """Writes the listing without typer's truncation."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self.listed.items()))

    def resolve_command(self, *arguments: Any) -> Any:  # noqa: ANN401 - of typer's own types
        """Imports the command that the first argument names."""
        name, command, rest = super().resolve_command(*arguments)
        return name, command and self.imported(str(name)), rest

    @classmethod
    def imported(cls, name: str) -> Any:  # noqa: ANN401 - a command of typer's
        """A command of this group, with its parameters."""
        module_name = f"{cls.prefix}{name}".replace("-", "_")
        module = import_module(f"visioncal.cli.{module_name}")
        if hasattr(module, f"{module_name}_app"):
            return get_group(getattr(module, f"{module_name}_app"))
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        app.command(name, cls=PlainCommand)(with_fields(getattr(module, f"{module_name}_command")))
        return get_command(app)


def with_fields(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose dataclass parameters are replaced by their fields, at any depth."""
    parameters = inspect.signature(command).parameters.values()
    hints = get_type_hints(command, include_extras=True)
    flat = [
        flattened
        for parameter in parameters
        for flattened in _flattened(parameter.name, hints[parameter.name], parameter.default)
    ]

    @wraps(command)
    def by_fields(**given: Any) -> None:  # noqa: ANN401 - of any type
        command(
            **{
                parameter.name: _gathered(parameter.name, hints[parameter.name], given)
                for parameter in parameters
            }
        )

    del by_fields.__wrapped__
    by_fields.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
    by_fields.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    return by_fields


def _flattened(name: str, kind: Any, default: Any) -> Iterator[inspect.Parameter]:  # noqa: ANN401 - any
    """Command-line parameters of a parameter: itself, or the fields of its dataclass."""
    if not _has_fields(kind):
        at = inspect.Parameter.KEYWORD_ONLY
        yield inspect.Parameter(name, at, annotation=kind, default=default)
        return
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        given = inspect.Parameter.empty if field.default is MISSING else field.default
        yield from _flattened(field.name, hints[field.name], given)


def _gathered(name: str, kind: Any, given: Mapping[str, Any]) -> Any:  # noqa: ANN401 - of any type
    """Builds a parameter from the command line's values."""
    if not _has_fields(kind):
        return given[name]
    hints = get_type_hints(kind, include_extras=True)
    return kind(
        **{field.name: _gathered(field.name, hints[field.name], given) for field in fields(kind)}
    )


def _has_fields(kind: object) -> TypeGuard[type]:
    return isinstance(kind, type) and is_dataclass(kind)
