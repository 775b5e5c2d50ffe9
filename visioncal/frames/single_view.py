"""Pose of a target in base or flange from one image, with its Jacobians by all error sources.

base_from_target = base_from_cam * cam_from_target                         eye-to-hand
base_from_target = base_from_flange * flange_from_cam * cam_from_target    eye-in-hand
flange_from_target = flange_from_base * base_from_cam * cam_from_target    eye-to-hand
flange_from_target = flange_from_cam * cam_from_target                     eye-in-hand

In the second and third case the robot is between parent and target: its noise counts, and images of
one stop share it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.arguments import check_fields
from visioncal.core.errors import DataError
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Corners, FloatArray, Image
from visioncal.frames.camera_chain import CalibratedCamera, checked_pose
from visioncal.frames.target_in_image import PoseCandidates

Parent: TypeAlias = Literal["base", "flange"]


@dataclass(frozen=True, eq=False)
class Sight:
    """One image of a target."""

    label: str  # Its name in messages and results.
    seen: Corners | Image  # The target's corners, or the (h, w) grey image to find them in.
    # (4, 4) the flange's pose at the image as reported; None where no robot is between parent and
    # target.
    base_from_flange: FloatArray | None = None
    # Number of the robot's stop; where None, images with the same pose are of one stop.
    stop: int | None = None
    # (n,) joints [rad] where the pose is the calibrated arm's for these joints.
    joints_rad: FloatArray | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def stop_key(self) -> object:
        """Hashable identity of the robot's stop; the label for an image without a pose."""
        if self.stop is not None:
            return self.stop
        return self.label if self.base_from_flange is None else self.base_from_flange.tobytes()


@dataclass(frozen=True, eq=False)
class TargetPlace:
    """Candidate pose of a target in the parent's frame, from one image."""

    matrix: FloatArray  # (4, 4) `parent_from_target`.
    pixels: FloatArray  # (6, 6) covariance of its right perturbation by the pixel noise.
    # (6, 6) Jacobian by the flange's perturbation; zero where the robot is not between. With k
    # images of one stop it is multiplied by sqrt(k), so that their mean has the variance of the
    # error that they share.
    flange_jacobian: FloatArray
    # (6, c) Jacobian by the errors that all images share: see `common_covariance`.
    by_common: FloatArray


def common_covariance(eye: CalibratedCamera, scale_sigma: float) -> FloatArray:
    """(c, c) covariance of common errors: the camera's edge, its lens, arm, target size."""
    return np.asarray(block_diag(eye.shared_covariance, [[scale_sigma**2]]))


def needs_robot(eye: CalibratedCamera, parent: Parent) -> bool:
    """Whether the robot is between the parent and the target."""
    return (eye.mount == "eye-in-hand") == (parent == "base")


def all_places(
    eye: CalibratedCamera, sights: Sequence[Sight], looks: Sequence[PoseCandidates], parent: Parent
) -> list[tuple[TargetPlace, ...]]:
    """Candidate poses in the parent's frame, for each image; see `candidate_places`."""
    stops = [sight.stop_key for sight in sights]
    return [
        candidate_places(eye, sight, look, parent, stops.count(stop))
        for sight, look, stop in zip(sights, looks, stops, strict=True)
    ]


def candidate_places(
    eye: CalibratedCamera, sight: Sight, view: PoseCandidates, parent: Parent, of_stop: int = 1
) -> tuple[TargetPlace, ...]:
    """Candidate poses of one image in the parent's frame.

    `view` has those in the camera's frame; `of_stop` is the number of images of the same stop.

    Raises:
        DataError: The robot's pose is needed and missing or invalid.
    """
    flange = sight.base_from_flange
    if not needs_robot(eye, parent):
        zero = np.zeros((len(view.symmetries), 6, 6))
        return _in_parent(view, eye.edge, zero, np.zeros((6, eye.arm_error_count)), of_stop)
    if flange is None:
        raise DataError(
            f"{sight.label}: the robot stands between the {parent} and what the camera "
            f"({eye.mount}) sees, and its pose is missing.",
            culprits=[sight.label],
            next_step="Give base_from_flange as the robot reported it when the image was taken.",
        )
    checked_pose(flange, f"{sight.label}: base_from_flange")
    arm = eye.arm_basis(flange, sight.joints_rad)
    if parent == "base":
        flange_jacobian = adjoint(invert(eye.edge @ view.cam_from_target))
        return _in_parent(view, flange @ eye.edge, flange_jacobian, arm, of_stop)
    flange_from_cam = invert(flange) @ eye.edge
    flange_jacobian = -adjoint(invert(flange_from_cam @ view.cam_from_target))
    return _in_parent(view, flange_from_cam, flange_jacobian, arm, of_stop)


def _in_parent(
    view: PoseCandidates,
    parent_from_cam: FloatArray,
    flange_jacobian: FloatArray,
    arm: FloatArray,
    of_stop: int,
) -> tuple[TargetPlace, ...]:
    by_edge = adjoint(invert(view.cam_from_target))
    return tuple(
        TargetPlace(
            parent_from_cam @ pose,
            view.covariance[at],
            np.sqrt(of_stop) * flange_jacobian[at],
            np.concatenate(
                [
                    by_edge[at],
                    view.by_lens[at],
                    flange_jacobian[at] @ arm,
                    view.by_scale[at][:, None],
                ],
                axis=1,
            ),
        )
        for at, pose in enumerate(view.cam_from_target)
    )


def check_labels(sights: Sequence[Sight]) -> None:
    """Checks that there are images with unique labels.

    Raises:
        DataError: There is no image, or two have one label.
    """
    if not sights:
        raise DataError("no image shows the target: at least one is needed.")
    labels = [sight.label for sight in sights]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise DataError(f"two images are called {twice[0]!r}.", culprits=twice)
