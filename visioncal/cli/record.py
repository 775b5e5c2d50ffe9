"""`visioncal record`."""

import json
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from visioncal.cli.console import asked, messages
from visioncal.cli.interrupts import ended_like_ctrl_c
from visioncal.cli.numbers import size_in
from visioncal.cli.options import AsJson, View
from visioncal.cli.recorded_cell import CellOptions, Scene, facts_of, guided, scene_of, shown_in
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import figure
from visioncal.live.capture.clock import HostClock
from visioncal.live.capture.core import Step, Watcher, missed
from visioncal.live.capture.devices import ArmWish, is_folder, open_arm, open_camera
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.messages import line_of
from visioncal.live.capture.options import CaptureOptions, Keep, Stillness
from visioncal.live.capture.record import Departure, departure, record
from visioncal.live.drivers.protocols import DeviceSetup, MovingArm
from visioncal.live.planning.written import SPEED

_taking = partial(typer.Option, rich_help_panel="How views are taken")
_moving = partial(typer.Option, rich_help_panel="How the arm is moved")
_camera = partial(typer.Option, rich_help_panel="What the camera is set to")


@dataclass(frozen=True)
class TakingOptions:
    """How views are taken."""

    frames: Annotated[
        int,
        _taking("--frames", min=1, max=100, help="Frames a view."),
    ] = 3
    keep: Annotated[
        Keep,
        _taking("--keep", help="The sharpest of these, or their mean."),
    ] = "sharpest"
    still_px: Annotated[
        float,
        _taking(
            "--still-px",
            min=0.01,
            max=10.0,
            help="Image motion over which nothing is taken.",
        ),
    ] = Stillness.image_px
    settle_s: Annotated[
        float,
        _taking(
            "--settle-s",
            min=0.0,
            max=30.0,
            help="How long arm and image must have been still before.",
        ),
    ] = Stillness.quiet_s
    speed: Annotated[
        float,
        _moving("--speed", help="Of the fastest joint, in rad/s; at most 1.5."),
    ] = SPEED

    def options(self, *, single: bool, lost: int) -> CaptureOptions:
        """The same, as a recording takes it.

        Args:
            single: Whether the camera gives each picture once.
            lost: How many stops in a row may give no view.
        """
        return CaptureOptions(
            speed=self.speed,
            frames=self.frames,
            keep=self.keep,
            still=Stillness(image_px=self.still_px, quiet_s=self.settle_s),
            single=single,
            lost=lost,
        )


@dataclass(frozen=True)
class DeviceOptions:
    """What the camera is set to."""

    resolution: Annotated[
        str | None,
        _camera("--resolution", metavar="W,H", help="Size of the images in pixels."),
    ] = None
    exposure_us: Annotated[
        int | None, _camera("--exposure-us", help="Exposure time in microseconds.")
    ] = None
    gain: Annotated[int | None, _camera("--gain", help="ISO, or the device's own unit.")] = None
    focus: Annotated[
        int | None, _camera("--focus", help="Lens position, in the device's own unit.")
    ] = None

    def setup(self) -> DeviceSetup:
        """The same, as drivers take it.

        Raises:
            DataError: The resolution is not two numbers.
        """
        resolution = None if self.resolution is None else size_in(self.resolution)
        return DeviceSetup(resolution, self.exposure_us, self.gain, self.focus)


