"""A synthetic robot cell with an independent forward model, which provides ground truth.

Boards are drawn as they are printed. Nothing here uses the application's camera, robot, solvers or
estimator, so that an error in a projection or in a kinematic chain cannot cancel out.
"""

from visioncal.simulation.arms import ArmOptions, Payload, arm_named, forward
from visioncal.simulation.boards import BOARDS
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.cell_files import read_cell
from visioncal.simulation.depth import DepthOptions
from visioncal.simulation.heat import Heat
from visioncal.simulation.layout import (
    BoardAt,
    CameraAt,
    CameraOptions,
    CellOptions,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
    Second,
    SweepOptions,
    Swept,
)
from visioncal.simulation.optics import CAMERAS, project, rays
from visioncal.simulation.recordings import Round, WarmUpOptions, simulate, simulate_warm_up, sweep
from visioncal.simulation.records import (
    Truth,
    cell_session,
    measured_poses,
    read_truth,
    truth_path,
    write_session,
)
from visioncal.simulation.render import prepare_scene, render
from visioncal.simulation.touching import touch
