"""Sentences about a result, by the templates of words.j2."""

import sys
from contextlib import suppress
from functools import cache
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemBytecodeCache, PackageLoader, StrictUndefined
from jinja2.bccache import Bucket

from visioncal.core.number_format import significant
from visioncal.present import arms, facts
from visioncal.robot.errors import SIGNIFICANT


def said(name: str, *about: object) -> list[str]:
    """The sentences of a template, which an empty line parts."""
    text = str(getattr(_templates(), name)(*about))
    return [" ".join(part.split()) for part in text.split("\n\n") if part.strip()]


class _Compiled(FileSystemBytecodeCache):
    """Templates as Python compiles modules: kept beside these where that is allowed."""

    def dump_bytecode(self, bucket: Bucket) -> None:
        with suppress(OSError):
            super().dump_bytecode(bucket)


def templates_of(folder: str, **options: Any) -> Environment:  # noqa: ANN401 - jinja2's own
    """The environment of the templates in a folder of the package, in which no name is unknown."""
    cache_folder = Path(cache_from_source(__file__)).parent
    environment = Environment(
        bytecode_cache=None if sys.dont_write_bytecode else _Compiled(str(cache_folder)),
        loader=PackageLoader("visioncal", folder),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )
    environment.filters["significant"] = significant
    return environment


@cache
def _templates() -> Any:  # noqa: ANN401 - a module of macros
    environment = templates_of("present")
    environment.globals |= {
        "chance": SIGNIFICANT,
        "frame_words": facts.frame_words,
        "hours": arms.hours,
        "level_words": arms.level_words,
    }
    return environment.get_template("words.j2").module
