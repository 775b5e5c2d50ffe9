"""Touches: flange poses at which the tool's tip touched a point of the cell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M, WIDE_RAD
from visioncal.core.number_format import did_you_mean, figure, some_of
from visioncal.core.transforms import invert, rotation_angle, skew
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.pointfit import PointPairs
from visioncal.results import Calibration, Edge, Frame, Verdict
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.selecting import ARM, Choice, check_one_of_each, select
from visioncal.session.table import reported_matrices

NO_TOOL = (
    "Find the tip with visioncal tcp first, and name its file with --tool; or say --tool none, "
    "where the controller's tool was active and the poses are of the tip itself."
)


@dataclass(frozen=True, eq=False)
class TouchRows:
    """The rows of a file of touches, n in all."""

    source: str  # Their origin, for messages and for the record.
    labels: tuple[str, ...]  # (n,) the rows' view numbers, as text.
    places: tuple[str, ...]  # (n,) the rows' lines: `touches.csv, line 3`.
    # (n, 4, 4) as the controller reported it [m]; NaN in a row without a pose, and in the rotation
    # where there are positions alone.
    base_from_flange: FloatArray
    # (n, j) joint angles [rad], NaN in a row without; None where there are none.
    joints_rad: FloatArray | None
    kinds: tuple[str, ...]  # (n,) kinds of the touches; empty where not stated.
    points: tuple[str, ...]  # (n,) names of the touched points; empty where not stated.
    # The poses as they are written in a table, which may be meant otherwise.
    numbers: PoseNumbers | None = None
    notes: tuple[str, ...] = ()  # Assumptions, in sentences for the user.

    def __len__(self) -> int:
        return len(self.labels)

    def of_kinds(self, allowed: Sequence[str], default: str = "", hint: str = "") -> "TouchRows":
        """Returns the rows with every kind filled in.

        `default` is the kind of a row without one, empty where a kind is required; `hint` is the
        advice where a kind resembles no allowed one.

        Raises:
            DataError: A row is of another kind.
        """
        kinds = tuple(kind.strip().lower() or default for kind in self.kinds)
        wrong = [at for at, kind in enumerate(kinds) if kind not in allowed]
        if wrong:
            seen = kinds[wrong[0]]
            needed = f"{some_of(allowed)} or nothing, for {default}," if default else "one of "
            needed += "" if default else some_of(allowed)
            raise DataError(
                f"{self.places[wrong[0]]}: "
                f"kind is {repr(seen) if seen else 'missing'}, but must be {needed}.",
                culprits=[self.places[at] for at in wrong],
                next_step=did_you_mean(seen, allowed) or hint,
            )
        return replace(self, kinds=kinds)


def touches_of(session: Session, robot: str | None = None) -> TouchRows:
    """Reads the rows of a session's views.csv as touches, in a whole cell those of one robot.

    Raises:
        DataError: It is of several robots, and none is named, or there is none of that name.
    """
    if len(session.robots) > 1:
        session = select(session, Choice(robot=robot), ARM)
    check_one_of_each(session)
    reported, no_pose = reported_matrices(session.views), np.full((4, 4), np.nan)
    joints = [view.joints_rad for view in session.views]
    size = max((len(joint) for joint in joints if joint is not None), default=0)
    no_joints = np.full(size, np.nan)
    return TouchRows(
        session.name,
        tuple(str(view.number) for view in session.views),
        tuple(f"views.csv, view {view.number}" for view in session.views),
        np.array([reported.get(view.number, no_pose) for view in session.views]),
        np.array([no_joints if joint is None else joint for joint in joints]) if size else None,
        tuple(view.text.get("kind", "") for view in session.views),
        tuple(view.text.get("point", "") for view in session.views),
    )


def flange_poses(
    rows: TouchRows, robot: Robot | None, calibration: Calibration | None = None
) -> FloatArray:
    """Flange poses of the touches.

    With a calibrated arm, joint angles take precedence: the controller reports poses of the nominal
    arm.

    Args:
        rows: The touches.
        robot: The arm's model, where the calibration has none.
        calibration: Of the same robot.

    Returns:
        (n, 4, 4) `base_from_flange` [m].

    Raises:
        DataError: A row has no pose, joints do not fit the model, or the numbers are in other units
            than metres and radians.
    """
    check_lengths(rows)
    calibrated = calibration is not None and calibration.arm_is_calibrated
    if calibration is not None and (calibrated or robot is None):
        robot = calibration.calibrated_robot
    reported = np.isfinite(rows.base_from_flange).all(axis=(1, 2))
    modelled, poses = _modelled(rows, robot, needed=not reported.all())
    missing = np.flatnonzero(~reported & ~modelled)
    if len(missing):
        places = [rows.places[index] for index in missing]
        raise DataError(
            f"{some_of(places)}: no pose of the robot.",
            culprits=places,
            next_step="Fill in x_m to qw, or joint angles and --robot-model.",
        )
    use_model = modelled if calibrated else modelled & ~reported
    if calibrated and calibration is not None and rows.joints_rad is not None:
        poses[modelled] = calibration.standing(rows.joints_rad[modelled])
    return np.where(use_model[:, None, None], poses, rows.base_from_flange)


def check_lengths(rows: TouchRows) -> None:
    """Checks that positions are in metres: that they are within an arm's reach.

    Raises:
        DataError: They look like millimetres, or like metres read as millimetres.
    """
    # Squares of the largest numbers overflow.
    distances = np.hypot.reduce(rows.base_from_flange[:, :3, 3], axis=1)
    far = np.flatnonzero(distances > FAR_M)
    if len(far):
        raise DataError(
            f"{rows.places[far[0]]}: its position is {distances[far[0]]:.4g} m from the base, and "
            f"no arm reaches {FAR_M:g} m: these look like millimetres.",
            culprits=[rows.places[index] for index in far],
            next_step="Give --robot-unit mm, or write metres.",
        )
    farthest = float(np.max(distances, initial=0.0, where=np.isfinite(distances)))
    # No arm works within 20 mm of its base's origin.
    if 0.0 < farthest < 0.02:
        raise DataError(
            f"{rows.source}: all positions are within {figure(1e3 * farthest)} mm of the base's "
            "origin, where no arm works: these look like metres read as millimetres.",
            culprits=[rows.source],
            next_step="Give --robot-unit m, or write millimetres.",
        )


def refuse_copies(poses: FloatArray, places: Sequence[str]) -> None:
    """Checks that the poses (n, 4, 4) are unique; raises DataError."""
    numbers = np.nan_to_num(poses.reshape(len(poses), -1))
    differences = np.abs(numbers[:, None] - numbers[None]).max(axis=2)
    first, second = np.nonzero(np.triu(differences < 1e-9, 1))
    if len(first):
        names = [places[first[0]], places[second[0]]]
        raise DataError(
            f"{names[0]} and {names[1]} have the same pose: one is a copy, and would count as a "
            "touch of its own.",
            culprits=names,
            next_step="Leave one of them out, or touch again and write down where the robot is.",
        )


def robot_noise(calibration: Calibration | None) -> Noise:
    """The calibrated noise of the flange from stop to stop; zero where unknown."""
    noise = {} if calibration is None else calibration.noise
    return Noise.of_robot(
        float(np.deg2rad(noise.get("robot_rotation_deg", 0.0))),
        1e-3 * noise.get("robot_translation_mm", 0.0),
    )


def _modelled(rows: TouchRows, robot: Robot | None, *, needed: bool) -> tuple[Mask, FloatArray]:
    """Mask of the rows with a pose by the arm's model, and the poses."""
    poses, has_joints = rows.base_from_flange.copy(), np.zeros(len(rows), dtype=bool)
    if rows.joints_rad is None:
        return has_joints, poses
    has_joints = np.asarray(np.isfinite(rows.joints_rad).all(axis=1))
    largest = np.abs(np.where(has_joints[:, None], rows.joints_rad, 0.0)).max(axis=1, initial=0.0)
    wide = np.flatnonzero(largest > WIDE_RAD)
    if len(wide):
        raise DataError(
            f"{rows.places[wide[0]]}: a joint stands at {largest[wide[0]]:.4g} rad, more than two "
            "turns: these look like degrees.",
            culprits=[rows.places[index] for index in wide],
            next_step="Give --joint-unit deg, or write radians.",
        )
    if robot is None:
        if needed and has_joints.any():
            raise DataError(
                f"{rows.source}: there are joint angles, but no model of the robot.",
                culprits=[rows.source],
                next_step="Name it with --robot-model, or fill in x_m to qw.",
            )
        return np.zeros(len(rows), dtype=bool), poses
    if rows.joints_rad.shape[1] != robot.joint_count:
        raise DataError(
            f"{rows.source}: a row has {rows.joints_rad.shape[1]} joint angles, but {robot.name} "
            f"has {robot.joint_count} joints.",
            culprits=[rows.source],
        )
    poses[has_joints] = robot.base_from_flange(rows.joints_rad[has_joints])
    paired_rows = np.flatnonzero(has_joints & np.isfinite(rows.base_from_flange).all(axis=(1, 2)))
    delta = invert(poses[paired_rows]) @ rows.base_from_flange[paired_rows]
    off_m, off_rad = np.linalg.norm(delta[:, :3, 3], axis=1), rotation_angle(delta)
    # Farther apart than any arm errs, the row's pose is of another arm or frame [m, rad].
    odd = np.flatnonzero((off_m > 0.05) | (off_rad > 0.1))
    if len(odd):
        at = odd[0]
        raise DataError(
            f"{rows.places[paired_rows[at]]}: the joints lead through {robot.name} to a flange "
            f"{1e3 * off_m[at]:.0f} mm and {np.rad2deg(off_rad[at]):.1f} deg away from "
            "the pose that is reported.",
            culprits=[rows.places[index] for index in paired_rows[odd]],
            next_step="Check the robot's model and its base, and whether the controller reports "
            "the flange without a tool.",
        )
    return has_joints, poses


