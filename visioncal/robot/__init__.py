"""Robot models: kinematics and their derivatives, from a DH table, a URDF or a calibration.

Only this package uses Pinocchio, which it imports where a model is built. `visioncal.robot.writing`
writes models as files.
"""

from visioncal.robot.chain import FUNCTION_NAMES, Chain
from visioncal.robot.conversion import (
    convert_table,
    has_ur_axes,
    other_convention,
    parallel_axes,
    table_of,
    with_base,
)
from visioncal.robot.files import (
    ROBOT_SUFFIXES,
    load_robot,
    read_robot_document,
    robot_file,
    robot_names,
)
from visioncal.robot.inertia import (
    PARAMETER_NAMES,
    Inertias,
    LogCholesky,
    parameter_transform,
    parameters_of,
    pseudo_inertias,
    symmetric_entries,
    symmetric_matrices,
)
from visioncal.robot.loads import (
    DriveLimits,
    Loads,
    Masses,
    WeightFunctions,
    deflected_joints,
    joint_deflections,
)
from visioncal.robot.model import LINK_KEYS, REPEATABILITY, Robot
from visioncal.robot.tables import DHTable, table_document, table_from_document
from visioncal.robot.torques import body_regressor, joint_torques, torque_regressor

__all__ = [
    "FUNCTION_NAMES",
    "LINK_KEYS",
    "PARAMETER_NAMES",
    "REPEATABILITY",
    "ROBOT_SUFFIXES",
    "Chain",
    "DHTable",
    "DriveLimits",
    "Inertias",
    "Loads",
    "LogCholesky",
    "Masses",
    "Robot",
    "WeightFunctions",
    "body_regressor",
    "convert_table",
    "deflected_joints",
    "has_ur_axes",
    "joint_deflections",
    "joint_torques",
    "load_robot",
    "other_convention",
    "parallel_axes",
    "parameter_transform",
    "parameters_of",
    "pseudo_inertias",
    "read_robot_document",
    "robot_file",
    "robot_names",
    "symmetric_entries",
    "symmetric_matrices",
    "table_document",
    "table_from_document",
    "table_of",
    "torque_regressor",
    "with_base",
]