def record_command(
    out: Annotated[
        Path,
        typer.Option(
            "-o",
            "--out",
            metavar="SESSION",
            file_okay=False,
            help="The session's folder; a new one.",
        ),
    ],
    arm: Annotated[
        str,
        typer.Option(
            "--arm",
            metavar="ur:HOST|manual",
            help="The arm: a UR by its address, or poses that you type from the pendant.",
        ),
    ],
    camera: Annotated[
        str,
        typer.Option(
            "--camera",
            metavar="oak|uvc:N|uvc:URL|folder:PATH",
            help="The camera: an OAK (oak:SERIAL for one of several), a webcam, a network "
            "camera's stream, or pictures that were taken already.",
        ),
    ],
    described: CellOptions,
    takes: TakingOptions,
    device: DeviceOptions,
    plan: Annotated[
        Path | None,
        typer.Option("--plan", help="What visioncal plan wrote: a folder, or its plan.json."),
    ] = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow", help="Move nothing: take a view whenever the arm, guided by hand, rests."
        ),
    ] = False,
    views: Annotated[
        int,
        typer.Option(
            "--views",
            min=0,
            help="With --follow or a manual arm: end after so many.",
        ),
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a recording that was ended or cut off.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be driven; nothing moves.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Begin to move without asking.")] = False,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Record a session: drive the stops of a plan, or follow an arm guided by hand.

    Every view is on the disk before the next is taken. Exit status 0: all views are there; 2: the
    recording ended before, the arm stands still, and --resume goes on.
    """
    scene = scene_of(plan, described)
    drives = not follow and arm.partition(":")[0] != "manual"
    if drives or dry_run:
        _check_driven(scene, drives=drives)
    taking = takes.options(single=is_folder(camera), lost=CaptureOptions.lost if drives else 0)
    requested = device.setup()
    answers = sys.stdin.isatty()
    wish = ArmWish("", not drives or dry_run, asked, described.pose_form, answers)
    with ended_like_ctrl_c(), _opened(arm, wish, camera, requested) as cell:
        scene.check(cell.camera.resolution, drives=drives)
        if dry_run:
            _report(departure(cell, scene.planned, (), taking), cell, taking)
            messages().print("Nothing was moved (--dry-run).")
            return
        start = Journal.resume if resume else Journal.begin
        count = len(scene.planned.stops) if drives else views
        facts = facts_of(scene, cell, out.name)
        journal = start(out, facts, cell.clock.unix_offset_s(), count)
        if taking.single:
            _check_not_begun(journal, camera)
        with shown_in(scene, cell, wanted=view) as viewers:
            watchers = [ViewLines(), *viewers]
            if drives:
                steps = driven(cell, scene, journal, taking, watchers, asks=not yes)
            else:
                ask = asked if answers else None
                steps = guided(cell, scene, journal, taking, watchers, views, ask)
    if drives:
        _check_all(journal, steps)
    _finish(journal, steps, as_json=as_json)


@contextmanager
def _opened(arm: str, wish: ArmWish, camera: str, requested: DeviceSetup) -> Iterator[LiveCell]:
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

    def stepped(self, step: Step) -> None:
        """Prints the line."""
        messages().print(escape(line_of(step)))


def driven(
    cell: LiveCell,
    scene: Scene,
    journal: Journal,
    taking: CaptureOptions,
    watchers: Sequence[Watcher],
    *,
    asks: bool,
) -> list[Step]:
    """Drives the plan's stops, after a word of the user."""
    leaving = departure(cell, scene.planned, [it.number for it in journal.views], taking)
    _report(leaving, cell, taking)
    if not leaving.stops:
        return []
    if asks:
        _confirm(cell)
    return record(cell, scene.planned, journal, taking, watchers, lens=cell.camera.factory)


def _report(leaving: Departure, cell: LiveCell, taking: CaptureOptions) -> None:
    """Says what is about to happen."""
    say, count = messages().print, len(leaving.stops)
    if not count:
        say("All stops of the plan have their view; nothing is left to drive.")
        return
    first = leaving.stops[0]
    postures = len(leaving.first)
    via = (
        f" by {postures - 1} posture{'s' if postures > 2 else ''} in between"
        if postures > 1
        else ""
    )
    say(
        escape(
            f"{cell.arm.name}, {cell.camera.name}: {count} stop{'s' if count > 1 else ''} to drive "
            f"at {taking.speed:g} rad/s, about {_minutes(leaving.duration_s)}"
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


def _check_all(journal: Journal, steps: Sequence[Step]) -> None:
    """Ends with status 2 where stops of the plan gave no view."""
    without = dict(missed(steps))
    if without:
        words = "; ".join(f"view {it}: {reason}" for it, reason in without.items())
        raise DataError(
            f"{len(without)} of {len(steps)} stops gave no view ({words}). {len(journal.views)} "
            f"views are in {journal.folder}.",
            culprits=[f"view {it}" for it in without],
            next_step="--resume tries them again.",
        )


def _finish(journal: Journal, steps: Sequence[Step], *, as_json: bool) -> None:
    """Says what there is now."""
    if as_json:
        typer.echo(json.dumps(_summary(journal, steps), indent=2, allow_nan=False))
        return
    count = len(journal.views)
    messages().print(
        escape(
            f"{count} view{'s' if count != 1 else ''} in {journal.folder}; next: visioncal "
            f"calibrate {journal.folder} -o out"
        )
    )


def _summary(journal: Journal, steps: Sequence[Step]) -> dict[str, Any]:
    known = [it.accuracy for it in steps if it.accuracy is not None and not it.accuracy.is_open]
    summary: dict[str, Any] = {
        "session": str(journal.folder),
        "views": [it.number for it in journal.views],
        "times_s": [
            {"view": it.view, **{name: round(value, 3) for name, value in vars(it.times).items()}}
            for it in steps
        ],
    }
    if known:
        summary["predicted"] = {"sigma_mm": known[-1].mm, "sigma_deg": known[-1].deg}
    return summary


def _check_driven(scene: Scene, *, drives: bool) -> None:
    """Refuses to drive without a plan, before a device is asked for."""
    if drives:
        _ = scene.planned
        return
    raise DataError(
        "--dry-run: a guided arm is not driven, so there is nothing to say of it.",
        culprits=["--dry-run"],
        next_step="Leave it out.",
    )


def _check_not_begun(journal: Journal, camera: str) -> None:
    """A folder begins with its first picture again, which would go to the wrong pose."""
    if journal.views:
        raise DataError(
            f"--resume: {camera} begins with its first picture again, and {len(journal.views)} "
            "views are there.",
            culprits=["--resume"],
            next_step="Record all of it into a new folder.",
        )


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
