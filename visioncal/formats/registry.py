"""The formats that are known, and the way from one to another."""

from pathlib import Path

from visioncal.errors import DataError
from visioncal.formats.folder import FOLDER
from visioncal.formats.format import Format
from visioncal.formats.recording import RECORDING
from visioncal.session import Session

FORMATS: tuple[Format, ...] = (FOLDER, RECORDING)


def convert(source: Path, dest: Path, *, force: bool = False) -> Session:
    """Writes a session in another form, without loss.

    Args:
        source: The session, in any of `FORMATS`.
        dest: Where to; its suffix says in which form, and none of theirs means a folder.
        force: Whether a file that is there may be replaced; a folder never is.

    Returns:
        The session.

    Raises:
        DataError: `source` is no session, `dest` is taken, cannot be written or, read again, is
            another session.
    """
    read, write = _format_of(source), _format_for(dest)
    _check_free(source, dest, write, force=force)
    session = read.read(source)
    write.write(session, dest)
    again = write.read(dest)
    if again.digest() != session.digest():
        raise DataError(
            f"{dest} does not hold the session of {source}: their digests differ.",
            culprits=[str(dest)],
            next_step="Remove it, and report this with the session.",
        )
    return session


def _format_of(source: Path) -> Format:
    for known in FORMATS:
        if known.recognises(source):
            return known
    what = "is no session" if source.exists() else "does not exist"
    raise DataError(
        f"{source} {what}: {' or '.join(it.words for it in FORMATS)} is needed.",
        culprits=[str(source)],
    )


def _format_for(dest: Path) -> Format:
    by_suffix = {it.suffix: it for it in FORMATS}
    return by_suffix.get(dest.suffix.lower(), FOLDER)


def _check_free(source: Path, dest: Path, write: Format, *, force: bool) -> None:
    # An empty folder is free for a session's folder, which looks for itself.
    if not dest.exists() or (dest.is_dir() and not write.suffix):
        return
    replaceable = dest.is_file() and bool(write.suffix) and not dest.samefile(source)
    if replaceable and force:
        return
    raise DataError(
        f"{dest} exists, and nothing is overwritten.",
        culprits=[str(dest)],
        next_step="Choose another name, or replace the file with --force."
        if replaceable
        else "Choose another name.",
    )
