"""The arm of a URDF, by Pinocchio, which is imported when needed, as is the reader of XML."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.robot.chain import IDENTITY_FUNCTION, Chain
from visioncal.robot.inertia import Inertias
from visioncal.robot.loads import DriveLimits, Masses

if TYPE_CHECKING:
    import pinocchio as pin

# Usual names of the frame of the reported poses, in order of preference.
_USUAL_TIPS = ("tool0", "flange")
# A plant with its conveyors has hundreds; the recursive parser crashes the process at some ten
# thousand.
_MOST_JOINTS = 2000

# Advice where no tip is known.
_NAME_TIP = "Name the frame of the reported poses as tip in [robot], or to convert as --tip."


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

    from visioncal.core.documents.structured import parse_xml

    text = table.text("urdf")
    joints = text.count("<joint")
    if joints > _MOST_JOINTS:
        raise DataError(
            f"{table.label}: the URDF has {joints} joints; up to {_MOST_JOINTS} are read.",
            culprits=[table.label],
            next_step="Leave the robot alone in it.",
        )
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
            next_step=_NAME_TIP,
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
        next_step=f"{did_you_mean(tip, frames)} {_NAME_TIP}".strip(),
    )
