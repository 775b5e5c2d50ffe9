"""Atomic replacement of all files of an output folder, even if the process is killed."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import flush_folder
from visioncal.core.temporary import LOCK, free_name, locked, temporary

# The new files are written into a temporary folder, which is then renamed to `.visioncal-switch`;
# an output folder has at most one of that name:
#
#     new/       the new files
#     old/       the files of the previous generation, as hard links
#     current    a symlink to old/, then to new/
#
# Each file is replaced by a symlink through `current`, first to its old version; one rename of
# `current` switches all of them; then each link is replaced by the file it points to. Files that
# exist in one generation only are broken links while the other is current. After a kill, the next
# writer replaces the links likewise, by the files of the current generation.
_SWITCH = ".visioncal-switch"
_OLD, _NEW, _CURRENT = "old", "new", "current"


def write_generation(
    folder: Path, names: Sequence[str], write: Callable[[Path], None]
) -> tuple[Path, ...]:
    """Replaces files of a folder, all at once or not at all, even if the process is killed.

    First cleans up after an earlier writer that was killed. Where the file system has no links or
    locks (Windows, FAT, some network drives), files are renamed one by one: a kill at that moment
    leaves a mixture of new and old files, and hidden folders stay.

    Args:
        folder: The output folder, created if needed. Other files in it are not changed.
        names: The files of a generation, the main one last.
        write: Writes them into the folder that it is given. Files that it does not write are
            removed.

    Returns:
        The written files, in reverse order.

    Raises:
        DataError: The folder cannot be written, or one of the names is a folder.
    """
    taken = [folder / name for name in names if (folder / name).is_dir()]
    if taken:
        raise DataError(
            f"{taken[0]} is a folder, where a file is to be written.",
            culprits=[str(taken[0])],
            next_step="Move it away, or name another folder with -o.",
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _recover(folder, wait=False)
        with temporary(folder, is_folder=True) as (aside, is_locked):
            new = aside / _NEW
            new.mkdir()
            try:
                write(new)
            except DataError as error:
                message, *culprits = (
                    name.replace(str(new), str(folder)) for name in (error.message, *error.culprits)
                )
                raise error.but(message, culprits=culprits) from error.__cause__
            written = [name for name in names if (new / name).exists()]
            if is_locked:
                with _switch(folder, aside) as switch:
                    _replace_together(folder, switch, names)
            else:
                _replace_one_by_one(folder, new, names)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written: {error.strerror or error}.",
            culprits=[str(folder)],
            next_step="Make room on its disk, or choose another folder."
            if error.errno == errno.ENOSPC
            else "Choose another folder, or one that may be written.",
        ) from error
    return tuple(folder / name for name in reversed(written))


@contextmanager
def _switch(folder: Path, aside: Path) -> Iterator[Path]:
    """Renames a temporary folder to the switch of an output folder, and back at the end."""
    switch = folder / _SWITCH
    while True:
        try:
            aside.rename(switch)
            break
        except OSError as error:
            # Another writer's switch exists.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            _recover(folder, wait=True)
    try:
        yield switch
    finally:
        _resolve_links(folder)
        switch.rename(aside)


def _replace_together(folder: Path, switch: Path, names: Sequence[str]) -> None:
    links, following = switch / "links", switch / "following"
    try:
        links.mkdir()
        following.symlink_to(_NEW)
        (switch / _CURRENT).symlink_to(_OLD)
        (switch / _OLD).mkdir()
        for name in names:
            path, old = folder / name, switch / _OLD / name
            if path.is_symlink():
                # A relative link would be wrong in another folder.
                old.symlink_to(os.path.realpath(path))
            elif path.exists():
                os.link(path, old)
            (links / name).symlink_to(_through_switch(name))
        for path in (switch / _NEW, switch / _OLD, switch):
            flush_folder(path)
    except OSError:
        _replace_one_by_one(folder, switch / _NEW, names)
        return
    for name in names:
        (links / name).replace(folder / name)
    flush_folder(folder)
    following.replace(switch / _CURRENT)
    flush_folder(switch)


def _through_switch(name: str) -> str:
    return f"{_SWITCH}/{_CURRENT}/{name}"


def _replace_one_by_one(folder: Path, new: Path, names: Sequence[str]) -> None:
    for name in names:
        if (new / name).exists():
            (new / name).replace(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


def _resolve_links(folder: Path) -> None:
    """Replaces each link through the switch by the file that it points to, or removes it."""
    current = folder / _SWITCH / _CURRENT
    for path in folder.iterdir():
        if path.is_symlink() and path.readlink() == Path(_through_switch(path.name)):
            try:
                (current / path.name).replace(path)
            except FileNotFoundError:
                path.unlink()
    flush_folder(folder)


def _recover(folder: Path, *, wait: bool) -> None:
    """Completes the switch of a killed writer; waits for a live one, or leaves it alone."""
    switch = folder / _SWITCH
    with locked(switch / LOCK, wait=wait) as held:
        if held:
            _resolve_links(folder)
            aside = free_name(folder)
            switch.rename(aside)
            shutil.rmtree(aside, ignore_errors=True)
