"""Observations of one camera and one robot with given lens, boards and arm."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.observed import Observed
from visioncal.core.types import IntArray
from visioncal.estimation.appearance import LensBoardParameters
from visioncal.estimation.chain import chain
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT
from visioncal.session.frames import edge_names
from visioncal.vision.pnp import ViewPoses


@dataclass(frozen=True, eq=False)
class ObservedPoses(Observed):
    """Observations with given lens, boards and arm, none of which is estimated here."""

    # Those of the session's boards that the problem contains, the reference board first.
    boards: tuple[int, ...] = (0,)
    used: tuple[int, ...] = ()  # The views in the problem, in the session's order.
    # Lens and boards with their free values; None without corners.
    free: LensBoardParameters | None = None
    calibrated: Arm | None = None  # The robot's calibrated arm; None for the nominal one.

    @classmethod
    def of(cls, observed: Observed) -> Self:
        """Copies the observations, with no lens, boards or arm given yet."""
        return cls(**{entry.name: getattr(observed, entry.name) for entry in fields(Observed)})

    def posed(self, poses: Iterable[ViewPoses], pixel_px: float | None) -> Self:
        """Takes over poses, recomputed with lens and boards where a view has a single pose.

        `pixel_px` is the noise of a corner's coordinate, if there are corners [px].
        """
        given = {pose.view: pose for pose in poses}
        if self.free is not None and pixel_px is not None:
            single = [
                view
                for view in given.values()
                if view.corners is not None and len(view.cam_from_target) == 1
            ]
            given |= {view.view: view for view in self.free.posed(single, pixel_px)}
        return replace(self, poses={**self.poses, **given})

    @cached_property
    def robot_arm(self) -> Arm:
        """The robot's arm at all views with a pose, in their order."""
        if self.calibrated is not None:
            return self.calibrated
        rows = {view.number: view for view in self.session.views}
        return Arm.of(
            ROBOT,
            np.array([*self.base_from_flange.values()]).reshape(-1, 4, 4),
            [rows[index] for index in self.base_from_flange],
            self.reported.matched,
            (self.session, next(iter(self.robots), "")),
        )

    def arm_at(self, views: Sequence[int]) -> Arm:
        """The robot's arm at some views."""
        places = {view: at for at, view in enumerate(self.base_from_flange)}
        return self.robot_arm.at(np.array([places[view] for view in views], dtype=np.int64))

    def problem(self, views: Sequence[int]) -> Problem:
        """The problem of some views, each with its first or chosen pose."""
        poses, arm = [self.poses[view] for view in views], self.arm_at(self.first_of_stops(views))
        covariance, effects = None, []
        from_corners = all(pose.corners is not None for pose in poses)
        if self.free is not None:
            # Measured poses do not depend on lens and boards.
            shift = np.zeros((len(poses), 6, len(self.free.columns)))
            if from_corners:
                shift = np.array([pose.shared_jacobian[0] for pose in poses]).reshape(shift.shape)
            effects = [self.free.effect(shift)]
        if from_corners:
            covariance = np.array([pose.covariance[0] for pose in poses]).reshape(-1, 6, 6)
        effects += arm.effects()
        return chain(
            self.session.mount,
            arm.poses,
            np.array([pose.cam_from_target[0] for pose in poses]).reshape(-1, 4, 4),
            covariance,
            stops=self.stops_of(views),
            targets=tuple(self.frame_of(pose.board) for pose in poses),
            order=[self.frame_of(board) for board in self.boards],
            # Shared values are relative to the given ones.
            effects=[replace(effect, values=np.zeros(len(effect))) for effect in effects],
        )

    def frame_of(self, board: int) -> str:
        """The frame of one of the session's boards."""
        if len(self.session.boards) < 2:
            return edge_names(self.session.mount)[1].partition("_from_")[2]
        return [*self.session.board_frames.values()][board]

    def first_of_stops(self, views: Sequence[int]) -> list[int]:
        """(s,) the first view of each stop."""
        first = np.unique(self.stops_of(views), return_index=True)[1]
        return [views[index] for index in first.tolist()]

    def stops_of(self, views: Sequence[int]) -> IntArray:
        """(m,) stop of the robot at each view, numbered from 0.

        Views of one stop share the robot's error. Of measured poses, the noise is not separated
        from the robot's: each then has a stop of its own.
        """
        are_measured = any(self.poses[view].corners is None for view in views)
        keys: dict[tuple[int, int], int] = {}
        stations = {row.view.number: row.station for row in self.timed.observations}
        pairs = ((stations[view], view if are_measured else 0) for view in views)
        return np.array([keys.setdefault(pair, len(keys)) for pair in pairs], dtype=np.int64)
