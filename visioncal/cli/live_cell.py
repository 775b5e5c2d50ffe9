"""The cell of `visioncal record`, from its options: what is recorded, by which devices, and how."""

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager

from visioncal.cli.console import typed_line
from visioncal.cli.session_options import RecordOptions
from visioncal.core.errors import DataError, DriverError
from visioncal.core.parsing import refuse_given
from visioncal.interchange.formats.intrinsics import target_named
from visioncal.live.capture.cell import HostClock, LiveCell
from visioncal.live.capture.devices import open_arm, open_camera
from visioncal.live.capture.journal import RecordedCell
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.drivers.protocols import Arm, DeviceSetup, MovingArm, RequestingArm
from visioncal.planning.cell import PlanCell
from visioncal.planning.plan_file import PlanFile
from visioncal.robot import load_robot


def taking_of(options: RecordOptions, *, is_driven: bool) -> CaptureOptions:
    """How views are taken."""
    return CaptureOptions(
        speed=options.speed,
        frames=options.frames,
        still=Stillness(image_px=options.still_px, quiet_s=options.settle_s),
        # Where a person sees them, missed views end nothing.
        missed_in_a_row=CaptureOptions.missed_in_a_row if is_driven else 0,
    )


def check_order(cell: LiveCell, *, is_resumed: bool) -> None:
    """Refuses what would part a folder's pictures from their poses; raises DataError."""
    if cell.is_stored and (is_resumed or not isinstance(cell.arm, RequestingArm)):
        raise DataError(
            "record: pictures of a folder belong to poses by their order alone, from the first on: "
            "neither a followed arm, a driven one nor --resume can keep it.",
            culprits=["--camera", "--resume" if is_resumed else "--arm"],
            next_step="Record all of it into a new session, with poses that are typed or sent.",
        )


def recorded_cell(plan: PlanFile | None, described: RecordOptions) -> RecordedCell | PlanCell:
    """The cell that is recorded, by the plan or by options; raises DataError."""
    target, robot, mount = described.target, described.robot, described.mount
    found: RecordedCell | PlanCell
    if plan is not None:
        given = {"--target": target, "--robot": robot, "--mount": mount}
        refuse_given(given, "the plan says that already")
        found = plan.cell
    elif target is None:
        raise DataError(
            "record needs --plan or --target to know what to look for.",
            culprits=["--plan", "--target"],
            next_step="Name the board, as --target charuco_9x6_30mm.",
        )
    else:
        arm = None if robot is None else load_robot(robot)
        found = RecordedCell(mount or "eye-in-hand", target_named(target), arm)
    if found.target.is_rig and not found.target.point_tags:
        raise DataError(
            f"record: target {found.target.name} is a rig of points, which no image is searched "
            "for.",
            culprits=["--target"],
            next_step="Record with a printed board, or write views.csv and corners.csv yourself.",
        )
    return found


@contextmanager
def opened(
    options: RecordOptions, *, is_moved: bool, given: Arm | None = None
) -> Iterator[LiveCell]:
    """Opens both devices, the arm unless it is given, and closes them at the end of the block."""
    requested = DeviceSetup(options.resolution, options.exposure_us, options.gain, options.focus)
    chosen = given or open_arm(
        *(str(options.arm), typed_line, options.pose_form),
        moves=is_moved,
        answers=sys.stdin.isatty(),
    )
    with closing(chosen) as arm:
        if is_moved and not isinstance(arm, MovingArm):
            raise DriverError(
                f"{arm.name} cannot be driven.",
                culprits=[arm.name],
                next_step="Guide it by hand: --follow.",
            )
        with closing(open_camera(str(options.camera), requested)) as camera:
            yield LiveCell(arm, camera, HostClock())
