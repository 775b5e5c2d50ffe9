"""A synthetic robot cell with a forward model of its own: whatever it says is the truth.

Nothing here uses the application's camera, robot, targets, solvers or estimator, so that a wrong
projection or a wrong chain cannot hide by being wrong in both.
"""

from visioncal.simulation.arms import Arm, arm_named, forward, ur_arm
from visioncal.simulation.cell import Cell, simulate
from visioncal.simulation.described import cell_names, read_cell
from visioncal.simulation.layout import (
    BoardAt,
    CameraAt,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
    Swept,
)
from visioncal.simulation.network import simulate_network
from visioncal.simulation.observed_points import Network, Sight
from visioncal.simulation.optics import (
    CAMERAS,
    fine_camera,
    fisheye_camera,
    project,
    rays,
    wide_camera,
)
from visioncal.simulation.options import (
    BOARDS,
    CameraOptions,
    CellOptions,
    Second,
    SweepOptions,
)
from visioncal.simulation.real_arm import ArmOptions
from visioncal.simulation.records import (
    cell_session,
    measured_poses,
    network_session,
    sweep_session,
    write_network,
    write_session,
    write_sweep,
)
from visioncal.simulation.render import Scene, prepare_scene, render
from visioncal.simulation.sag import Payload
from visioncal.simulation.sweep import Sweep, sweep
from visioncal.simulation.touching import touch, touch_network
from visioncal.simulation.truth import Truth, read_truth, truth_path
from visioncal.simulation.warmup import (
    Heat,
    Round,
    WarmUp,
    WarmUpOptions,
    simulate_warm_up,
    write_warm_up,
)

__all__ = [
    "BOARDS",
    "CAMERAS",
    "Arm",
    "ArmOptions",
    "BoardAt",
    "CameraAt",
    "CameraOptions",
    "Cell",
    "CellOptions",
    "Heat",
    "InstrumentAt",
    "Moved",
    "Network",
    "NetworkOptions",
    "Payload",
    "PointAt",
    "RobotAt",
    "Round",
    "Scene",
    "Second",
    "Sight",
    "Sweep",
    "SweepOptions",
    "Swept",
    "Truth",
    "WarmUp",
    "WarmUpOptions",
    "arm_named",
    "cell_names",
    "cell_session",
    "fine_camera",
    "fisheye_camera",
    "forward",
    "measured_poses",
    "network_session",
    "prepare_scene",
    "project",
    "rays",
    "read_cell",
    "read_truth",
    "render",
    "simulate",
    "simulate_network",
    "simulate_warm_up",
    "sweep",
    "sweep_session",
    "touch",
    "touch_network",
    "truth_path",
    "ur_arm",
    "wide_camera",
    "write_network",
    "write_session",
    "write_sweep",
    "write_warm_up",
]
