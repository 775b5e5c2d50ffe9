"""Kinematics and statics by Pinocchio, which is imported when needed."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import FloatArray
from visioncal.robot.chain import IDENTITY_FUNCTION, Chain
from visioncal.robot.inertia import Inertias
from visioncal.robot.loads import DriveLimits, Masses

if TYPE_CHECKING:
    import pinocchio as pin

# Usual names of the frame of the reported poses, in order of preference.
_USUAL_TIPS = ("tool0", "flange")


def build_model(name: str, tip: str, chain: Chain, masses: Masses | None = None) -> "pin.Model":
    """Builds Pinocchio's model of a chain, whose positions are the joints' effective ones."""
    import pinocchio as pin

    along = {(1.0, 0.0, 0.0): "X", (0.0, 1.0, 0.0): "Y", (0.0, 0.0, 1.0): "Z"}
    model, last = pin.Model(), 0
    model.name = name
    for place, joint in enumerate(chain.joint_names):
        kind = "Prismatic" if chain.prismatic[place] else "Revolute"
        letter = along.get(tuple(chain.axes[place].tolist()))
        if letter is None:
            motion = getattr(pin, f"JointModel{kind}Unaligned")(chain.axes[place])
        else:
            motion = getattr(pin, f"JointModel{kind[0]}{letter}")()
        last = model.addJoint(last, motion, pin.SE3(chain.placements[place]), joint)
        if masses is not None:
            # The rotational inertia does not matter to an arm at rest.
            body = pin.Inertia(masses.kg[place], masses.centres_m[place], np.zeros((3, 3)))
            model.appendBodyToJoint(last, body, pin.SE3.Identity())
    tip_placement = pin.SE3(chain.placements[-1])
    model.addFrame(pin.Frame(tip, last, 0, tip_placement, pin.FrameType.OP_FRAME))
    return model


def flange_poses(model: "pin.Model", tip: str, positions: FloatArray) -> FloatArray:
    """Forward kinematics: (m, 4, 4) `base_from_tip` [m] at (m, n) effective positions."""
    import pinocchio as pin

    data, frame = model.createData(), model.getFrameId(tip)
    poses = np.empty((len(positions), 4, 4))
    for row, configuration in enumerate(positions):
        pin.forwardKinematics(model, data, configuration)
        poses[row] = pin.updateFramePlacement(model, data, frame).homogeneous
    return poses


def joint_frames(model: "pin.Model", positions: FloatArray) -> FloatArray:
    """Joint frames (n, 4, 4) in the base, after their motion, at (n,) effective positions."""
    import pinocchio as pin

    data = model.createData()
    pin.forwardKinematics(model, data, positions)
    return np.array([joint.homogeneous for joint in data.oMi[1:]])


def placement_derivatives(model: "pin.Model", tip: str, positions: FloatArray) -> FloatArray:
    """Jacobian of the tip over the joints' placements: Pinocchio's kinematic regressor.

    Returns:
        (m, 6, 6 n) right perturbations of `base_from_tip` for right perturbations of the
        placements, both (rotation, translation), at (m, n) effective positions [rad or m].
    """
    import pinocchio as pin

    data, frame = model.createData(), model.getFrameId(tip)
    count = model.njoints - 1
    derivatives = np.empty((len(positions), 6, 6 * count))
    for row, configuration in enumerate(positions):
        pin.forwardKinematics(model, data, configuration)
        pin.updateFramePlacement(model, data, frame)
        derivatives[row] = pin.computeFrameKinematicRegressor(model, data, frame, pin.LOCAL)
    # Pinocchio puts translations first.
    halves = derivatives.reshape(-1, 2, 3, count, 2, 3)[:, ::-1, :, :, ::-1]
    return halves.reshape(-1, 6, 6 * count)


def gravity_torques(model: "pin.Model", positions: FloatArray, gravity: FloatArray) -> FloatArray:
    """Joint torques (m, n) that hold the weight of the model's links [N m, or N if prismatic].

    Positions are effective ones (m, n) [rad or m], gravity is in the base's frame (3,) [m/s^2].
    """
    import pinocchio as pin

    model.gravity.linear = gravity
    data = model.createData()
    torques = [
        pin.computeGeneralizedGravity(model, data, position).copy() for position in positions
    ]
    return np.array(torques).reshape(positions.shape)


def weight_jacobian(model: "pin.Model", positions: FloatArray, gravity: FloatArray) -> FloatArray:
    """Derivatives of the joint torques by weight over masses and first moments.

    Positions are effective ones (m, n) [rad or m], gravity is in the base's frame (3,) [m/s^2].

    Returns:
        (m, n, 4 n) for the mass [kg] and first moments [kg m] of each joint's body.
    """
    import pinocchio as pin

    model.gravity.linear = gravity
    data, count = model.createData(), model.nv
    still = np.zeros(count)
    rows = np.empty((len(positions), count, count, 4))
    for row, configuration in enumerate(positions):
        regressor = pin.computeJointTorqueRegressor(model, data, configuration, still, still)
        # Ten parameters a body: mass, first moments, and inertias, which do not matter at rest.
        rows[row] = -regressor.reshape(count, count, 10)[:, :, :4]
    return rows.reshape(len(positions), count, 4 * count)


def regressors(
    model: "pin.Model", gravity: FloatArray, states: tuple[FloatArray, FloatArray, FloatArray]
) -> Iterator[FloatArray]:
    """Iterates over the torque regressors of states, for the bodies' inertial parameters.

    Args:
        model: Of `build_model`.
        gravity: (3,) in the base's frame [m/s^2].
        states: (m, n) effective positions, speeds and accelerations.

    Yields:
        (10 n, n) for each state, in memory that the next state overwrites.
    """
    import pinocchio as pin

    model.gravity.linear = gravity
    data, compute = model.createData(), pin.computeJointTorqueRegressor
    # The function's return value is a copy of this array.
    regressor = data.jointTorqueRegressor.T
    for q, dq, ddq in zip(*states, strict=True):
        compute(model, data, q, dq, ddq)
        yield regressor


# A plant with its conveyors has hundreds; the recursive parser crashes the process at some ten
# thousand.
_MOST_JOINTS = 2000


class UrdfArm(NamedTuple):
    """The arm of a URDF from its root to the tip; masses are None where it states none."""

    chain: Chain
    tip: str
    masses: Masses | None
    inertias: Inertias | None
    rates: DriveLimits


def arm_of_urdf(table: DocumentTable) -> UrdfArm:
    """Reads the arm from a URDF's root to the tip.

    Raises:
        DataError: The URDF cannot be parsed or lacks the tip, or a joint before it has more than
            one degree of freedom.
    """
    import pinocchio as pin

    text = table.text("urdf")
    joints = text.count("<joint")
    if joints > _MOST_JOINTS:
        raise DataError(
            f"{table.label}: the URDF has {joints} joints; up to {_MOST_JOINTS} are read.",
            culprits=[table.label],
            next_step="Leave the robot alone in it.",
        )
    from visioncal.core.documents.structured import parse_xml

    # Pinocchio's reader forgives what the readers of bodies and inertias do not.
    parse_xml(text.encode("utf-8"), f"{table.label}: the URDF")
    try:
        model = pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise DataError(
            f"{table.label}: the URDF cannot be parsed: {error}.",
            culprits=[table.label],
            next_step="Expand xacro first (xacro robot.urdf.xacro > robot.urdf); check_urdf names "
            "the place.",
        ) from error
    tip = _find_tip(table, [frame.name for frame in model.frames][1:])
    arm_joints = list(model.supports[model.frames[model.getFrameId(tip)].parentJoint])[1:]
    for joint in arm_joints:
        if model.joints[joint].nv != 1:
            raise DataError(
                f"{table.label}: joint {model.names[joint]} before {tip} has "
                f"{model.joints[joint].nv} degrees of freedom; revolute, continuous and prismatic "
                "joints are read.",
                culprits=[model.names[joint]],
            )
    if not arm_joints:
        raise DataError(
            f"{table.label}: no joint lies between the URDF's root and {tip}.",
            culprits=[f"{table.label}: tip"],
            next_step="Name the frame of the reported poses as tip in [robot].",
        )
    others = [joint for joint in range(1, model.njoints) if joint not in arm_joints]
    arm = pin.buildReducedModel(model, others, pin.neutral(model))
    bodies = list(arm.inertias)[1:]
    kg = np.array([body.mass for body in bodies])
    # Zero in a URDF means unknown.
    limits = np.array([arm.velocityLimit, arm.effortLimit])
    known = (limits > 0.0) & (limits < np.finfo(float).max)
    speed, torque = np.where(known, limits, np.inf)
    rates = DriveLimits(speed, np.full(len(speed), np.inf), torque)
    if not kg.any():
        return UrdfArm(_chain_of_model(arm, tip), tip, None, None, rates)
    inertias = Inertias(np.array([body.toDynamicParameters() for body in bodies]))
    return UrdfArm(_chain_of_model(arm, tip), tip, inertias.masses, inertias, rates)


def _chain_of_model(model: "pin.Model", tip: str) -> Chain:
    """Extracts the chain from a model that has no other joints."""
    import pinocchio as pin

    neutral, axes, prismatic = pin.neutral(model), [], []
    for joint in list(model.joints)[1:]:
        data = joint.createData()
        joint.calc(data, neutral)
        moving, turning = np.split(np.asarray(data.S).ravel(), 2)
        prismatic.append(not turning.any())
        axes.append(moving if prismatic[-1] else turning)
    joints = list(model.joints)[1:]
    unbounded = np.array([joint.nq == 2 for joint in joints])
    indices = [joint.idx_q for joint in joints]
    placements = [*list(model.jointPlacements)[1:], model.frames[model.getFrameId(tip)].placement]
    return Chain(
        tuple(model.names)[1:],
        np.array(prismatic),
        np.array(axes),
        np.array([placement.homogeneous for placement in placements]),
        np.where(unbounded, -np.inf, model.lowerPositionLimit[indices]),
        np.where(unbounded, np.inf, model.upperPositionLimit[indices]),
        np.tile(IDENTITY_FUNCTION, (len(joints), 1)),
    )


def _find_tip(table: DocumentTable, frames: list[str]) -> str:
    """Finds the tip among a URDF's frames; by default a usual name."""
    tip = table.text("tip", "")
    usual = [name for name in _USUAL_TIPS if name in frames]
    if not tip and usual:
        return usual[0]
    if tip in frames:
        return tip
    links = ", ".join(dict.fromkeys(frames))
    what = f"has no frame {tip!r}" if tip else "has no tool0 or flange, and no tip is named"
    raise DataError(
        f"{table.label}: the URDF {what}; its frames are {links}.",
        culprits=[f"{table.label}: tip"],
        next_step=f"{did_you_mean(tip, frames)} Name the frame of the reported poses as tip in "
        "[robot].".strip(),
    )
