"""Commands with plain-text help, and groups that import a command on demand."""

import inspect
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from functools import partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from visioncal.cli.typed_values import check_paths, refusal, shown_name
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed

# Source of a parameter that was typed.
_TYPED = "COMMANDLINE"
# Attributes of options that are not typer's.
_OWN = ("panel", "parse", "needs")
# Base class of usage errors; typer exports only a subclass.
_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]


class PlainCommand(TyperCommand):
    """A command whose help lists first what most need, and then all else by panel.

    Without markup, which reads `[mm]` as a style, and without columns, which do not fit a terminal
    of 80 columns.
    """

    first: ClassVar[Sequence[str]] = ()  # Options that most need, in order of use.
    kinds: ClassVar[Mapping[str, Any]] = {}  # Annotations of the values, by their parameters.

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - typer's own
        """Parses the options; a usage error becomes a DataError."""
        typed = list(args)
        try:
            rest = super().parse_args(ctx, args)
        except _USAGE_ERROR as error:
            raise self._refusal(ctx, error, typed) from None
        paths = [param for param in self.params if _holds_paths(param, ctx.params.get(param.name))]
        check_paths(paths, self._words(ctx, typed), typed)
        return rest

    def _words(self, ctx: Any, typed: list[str]) -> dict[str, Any]:  # noqa: ANN401 - typer's own
        """The typed value of each parameter."""
        return dict(self.make_parser(ctx).parse_args(list(typed))[0])

    def _refusal(self, ctx: Any, error: Any, typed: list[str]) -> DataError:  # noqa: ANN401
        message, param = error.format_message(), getattr(error, "param", None)
        names, step = [shown_name(param) if param else getattr(error, "option_name", "")], ""
        words = {} if param is None else self._words(ctx, typed)
        if param is not None and words.get(param.name) not in (None, ()):
            kind, value = self.kinds.get(param.name), words[param.name]
            message, step = refusal(param, kind, value, message)
        elif param is not None and param.required:
            # The parser names the first of what is missing alone.
            required = [each for each in self.params if each.required]
            if missing := [each for each in required if words.get(each.name) in (None, ())]:
                names = [*map(shown_name, missing)]
                message = f"{listed(names)} {'is' if len(names) == 1 else 'are'} missing."
        shows = any("--example" in each.opts for each in self.params)
        remedy = f"{step} {ctx.command_path} --help lists what it takes".lstrip()
        if shows:
            remedy += f"; {ctx.command_path} --example prints one that works"
        return DataError(message, culprits=[*filter(None, names)], next_step=f"{remedy}.")

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - typer's own types
        """Runs the command; Ctrl-C ends it with a message."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("stopped by Ctrl-C", err=True)
            # As shells report a program ended by SIGINT.
            raise typer.Exit(128 + 2) from None

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - typer's own types
        """Writes what most need in order of use, and all else by panel."""
        panels = defaultdict[str, list[tuple[str, str]]](list)
        params, last = self.get_params(ctx), len(self.first)
        places = {name: place for place, name in enumerate(self.first)}
        for param in sorted(params, key=lambda param: places.get(param.name, last)):
            kind, panel = param.param_type_name, getattr(param, "rich_help_panel", None)
            if kind == "option" and last and param.name not in places:
                panel = f"More: {panel[0].lower()}{panel[1:]}" if panel else "More options"
            elif kind == "argument" or param.name in places or not panel:
                panel = f"{kind.capitalize()}s"
            if record := param.get_help_record(ctx):
                panels[panel].append(record)
        heads = ("Arguments", "Options", "More options")
        for name in sorted(panels, key=lambda panel: (*heads, panel).index(panel)):
            with formatter.section(name):
                formatter.write_dl(panels[name])


def _holds_paths(param: Any, value: object) -> bool:  # noqa: ANN401 - of typer
    is_list = param.param_type_name == "argument" and isinstance(value, list | tuple)
    return is_list or isinstance(value, Path)


class LazyGroup(TyperGroup):
    """A group that lists its commands without imports, and imports a command on demand.

    The command `plan` of prefix `dynamics_` takes the record `DynamicsPlanOptions`, whose docstring
    is its help, and is the function `dynamics_plan_command` of the module `dynamics_plan`.
    """

    # Names of its commands by heading, as they are listed.
    listed: ClassVar[Mapping[str, Sequence[str]]]
    records: ClassVar[Sequence[str]]  # Modules of the records, which import nothing heavy.
    homes: ClassVar[Mapping[str, str]] = {}  # Modules with another name than their command's.
    prefix: ClassVar[str] = ""
    groups: ClassVar[Mapping[str, typer.Typer]] = {}  # Those of its commands that are groups.

    def __init__(self, **attributes: Any) -> None:  # noqa: ANN401 - typer's
        super().__init__(**attributes)
        for name in chain(*self.listed.values()):
            group = self.groups.get(name)
            words = group.info.help if group else inspect.getdoc(self.record_of(name))
            self.add_command(TyperCommand(name, help=str(words).partition("\n\n")[0]))

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401, ARG002 - typer's
        """Writes the listing without typer's truncation."""
        width = max(map(len, self.commands))
        for heading, names in self.listed.items():
            with formatter.section(heading):
                words = (" ".join(str(self.commands[name].help).split()) for name in names)
                # All headings' words begin in one column.
                listed = zip((f"{name:<{width}}" for name in names), words, strict=True)
                formatter.write_dl([*listed])

    def resolve_command(self, *arguments: Any) -> Any:  # noqa: ANN401 - of typer's own types
        """Imports the command that the first argument names."""
        name, command, rest = super().resolve_command(*arguments)
        return name, command and self.imported(str(name)), rest

    @classmethod
    def record_of(cls, name: str) -> Any:  # noqa: ANN401 - a class
        """The record of a command's options."""
        stem = f"{cls.prefix}{name}".replace("-", "_").title().replace("_", "")
        modules = map(import_module, cls.records)
        return next(filter(None, (getattr(module, f"{stem}Options", None) for module in modules)))

    @classmethod
    def imported(cls, name: str) -> Any:  # noqa: ANN401 - a command of typer's
        """A command of this group, with its parameters."""
        if name in cls.groups:
            return get_group(cls.groups[name])
        stem, record = f"{cls.prefix}{name}".replace("-", "_"), cls.record_of(name)

        def command(context: typer.Context, **values: Any) -> None:  # noqa: ANN401 - of any type
            home = import_module(f"visioncal.cli.{cls.homes.get(name, stem)}")
            sources = {key: context.get_parameter_source(key) for key in values}
            given = {key for key, source in sources.items() if source and source.name == _TYPED}
            getattr(home, f"{stem}_command")(_gathered(record, values, frozenset(given)))

        parameters = [*_flattened(record)]
        at = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        command.__signature__ = inspect.Signature([at, *parameters])  # type: ignore[attr-defined]
        command.__annotations__ = {value.name: value.annotation for value in (at, *parameters)}
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        facts = {"first": getattr(record, "first", "").split(), "kinds": get_type_hints(record)}
        kind = type(name, (PlainCommand,), facts)
        app.command(name, cls=kind, help=record.__doc__)(command)
        return get_command(app)


