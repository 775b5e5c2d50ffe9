"""An arm calibrated by figaroh from measured poses, through its own interface.

As its UR10 example does it (github.com/thanhndv212/figaroh-examples, examples/ur10): a
`BaseCalibration` with the residuals of its log map, weighted by unit, one marker of six measured
components, base and marker unknown, six parameters a joint.
"""

import contextlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np
import yaml
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot as load_figaroh_robot
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.robot import Robot, small_urdf

_POSE = ("x1", "y1", "z1", "phix1", "phiy1", "phiz1")


@dataclass(frozen=True)
class Settings:
    """What figaroh is told."""

    weights: tuple[float, float]  # Of a residual of position [1/m] and of rotation [1/rad].
    estimation: dict  # Its table `estimation`: the method, and priors where it takes them.


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What came out."""

    # World_from_marker (k, 4, 4) [m] for (k, n) joint angles [rad].
    predict: Callable[[FloatArray], FloatArray]
    parameters: int  # How many were estimated.
    seconds: float  # Processor time of `initialize` and `solve`.


class _Weighted(BaseCalibration):
    """Its residuals with weights of their own, as the robots of its examples set them."""

    weights: tuple[float, float] = (1.0, 1.0)

    def cost_function(self, var: FloatArray) -> FloatArray:
        """Weighted residuals of all poses."""
        estimated = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        residuals = self._compute_logmap_residuals(self.PEE_measured, estimated)
        position, rotation = self.weights
        return self.apply_measurement_weighting(
            residuals, pos_weight=position, orient_weight=rotation
        )


def calibrate(
    robot: Robot, q: FloatArray, world_from_marker: FloatArray, settings: Settings
) -> Calibrated:
    """Calibrates the nominal arm `robot` from (m, n) joints [rad] and (m, 4, 4) poses [m]."""
    with TemporaryDirectory() as name:
        found = _prepared(Path(name), robot, q, world_from_marker, settings)
        # It prints a report.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            begun = process_time()
            found.initialize()
            values = found.solve(enable_logging=False).x
            seconds = process_time() - begun
    if found.STATUS != "CALIBRATED":
        raise RuntimeError(f"figaroh did not converge: {found.STATUS}")

    def predict(at: FloatArray) -> FloatArray:
        config = dict(found.calib_config, NbSample=len(at))
        flat = calc_updated_fkm(found.model, found.data, values, at, config)
        poses = flat.reshape(6, len(at)).T
        return compose(Rotation.from_euler("xyz", poses[:, 3:]).as_matrix(), poses[:, :3])

    return Calibrated(predict, len(values), seconds)


def _prepared(
    folder: Path, robot: Robot, q: FloatArray, world_from_marker: FloatArray, settings: Settings
) -> _Weighted:
    """Its calibration with the robot, the configuration and the data that it reads from files."""
    (folder / "arm.urdf").write_text(small_urdf(robot))
    rotations = Rotation.from_matrix(world_from_marker[:, :3, :3]).as_euler("xyz")
    np.savetxt(
        folder / "poses.csv",
        np.hstack([world_from_marker[:, :3, 3], rotations, q]),
        delimiter=",",
        header=",".join((*_POSE, *robot.joint_names)),
        comments="",
        fmt="%.17g",
    )
    config = {
        "robot": {
            "name": robot.name,
            "properties": {"joints": {"active_joints": list(robot.joint_names)}},
        },
        "tasks": {
            "calibration": {
                "parameters": {
                    "calibration_level": "full_params",
                    "outlier_threshold": 0.02,
                    "estimation": settings.estimation,
                },
                "kinematics": {"base_frame": "universe", "tool_frame": robot.tip},
                "measurements": {
                    "markers": [{"name": "marker", "measurable_dof": [True] * 6}],
                    "poses": {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6},
                },
                "data": {"source_file": str(folder / "poses.csv"), "number_of_samples": len(q)},
            }
        },
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    model = load_figaroh_robot(str(folder / "arm.urdf"), package_dirs=str(folder))
    found = _Weighted(model, str(folder / "config.yaml"))
    found.weights = settings.weights
    # Its files have no place for these two; its examples set them so.
    found.calib_config["known_baseframe"] = False
    found.calib_config["known_tipframe"] = False
    return found
