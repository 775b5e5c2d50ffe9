"""`visioncal record`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from visioncal.cli.console import asked, say
from visioncal.cli.options import AsJson, View, Yes
from visioncal.cli.record_options import DeviceOptions, RecordCellOptions, TakingOptions
from visioncal.core.interrupts import signals_as_interrupts
from visioncal.live.capture.options import CaptureOptions


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
            metavar="ur:HOST|manual",
            help="The arm: a UR by its address, or poses that you type from the pendant.",
        ),
    ],
    camera: Annotated[
        str,
        typer.Option(
            metavar="oak|uvc:N|uvc:URL|folder:PATH",
            help="The camera: an OAK (oak:SERIAL for one of several), a webcam, a network "
            "camera's stream, or pictures that were taken already.",
        ),
    ],
    described: RecordCellOptions,
    takes: TakingOptions,
    device: DeviceOptions,
    plan: Annotated[
        Path | None, typer.Option(help="What visioncal plan wrote: a folder, or its plan.json.")
    ] = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow", help="Move nothing: take a view whenever the arm, guided by hand, rests."
        ),
    ] = False,
    views: Annotated[
        int, typer.Option(min=0, help="With --follow or a manual arm: end after this number.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a recording that was ended or cut off.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be driven; nothing moves.")
    ] = False,
    yes: Yes = False,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Record a session: drive the stops of a plan, or follow an arm guided by hand.

    Every view is on the disk before the next is taken. Exit status 0: all views are there; 2: the
    recording ended early, the arm stands still, and --resume continues it.
    """
    from visioncal.cli.recorded_cell import (
        ViewLines,
        check_all,
        check_driven,
        check_not_begun,
        facts_of,
        finish,
        opened,
        record_driven,
        record_guided,
        report_departure,
        scene_of,
        shown_in,
    )
    from visioncal.live.capture.devices import ArmSetup, is_folder
    from visioncal.live.capture.gate import Consent
    from visioncal.live.capture.journal import Journal
    from visioncal.live.capture.recording import motion_summary

    scene = scene_of(plan, described)
    drives = not follow and arm.partition(":")[0] != "manual"
    if drives or dry_run:
        check_driven(scene, drives=drives)
    taking = takes.options(
        single=is_folder(camera), lost=CaptureOptions.missed_in_a_row if drives else 0
    )
    requested = device.setup()
    answers = sys.stdin.isatty()
    wish = ArmSetup("", not drives or dry_run, asked, described.pose_form, answers)
    with signals_as_interrupts(), opened(arm, wish, camera, requested) as cell:
        scene.check(cell.camera.resolution, drives=drives)
        if dry_run:
            report_departure(motion_summary(cell, scene.planned, (), taking), cell, taking)
            say("Nothing was moved (--dry-run).")
            return
        consent = Consent.of("record", asked, yes=yes or not drives)
        start = Journal.resume if resume else Journal.begin
        count = len(scene.planned.stops) if drives else views
        facts = facts_of(scene, cell, out.name)
        journal = start(out, facts, cell.clock.unix_offset_s(), count)
        if taking.single:
            check_not_begun(journal, camera)
        with shown_in(scene, cell, wanted=view) as viewers:
            watchers = [ViewLines(), *viewers]
            if drives:
                steps = record_driven(cell, scene, journal, taking, watchers, consent)
            else:
                ask = asked if answers else None
                steps = record_guided(cell, scene, journal, taking, watchers, views, ask)
    if drives:
        check_all(journal, steps)
    finish(journal, steps, as_json=as_json)
