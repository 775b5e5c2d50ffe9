"""Temporary files and folders of a process, which the next writer removes after a kill."""

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
# Lock file of a folder.
LOCK = "lock"
_NAME = re.compile(r"\.[0-9a-f]{32}\.tmp")


def free_name(folder: Path) -> Path:
    """An unused name in a folder; short, to leave room for long names within."""
    return folder / f".{uuid4().hex}.tmp"


@contextmanager
def temporary(folder: Path, *, is_folder: bool) -> Iterator[tuple[Path, bool]]:
    """Yields an empty file or folder `.HEX.tmp`, removed at the end if it still exists.

    A lock (flock) on it ends with its process: an unlocked one is abandoned, and the next writer in
    the same folder removes it. Without such locks (Windows, some network drives) they stay.

    Yields:
        Its path, and whether it is locked.
    """
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        if is_folder:
            path.mkdir()
        else:
            path.touch(exist_ok=False)
        with locked(path / LOCK if is_folder else path, wait=True) as held:
            # Another writer may have removed it as abandoned before it was locked.
            if held is not False:
                try:
                    yield path, bool(held)
                finally:
                    _remove(path, is_folder=is_folder)
                return


def _remove(path: Path, *, is_folder: bool) -> None:
    if is_folder:
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[bool | None]:
    """Locks a file, which is created if needed.

    Yields:
        Whether the lock is held: not if another process has it (and `wait` is false), or the file
        was moved or removed meanwhile. None where there are no locks.
    """
    if sys.platform == "win32":
        # An open file could neither be renamed nor removed.
        if exists := path.parent.is_dir():
            path.touch()
        yield None if exists else False
        return
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except FileNotFoundError:
        yield False
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            # A moved or removed file is another one.
            is_locked: bool | None = os.path.samestat(os.fstat(descriptor), path.lstat())
        except (BlockingIOError, FileNotFoundError):
            is_locked = False
        except OSError:
            is_locked = None
        yield is_locked
    finally:
        os.close(descriptor)


def remove_abandoned(folder: Path) -> None:
    """Removes the temporary files of killed processes from a folder, as far as possible."""
    with suppress(OSError), os.scandir(folder) as entries:
        temporary = [entry for entry in entries if _NAME.fullmatch(entry.name)]
        for entry in temporary:
            path, is_folder = Path(entry.path), entry.is_dir(follow_symlinks=False)
            with suppress(OSError), locked(path / LOCK if is_folder else path, wait=False) as held:
                if held:
                    _remove(path, is_folder=is_folder)
