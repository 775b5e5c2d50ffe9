"""Robot models: kinematics and their derivatives, from a DH table, a URDF or a calibration.

Only this package uses Pinocchio, which it imports where a model is built. `visioncal.robot.writing`
writes models as files.
"""

from visioncal.robot.files import load_robot
from visioncal.robot.loads import Loads
from visioncal.robot.model import Robot
