"""`visioncal record`."""

import json
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import typer
from rich.markup import escape

from visioncal.cli import record_options as options
from visioncal.cli.console import messages
from visioncal.cli.interrupts import ended_like_ctrl_c
from visioncal.cli.numbers import numbers_in
from visioncal.cli.recorded_cell import Scene, facts_of, guided, scene_of, shown_in
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import figure
from visioncal.live.capture.clock import HostClock
from visioncal.live.capture.core import Step, Watcher, missed
from visioncal.live.capture.devices import ArmWish, is_folder, open_arm, open_camera
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.messages import line_of
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.record import Departure, departure, record
from visioncal.live.drivers.protocols import DeviceWishes, MovingArm
from visioncal.live.planning.written import SPEED


def record_command(
    out: options.Out,
    arm: options.ArmOption,
    camera: options.CameraOption,
    plan: options.PlanOption = None,
    follow: options.Follow = False,
    views: options.Views = 0,
    resume: options.Resume = False,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    view: options.View = False,
    target: options.TargetOption = None,
    robot: options.RobotOption = None,
    mount: options.MountOption = None,
    pose_form: options.PoseForm = None,
    frames: options.Frames = 3,
    keep: options.KeepOption = "sharpest",
    still_px: options.StillPx = Stillness.image_px,
    settle_s: options.SettleS = Stillness.quiet_s,
    speed: options.Speed = SPEED,
    resolution: options.Resolution = None,
    exposure_us: options.ExposureUs = None,
    gain: options.Gain = None,
    focus: options.Focus = None,
    as_json: options.AsJson = False,
) -> None:
    """Record a session: drive the stops of a plan, or follow an arm guided by hand.

    Every view is on the disk before the next is taken. Exit status 0: all views are there; 2: the
    recording ended before, the arm stands still, and --resume goes on.
    """
    scene = scene_of(plan, target=target, robot=robot, mount=mount)
    drives = not follow and arm.partition(":")[0] != "manual"
    if drives or dry_run:
        _check_driven(scene, drives=drives)
    taking = CaptureOptions(
        speed=speed,
        frames=frames,
        keep=keep,
        still=Stillness(image_px=still_px, quiet_s=settle_s),
        single=is_folder(camera),
        lost=CaptureOptions.lost if drives else 0,
    )
    requested = DeviceWishes(_size(resolution), exposure_us, gain, focus)
    wish = ArmWish("", not drives or dry_run, _asked, pose_form)
    with ended_like_ctrl_c(), _opened(arm, wish, camera, requested) as cell:
        scene.check(cell.camera.resolution, drives=drives)
        if dry_run:
            _tell(departure(cell, scene.planned, (), taking), cell, taking)
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
                steps = guided(cell, scene, journal, taking, watchers, views, _asked)
    if drives:
        _check_all(journal, steps)
    _finish(journal, steps, as_json=as_json)


@contextmanager
def _opened(arm: str, wish: ArmWish, camera: str, requested: DeviceWishes) -> Iterator[LiveCell]:
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
    _tell(leaving, cell, taking)
    if not leaving.stops:
        return []
    if asks:
        _confirm(cell)
    return record(cell, scene.planned, journal, taking, watchers, lens=cell.camera.factory)


def _tell(leaving: Departure, cell: LiveCell, taking: CaptureOptions) -> None:
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


def _asked(question: str) -> str:
    """Asks on stderr, which leaves stdout to results.

    Raises:
        EOFError: Nothing more is typed.
    """
    messages().print(escape(question), end="")
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\r\n")


def _size(words: str | None) -> tuple[int, int] | None:
    if words is None:
        return None
    width, height = numbers_in(words, "--resolution", "w,h")
    return int(width), int(height)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
