"""The cell that is recorded: from a plan, or from options."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from visioncal.cli.console import say
from visioncal.cli.record_options import RecordCellOptions
from visioncal.core.errors import DataError, DriverError
from visioncal.core.types import Camera, Mount, Target
from visioncal.interchange.formats.boards import target_named
from visioncal.live.capture.coach import Coach
from visioncal.live.capture.core import Capture, CaptureEvent, Watcher
from visioncal.live.capture.facts import CaptureFacts
from visioncal.live.capture.follow import ask_and_take, follow
from visioncal.live.capture.joint_pose_check import JointPoseCheck
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.live import LiveCell
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.predict import RecordedAccuracy
from visioncal.live.drivers.protocols import MovingArm
from visioncal.live.planning.read_back import PlanFile, read_plan
from visioncal.robot import Robot, load_robot


@dataclass(frozen=True, eq=False)
class RecordedSetup:
    """What is recorded of, as the user says it.

    Attributes:
        mount: Where the camera is.
        target: The board.
        robot: The arm's model; None where nobody said it.
        plan: The stops; None without a plan.
    """

    mount: Mount
    target: Target
    robot: Robot | None
    plan: PlanFile | None

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
        """The lens as the plan has it."""
        return None if self.plan is None else self.plan.cell.camera

    def check(self, resolution: tuple[int, int], *, drives: bool) -> None:
        """Checks that the camera's pictures are those that the stops were planned for.

        Raises:
            DataError: They are not.
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
    """Puts together what is recorded of.

    Raises:
        DataError: The plan cannot be read, says otherwise than the options, or no board is named.
    """
    described = described or RecordCellOptions()
    target, robot, mount = described.target, described.robot, described.mount
    if plan is not None:
        given = {"--target": target, "--robot": robot, "--mount": mount}
        said = [name for name, value in given.items() if value is not None]
        if said:
            raise DataError(
                f"{', '.join(said)}: the plan says that already.",
                culprits=said,
                next_step="Leave it out, or record without --plan.",
            )
        read = read_plan(plan)
        return RecordedSetup(read.cell.mount, _findable(read.cell.target), read.cell.robot, read)
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
    """Refuses a rig of points that is not found in images."""
    if target.kind == "points" and not target.point_tags:
        raise DataError(
            f"record: target {target.name} is a rig of points, which no image is searched for.",
            culprits=["--target"],
            next_step="Record with a printed board, or write views.csv and corners.csv yourself.",
        )
    return target


def facts_of(scene: RecordedSetup, cell: LiveCell, name: str) -> CaptureFacts:
    """What is written of the cell besides its views."""
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


def guided(
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
    prediction = RecordedAccuracy(journal.folder)
    lens = cell.camera.factory or scene.lens
    capture = Capture(
        cell,
        scene.target,
        journal,
        taking,
        JointPoseCheck(scene.robot),
        Coach(scene.target, cell.camera.resolution, lens),
        prediction,
        watchers,
    )
    try:
        if not isinstance(cell.arm, MovingArm):
            return ask_and_take(capture, cell.arm, views, ask)
        say("Guide the arm: a view is taken wherever it rests at a new place; Ctrl-C ends.")
        return follow(capture, views)
    finally:
        prediction.close()


@contextmanager
def shown_in(scene: RecordedSetup, cell: LiveCell, *, wanted: bool) -> Iterator[list[Watcher]]:
    """Opens the viewer where that is wanted; without a display the recording goes on unseen."""
    if not wanted:
        yield []
        return
    # Rerun takes half a second to import, which a recording that nobody watches need not wait for.
    from visioncal.live.capture.shown import Shown
    from visioncal.present.recording import live
    from visioncal.present.viewer.live import live_viewer

    plan = None if scene.plan is None else scene.plan.cell
    drawn = live.LiveCell(
        scene.mount,
        scene.target,
        cell.camera.resolution,
        scene.robot,
        cell.camera.factory or scene.lens,
        None if plan is None else plan.x,
        None if plan is None else plan.z,
    )
    with ExitStack() as opened:
        watchers: list[Watcher] = []
        try:
            stream = opened.enter_context(live_viewer(f"recording with {cell.camera.name}"))
            drawing = live.LiveDrawing(stream, drawn)
            drawing.begin()
            watchers = [Shown(drawing)]
        except DriverError as error:
            say(f"{error} The recording goes on without it.")
        yield watchers
