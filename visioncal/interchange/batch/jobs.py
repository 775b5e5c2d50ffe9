"""What a batch is to do: the sessions that are meant, and the folders of their results."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import natural

_SESSION = "session.toml"


@dataclass(frozen=True)
class Options:
    """What the results of a batch depend on, beside the sessions.

    Attributes:
        level: As in `calibrate`.
        need_mm: Likewise.
        need_deg: Likewise.
        without: The files that are not drawn.
    """

    level: str = "auto"
    need_mm: float | None = None
    need_deg: float | None = None
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """One session to be calibrated.

    Attributes:
        name: Its name in the batch.
        session: Its absolute path.
        folder: Where its result goes, likewise.
        options: How it is calibrated.
    """

    name: str
    session: Path
    folder: Path
    options: Options


def jobs_of(sessions: Iterable[Path | str], out: Path, options: Options) -> list[Job]:
    """One job a session, in their natural order.

    Args:
        sessions: Folders of sessions, recordings, folders that have some below them, or globs.
        out: Where the results go.
        options: How they are calibrated.

    Returns:
        The jobs. Names are paths below the folder that all sessions share.

    Raises:
        DataError: There are no sessions, or two would have one name.
    """
    given = [str(it) for it in sessions]
    paths = sorted(
        {it.absolute() for one in given for it in _named(one)},
        key=lambda it: [natural(Path(part)) for part in it.parts],
    )
    if not paths:
        raise DataError(
            f"{', '.join(given) or 'nothing'}: there is no session.",
            next_step="Name folders of sessions, .rrd recordings, or a glob in quotes.",
        )
    shared = Path(os.path.commonpath([it.parent for it in paths]))
    names = [it.relative_to(shared).with_suffix("").as_posix() for it in paths]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise DataError(
            f"two sessions are called {twice[0]}: a folder and a recording beside it.",
            culprits=twice,
            next_step="Leave one of them out.",
        )
    whole = out.absolute()
    return [Job(name, it, whole / name, options) for name, it in zip(names, paths, strict=True)]


def _named(given: str) -> Iterator[Path]:
    """The sessions that are meant; what is none is kept, so that its row can say so."""
    magic = next((at for at, it in enumerate(Path(given).parts) if set(it) & set("*?[")), None)
    if magic is None or Path(given).exists():
        yield from _within(Path(given))
    else:
        parts = Path(given).parts
        for found in Path(*parts[:magic]).glob(str(Path(*parts[magic:]))):
            # What lies beside sessions, as their truths and notes, is not meant.
            if found.is_dir() or found.suffix.lower() == ".rrd":
                yield from _within(found)


def _within(path: Path) -> Iterator[Path]:
    below = []
    if path.is_dir() and not (path / _SESSION).exists():
        below = [it.parent for it in path.rglob(_SESSION)]
    yield from below or [path]
