"""A cell to plan for: guesses of what is unknown, limits of the stops, and obstacles."""

from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias

import numpy as np

from visioncal.core.arguments import check_fields
from visioncal.core.codec import Array, Check, NotNegative, Vector, WrittenForm
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, rigid_fault
from visioncal.core.types import FloatArray, Mount, Target
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.touches import robot_noise
from visioncal.results import Calibration
from visioncal.results.arm import StoredRobot
from visioncal.results.lens import StoredCamera
from visioncal.robot import Robot
from visioncal.robot.collision import SLACK_M, Body, Collisions, arm_bodies, camera_body, capsule
from visioncal.session.kinds import Instrument
from visioncal.vision.targets import (
    corner_positions,
    extent_m,
    target_document,
    target_from_document,
    target_name,
)

# Noise of well-kept arms and cameras, where none is stated [rad, m and px].
TYPICAL_NOISE, TYPICAL_PX = Noise.of_robot(5e-5, 3e-5), 0.1
# Thickness of the plate under a board [m].
_PLATE_M = 0.01


_TILT = Check(
    "above 0 and up to 1.4: beyond it the camera looks at the board's edge",
    lambda angle: 0.0 < angle <= 1.4,
)
Pose: TypeAlias = Annotated[FloatArray, Array((4, 4))]
# Forms in plan.json. A board that comes with visioncal gets its name.
_TARGET = WrittenForm(
    target_document,
    lambda content, _: target_from_document(content, target_name(content) or "board"),
)
_NOISE = WrittenForm(
    lambda noise: noise.robots[0].tolist(), lambda sigmas, _: Noise.of_robot(*sigmas)
)


@dataclass(frozen=True, eq=False)
class Box:
    """A box-shaped obstacle."""

    name: str
    base_from_box: Pose  # (4, 4) frame at its centre [m].
    size_m: Vector  # (3,) full lengths along that frame's axes [m].

    def __post_init__(self) -> None:
        _check_pose(f"box {self.name}", self.base_from_box)
        size = np.asarray(self.size_m)
        if size.shape != (3,) or not np.all(np.isfinite(size) & (size > 0.0)):
            raise DataError(
                f"box {self.name}: its size is {size.tolist()}; three lengths above zero [m] are "
                "needed.",
                culprits=[f"box {self.name}"],
            )

    @property
    def body(self) -> Body:
        """The box as a body that is fixed to the base."""
        return Body(self.name, 0, "box", self.size_m, self.base_from_box)


@dataclass(frozen=True)
class Limits:
    """Limits of every planned stop, and of every path between two of them."""

    # Distance of the joints from their limits [rad]; [m] for a prismatic joint.
    joint_margin_rad: NotNegative = 0.05
    # Least and greatest distance of the camera from the board's centre [m]. None takes distances at
    # which the board fills the image well, and stays in it within the uncertainty of the guesses.
    distance_m: tuple[float, float] | None = None
    # Least and greatest depth at which the image is sharp [m]; None for any.
    focus_m: tuple[float, float] | None = None
    # Greatest angle between the line of sight and the board's normal [rad].
    tilt_rad: Annotated[float, _TILT] = 0.9
    edge_px: NotNegative = 20.0  # Distance of the board from the image's edge [px].
    # Distance of the arm, and of what it carries, from the floor, the board, the boxes and itself
    # [m].
    clearance_m: NotNegative = 0.03
    # Height of the floor in the base frame [m]; None for a cell without one.
    floor_m: float | None = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "limits")
        for name in ("distance_m", "focus_m"):
            span = getattr(self, name)
            if span is not None and not 0.0 <= span[0] < span[1]:
                raise DataError(
                    f"limits: {name} is {span}, but must be an ascending range from zero [m]."
                )