@dataclass(frozen=True, eq=False)
class Tool:
    """Tool that points were touched with."""

    name: str  # The transform's name, as `flange_from_gripper`.
    edge: Edge  # The transform.
    oriented: bool  # Whether its rotation was measured.
    verdict: Verdict  # Its verdict.

    @classmethod
    def among(cls, frames: Mapping[str, Frame], source: str, name: str | None) -> "Tool":
        """Selects a tool among frames by its name or its transform's; the only one where None.

        Raises:
            DataError: There is none of that name, or no name is given and there is not one tool.
        """
        tools = {word: frame for word, frame in frames.items() if word.startswith("flange_from_")}
        if name is None and len(tools) == 1:
            name = next(iter(tools))
        if name is None or not tools:
            state = f"has {len(tools)} tools: {some_of(list(tools))}" if tools else "has no tool"
            raise DataError(
                f"{source} {state}, but must have the one that the points were touched with.",
                culprits=list(tools) or [source],
                next_step=f"Give --tool {next(iter(tools))}, or the like." if tools else NO_TOOL,
            )
        full = name if name in tools else f"flange_from_{name}"
        if full not in tools:
            raise DataError(
                f"{source} has no tool {name!r}; it has {some_of(list(tools))}.",
                culprits=[name],
                next_step=did_you_mean(full, tools),
            )
        frame = tools[full]
        return cls(full, frame.edge, frame.oriented, frame.verdict)


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Measured points, n in all, with their covariance."""

    source: str  # Their origin, for the record.
    labels: tuple[str, ...]  # (n,) the measurements' names, such as the rows' view numbers.
    places: tuple[str, ...]  # (n,) their rows, `touches.csv, line 3`; empty where there are none.
    names: tuple[str, ...]  # (n,) names of the points; empty where unknown.
    points: FloatArray  # (n, 3) in the base [m].
    independent: FloatArray  # (n, 3, 3) covariance of each by its independent errors [m^2].
    common: FloatArray  # (3 n, 3 n) covariance by common errors, such as the tip's [m^2].
    # (n, 3) unit directions in the base to where the tool came from; NaN where unknown.
    outward: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def scattered(self) -> FloatArray:
        """(n, 3, 3) covariance of the points relative to each other.

        The independent part and the common part about its mean: an equal shift of all points does
        not show in the residuals of a fit.
        """
        count = len(self)
        centring = np.kron(np.eye(count) - 1.0 / count, np.eye(3))
        uneven = (centring @ self.common @ centring).reshape(count, 3, count, 3)
        at = np.arange(count)
        return np.asarray(self.independent + uneven[at, :, at, :])

    @property
    def covariance(self) -> FloatArray:
        """(3 n, 3 n) joint covariance of all points [m^2]."""
        return np.asarray(block_diag(*self.independent) + self.common)

    def carried(self, by_points: FloatArray, noise_m: FloatArray) -> FloatArray:
        """(p, p) covariance of a result with the (n, p, 3) Jacobian `by_points` by each point.

        `noise_m` is the (n,) additional noise of each per axis [m].
        """
        jacobian = np.concatenate(list(by_points), axis=1)
        total = self.covariance + np.diag(np.repeat(noise_m**2, 3))
        return np.asarray(jacobian @ total @ jacobian.T)


def touched_points(
    rows: TouchRows,
    tool: Tool | None,
    noise: Noise,
    robot: Robot | None = None,
    calibration: Calibration | None = None,
) -> MeasuredPoints:
    """Computes the touched points from the flange's poses and the tool.

    Without a tool, the poses are of the tip itself. `robot` is the model for joint angles where the
    calibration has none; `noise` is that of the flange, per axis.

    Raises:
        DataError: A row has no pose, or the same one as another.
    """
    if tool is None:
        # Positions suffice for the tip itself.
        poses, tip = rows.base_from_flange, np.zeros(3)
        known = np.isfinite(poses[:, :3, 3]).all(axis=1)
        missing = [rows.places[index] for index in np.flatnonzero(~known)]
        if missing:
            raise DataError(
                f"{some_of(missing)}: no position of the tip. With --tool none that is what the "
                "rows have to hold; joint angles lead to the flange alone.",
                culprits=missing,
                next_step="Fill in x_m, y_m, z_m, or name the tool with --tool.",
            )
        check_lengths(rows)
        covariance, axis = np.zeros((3, 3)), np.array([0.0, 0.0, 1.0])
    else:
        poses, tip = flange_poses(rows, robot, calibration), tool.edge.matrix[:3, 3]
        tool_rotation = tool.edge.matrix[:3, :3]
        covariance = tool_rotation @ tool.edge.covariance[3:, 3:] @ tool_rotation.T
        # A tool whose rotation was not measured points more or less along the flange's z.
        axis = tool_rotation[:, 2] if tool.oriented else np.array([0.0, 0.0, 1.0])
    refuse_copies(poses, rows.places)
    turns = poses[:, :3, :3]
    turn_sq, shift_sq = noise.robots[0] ** 2
    lever = shift_sq * np.eye(3) + turn_sq * skew(tip) @ skew(tip).T
    rotations = np.where(np.isfinite(turns), turns, np.eye(3))
    flat = np.concatenate(list(rotations), axis=0)
    return MeasuredPoints(
        rows.source,
        rows.labels,
        rows.places,
        tuple(point.strip() for point in rows.points),
        rotations @ tip + poses[:, :3, 3],
        rotations @ lever @ np.swapaxes(rotations, 1, 2),
        flat @ covariance @ flat.T,
        -(turns @ axis),
    )


@dataclass(frozen=True, eq=False)
class NominalPoints:
    """Nominal points of a drawing, n in all."""

    source: str  # Their origin, for messages and for the record.
    names: tuple[str, ...]  # (n,) unique names.
    positions: FloatArray  # (n, 3) [m] in the drawing's frame.
    sigma_m: FloatArray  # (n,) standard deviation of each coordinate [m]; 0 where taken as exact.

    def pairs_of(
        self, names: Sequence[str], measured: FloatArray, covariances: FloatArray
    ) -> PointPairs:
        """Pairs measured points with the drawn ones of the same names.

        Upper and lower case are the same where the match is unique.

        Args:
            names: (m,) names of the measured points; names may repeat.
            measured: (m, 3) in the base [m].
            covariances: (m, 3, 3) of their known noise [m^2].

        Raises:
            DataError: The drawing has no point of that name.
        """
        index_of = {name: at for at, name in enumerate(self.names)}
        folded = [name.casefold() for name in self.names]
        index_of |= {
            name: folded.index(name.casefold())
            for name in names
            if name not in index_of and folded.count(name.casefold()) == 1
        }
        unknown = [name for name in dict.fromkeys(names) if name not in index_of]
        if unknown:
            raise DataError(
                f"{self.source} has no point {some_of(unknown)}; it has {some_of(self.names, 20)}.",
                culprits=unknown,
                next_step=did_you_mean(unknown[0], self.names) or "Correct the points' names.",
            )
        rows = np.array([index_of[name] for name in names], dtype=np.int64)
        return PointPairs(
            tuple(self.names[index] for index in rows),
            measured,
            covariances,
            self.positions[rows],
            self.sigma_m[rows],
        )