def _flattened(record: type) -> Iterator[inspect.Parameter]:
    """Command-line parameters of a record's fields (`cli.options`)."""
    hints = get_type_hints(record)
    for field in fields(record):
        kind = hints[field.name]
        for form, (words, names, attributes) in field.metadata.items():
            stated = {key: value for key, value in attributes.items() if key not in _OWN}
            stated |= {"help": words, "rich_help_panel": attributes.get("panel")}
            if "parse" in attributes:
                is_list = any(get_origin(part) is list for part in (kind, *get_args(kind)))
                typed: Any = list[str] if is_list else str
                kind = typed | None if field.default is None else typed
            flag_names = (_option_of(field),) if form == "flag" else ()
            declare = typer.Argument if form == "argument" else typer.Option
            yield inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                annotation=Annotated[kind, declare(*(names or flag_names), **stated)],
                default=inspect.Parameter.empty if field.default is MISSING else field.default,
            )


def _gathered(record: Any, values: Mapping[str, Any], given: frozenset[str]) -> Any:  # noqa: ANN401
    """Builds a record from the command line's values, and the names of those that were typed.

    Raises:
        DataError: A value cannot be parsed, or an option goes with another that is not given.
    """
    content = {"given": given, **values}
    for field in fields(record):
        for _, _, attributes in field.metadata.values():
            option, value = _option_of(field), content[field.name]
            needs = attributes.get("needs")
            if needs is not None and field.name in given and not values[needs]:
                raise DataError(
                    f"{option} is for --{needs}.",
                    culprits=[option],
                    next_step="Give that, too, or leave it out.",
                )
            if "parse" in attributes and value is not None:
                parse = partial(attributes["parse"], option=option)
                content[field.name] = [*map(parse, value)] if type(value) is list else parse(value)
    return record(**{field.name: content[field.name] for field in fields(record)})


def _option_of(field: Field[Any]) -> str:
    """The long name of a field's option."""
    ((_, names, _),) = field.metadata.values()
    long = (name for name in names if name.startswith("--"))
    return next(long, f"--{field.name.replace('_', '-')}").partition("/")[0]