@dataclass(frozen=True, eq=False)
class PlanCell:
    """A cell to plan for: its parts, rough guesses of the unknown edges, and limits."""

    mount: Mount
    robot: StoredRobot
    camera: StoredCamera
    target: Annotated[Target, _TARGET]
    # (4, 4) guess of `flange_from_cam` (eye-in-hand) or `base_from_cam` (eye-to-hand) [m].
    x: Pose
    # (4, 4) guess of `base_from_target` (eye-in-hand) or `flange_from_target` (eye-to-hand).
    z: Pose
    sigma_rad: NotNegative  # Standard deviation of both rotations, per axis [rad].
    sigma_m: NotNegative  # The same for their translations [m].
    noise: Annotated[Noise, _NOISE]  # Noise of the robot's poses.
    pixel_px: float  # Noise of a corner, per axis [px].
    limits: Limits = field(default_factory=Limits)
    boxes: tuple[Box, ...] = ()
    # (12, 12) joint covariance of both edges (rotation, translation; right perturbations), where
    # recorded stops determine it; both sigmas are then typical of it. None where the sigmas are all
    # that is known.
    covariance: Annotated[FloatArray, Array((12, 12))] | None = None
    # Least and greatest distance at which the board has been observed [m], allowed whether it fills
    # the image there or not; None where it has not been.
    observed_distances_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if corner_positions(self.target)[:, 2].any():
            raise DataError(
                f"target {self.target.name} is a rig of points outside the plane z = 0 of its "
                "frame: which of them a view will show is not known, and no stops are planned.",
                culprits=[f"target {self.target.name}"],
                next_step="Plan with a flat board in the rig's place.",
            )
        for name, edge in (("x", self.x), ("z", self.z)):
            _check_pose(f"the guess of {name}", edge)
        check_fields(self, "the guesses")

    def collisions(self) -> Collisions:
        """See `collision_model`."""
        return collision_model(self)

    def cam_from_target(self, q: FloatArray) -> FloatArray:
        """Predicts (k, 4, 4) `cam_from_target` [m] at (k, n) joint angles [rad] by the guesses."""
        return self.seen_from(self.robot.base_from_flange(q))

    def seen_from(self, base_from_flange: FloatArray) -> FloatArray:
        """Predicts (k, 4, 4) `cam_from_target` at (k, 4, 4) poses of the flange [m]."""
        return seen_from(self.mount, self.x, self.z, base_from_flange)

    def flange_at(self, cam_from_target: FloatArray) -> FloatArray:
        """Poses (k, 4, 4) `base_from_flange` for views (k, 4, 4) `cam_from_target` [m]."""
        return flange_at(self.mount, self.x, self.z, cam_from_target)

    def guesses(self, count: int, seed: int) -> tuple["PlanCell", ...]:
        """Draws cells from the uncertainty of both edges, perturbed on the right."""
        rng = np.random.default_rng(seed)
        draws = rng.standard_normal((count, 12))
        if self.covariance is None:
            twists = draws * np.tile(np.repeat([self.sigma_rad, self.sigma_m], 3), 2)
        else:
            values, vectors = np.linalg.eigh(self.covariance)
            twists = draws @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
        moves = exp(twists.reshape(count, 2, 6))
        return tuple(replace(self, x=self.x @ by_x, z=self.z @ by_z) for by_x, by_z in moves)


@dataclass(frozen=True, eq=False)
class InstrumentCell:
    """An instrument beside an arm that carries its probe, with rough guesses of both places."""

    robot: Robot
    instrument: Instrument
    x: FloatArray  # (4, 4) `base_from_instrument` [m].
    z: FloatArray  # (4, 4) `flange_from_probe`; of a point only its position counts.
    are_poses: bool  # Whether the probe's rotation is read, too.
    noise: Noise  # Noise of the robot's poses.
    limits: Limits = field(default_factory=Limits)
    boxes: tuple[Box, ...] = ()
    mount: Mount = "instrument"

    def collisions(self) -> Collisions:
        """Collision model of the arm, the probe with its holder, and obstacles."""
        hand, flange = self.robot.joint_count, self.robot.chain.placements[-1]
        # The probe is as thick as the holder of a camera.
        tip = capsule("probe", hand, flange[:3, 3], (flange @ self.z)[:3, 3], 0.02)
        bodies = [*arm_bodies(self.robot), tip, *(box.body for box in self.boxes)]
        limits = self.limits
        return Collisions(self.robot, bodies, limits.clearance_m + SLACK_M, limits.floor_m)


AnyCell: TypeAlias = PlanCell | InstrumentCell


def flange_at(
    mount: Mount, x: FloatArray, z: FloatArray, cam_from_target: FloatArray
) -> FloatArray:
    """Poses `base_from_flange` (..., 4, 4) of views `cam_from_target` [m], by a cell's edges."""
    if mount == "eye-in-hand":
        return np.asarray(z @ invert(cam_from_target) @ invert(x))
    return np.asarray(x @ cam_from_target @ invert(z))


def seen_from(
    mount: Mount, x: FloatArray, z: FloatArray, base_from_flange: FloatArray
) -> FloatArray:
    """Predicts `cam_from_target` (..., 4, 4) [m], the inverse of `flange_at`."""
    if mount == "eye-in-hand":
        return np.asarray(invert(base_from_flange @ x) @ z)
    return np.asarray(invert(x) @ base_from_flange @ z)


