"""The observations of a session, by one camera and one robot or by many."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Self

from visioncal.calibration.stages.clock_offset import ClockedViews, ClockPair
from visioncal.calibration.stages.reported_poses import RobotReport
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed, some_of
from visioncal.core.types import Corners, FloatArray, Progress, Rejection, Searched
from visioncal.core.verdict import Finding
from visioncal.estimation.scene import Scene
from visioncal.results import HELD_BACK, CameraResult
from visioncal.robot import Robot
from visioncal.session import Session, frame_name
from visioncal.session.document import CameraTable
from visioncal.session.kinds import has_robot_state
from visioncal.vision.pnp import ViewPoses


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """Observations of one camera."""

    table: CameraTable  # The session's table of the camera.
    # The corners in its images, by view; those of several boards are numbered through.
    corners: Mapping[int, Corners]
    resolution: tuple[int, int] | None = None  # Size of its images [px].
    lens: CameraResult | None = None  # Its intrinsics; None where no view determines them.
    pixel_px: float | None = None  # Noise of a corner's coordinate [px].

    def in_model(
        self, lens: CameraResult, depths_m: Mapping[int, float] = MappingProxyType({})
    ) -> Self:
        """Corrects corners, of views at known distances, for a lens's errors beyond its model."""
        corners = {
            view: replace(detected, px=lens.in_model(detected.px, depths_m.get(view)))
            for view, detected in self.corners.items()
        }
        return replace(self, corners=corners)


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations of a session, as far as they are processed."""

    session: Session  # The recording.
    progress: Progress | None = None  # Reports long work.
    threads: int = 0  # Number of images that are processed at a time; 0 for one per core.
    # Observations of each camera with images, by its frame.
    cameras: Mapping[str, CameraObservations] = field(default_factory=dict)
    # The target's pose by view; several candidates until one is chosen.
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)
    reasons: Mapping[int, str] = field(default_factory=dict)  # Why a view cannot be used, by view.
    # Why views that repeat others are not needed, by view.
    repeats: Mapping[int, str] = field(default_factory=dict)
    # Reported poses and joints of each robot, by the name that rows give it.
    robots: Mapping[str, RobotReport] = field(default_factory=dict)
    # Relations of the clocks of cameras and robots, where robots' streams are used.
    clocks: Mapping[ClockPair, ClockedViews] = field(default_factory=dict)
    warnings: tuple[Finding, ...] = ()  # Findings for the user.
    notes: tuple[str, ...] = ()  # Remarks that are no reason for doubt.
    dense: bool = False  # Whether prints are fitted to all pixels of refused images.
    pictures: bool = False  # Whether faint copies of the images are kept.
    searches: Mapping[int, Searched] = field(default_factory=dict)  # Of each image, by view.
    # How robots' poses are misread, so that they determine nothing of lenses and boards; None where
    # this was not sought.
    misread: tuple[Finding, ...] | None = None
    # Sizes of pictures of views in corners.csv, as shares of the camera's, where they are others.
    shares: Mapping[int, float] = field(default_factory=dict)

    def noting(self, rejections: Iterable[Rejection], warnings: Iterable[Finding] = ()) -> Self:
        """Adds rejected views, of which the first reason counts, and warnings."""
        reasons = {rejection.view: rejection.reason for rejection in rejections}
        return replace(
            self, reasons={**reasons, **self.reasons}, warnings=(*self.warnings, *warnings)
        )

    def with_camera(self, frame: str, look: CameraObservations) -> Self:
        """Adds or replaces one camera's observations."""
        return replace(self, cameras={**self.cameras, frame: look})

    @cached_property
    def corners(self) -> Mapping[int, Corners]:
        """The corners in the images of all cameras, by view."""
        return {
            view: view_corners
            for look in self.cameras.values()
            for view, view_corners in look.corners.items()
        }

    @cached_property
    def timed(self) -> Session:
        """The session with robot poses from streams in the rows that wait for them."""
        if not self.clocks:
            return self.session
        timed_views = {view.number: view for clock in self.clocks.values() for view in clock.views}
        views = tuple(timed_views.get(view.number, view) for view in self.session.views)
        return replace(self.session, views=views)

    @cached_property
    def spared(self) -> Mapping[int, str]:
        """Why views of sweeps, and those that repeat others, are not needed, by view."""
        of_sweeps = (clock.spared for clock in self.clocks.values())
        return {view: why for spared in (*of_sweeps, self.repeats) for view, why in spared.items()}

    @property
    def lenses(self) -> Mapping[str, CameraResult]:
        """The known intrinsics of the cameras, by frame."""
        return {frame: look.lens for frame, look in self.cameras.items() if look.lens is not None}

    @property
    def scenes(self) -> Mapping[str, Scene]:
        """Boards and lens of each camera whose corners have poses, by its frame."""
        boards, tables = self.session.boards, {name: at.table for name, at in self.cameras.items()}
        return {
            frame: Scene(
                tuple(boards.values()),
                lens.camera,
                lens.estimated,
                tables[frame].intrinsics,
                tables[frame].matrix_sigma_px,
                tuple(boards),
            )
            for frame, lens in self.lenses.items()
            if boards and self.cameras[frame].pixel_px is not None
        }

    @property
    def reported(self) -> RobotReport:
        """Reported poses and joints of the only robot."""
        return next(iter(self.robots.values()), RobotReport({}))

    @property
    def base_from_flange(self) -> Mapping[int, FloatArray]:
        """(4, 4) reported poses of the only robot, by view."""
        return self.reported.base_from_flange

    @property
    def robot(self) -> Robot | None:
        """The nominal model of the only robot, where the session names a known one."""
        matched = self.reported.matched
        return None if matched is None else matched.robot

    @property
    def can_tilt(self) -> bool | None:
        """Whether the only robot's flange rotates about several axes; None without a model."""
        return None if self.robot is None else self.robot.can_tilt

    @property
    def pixel_px(self) -> float | None:
        """Noise of a coordinate of the only camera's corners [px]."""
        return next((camera.pixel_px for camera in self.cameras.values()), None)

    @property
    def poses_of_one_board(self) -> Mapping[int, ViewPoses]:
        """The poses of the board that most views show; those of others do not compare."""
        shown = [pose.board for pose in self.poses.values()]
        most = max(sorted(set(shown)), key=shown.count, default=0)
        return {view: pose for view, pose in self.poses.items() if pose.board == most}

    @cached_property
    def held_back(self) -> frozenset[int]:
        """The views that the session keeps out of every fit (`role = holdout`)."""
        return frozenset(view.number for view in self.session.views if view.holdout)

    @property
    def lost_views(self) -> tuple[str, ...]:
        """The rejected and held-back views, grouped by reason, in words."""
        held = dict.fromkeys(sorted(self.held_back - self.reasons.keys()), HELD_BACK)
        return by_reason({**self.reasons, **held})


