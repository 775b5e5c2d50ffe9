"""The templates of this package's pages."""

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


def template(name: str) -> Template:
    """A template by its name, in which what is not given is an error."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    # It keeps the templates, which take longer to be compiled than a page to be made.
    return Environment(
        loader=PackageLoader("visioncal", "present/report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
