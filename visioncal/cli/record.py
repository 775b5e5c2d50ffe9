"""`visioncal record`."""

import math
import shlex
from collections.abc import Callable, Sequence
from typing import Any

from visioncal.cli.console import print_json, say, typed_line
from visioncal.cli.live_cell import check_order, opened, recorded_cell, taking_of
from visioncal.cli.session_options import RecordOptions
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, figure, listed
from visioncal.core.parsing import refuse_given
from visioncal.core.threads import signals_as_interrupts
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.devices import REQUESTING
from visioncal.live.capture.gate import Consent
from visioncal.live.capture.journal import CaptureFacts, Journal
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.recording import (
    Capture,
    CaptureEvent,
    MotionSummary,
    ask_and_take,
    follow,
    missed_stops,
    motion_summary,
    record,
)
from visioncal.live.drivers.protocols import RequestingArm
from visioncal.planning.plan_file import PlanFile, read_plan


def record_command(options: RecordOptions) -> None:
    """Runs `visioncal record`."""
    if options.page:
        # NiceGUI comes with an extra.
        from visioncal.cli.page import record_on_page

        record_on_page(options)
        return
    plan = None if options.plan is None else read_plan(options.plan)
    needed = ("target", "arm", "camera")[plan is not None :]
    missing = [f"--{name}" for name in needed if getattr(options, name) is None]
    drives = not options.follow and str(options.arm).partition(":")[0] not in REQUESTING
    if drives and plan is None and options.arm is not None:
        raise DataError(
            "record needs a plan to drive an arm.",
            culprits=["--plan"],
            next_step="Make one with visioncal plan, or guide the arm by hand: --follow "
            "and --target.",
        )
    if missing:
        examples = {"--target": "charuco_9x6_30mm", "--arm": "manual", "--camera": "uvc:0"}
        raise DataError(
            f"record: {listed(missing)} {'is' if len(missing) == 1 else 'are'} missing.",
            culprits=missing,
            next_step="Name them, as "
            f"{' '.join(f'{name} {examples[name]}' for name in missing)}; --page asks for them.",
        )
    recorded = recorded_cell(plan, options)
    if not drives:
        is_dry = {"--dry-run": options.dry_run or None}
        refuse_given(is_dry, "a guided arm is not driven, so there is nothing to say of it")
    driven = plan if drives else None
    taking = taking_of(options, is_driven=drives)
    with signals_as_interrupts(), opened(options, is_moved=drives and not options.dry_run) as cell:
        check_order(cell, is_resumed=options.resume)
        if driven is not None and driven.cell.camera.resolution != cell.camera.resolution:
            sizes = driven.cell.camera.resolution, cell.camera.resolution
            had, has = (f"{width} x {height}" for width, height in sizes)
            raise DataError(
                f"the plan is for pictures of {had} px, and the camera gives {has} px: the board "
                "might not be in them.",
                culprits=["--resolution"],
                next_step=f"Ask for them with --resolution {had.replace(' x ', ',')}, or plan "
                "anew.",
            )
        if options.dry_run and driven is not None:
            report_departure(motion_summary(cell, driven, (), taking), cell, taking)
            say("Nothing was moved (--dry-run).")
            return
        consent = Consent.of(typed_line, yes=options.yes or not drives)
        start = Journal.resume if options.resume else Journal.begin
        count = options.views if driven is None else len(driven.stops)
        facts = CaptureFacts.of(cell, options.out.name, recorded, plan)
        journal = start(options.out, facts, cell.clock.unix_offset_s(), count)
        try:
            if driven is not None:
                steps = record_driven(cell, driven, journal, taking, consent, say_line)
            else:
                lens = cell.camera.factory or (None if plan is None else plan.cell.camera)
                target, robot = recorded.target, recorded.robot
                capture = Capture(cell, target, robot, lens, journal, taking, None, say_line)
                steps = _guided(capture, options.views)
        finally:
            journal.remove_unbegun()
    if drives:
        check_all(journal, steps)
    _finish(journal, steps, as_json=options.as_json)


def _guided(capture: Capture, views: int) -> list[CaptureEvent]:
    """Records an arm that a person or its own program moves."""
    arm = capture.cell.arm
    if not isinstance(arm, RequestingArm):
        say("Guide the arm: a view is taken wherever it rests at a new place; Ctrl-C ends.")
        return follow(capture, views)
    if arm.invitation:
        say(arm.invitation)
    return ask_and_take(capture, arm, views)


def say_line(step: CaptureEvent) -> None:
    """Prints the line of a view."""
    say(step.line)


def record_driven(
    cell: LiveCell,
    plan: PlanFile,
    journal: Journal,
    taking: CaptureOptions,
    consent: Consent,
    watch: Callable[[CaptureEvent], None],
) -> list[CaptureEvent]:
    """Drives the plan's stops, each with the user's consent."""
    leaving = motion_summary(cell, plan, [view.number for view in journal.views], taking)
    report_departure(leaving, cell, taking)
    return record(cell, plan, journal, taking, consent, watch) if leaving.stops else []


def report_departure(leaving: MotionSummary, cell: LiveCell, taking: CaptureOptions) -> None:
    """Prints what is about to be driven."""
    count = len(leaving.stops)
    if not count:
        say("All stops of the plan have their view; nothing is left to drive.")
        return
    seconds, between = leaving.duration_s, len(leaving.first) - 1
    duration = f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
    via = f" by {counted(between, 'posture')} in between" if between else ""
    say(
        f"{cell.arm.name}, {cell.camera.name}: {counted(count, 'stop')} to drive at "
        f"{taking.speed:g} rad/s, about {duration}"
    )
    say(
        f"  first to view {leaving.stops[0].view}{via}; a joint turns by up to "
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


def _finish(journal: Journal, steps: Sequence[CaptureEvent], *, as_json: bool) -> None:
    """Prints a summary of the recording, and the next command."""
    if not as_json:
        say(
            f"{counted(len(journal.views), 'view')} in {journal.folder}; next: visioncal calibrate "
            f"{shlex.quote(str(journal.folder))} -o out"
        )
        return
    summary: dict[str, Any] = {
        "session": str(journal.folder),
        "views": [view.number for view in journal.views],
    }
    for step in steps:
        if step.accuracy is not None and not step.accuracy.is_open:
            sigmas = {"sigma_mm": step.accuracy.mm, "sigma_deg": step.accuracy.deg}
            summary["predicted"] = sigmas
    print_json(summary)
