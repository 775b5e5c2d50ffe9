"""The parts of `visioncal record`: its devices, its stops, and what it says of them."""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import typer
from rich.markup import escape

from visioncal.cli.console import messages, print_json, say
from visioncal.cli.recorded_cell import RecordedSetup
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import figure
from visioncal.live.capture.core import CaptureEvent, Watcher, line_of, missed
from visioncal.live.capture.devices import ArmWish, open_arm, open_camera
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import HostClock, LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.record import Departure, departure, record
from visioncal.live.drivers.protocols import DeviceSetup, MovingArm


@contextmanager
def opened(arm: str, wish: ArmWish, camera: str, requested: DeviceSetup) -> Iterator[LiveCell]:
    """Opens both devices; the block's end lets go of them."""
    with closing(open_arm(arm, wish)) as opened:
        if not wish.watch_only and not isinstance(opened, MovingArm):
            raise DriverError(
                f"{opened.name} cannot be driven.",
                culprits=[opened.name],
                next_step="Guide it by hand: --follow.",
            )
        with closing(open_camera(camera, requested)) as device:
            yield LiveCell(opened, device, HostClock())


class ViewLines:
    """Tells each view in a line."""

    def stepped(self, step: CaptureEvent) -> None:
        """Prints the line."""
        say(line_of(step))


def driven(
    cell: LiveCell,
    scene: RecordedSetup,
    journal: Journal,
    taking: CaptureOptions,
    watchers: Sequence[Watcher],
    *,
    asks: bool,
) -> list[CaptureEvent]:
    """Drives the plan's stops, after a word of the user."""
    leaving = departure(cell, scene.planned, [view.number for view in journal.views], taking)
    report_departure(leaving, cell, taking)
    if not leaving.stops:
        return []
    if asks:
        _confirm(cell)
    return record(cell, scene.planned, journal, taking, watchers, lens=cell.camera.factory)


def report_departure(leaving: Departure, cell: LiveCell, taking: CaptureOptions) -> None:
    """Says what is about to happen."""
    say, count = messages().print, len(leaving.stops)
    if not count:
        say("All stops of the plan have their view; nothing is left to drive.")
        return
    first, seconds = leaving.stops[0], leaving.duration_s
    long = f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
    postures = len(leaving.first)
    via = (
        f" by {postures - 1} posture{'s' if postures > 2 else ''} in between"
        if postures > 1
        else ""
    )
    say(
        escape(
            f"{cell.arm.name}, {cell.camera.name}: {count} stop{'s' if count > 1 else ''} to drive "
            f"at {taking.speed:g} rad/s, about {long}"
        )
    )
    say(
        f"  first to view {first.view}{via}; a joint turns by up to "
        f"{figure(math.degrees(leaving.turn_rad))} deg; the way is clear of all that was declared "
        "to the plan"
    )


def _confirm(cell: LiveCell) -> None:
    if not sys.stdin.isatty():
        raise DataError(
            "record: nobody can be asked whether the arm may move: stdin is no terminal.",
            culprits=["--yes"],
            next_step="Say --yes where the cell is clear and somebody holds the stop button.",
        )
    sentence = f"{cell.arm.name} will move. Is the cell clear, and a hand on the stop button?"
    if not typer.confirm(sentence, err=True):
        raise DataError("record: not begun; nothing moved.", next_step="Look with --dry-run.")


def check_all(journal: Journal, steps: Sequence[CaptureEvent]) -> None:
    """Ends with status 2 where stops of the plan gave no view."""
    without = dict(missed(steps))
    if without:
        words = "; ".join(f"view {key}: {reason}" for key, reason in without.items())
        raise DataError(
            f"{len(without)} of {len(steps)} stops gave no view ({words}). {len(journal.views)} "
            f"views are in {journal.folder}.",
            culprits=[f"view {index}" for index in without],
            next_step="--resume tries them again.",
        )


def finish(journal: Journal, steps: Sequence[CaptureEvent], *, as_json: bool) -> None:
    """Says what there is now."""
    if as_json:
        print_json(_summary(journal, steps))
        return
    count = len(journal.views)
    say(
        f"{count} view{'s' if count != 1 else ''} in {journal.folder}; next: visioncal "
        f"calibrate {journal.folder} -o out"
    )


def _summary(journal: Journal, steps: Sequence[CaptureEvent]) -> dict[str, Any]:
    known = [
        step.accuracy for step in steps if step.accuracy is not None and not step.accuracy.is_open
    ]
    summary: dict[str, Any] = {
        "session": str(journal.folder),
        "views": [view.number for view in journal.views],
        "times_s": [
            {
                "view": step.view,
                **{name: round(value, 3) for name, value in vars(step.times).items()},
            }
            for step in steps
        ],
    }
    if known:
        summary["predicted"] = {"sigma_mm": known[-1].mm, "sigma_deg": known[-1].deg}
    return summary


def check_driven(scene: RecordedSetup, *, drives: bool) -> None:
    """Refuses to drive without a plan, before a device is asked for."""
    if drives:
        _ = scene.planned
        return
    raise DataError(
        "--dry-run: a guided arm is not driven, so there is nothing to say of it.",
        culprits=["--dry-run"],
        next_step="Leave it out.",
    )


def check_not_begun(journal: Journal, camera: str) -> None:
    """A folder begins with its first picture again, which would go to the wrong pose."""
    if journal.views:
        raise DataError(
            f"--resume: {camera} begins with its first picture again, and {len(journal.views)} "
            "views are there.",
            culprits=["--resume"],
            next_step="Record all of it into a new folder.",
        )
