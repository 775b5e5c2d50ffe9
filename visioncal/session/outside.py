"""Files that session.toml names and that lie outside of the session's folder.

Boards and robots are shared between sessions, so these are followed; but a session may come from a
stranger, so each is named to the user, and what is wrong with one is said without its content.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import absence, is_inside
from visioncal.robot import ROBOT_SUFFIXES
from visioncal.session.document import Declaration, Kind

_SUFFIXES = {"target": (".toml",), "model": ROBOT_SUFFIXES}


@contextmanager
def without_content(named: str, field: str, folder: Path | None) -> Iterator[None]:
    """Keeps what a file outside of the folder holds out of the errors of reading it.

    Args:
        named: The file, as session.toml names it; a name that comes with visioncal is none.
        field: Which field does: `target` or `model`.
        folder: The session's folder; None where it has none.

    Raises:
        DataError: In the place of what reading it raises, or it is a link to another kind of file.
    """
    file = outside_file(named, field, folder)
    if file is None or absence(file):
        yield
        return
    refusal = DataError(
        f"{file}, outside of the session's folder, is no {field} that can be read.",
        culprits=[f"session.toml: {field}"],
        next_step="Copy it into the session's folder: then the message says what is wrong with it.",
    )
    if file.suffix.lower() not in _SUFFIXES[field]:
        raise refusal
    try:
        yield
    except DataError as error:
        raise refusal from error


def outside_file(named: str, field: str, folder: Path | None) -> Path | None:
    """The file outside of the folder that a name leads to; None where it leads to none."""
    if folder is None or not named.lower().endswith(_SUFFIXES[field]):
        return None
    path = folder / named.replace("\\", "/")
    try:
        return None if is_inside(path, folder) else path.resolve()
    except (OSError, ValueError, RuntimeError):
        return path


def outside_warnings(declaration: Declaration, folder: Path | None) -> Iterator[str]:
    """Names the files outside of the folder that were read."""
    places: list[tuple[str, str]] = []
    fields: tuple[tuple[Kind, str], ...] = (("target", "target"), ("robot", "model"))
    for kind, field in fields:
        for table in declaration.named(kind).values():
            named = getattr(table, field)
            if named is not None:
                places.append((named, field))
    for named, field in dict.fromkeys(places):
        file = outside_file(named, field, folder)
        if file is not None and not absence(file):
            yield (
                f"session.toml: {field} = {named!r} lies outside of the session's folder: {file} "
                "was read."
            )
