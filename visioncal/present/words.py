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


@cache
def _templates() -> Any:  # noqa: ANN401 - a module of macros
    environment = Environment(
        loader=PackageLoader("visioncal", "present"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["significant"] = significant
    environment.globals |= {
        "chance": SIGNIFICANT,
        "frame_words": facts.frame_words,
        "hours": arms.hours,
        "level_words": arms.level_words,
    }
    return environment.get_template("words.j2").module
