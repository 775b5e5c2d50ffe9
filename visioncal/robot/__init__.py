"""Robot models: kinematics and their derivatives, from a DH table, a URDF or a calibration.

Only this package uses Pinocchio, which it imports where a model is built.
"""

from visioncal.robot.chain import FUNCTION_NAMES, Chain
from visioncal.robot.conversion import (
    convert_table,
    has_ur_axes,
    other_convention,
    parallel_axes,
    placed_at,
    table_of,
    with_zeros,
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
    entries,
    matrices,
    moving,
    parameters_of,
    pseudo_inertias,
)
from visioncal.robot.loads import Loads, Masses, bends, bent_joints
from visioncal.robot.model import LINK_KEYS, Robot
from visioncal.robot.rates import Rates
from visioncal.robot.tables import DHTable, table_document, table_from_document
from visioncal.robot.torques import body_regressor, joint_torques, momenta, torque_regressor
from visioncal.robot.weights import WeightFunctions
from visioncal.robot.writing import (
    corrected_tip,
    corrected_urdf,
    fit_links,
    small_urdf,
    table_toml,
    unwritten,
    ur_flange,
    ur_kinematics_yaml,
    weighed_urdf,
    with_inertias,
    without_functions,
)

__all__ = [
    "FUNCTION_NAMES",
    "LINK_KEYS",
    "PARAMETER_NAMES",
    "ROBOT_SUFFIXES",
    "Chain",
    "DHTable",
    "Inertias",
    "Loads",
    "LogCholesky",
    "Masses",
    "Rates",
    "Robot",
    "WeightFunctions",
    "bends",
    "bent_joints",
    "body_regressor",
    "convert_table",
    "corrected_tip",
    "corrected_urdf",
    "entries",
    "fit_links",
    "has_ur_axes",
    "joint_torques",
    "load_robot",
    "matrices",
    "momenta",
    "moving",
    "other_convention",
    "parallel_axes",
    "parameters_of",
    "placed_at",
    "pseudo_inertias",
    "read_robot_document",
    "robot_file",
    "robot_names",
    "small_urdf",
    "table_document",
    "table_from_document",
    "table_of",
    "table_toml",
    "torque_regressor",
    "unwritten",
    "ur_flange",
    "ur_kinematics_yaml",
    "weighed_urdf",
    "with_inertias",
    "with_zeros",
    "without_functions",
]
