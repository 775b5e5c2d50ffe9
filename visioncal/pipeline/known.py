"""What is known of a session so far; every stage adds to it."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from visioncal.calibration import CameraResult, Rms, Verdict
from visioncal.estimator.closure import Closure, Lens, Noise
from visioncal.estimator.linalg import covariance
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.stages.handeye import HandEyeResult, robot_part
from visioncal.stages.judge import Findings
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.validate import HeldOut
from visioncal.targets import corner_positions
from visioncal.types import Corners, FloatArray, IntArray, Progress, Rejection, SolverName

# Why a view is in no fit although nothing is wrong with it.
HELD_BACK = "held out of the fit by the session (role = holdout)"

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
        findings: What the verdict is made of.
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
    findings: Findings | None = None
    verdict: Verdict | None = None
    reasons: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def noting(self, rejections: Iterable[Rejection], warnings: Iterable[str] = ()) -> Self:
        """Adds rejected views, of which the first reason counts, and warnings."""
        reasons = {it.view: it.reason for it in rejections} | dict(self.reasons)
        return replace(self, reasons=reasons, warnings=(*self.warnings, *warnings))

    @property
    def lost_views(self) -> tuple[str, ...]:
        """The rejected views and those held back, grouped by their reason, in words."""
        views = defaultdict(list)
        for view, reason in self.reasons.items():
            views[reason].append(view)
        for view in self.held_back - self.reasons.keys():
            views[HELD_BACK].append(view)
        grouped = sorted(views.items(), key=lambda item: -len(item[1]))
        return tuple(
            f"view{'s' if len(it) > 1 else ''} {', '.join(map(str, it))}: {reason}"
            for reason, it in grouped
        )

    @property
    def held_back(self) -> frozenset[int]:
        """The views that the session keeps from every fit (`role = holdout`)."""
        return frozenset(view.number for view in self.session.views if view.holdout)

    def closure(self, views: Sequence[int]) -> Closure:
        """The chain's known parts for some views, each with its first or chosen pose."""
        mount, poses = self.session.mount, [self.poses[view] for view in views]
        robot = np.array([self.base_from_flange[view] for view in views]).reshape(-1, 4, 4)
        data = Closure(
            mount,
            robot_part(robot, mount),
            np.array([pose.cam_from_target[0] for pose in poses]).reshape(-1, 4, 4),
        )
        if not poses or any(pose.corners is None for pose in poses):
            return data
        return replace(
            data,
            camera_covariance=np.array([pose.covariance[0] for pose in poses]),
            lens=self._lens(poses),
        )

    def _lens(self, poses: Sequence[ViewPoses]) -> Lens | None:
        if self.camera is None or self.camera.covariance is None:
            return None
        shift = np.array([pose.by_intrinsics[0] for pose in poses])
        return Lens(covariance(self.camera.covariance), shift)

    @property
    def stops(self) -> IntArray:
        """(m,) which stop of the robot each used view was taken at, numbered from 0.

        Views of one stop share the robot's error. Where the session does not number its stops,
        views with the same reported pose are of one.
        """
        declared = {view.number: view.stop for view in self.session.views}
        keys: dict[object, int] = {}
        return np.array(
            [
                keys.setdefault(
                    self.base_from_flange[view].tobytes()
                    if (stop := declared[view]) is None
                    else stop,
                    len(keys),
                )
                for view in self.used
            ],
            dtype=np.int64,
        )

    def seen(self, views: Sequence[int]) -> list[Seen]:
        """The corners of some views with their places on the target."""
        target = self.session.target
        positions = None if target is None else corner_positions(target)
        corners = [self.poses[view].corners for view in views]
        return [
            None if it is None or positions is None else (it, positions[it.ids]) for it in corners
        ]

    @property
    def robot_noise(self) -> Noise | None:
        """Noise of the flange; None where it cannot be told from the camera's."""
        separate = self.closure(self.used).camera_covariance is not None
        return self.solved.noise if separate else None

    @property
    def solved(self) -> HandEyeResult:
        """Both unknown edges.

        Raises:
            RuntimeError: A stage asks for them before they are solved for: the order is wrong.
        """
        if self.hand_eye is None:
            raise RuntimeError("a stage that needs the hand-eye result comes before it")
        return self.hand_eye


def rms_of(away_m: FloatArray, away_rad: FloatArray, rms_px: FloatArray) -> Rms:
    """Root mean squares over views [m, rad, px]; views without corners have NaN pixels."""
    seen = rms_px[np.isfinite(rms_px)]
    return Rms(
        mm=float(1e3 * np.sqrt(np.mean(away_m**2))),
        deg=float(np.rad2deg(np.sqrt(np.mean(away_rad**2)))),
        px=float(np.sqrt(np.mean(seen**2))) if len(seen) else None,
    )
