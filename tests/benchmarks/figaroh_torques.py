"""An arm's dynamics identified by figaroh from exact motions, through its own interface.

As its examples do it (github.com/thanhndv212/figaroh-examples, examples/ur10): a
`BaseIdentification` that gets its trajectory from the caller, with Coulomb and viscous friction and
an offset a joint, and weighted least squares behind its QR decomposition. Filters are left out,
since the motion is exact.
"""

import contextlib
import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np
import yaml
from figaroh.identification.base_identification import BaseIdentification
from figaroh.tools.load_robot import load_robot as load_figaroh_robot

from visioncal.core.types import FloatArray
from visioncal.dynamics.motion import Measured
from visioncal.robot import Robot


@dataclass(frozen=True, eq=False)
class Found:
    """What came out.

    Attributes:
        parameters: How many base parameters were estimated.
        rms_nm: (n,) residual of the torques [N m].
        seconds: Processor time of `initialize` and `solve`.
        bare_seconds: That of its regressor, its QR decomposition and its weighting alone.
    """

    parameters: int
    rms_nm: FloatArray
    seconds: float
    bare_seconds: float


class _Given(BaseIdentification):
    """Its identification of a motion that is given."""

    measured: Measured

    def load_trajectory_data(self, data_source: str | None = None) -> dict:
        """Its form of a motion."""
        del data_source
        motion = self.measured.motion
        return {
            "timestamps": motion.times_s,
            "positions": motion.q,
            "velocities": motion.dq,
            "accelerations": motion.ddq,
            "torques": self.measured.torques_nm,
        }

    def filter_kinematics_data(self, filter_config: dict | None = None) -> None:
        """Leaves an exact motion as it is."""
        del filter_config
        self.processed_data = {
            name: value for name, value in self.raw_data.items() if name != "torques"
        }


def identify(robot: Robot, urdf: str, measured: Measured) -> Found:
    """Identifies an arm from its URDF with inertias and (m, n) exact states and torques."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        found = _prepared(folder, robot, urdf, measured)
        # It prints reports, and writes beside itself what it found.
        quiet = contextlib.redirect_stdout(io.StringIO())
        with quiet, contextlib.chdir(folder), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            begun = process_time()
            found.initialize()
            found.solve(decimate=False, plotting=False, wls=True)
            seconds = process_time() - begun
            begun = process_time()
            found.calculate_full_regressor()
            reduced, active = found._eliminate_zero_columns(1e-3)
            rows = found._prepare_undecimated_data(reduced)
            found._calculate_base_parameters(*rows, active)
            found._apply_weighted_least_squares()
            bare = process_time() - begun
        left = found.tau_noised - found.dynamic_regressor_base @ found.phi_base
    rms_nm = np.sqrt(np.mean(left.reshape(robot.joint_count, -1) ** 2, axis=1))
    return Found(len(found.phi_base), rms_nm, seconds, bare)


def _prepared(folder: Path, robot: Robot, urdf: str, measured: Measured) -> _Given:
    """Its identification with the robot and the configuration that it reads from files."""
    (folder / "arm.urdf").write_text(urdf)
    zeros = [0.0] * robot.joint_count
    config = {
        "robot": {
            "name": robot.name,
            "properties": {
                "joints": {"active_joints": list(robot.joint_names)},
                "mechanics": {
                    "friction_coefficients": {"viscous": zeros, "static": zeros},
                    "actuator_inertias": zeros,
                    "joint_offsets": zeros,
                },
            },
        },
        "tasks": {
            "identification": {
                "problem": {
                    "model_components": {
                        "friction": True,
                        "actuator_inertia": False,
                        "joint_offset": True,
                    },
                },
                "signal_processing": {"sampling_frequency": 500.0, "cutoff_frequency": 100.0},
            }
        },
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    model = load_figaroh_robot(str(folder / "arm.urdf"), package_dirs=str(folder))
    found = _Given(model, str(folder / "config.yaml"))
    found.measured = measured
    # Its files have no place for these two; its examples set them so.
    places = list(range(robot.joint_count))
    found.identif_config |= {"act_idxq": places, "act_idxv": places}
    return found
