"""`visioncal record`."""

import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visioncal.cli.console import asked, print_json, say
from visioncal.cli.parsing import refuse_given
from visioncal.cli.session_options import RecordCellOptions, RecordOptions
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import counted, figure
from visioncal.core.threads import signals_as_interrupts
from visioncal.core.types import Camera, Mount, Target
from visioncal.interchange.formats.intrinsics import target_named
from visioncal.live.capture.cell import HostClock, LiveCell
from visioncal.live.capture.devices import ArmSetup, open_arm, open_camera
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import CaptureFacts, Journal
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.recording import (
    Capture,
    CaptureEvent,
    MotionSummary,
    Watcher,
    ask_and_take,
    follow,
    missed_stops,
    motion_summary,
    record,
)
from visioncal.live.drivers.protocols import DeviceSetup, MovingArm
from visioncal.live.planning.plan_file import PlanFile, read_plan
from visioncal.robot import Robot, load_robot


def record_command(options: RecordOptions) -> None:
    """Runs `visioncal record`."""
    scene = scene_of(options.plan, options.described)
    drives = not options.follow and options.arm.partition(":")[0] != "manual"
    if drives:
        # Refuses to drive without a plan, before a device is opened.
        _ = scene.planned
    else:
        is_dry = {"--dry-run": options.dry_run or None}
        refuse_given(is_dry, "a guided arm is not driven, so there is nothing to say of it")
    takes, device = options.takes, options.device
    taking = CaptureOptions(
        speed=takes.speed,
        frames=takes.frames,
        still=Stillness(image_px=takes.still_px, quiet_s=takes.settle_s),
        missed_in_a_row=CaptureOptions.missed_in_a_row if drives else 0,
    )
    requested = DeviceSetup(device.resolution, device.exposure_us, device.gain, device.focus)
    answers = sys.stdin.isatty()
    wish = ArmSetup("", not drives or options.dry_run, asked, options.described.pose_form, answers)
    with signals_as_interrupts(), opened(options.arm, wish, options.camera, requested) as cell:
        scene.check(cell.camera.resolution, drives=drives)
        if options.dry_run:
            report_departure(motion_summary(cell, scene.planned, (), taking), cell, taking)
            say("Nothing was moved (--dry-run).")
            return
        consent = Consent.of("record", asked, yes=options.yes or not drives)
        start = Journal.resume if options.resume else Journal.begin
        count = len(scene.planned.stops) if drives else options.views
        facts = facts_of(scene, cell, options.out.name)
        journal = start(options.out, facts, cell.clock.unix_offset_s(), count)
        watchers = [ViewLines()]
        if drives:
            steps = record_driven(cell, scene, journal, taking, watchers, consent)
        else:
            ask = asked if answers else None
            steps = record_guided(cell, scene, journal, taking, watchers, options.views, ask)
    if drives:
        check_all(journal, steps)
    finish(journal, steps, as_json=options.as_json)


@dataclass(frozen=True, eq=False)
class RecordedSetup:
    """Setup of a recording."""

    mount: Mount
    target: Target
    robot: Robot | None  # The arm's model; None where unknown.
    plan: PlanFile | None  # The stops; None without a plan.

    @property
    def planned(self) -> PlanFile:
        """The plan.

        Raises:
            DataError: There is none.
        """
        if self.plan is None:
            raise DataError(
                "record: an arm is driven by a plan, and none is given.",
                culprits=["--plan"],
                next_step="Make one with visioncal plan, or guide the arm by hand: --follow.",
            )
        return self.plan

    @property
    def lens(self) -> Camera | None:
        """The plan's lens; None without a plan."""
        return None if self.plan is None else self.plan.cell.camera

    def check(self, resolution: tuple[int, int], *, drives: bool) -> None:
        """Checks that the camera has the image size of the plan.

        Raises:
            DataError: It has another.
        """
        if not drives or self.lens is None or resolution == self.lens.resolution:
            return
        had, has = (f"{w} x {h}" for w, h in (self.lens.resolution, resolution))
        raise DataError(
            f"the plan is for pictures of {had} px, and the camera gives {has} px: the board might "
            "not be in them.",
            culprits=["--resolution"],
            next_step=f"Ask for them with --resolution {had.replace(' x ', ',')}, or plan anew.",
        )


def scene_of(plan: Path | None, described: RecordCellOptions | None = None) -> RecordedSetup:
    """Builds the setup of a recording from a plan or from options.

    Raises:
        DataError: The plan cannot be read, options contradict it, or no board is named.
    """
    described = described or RecordCellOptions()
    target, robot, mount = described.target, described.robot, described.mount
    if plan is not None:
        given = {"--target": target, "--robot": robot, "--mount": mount}
        repeated = [name for name, value in given.items() if value is not None]
        if repeated:
            raise DataError(
                f"{', '.join(repeated)}: the plan says that already.",
                culprits=repeated,
                next_step="Leave it out, or record without --plan.",
            )
        plan_file = read_plan(plan)
        return RecordedSetup(
            plan_file.cell.mount, _findable(plan_file.cell.target), plan_file.cell.robot, plan_file
        )
    if target is None:
        raise DataError(
            "record: --plan or --target is needed to know what to look for.",
            culprits=["--plan", "--target"],
            next_step="Name the board, as --target charuco_9x6_30mm.",
        )
    return RecordedSetup(
        mount or "eye-in-hand",
        _findable(target_named(target)),
        None if robot is None else load_robot(robot),
        None,
    )