def by_reason(reasons: Mapping[int, str]) -> tuple[str, ...]:
    """Groups views by why they cannot be used, in words: the most frequent reason first."""
    views = defaultdict(list)
    for view, reason in reasons.items():
        views[reason].append(view)
    grouped = sorted(views.items(), key=lambda item: -len(item[1]))
    # Views of one reason that are listed.
    return tuple(
        f"view{'s' if len(group) > 1 else ''} {some_of([*map(str, group)], 40)}: {reason}"
        for reason, group in grouped
    )


def all_held_back(observed: Observed) -> DataError:
    """The error where the session keeps every usable view out of the fit."""
    return DataError(
        f"session {observed.session.name!r}: all views that could be used are held back (role = "
        "holdout), and none is left to fit.",
        next_step="Clear role in the rows that the fit may use.",
    )


def _on_other_robots(observed: Observed) -> DataError | None:
    """The error where rows state another robot than the one that carries their camera or target."""
    session, found = observed.session, dict[str, tuple[str, str]]()
    for row in session.observations:
        if not (row.missing_robots and has_robot_state(row.view)):
            return None
        flange = frame_name("flange", row.missing_robots[0])
        frame = row.seer if session.frames[row.seer] == flange else row.seen
        found[frame] = row.missing_robots[0], row.view.text.get("robot", "")
    each = [
        f"{frame} is on robot {declared} as [frames] declares, and its rows state the poses of "
        f"robot {stated}"
        for frame, (declared, stated) in found.items()
    ]
    edits = [f'{frame} = "{frame_name("flange", stated)}"' for frame, (_, stated) in found.items()]
    return DataError(
        f"session {session.name!r}: {'; '.join(each)}.",
        culprits=[*found],
        next_step=f"Write {listed(edits)} in [frames] of session.toml, or the other robot in "
        "column robot of these rows in views.csv, and calibrate again.",
    )


def nothing_seen(observed: Observed) -> DataError:
    """The error where no view shows anything to calibrate by."""
    if observed.corners and observed.corners.keys() <= observed.held_back:
        return all_held_back(observed)
    if not any(view.image or view.has_corners for view in observed.session.views):
        return DataError(
            f"session {observed.session.name!r}: there are neither images nor measured poses.",
            next_step="Give the views images, rows in corners.csv, or cft_ or meas_ columns.",
        )
    if (elsewhere := _on_other_robots(observed)) is not None:
        return elsewhere
    image = next((view.image for view in observed.session.views if view.image), "an image")
    why = "".join(f" ({reason})" for reason in observed.lost_views[:1])
    return DataError(
        f"session {observed.session.name!r}: no view shows the target, or enough of it{why}.",
        culprits=observed.lost_views,
        next_step=f"Look at {image}: is the whole target in it, sharp, near enough and not "
        "mirrored, and is it the one that the session declares? visioncal target check IMAGE names "
        "the board, if it shows one.",
    )
