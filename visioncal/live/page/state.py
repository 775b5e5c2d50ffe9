"""State of the page: the setup, its task, the table of views, and all that browsers are shown."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from visioncal.core.conventions import PoseForm
from visioncal.core.documents.pendants import pendant_words
from visioncal.core.number_format import figure
from visioncal.core.types import Camera, Corners
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.journal import Journal, RecordedCell, picture_name, state_of
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.drivers.protocols import ArmState
from visioncal.live.page.outcome import Light, Outcome
from visioncal.live.page.suggestion import NextPose
from visioncal.planning.cell import PlanCell
from visioncal.session import View

# Possible faults of a view of the table. Where its picture has no pose, or its pose no picture,
# those from it on are one apart.
Fault = Literal["not wanted", "exchanged", "no pose", "no picture"]


@dataclass(frozen=True)
class Setup:
    """Questions of a page before a recording begins, in the words of the command line."""

    target: str = "charuco_9x6_30mm"  # The board.
    mount: str = "eye-in-hand"
    robot: str = ""  # The arm's model; empty where it has none.
    arm: str = "manual"
    camera: str = "uvc:0"
    pose_form: str = ""  # How poses are typed; empty to recognise it.
    against: str = ""  # The calibration to verify.


@dataclass(frozen=True)
class PageText:
    """Texts of a page: its questions and its other words."""

    title: str
    # Fields of the setup that are asked for, by their names: label, and what may be chosen.
    fields: Mapping[str, tuple[str, Sequence[str]]]
    finish: str  # Label of the button that judges the views.
    # Earlier results, the newest first: light, name and words.
    history: Callable[[], Sequence[tuple[Light, str, str]]] = lambda: ()


@dataclass(frozen=True, eq=False)
class Task:
    """A recording to make, and the command that judges it."""

    # Opens the devices, and begins or resumes the session.
    begin: Callable[[], AbstractContextManager[tuple[LiveCell, Journal]]]
    recorded: RecordedCell | PlanCell
    lens: Camera | None  # Intrinsics; None where they are not known.
    stops: tuple[NextPose, ...]  # Planned poses; none where coverage decides.
    count: int  # Number of views after which it is judged; 0 where the person decides.
    options: CaptureOptions
    command: Sequence[str]  # The command's words, without the folder that it writes.
    result: Path  # The folder.
    usual: PoseForm | None = None  # The form of its controller's poses, where it is known.


@dataclass(frozen=True)
class Row:
    """A view in the table of a page."""

    number: int
    picture: str  # Name of the picture in its folder; empty where it has none.
    version: str  # Differs for each picture that the view has had.
    pose: str  # As it was typed, else as the pendant shows it.
    is_typed: bool  # Whether its pose may be typed anew.
    state: str  # The board in the picture, in words.
    residual: str = ""  # Of the newest trial; empty where that is of another picture or pose.
    is_odd: bool = False  # Whether that left it out.


@dataclass(eq=False)
class Visitor:
    """A browser: what it shows, and what became of its requests."""

    seen: "Snapshot"
    answers: int = 0  # Number of its requests that were answered.
    refusal: str = ""  # Why the last of them was refused; empty where it was done.
    lines: tuple[str, ...] = ()  # The lines of poses that were taken last.
    returned: str = ""  # The line of the view that was taken back last.


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Content of the pages."""

    phase: Literal["setup", "opening", "live", "stopped"] = "setup"
    setup: Setup = field(default_factory=Setup)
    problem: str = ""  # The fault and its remedy.
    picture: bytes = b""  # The live picture, a JPEG.
    pictures: int = 0  # Number of pictures so far.
    sees: str = ""  # The board in it, in words.
    is_still: bool | None = None  # None where pictures are no stream.
    arm: str = ""  # The arm's name.
    takes_typed: bool = False  # Whether poses are typed.
    views: tuple[Row, ...] = ()
    revision: int = 0  # Number of changes of the table so far.
    again: int | None = None  # Number of the view that the next one replaces.
    is_stored: bool = False  # Whether pictures are those of a folder.
    due: str = ""  # Name of the folder's picture that belongs to the next pose.
    waiting: tuple[str, ...] = ()  # Names of its pictures that have no pose yet.
    left_out: tuple[str, ...] = ()  # Names of those that are to have none.
    note: str = ""  # How views are requested.
    missed: str = ""  # Why the last try gave no view.
    coverage: str = ""  # The coverage, as SVG.
    advice: str = ""
    next_pose: NextPose | None = None
    pose_form: str = ""  # The form in which poses are shown.
    trial: Outcome | None = None  # Result of the views so far.
    outcome: Outcome | None = None  # Result at the end.
    outdated: str = ""  # The change since the newer of the two.
    is_judging: bool = False


def why_same(state: ArmState, others: Sequence[View | ArmState]) -> str:
    """Says which of other rows, or of the lines before, has the same pose; empty for none."""
    for other in others:
        taken = state_of(other) if isinstance(other, View) else other
        if taken and np.abs(taken.base_from_flange - state.base_from_flange).max() < 1e-9:
            where = f"View {other.number}" if isinstance(other, View) else "A line before"
            return f"{where} has this very pose: type that of this picture, or drive to another."
    return ""


def sight_words(corners: Corners) -> str:
    """Corners that were found in a picture, in words."""
    return f"{len(corners.ids)} corners, edges {figure(corners.blur_px)} px"


def mended_poses(
    poses: Mapping[int, View | ArmState], fault: Fault, first: int, other: int
) -> dict[int, View | ArmState]:
    """The poses of views by their numbers, with a fault of the first or from it on mended."""
    mended, numbers = {**poses}, [at for at in poses if at >= first]
    moved = [poses[at] for at in numbers]
    if fault == "exchanged":
        mended[first], mended[other] = poses[other], poses[first]
    elif fault == "no picture":
        mended.update(zip(numbers, moved[1:], strict=False))
        del mended[numbers[-1]]
    else:
        if fault == "no pose":
            mended.update(zip(numbers[1:], moved, strict=False))
        del mended[first]
    return mended


def table_rows(
    views: Sequence[View], found: Mapping[int, Corners], outcome: Outcome | None, form: PoseForm
) -> tuple[Row, ...]:
    """The table of views with the corners found in them, and their residuals by an outcome."""
    rows = list[Row]()
    for view in views:
        state, corners = state_of(view), found.get(view.number)
        pose = view.text.get("typed", "")
        if not pose and state is not None:
            pose = pendant_words(state.base_from_flange, form)
        seen = "no board" if corners is None else sight_words(corners)
        residual = ("", False) if outcome is None else outcome.residual(view)
        version, is_typed = f"{view.stamp_s}", view.joints_rad is None
        name = picture_name(view)
        rows.append(Row(view.number, name, version, pose, is_typed, seen, *residual))
    return tuple(rows)
