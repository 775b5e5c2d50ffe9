"""Ends a process at each of its calls to the file system in turn, as `kill -9` would.

It is a program of its own, since a process with threads must not fork. It prints what went wrong.
"""

import os
import shutil
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path

from visioncal.core.files import write_atomically
from visioncal.core.generations import write_generation

NAMES = ("gone.txt", "report.html", "result.json")
# Generations by their files: one that has all, one without the first, none.
ALL, LESS, NONE = (
    {name: f"{which} {name}" for name in names}
    for which, names in (("all", NAMES), ("less", NAMES[1:]), ("none", ()))
)
# Other people's files, some of them much like ours.
FOREIGN = {"views.csv": "view", ".notes.tmp": "a note", f".{31 * 'a'}.tmp": "another"}
_KILLED = 9
_CALLS = {"open", "fcntl.flock"} | {
    f"os.{name}" for name in ("link", "mkdir", "remove", "rename", "rmdir", "scandir", "symlink")
}


def written(folder: Path, content: dict[str, str]) -> None:
    """Writes a generation."""

    def write(aside: Path) -> None:
        for name, text in content.items():
            write_atomically(aside / name, text)

    write_generation(folder, NAMES, write)


def visible(folder: Path) -> dict[str, str]:
    """What a reader finds, of ours and of others."""
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def ended(act: Callable[[], None], call: int) -> bool:
    """Whether an action came to its own end, if it is killed at a call to the file system."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != _KILLED
    made = count(1)

    def watch(event: str, _: object) -> None:
        if event in _CALLS and next(made) == call:
            os._exit(_KILLED)

    sys.addaudithook(watch)
    act()
    os._exit(0)


def killed_everywhere(folder: Path, before: dict[str, str], after: dict[str, str]) -> int:
    """Kills the change from one generation to another at each call; how many calls there are."""
    for call in count(1):
        begin(folder, before)
        whole = ended(lambda: written(folder, after), call)
        seen = visible(folder)
        allowed = [after] if whole else [before, after]
        assert seen in [FOREIGN | mapping for mapping in allowed], (before, after, call, seen)
        # The next writer is killed, too, while it puts things in order.
        for again in (12, 30):
            ended(lambda: written(folder, after), again)
            seen = visible(folder)
            assert seen in [FOREIGN | before, FOREIGN | after], (call, again, seen)
        written(folder, after)
        assert visible(folder) == FOREIGN | after, call
        expect_no_leftovers(folder, FOREIGN | after)
        if whole:
            return call - 1
    raise AssertionError


def begin(folder: Path, content: dict[str, str]) -> None:
    """Makes a folder with a generation and other people's files."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, text in {**FOREIGN, **content}.items():
        (folder / name).write_text(text)


def expect_no_leftovers(folder: Path, content: dict[str, str]) -> None:
    """The folder holds regular files alone, and none but these."""
    left = [path.name for path in folder.iterdir() if path.name not in content or path.is_symlink()]
    assert not left


def killed_single(folder: Path) -> int:
    """Kills the writing of one file at each call; how many there are."""
    path = folder / "result.json"
    for call in count(1):
        begin(folder, ALL)
        whole = ended(lambda: write_atomically(path, "new"), call)
        assert path.read_text() in ("new", *([] if whole else [ALL[path.name]])), call
        write_atomically(folder / "report.html", "new")
        expect_no_leftovers(folder, FOREIGN | ALL)
        if whole:
            return call - 1
    raise AssertionError


if __name__ == "__main__":
    # What a kill leaves does not depend on the disk, and waiting for it takes most of the time.
    os.fsync = lambda _: None
    place = Path(sys.argv[1]) / "out"
    for change in ((NONE, ALL), (LESS, ALL | {"result.json": "another"}), (ALL, LESS)):
        print(killed_everywhere(place, *change))
    print(killed_single(place))
