"""Progress of a command on stderr."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from visioncal.cli.console import console, is_terminal, say

# Descriptions of steps; other names are words already.
WORDS = {
    "bag": "read the bag",
    "robot": "read the robot",
    "readings": "read the instruments",
    "detect": "detect the board",
    "dense": "fit boards to blurred images",
    "intrinsics": "estimate the lens",
    "pnp": "locate the board in each view",
    "board": "look for corners that are elsewhere on the board",
    "clock": "compare the clocks",
    "joints": "check poses and joint angles",
    "solve": "solve for all frames",
    "lenses": "fit lenses, boards and frames, with outliers left out",
    "arms": "fit the arms, and look again for outliers and moves",
    "examine": "leave views out and predict them",
    "judge": "judge the result",
    "pairs": "calibrate each camera and robot of the cell alone",
    "write": "write the result, report and recording",
    "batch": "calibrate the sessions",
    "render": "render the images",
    "candidates": "collect possible stops",
    "information": "compute the information of each stop",
    "choice": "choose the stops",
    "path": "find a clear path",
    "audit": "look at the episodes",
    "excitation": "search for the motion",
}
# Least interval of lines without a terminal [s].
PAUSE_S = 2.0


class Steps:
    """The current step, in words.

    The first report of a step is its place among all steps; later ones count within it.
    """

    def __init__(self) -> None:
        self.words = ""
        self.count: tuple[int, int] | None = None
        self._name = ""

    def report(self, name: str, done: int, total: int) -> None:
        """Records a report of progress."""
        self.count = (done, total) if name == self._name and total else None
        self._name, self.words = name, WORDS.get(name, name)

    @property
    def line(self) -> str:
        """The step, with its count if there is one."""
        counted = "" if self.count is None else f": {self.count[0]} of {self.count[1]}"
        return f"{self.words}{counted}"


@contextmanager
def shown_progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Shows progress as a bar on a terminal, else as occasional lines; nothing if quiet."""
    steps = Steps()
    if quiet:
        yield steps.report
        return
    shown = _bar if is_terminal() else _lines
    with shown(steps) as report:
        yield report


@contextmanager
def _bar(steps: Steps) -> Iterator[Callable[[str, int, int], None]]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console(), transient=True) as bar:
        task = bar.add_task("begin", total=None)

        def report(name: str, done: int, total: int) -> None:
            steps.report(name, done, total)
            # A total of None in an update would keep the previous one.
            completed, bar.tasks[0].total = steps.count or (0, None)
            bar.update(task, description=steps.words, completed=completed)

        yield report


@contextmanager
def _lines(steps: Steps) -> Iterator[Callable[[str, int, int], None]]:
    start_s, over = time.monotonic(), Event()

    def repeat() -> None:
        last, pauses = "", 0
        while not over.wait(PAUSE_S):
            pauses += 1
            # Long work is said again each minute.
            if steps.line != last or pauses % 30 == 0:
                last = steps.line
                say(f"{last} ({time.monotonic() - start_s:.0f} s)")

    printer = Thread(target=repeat, daemon=True)
    printer.start()
    try:
        yield steps.report
    finally:
        over.set()
        printer.join()
