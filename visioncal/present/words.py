"""Sentences about a result, by the templates of words.j2."""

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from visioncal.core.number_format import significant
from visioncal.estimation.arm import SIGNIFICANT
from visioncal.present import arms, facts


def said(name: str, *about: object) -> list[str]:
    """The sentences of a template, which an empty line parts."""
    text = str(getattr(_templates(), name)(*about))
    return [" ".join(part.split()) for part in text.split("\n\n") if part.strip()]


def templates_of(folder: str, **options: Any) -> Environment:  # noqa: ANN401 - jinja2's own
    """The environment of the templates in a folder of the package, in which no name is unknown."""
    environment = Environment(
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
