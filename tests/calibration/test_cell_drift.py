"""Arms of a whole cell that warm up: each drifts with its own temperatures, beside the others."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.results import Calibration
from visioncal.simulation import SimulatedCell, simulate
from visioncal.simulation.arms import Heat
from visioncal.simulation.layout import CameraAt, NetworkOptions, RobotAt
from visioncal.simulation.optics import fine_camera
from visioncal.simulation.records import cell_session

# Chi-square of six and of twelve degrees of freedom is below these but for one in a thousand.
OF_SIX, OF_TWELVE = 22.5, 32.9


@pytest.fixture(scope="module")
def cell() -> SimulatedCell:
    """Two robots before two cameras; one of them is cold at the first of 40 stops."""
    return simulate(
        NetworkOptions(
            robots=(
                RobotAt("a", (-0.6, 0.0, 0.0), warms_up=True),
                RobotAt("b", (0.6, 0.05, 0.02)),
            ),
            cameras=(
                CameraAt("left", place_m=(0.0, -1.0, 1.1), camera=fine_camera()),
                CameraAt("right", place_m=(0.15, 0.95, 1.25), camera=fine_camera()),
            ),
            stops=40,
            pace_s=150.0,
        )
    )


@pytest.fixture(scope="module")
def session(cell):
    return cell_session(cell, "cell", seen="names")


def aligned(cell, session, level):
    return calibrate(session, corners={corner.view: corner for corner in cell.corners}, level=level)


@pytest.fixture(scope="module")
def found(cell, session):
    return aligned(cell, session, "thermal")


def mahalanobis_sq(cell, found, frame):
    """Squared error of a frame in the base of the robot that warms up, over its covariance."""
    edge = found.between("base_a", frame)
    away = log(invert(cell.between("base_a", frame)) @ edge.matrix)
    return float(away @ np.linalg.solve(edge.covariance, away))


@pytest.mark.slow
def test_frames_are_those_of_the_cold_arm(cell, session, found):
    without = aligned(cell, session, "hand-eye")
    for frame in ("base_b", "cam_left"):
        assert mahalanobis_sq(cell, found, frame) < OF_SIX
        # Drift of some 0.3 mm that is taken for a base that creeps moves them by several sigmas.
        assert mahalanobis_sq(cell, without, frame) > OF_SIX


def test_coefficients_are_within_their_sigmas(found, tmp_path):
    found.save(tmp_path / "calibration.json")
    drift, heat = (
        Calibration.load(tmp_path / "calibration.json").of("left", "a").drift,
        Heat.drawn(0),
    )
    off = np.concatenate(
        [drift.growth_per_k - heat.growth_per_k, drift.drift_rad_per_k - heat.drift_rad_per_k]
    )
    assert off @ np.linalg.solve(drift.covariance[:12, :12], off) < OF_TWELVE
    thermal = found.cell.robots["a"].thermal
    assert thermal.residual_mm.with_drift < 0.7 * thermal.residual_mm.without
    assert len(thermal.views) > 30


def test_a_robot_without_temperatures_stays_as_it_is(found):
    assert found.cell.robots["b"].thermal is None
    reasons = found.verdict.reasons
    assert any(reason.startswith("Robot a: the arm drifts with its temp") for reason in reasons)
    assert not any(reason.startswith("Robot b: the arm drifts") for reason in reasons)
    budget = found.cell.uncertainty.budget_mm["flange_a_from_target_plate_a"]
    assert 0.0 < budget["temperature of a"] < budget["total"]


def test_drift_that_is_asked_for_is_refused_where_no_robot_tells_its_temperatures(cell, session):
    with pytest.raises(DataError, match=r"robot a: level 'thermal' needs .* temp1_c"):
        aligned(cell, replace(session, streams={}), "thermal")


def test_a_simulated_robot_that_warms_up_needs_times():
    with pytest.raises(DataError, match="warms up needs pace_s"):
        NetworkOptions(robots=(RobotAt("a", (0.0, 0.0, 0.0), warms_up=True),))
