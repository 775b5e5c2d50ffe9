"""Page templates, and the functions that they call."""

import platform
from functools import cache, partial
from importlib import metadata

from jinja2 import Environment, Template
from markupsafe import Markup

from visioncal.core.version import __version__
from visioncal.present.words import templates_of

# Figures by matplotlib.
_FIGURES = ("before_and_after", "workspace", "course", "board_shape")
_DEPENDENCIES = ("numpy", "scipy", "opencv-contrib-python-headless", "pin", "rerun-sdk")


@cache
def _software() -> str:
    """Versions of this program, of Python, and of the libraries that compute the result."""
    versions = "".join(f", {name} {metadata.version(name)}" for name in _DEPENDENCIES)
    return f"visioncal {__version__}, Python {platform.python_version()}{versions}"


def template(name: str, *, has_result: bool = True) -> Template:
    """A template by name, in which undefined variables are errors.

    One of a result may call all functions that describe and draw results.
    """
    return _environment(has_result=has_result).get_template(name)


@cache
def _environment(*, has_result: bool) -> Environment:
    # Cached, as compiling the templates takes longer than rendering a page.
    environment = templates_of("present/report", autoescape=True)
    environment.globals |= {"software": _software, "version": __version__}
    if not has_result:
        return environment
    from visioncal.present import advice, arms, details, facts, result_parts, torques, words
    from visioncal.present.report import cell_picture, content, network, plots

    called = (
        *(result_parts, facts, arms, details, torques, advice, words),
        *(cell_picture, content, network, plots),
    )
    environment.globals |= {
        name: var
        for module in called
        for name, var in vars(module).items()
        if getattr(var, "__module__", "") == module.__name__
    }
    environment.globals |= {name: partial(_figure, name) for name in _FIGURES}
    return environment


def _figure(name: str, *about: object) -> Markup:
    """A figure by matplotlib, which a page without one does not wait for."""
    from visioncal.present.report import armplots

    return Markup(getattr(armplots, name)(*about))