def _check_pose(what: str, pose: FloatArray) -> None:
    # It may be typed with three digits.
    if fault := rigid_fault(np.asarray(pose), 1e-3):
        raise DataError(
            f"{what} must be a 4 x 4 matrix of a rotation and a translation [m]: {fault}.",
            culprits=[what],
        )


def cell_of_calibration(
    calibration: Calibration,
    target: Target,
    limits: Limits,
    boxes: tuple[Box, ...] = (),
    *,
    robot: Robot | None = None,
) -> PlanCell:
    """Takes a calibrated cell as the guess for another calibration of it.

    The edges' sigmas are those of the result, but at least a millimetre or two: the reason for
    another calibration may be that somebody touched the camera or the board. The robot is used
    where the calibration has none.

    Raises:
        DataError: The calibration has no robot or no camera.
    """
    arm = calibration.calibrated_robot or robot
    if arm is None:
        raise DataError(
            f"calibration {calibration.session_name!r} names no robot, and its stops cannot be "
            "planned without one.",
            culprits=["robot"],
            next_step="Name it with --robot.",
        )
    if calibration.camera is None:
        raise DataError(
            f"calibration {calibration.session_name!r} was made from measured poses and knows no "
            "camera.",
            culprits=["camera"],
            next_step="Plan from a robot, with --camera, --cam and --board.",
        )
    x, z = calibration.edges.values()
    sigma_m = max(1e-3 * x.sigma_mm, 1e-3 * z.sigma_mm) / np.sqrt(3.0)
    sigma_rad = np.deg2rad(max(x.sigma_deg, z.sigma_deg)) / np.sqrt(3.0)
    noise = robot_noise(calibration)
    # Few stops may underestimate the noise by chance.
    noise = replace(noise, robots=np.maximum(noise.robots, 0.5 * TYPICAL_NOISE.robots))
    budget = calibration.budget
    # Somebody may have touched something since the calibration: 5 mrad and 2 mm at least.
    return PlanCell(
        calibration.mount,
        arm,
        calibration.camera.camera,
        target,
        x.matrix,
        z.matrix,
        max(float(sigma_rad), 5e-3),
        max(float(sigma_m), 2e-3),
        noise,
        calibration.noise.get("pixel_px", TYPICAL_PX),
        limits,
        boxes,
        observed_distances_m=None if budget is None else (budget.distance_m, budget.distance_m),
    )


def collision_model(cell: PlanCell) -> Collisions:
    """Collision model of a cell: the arm, what it carries, and obstacles.

    The uncertainty of the guessed camera and board is added to their clearance.
    """
    hand = cell.robot.joint_count
    in_hand = cell.mount == "eye-in-hand"
    flange = cell.robot.chain.placements[-1]
    held, fixed = (cell.x, cell.z) if in_hand else (cell.z, cell.x)
    # Two standard deviations of the guesses.
    unsure_m = 2.0 * (cell.sigma_m + cell.sigma_rad * 0.5 * board_size_m(cell.target))
    if in_hand:
        carried = camera_body(hand, flange @ held, unsure_m)
        standing = _board(cell.target, 0, fixed, unsure_m)
    else:
        carried = _board(cell.target, hand, flange @ held, unsure_m)
        standing = camera_body(0, fixed, unsure_m)
    middle = carried.link_from_body[:3, 3]
    # The holder of the camera or the board is 20 mm in radius.
    bodies = [
        *arm_bodies(cell.robot),
        capsule("holder", hand, flange[:3, 3], middle, 0.02, unsure_m=unsure_m),
        carried,
        standing,
        *(box.body for box in cell.boxes),
    ]
    return Collisions(cell.robot, bodies, cell.limits.clearance_m, cell.limits.floor_m)


def board_size_m(target: Target) -> float:
    """The diagonal of the print [m]."""
    low, high = extent_m(target)
    return float(np.linalg.norm(high - low))


def _board(target: Target, link: int, link_from_target: FloatArray, unsure_m: float) -> Body:
    """The plate, whose face is the print."""
    low, high = extent_m(target)
    centre = compose(np.eye(3), np.append(0.5 * (low + high), 0.5 * _PLATE_M))
    # The rim around the print has 0.02 m.
    size = np.append(high - low + 0.04, _PLATE_M)
    return Body("board", link, "box", size, link_from_target @ centre, uncertainty_m=unsure_m)
