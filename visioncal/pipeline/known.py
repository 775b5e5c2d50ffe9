"""What is known of a session so far; every stage adds to it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from visioncal.calibration import CameraResult, Rms, Verdict
from visioncal.errors import DataError
from visioncal.estimator.closure import Closure
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.stages.handeye import HandEyeResult, robot_part
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.validate import HeldOut
from visioncal.targets import corner_positions
from visioncal.types import Corners, FloatArray, Progress, Rejection, SolverName

# A view's corners with their (n, 3) places on the target [m]; None where it has no image.
Seen = tuple[Corners, FloatArray] | None


@dataclass(frozen=True, eq=False)
class Known:
    """Everything that is known of a session at some point of the way.

    Attributes:
        session: What was recorded.
        solver: The hand-eye solver asked for.
        progress: Told of long work.
        robot: The nominal robot, where the session names a known one.
        base_from_flange: (4, 4) by view, as the robot reported it.
        corners: What was found of the target, by view.
        resolution: Size of the images [px].
        camera: The intrinsics, where there are images.
        poses: The target's pose by view; several candidates until they are chosen from.
        pixel_px: Noise of a corner's coordinate [px].
        used: The views in the fit, in the session's order.
        hand_eye: Both unknown edges.
        held_out: Residuals of used views, left out of the fit.
        rms: Residuals of the used views.
        verdict: Whether to trust it all.
        reasons: Why a view cannot be used, by view.
        warnings: What the user should know, in sentences.
    """

    session: Session
    solver: SolverName
    progress: Progress | None = None
    robot: Robot | None = None
    base_from_flange: Mapping[int, FloatArray] = field(default_factory=dict)
    corners: Mapping[int, Corners] = field(default_factory=dict)
    resolution: tuple[int, int] | None = None
    camera: CameraResult | None = None
    poses: Mapping[int, ViewPoses] = field(default_factory=dict)
    pixel_px: float | None = None
    used: tuple[int, ...] = ()
    hand_eye: HandEyeResult | None = None
    held_out: HeldOut | None = None
    rms: Rms | None = None
    verdict: Verdict | None = None
    reasons: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def noting(self, rejections: Iterable[Rejection], warnings: Iterable[str] = ()) -> Self:
        """Adds rejected views, of which the first reason counts, and warnings."""
        reasons = {it.view: it.reason for it in rejections} | dict(self.reasons)
        return replace(self, reasons=reasons, warnings=(*self.warnings, *warnings))

    @property
    def held_back(self) -> frozenset[int]:
        """The views that the session keeps from every fit (`role = holdout`)."""
        return frozenset(view.number for view in self.session.views if view.holdout)

    def closure(self, views: Sequence[int]) -> Closure:
        """The chain's known parts for some views, each with its first or chosen pose."""
        robot = np.array([self.base_from_flange[view] for view in views]).reshape(-1, 4, 4)
        camera = np.array([self.poses[view].cam_from_target[0] for view in views])
        return Closure(robot_part(robot, self.session.mount), camera.reshape(-1, 4, 4))

    def seen(self, views: Sequence[int]) -> list[Seen]:
        """The corners of some views with their places on the target."""
        target = self.session.target
        positions = None if target is None else corner_positions(target)
        corners = [self.poses[view].corners for view in views]
        return [
            None if it is None or positions is None else (it, positions[it.ids]) for it in corners
        ]

    @property
    def solved(self) -> HandEyeResult:
        """Both unknown edges.

        Raises:
            DataError: A stage asks for them before they are solved for.
        """
        if self.hand_eye is None:
            raise DataError("pipeline: a stage that needs the hand-eye result comes before it.")
        return self.hand_eye
