"""The files of an output folder, replaced together: killed at any moment, one generation is whole.

The new files are written into a folder aside. It then becomes `.visioncal-switch`, of which there
is one at a time in an output folder:

    new/       the new files
    old/       the files of the earlier generation, as hard links
    current    a symlink to old/, and from one moment on to new/

Each public name is replaced by a symlink through `current`, which shows what was there before; one
rename of `current` changes them all; and each link is replaced by the file that it shows. What is
only in one of the generations is a link that leads nowhere while the other one is current. After a
kill, the next writer replaces the links in the same way: by the files of whichever is current.
"""

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import flush_folder
from visioncal.core.temporary_files import LOCK, aside_folder, free_name, locked

_SWITCH = ".visioncal-switch"
_OLD, _NEW, _CURRENT = "old", "new", "current"


def write_generation(
    folder: Path, names: Sequence[str], write: Callable[[Path], None]
) -> tuple[Path, ...]:
    """Replaces files of a folder by new ones, all at once or not at all, whenever it is killed.

    What an earlier writer left when it was killed is put in order first. Where the file system has
    no links or locks (Windows, FAT, some network drives), the files are renamed one by one: a kill
    just then leaves new ones beside old ones, and hidden folders stay.

    Args:
        folder: Where to; it is made where there is none. Other files in it are left alone.
        names: The files of a generation, the one that counts last.
        write: Writes them into the folder that it is given. Those that it leaves out are no longer
            there in the end.

    Returns:
        The files that were written, in reverse order.

    Raises:
        DataError: The folder cannot be written, or one of the names is a folder's.
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
        _put_in_order(folder, wait=False)
        with aside_folder(folder) as (aside, is_locked):
            new = aside / _NEW
            new.mkdir()
            with _named_publicly(new, folder):
                write(new)
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
def _named_publicly(new: Path, folder: Path) -> Iterator[None]:
    """Has errors name the files as they would be called in the end."""
    try:
        yield
    except DataError as error:
        message, *culprits = (
            name.replace(str(new), str(folder)) for name in (error.message, *error.culprits)
        )
        raise DataError(message, culprits=culprits, next_step=error.next_step) from error.__cause__


@contextmanager
def _switch(folder: Path, aside: Path) -> Iterator[Path]:
    """Makes a folder aside the one switch of an output folder; in the end it is aside again."""
    switch = folder / _SWITCH
    while not _renamed(aside, switch):
        _put_in_order(folder, wait=True)
    try:
        yield switch
    finally:
        _settle(folder)
        switch.rename(aside)


def _renamed(aside: Path, switch: Path) -> bool:
    """Whether the name of the switch could be had."""
    try:
        aside.rename(switch)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    return True


def _replace_together(folder: Path, switch: Path, names: Sequence[str]) -> None:
    links, following = switch / "links", switch / "following"
    try:
        links.mkdir()
        following.symlink_to(_NEW)
        (switch / _CURRENT).symlink_to(_OLD)
        _link_old(folder, switch / _OLD, names)
        for name in names:
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


def _link_old(folder: Path, old: Path, names: Sequence[str]) -> None:
    old.mkdir()
    for name in names:
        there = folder / name
        if there.is_symlink():
            # From another folder a relative link would lead elsewhere.
            (old / name).symlink_to(os.path.realpath(there))
        elif there.exists():
            os.link(there, old / name)


def _through_switch(name: str) -> str:
    return f"{_SWITCH}/{_CURRENT}/{name}"


def _replace_one_by_one(folder: Path, new: Path, names: Sequence[str]) -> None:
    for name in names:
        if (new / name).exists():
            (new / name).replace(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


def _settle(folder: Path) -> None:
    """Replaces each link through the switch by the file that it shows, if it shows one."""
    current = folder / _SWITCH / _CURRENT
    for path in folder.iterdir():
        if path.is_symlink() and path.readlink() == Path(_through_switch(path.name)):
            try:
                (current / path.name).replace(path)
            except FileNotFoundError:
                path.unlink()
    flush_folder(folder)


def _put_in_order(folder: Path, *, wait: bool) -> None:
    """Ends the switch of a writer that was killed; one that lives is waited for, or left alone."""
    switch = folder / _SWITCH
    with locked(switch / LOCK, wait=wait) as held:
        if held:
            _settle(folder)
            aside = free_name(folder)
            switch.rename(aside)
            shutil.rmtree(aside, ignore_errors=True)
