"""The printed targets of a session: one, or several named by the column `target`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from visioncal.core.errors import DataError
from visioncal.core.types import Target
from visioncal.core.verdict import READ_AGAIN
from visioncal.session.document import Declaration
from visioncal.session.kinds import without_content
from visioncal.vision.targets import misspelt_keys, read_target, target_from_document

# The column of views.csv that names the target of a row.
COLUMN = "target"


def read_targets(
    declaration: Declaration, folder: Path | None, document: Mapping[str, Any] | None
) -> tuple[dict[str, Target], Mapping[str, Any] | None]:
    """Reads the targets that a session declares.

    Args:
        declaration: What it declares.
        folder: Relative paths start here; the working directory where None.
        document: The content of the target's file, where that is known already; of several
            targets, the contents by their names.

    Returns:
        The targets by name, the name of an only one being empty, and their document in the form of
        the argument; None where there is none.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    places = _declared_targets(declaration)
    if not places:
        return {}, document
    if len(places) == 1:
        (place,) = places.values()
        if document is None:
            target, document = _load(place, folder)
        else:
            target = target_from_document(document, Path(place).stem)
        return {"": target}, document
    targets, contents = {}, {}
    for name, place in places.items():
        if document is None:
            targets[name], contents[name] = _load(place, folder)
        elif name in document:
            targets[name] = target_from_document(document[name], Path(place).stem)
            contents[name] = document[name]
        else:
            raise DataError(
                f"session.toml: targets.{name}: its description is not among those given.",
                culprits=[f"session.toml: targets.{name}"],
            )
    return targets, contents


def _load(place: str, folder: Path | None) -> tuple[Target, dict[str, Any]]:
    with without_content(place, "target", folder):
        try:
            return read_target(place, folder)
        except DataError as error:
            if "metres, such as" not in error.message:
                raise
            # Sizes in millimetres are all read so at once.
            raise type(error)(
                error.message, culprits=error.culprits, next_step=str(READ_AGAIN)
            ) from error


def target_warnings(declaration: Declaration, document: Mapping[str, Any] | None) -> Iterator[str]:
    """Words what in the targets' descriptions looks like a known key misspelt.

    Args:
        declaration: What the session declares.
        document: The descriptions, in the form of `read_targets`.
    """
    places = _declared_targets(declaration)
    for name, place in places.items():
        described = document if len(places) == 1 else (document or {}).get(name)
        for words in misspelt_keys(described or {}):
            yield f"{place}: {words}"


def _declared_targets(declaration: Declaration) -> dict[str, str]:
    """The targets' built-in names or paths, by the names that rows give them."""
    if declaration.target is not None:
        return {"": declaration.target}
    return {name: table.target for name, table in declaration.targets.items()}
