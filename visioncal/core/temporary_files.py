"""Files and folders that are written aside, and the removal of those that a killed process left.

They are called `.HEX.tmp`. Whoever writes one holds a lock (flock) on it, which ends with the
process: one that nobody holds is abandoned, and the next writer in the same folder removes it.
Where there are no such locks (Windows, some network drives) they stay.
"""

import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

if sys.platform != "win32":
    import fcntl

# The file by which a folder is locked.
LOCK = "lock"
_NAME = re.compile(r"\.[0-9a-f]{32}\.tmp")


def free_name(folder: Path) -> Path:
    """A name that is free in a folder; short, for it may hold names of the longest kind allowed."""
    return folder / f".{uuid4().hex}.tmp"


@contextmanager
def aside_file(folder: Path) -> Iterator[Path]:
    """Gives an empty file to write to; in the end it is removed if it is still there.

    Args:
        folder: Where it is made; abandoned ones in there are removed.

    Raises:
        OSError: It cannot be made.
    """
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        path.touch(exist_ok=False)
        with locked(path, wait=True) as held:
            # Before it was locked, another writer may have taken it for abandoned.
            if held or path.exists():
                try:
                    yield path
                finally:
                    with suppress(OSError):
                        path.unlink(missing_ok=True)
                return


@contextmanager
def aside_folder(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Gives a folder to write to; in the end it is removed if it is still there.

    Args:
        folder: Where it is made; abandoned ones in there are removed.

    Yields:
        Its path, and whether it is locked: not where there are no locks.

    Raises:
        OSError: It cannot be made.
    """
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        path.mkdir()
        with locked(path / LOCK, wait=True) as held:
            if held or path.exists():
                try:
                    yield path, held
                finally:
                    shutil.rmtree(path, ignore_errors=True)
                return


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[bool]:
    """Locks a file, which is made if it is missing.

    Args:
        path: The file.
        wait: Whether to wait for who holds the lock.

    Yields:
        Whether the lock is held. It is not where somebody else has it, where the file was moved or
        removed meanwhile, and where there are no locks.

    Raises:
        OSError: The file cannot be opened.
    """
    if sys.platform == "win32":
        path.touch()
        yield False
        return
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except FileNotFoundError:
        yield False
        return
    try:
        yield _flocked(descriptor, wait=wait) and _is_at(descriptor, path)
    finally:
        os.close(descriptor)


if sys.platform != "win32":

    def _flocked(descriptor: int, *, wait: bool) -> bool:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def remove_abandoned(folder: Path) -> None:
    """Removes from a folder what killed processes have left aside, as far as it can be."""
    with suppress(OSError), os.scandir(folder) as entries:
        found = [entry for entry in entries if _NAME.fullmatch(entry.name)]
        for entry in found:
            path, is_folder = Path(entry.path), entry.is_dir(follow_symlinks=False)
            with suppress(OSError), locked(path / LOCK if is_folder else path, wait=False) as held:
                if held and is_folder:
                    shutil.rmtree(path, ignore_errors=True)
                elif held:
                    path.unlink(missing_ok=True)
