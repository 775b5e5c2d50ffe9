"""Temporary files and folders, and the removal of those of killed processes.

They are named `.HEX.tmp`, and their writer holds a lock (flock) that ends with its process: an
unlocked one is abandoned, and the next writer in the same folder removes it. Without such locks
(Windows, some network drives) they stay.
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

# Lock file of a folder.
LOCK = "lock"
_NAME = re.compile(r"\.[0-9a-f]{32}\.tmp")


def free_name(folder: Path) -> Path:
    """An unused name in a folder; short, to leave room for long names within."""
    return folder / f".{uuid4().hex}.tmp"


@contextmanager
def temporary_file(folder: Path) -> Iterator[Path]:
    """Yields an empty temporary file, which is removed at the end if it still exists."""
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        path.touch(exist_ok=False)
        with locked(path, wait=True) as held:
            # Another writer may have removed it as abandoned before it was locked.
            if held is not False:
                try:
                    yield path
                finally:
                    with suppress(OSError):
                        path.unlink(missing_ok=True)
                return


@contextmanager
def temporary_folder(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Yields a temporary folder, which is removed at the end if it still exists.

    Yields:
        Its path, and whether it is locked, which needs a file system with locks.
    """
    remove_abandoned(folder)
    while True:
        path = free_name(folder)
        path.mkdir()
        with locked(path / LOCK, wait=True) as held:
            # As with files; what several writers left of it is abandoned.
            if held is not False:
                try:
                    yield path, bool(held)
                finally:
                    shutil.rmtree(path, ignore_errors=True)
                return


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[bool | None]:
    """Locks a file, which is created if needed.

    Yields:
        Whether the lock is held: not if another process has it (and `wait` is false), or the file
        was moved or removed meanwhile. None where there are no locks.
    """
    if sys.platform == "win32":
        path.touch()
        yield None
        return
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except FileNotFoundError:
        yield False
        return
    try:
        is_locked = _flocked(descriptor, wait=wait)
        yield is_locked and _is_at(descriptor, path)
    finally:
        os.close(descriptor)


if sys.platform != "win32":

    def _flocked(descriptor: int, *, wait: bool) -> bool | None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return None
        return True


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def remove_abandoned(folder: Path) -> None:
    """Removes the temporary files of killed processes from a folder, as far as possible."""
    with suppress(OSError), os.scandir(folder) as entries:
        temporary = [entry for entry in entries if _NAME.fullmatch(entry.name)]
        for entry in temporary:
            path, is_folder = Path(entry.path), entry.is_dir(follow_symlinks=False)
            with suppress(OSError), locked(path / LOCK if is_folder else path, wait=False) as held:
                if held and is_folder:
                    shutil.rmtree(path, ignore_errors=True)
                elif held:
                    path.unlink(missing_ok=True)