def _findable(target: Target) -> Target:
    """Refuses a rig of points that cannot be detected in images."""
    if target.is_rig and not target.point_tags:
        raise DataError(
            f"record: target {target.name} is a rig of points, which no image is searched for.",
            culprits=["--target"],
            next_step="Record with a printed board, or write views.csv and corners.csv yourself.",
        )
    return target


def facts_of(scene: RecordedSetup, cell: LiveCell, name: str) -> CaptureFacts:
    """Facts of the cell that are recorded besides its views."""
    camera = cell.camera
    return CaptureFacts(
        name or "session",
        scene.mount,
        scene.target,
        scene.robot,
        cell.arm.name,
        camera.name,
        camera.resolution,
        camera.factory,
        dict(camera.settings),
        "" if scene.plan is None else scene.plan.digest,
    )


def record_guided(
    cell: LiveCell,
    scene: RecordedSetup,
    journal: Journal,
    taking: CaptureOptions,
    watchers: Sequence[Watcher],
    views: int,
    ask: Callable[[str], str] | None,
) -> list[CaptureEvent]:
    """Records an arm that a person moves.

    Raises:
        DriverError: A device failed, or nothing was recorded.
        DataError: A view cannot be written, or three in a row gave none.
    """
    lens = cell.camera.factory or scene.lens
    capture = Capture(cell, scene.target, scene.robot, lens, journal, taking, None, watchers)
    if not isinstance(cell.arm, MovingArm):
        if ask is None:
            say("Poses are read from stdin, one a line, and no question is asked; q ends.")
        return ask_and_take(capture, cell.arm, views, ask)
    say("Guide the arm: a view is taken wherever it rests at a new place; Ctrl-C ends.")
    return follow(capture, views)


@contextmanager
def opened(arm: str, wish: ArmSetup, camera: str, requested: DeviceSetup) -> Iterator[LiveCell]:
    """Opens both devices, and closes them at the end of the block."""
    with closing(open_arm(arm, wish)) as opened:
        if not wish.watch_only and not isinstance(opened, MovingArm):
            raise DriverError(
                f"{opened.name} cannot be driven.",
                culprits=[opened.name],
                next_step="Guide it by hand: --follow.",
            )
        with closing(open_camera(camera, requested)) as device:
            yield LiveCell(opened, (device,), HostClock())


class ViewLines:
    """A watcher that prints a line for each view."""

    def stepped(self, step: CaptureEvent) -> None:
        """Prints the line."""
        say(step.line)


def record_driven(
    cell: LiveCell,
    scene: RecordedSetup,
    journal: Journal,
    taking: CaptureOptions,
    watchers: Sequence[Watcher],
    consent: Consent,
) -> list[CaptureEvent]:
    """Drives the plan's stops, each with the user's consent."""
    leaving = motion_summary(cell, scene.planned, [view.number for view in journal.views], taking)
    report_departure(leaving, cell, taking)
    if not leaving.stops:
        return []
    return record(cell, scene.planned, journal, taking, consent, watchers)


def report_departure(leaving: MotionSummary, cell: LiveCell, taking: CaptureOptions) -> None:
    """Prints what is about to be driven."""
    count = len(leaving.stops)
    if not count:
        say("All stops of the plan have their view; nothing is left to drive.")
        return
    first, seconds = leaving.stops[0], leaving.duration_s
    duration = f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
    postures = len(leaving.first)
    via = (
        f" by {postures - 1} posture{'s' if postures > 2 else ''} in between"
        if postures > 1
        else ""
    )
    say(
        f"{cell.arm.name}, {cell.camera.name}: {counted(count, 'stop')} to drive at "
        f"{taking.speed:g} rad/s, about {duration}"
    )
    say(
        f"  first to view {first.view}{via}; a joint turns by up to "
        f"{figure(math.degrees(leaving.turn_rad))} deg; the way is clear of all that was declared "
        "to the plan"
    )


def check_all(journal: Journal, steps: Sequence[CaptureEvent]) -> None:
    """Ends with status 2 where stops of the plan gave no view."""
    missing = missed_stops(steps)
    if missing:
        words = "; ".join(f"view {key}: {reason}" for key, reason in missing.items())
        raise DataError(
            f"{len(missing)} of {len(steps)} stops gave no view ({words}). {len(journal.views)} "
            f"views are in {journal.folder}.",
            culprits=[f"view {index}" for index in missing],
            next_step="--resume tries them again.",
        )


def finish(journal: Journal, steps: Sequence[CaptureEvent], *, as_json: bool) -> None:
    """Prints a summary of the recording, and the next command."""
    if as_json:
        predicted = [
            step.accuracy
            for step in steps
            if step.accuracy is not None and not step.accuracy.is_open
        ]
        summary: dict[str, Any] = {
            "session": str(journal.folder),
            "views": [view.number for view in journal.views],
        }
        if predicted:
            summary["predicted"] = {"sigma_mm": predicted[-1].mm, "sigma_deg": predicted[-1].deg}
        print_json(summary)
        return
    say(
        f"{counted(len(journal.views), 'view')} in {journal.folder}; next: visioncal calibrate "
        f"{shlex.quote(str(journal.folder))} -o out"
    )
