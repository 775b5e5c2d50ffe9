"""Printed targets of a session: one, or several named by the column `target`."""

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
        declaration: The typed session.toml.
        folder: Base of relative paths; the working directory where None.
        document: Content of the target's file, if already read; with several targets, contents by
            name.

    Returns:
        The targets by name, which is empty for the only one, and their document in the form of the
        argument; None without targets.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    paths = _declared_targets(declaration)
    if not paths:
        return {}, document
    if len(paths) == 1:
        (path,) = paths.values()
        if document is None:
            target, document = _load(path, folder)
        else:
            target = target_from_document(document, Path(path).stem)
        return {"": target}, document
    targets, contents = {}, {}
    for name, path in paths.items():
        if document is None:
            targets[name], contents[name] = _load(path, folder)
        elif name in document:
            targets[name] = target_from_document(document[name], Path(path).stem)
            contents[name] = document[name]
        else:
            raise DataError(
                f"session.toml: targets.{name}: its description is not among those given.",
                culprits=[f"session.toml: targets.{name}"],
            )
    return targets, contents


def _load(path: str, folder: Path | None) -> tuple[Target, dict[str, Any]]:
    with without_content(path, "target", folder):
        try:
            return read_target(path, folder)
        except DataError as error:
            if "metres, such as" not in error.message:
                raise
            # All sizes in millimetres can be converted at once.
            raise type(error)(
                error.message, culprits=error.culprits, next_step=str(READ_AGAIN)
            ) from error


def target_warnings(declaration: Declaration, document: Mapping[str, Any] | None) -> Iterator[str]:
    """Warnings of misspelt keys in the targets' descriptions, in the form of `read_targets`."""
    paths = _declared_targets(declaration)
    for name, path in paths.items():
        described = document if len(paths) == 1 else (document or {}).get(name)
        for words in misspelt_keys(described or {}):
            yield f"{path}: {words}"


def _declared_targets(declaration: Declaration) -> dict[str, str]:
    """Built-in names or paths of the targets, by their names in rows."""
    if declaration.target is not None:
        return {"": declaration.target}
    return {name: table.target for name, table in declaration.targets.items()}
