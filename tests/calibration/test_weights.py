"""Arms whose model does not state the masses of their links: and their springs."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found, calibrated
from support.wrong_arms import SAGGING, error_m

from visioncal.calibration.pipeline.result import result_of
from visioncal.estimation.workspace import postures
from visioncal.robot import Robot, WeightFunctions, load_robot
from visioncal.simulation import simulate


@pytest.fixture(scope="module")
def bare():
    """A UR10e of which nobody knows what it weighs."""
    document = dict(load_robot("ur10e").document)
    document["joint"] = [
        {key: value for key, value in row.items() if key not in ("mass_kg", "com_m")}
        for row in document["joint"]
    ]
    return Robot.from_document(document)


def test_weight_is_among_the_functions(bare):
    functions, q = WeightFunctions.of(bare), postures(bare)[:60]
    # An upright axis bears nothing.
    assert functions.parts[0].shape[1] == 0
    torques = load_robot("ur10e").load_torques(q)
    values = functions.values(bare, q).reshape(-1, functions.size)
    shares, *_ = np.linalg.lstsq(values, torques.ravel(), rcond=None)
    assert values @ shares == pytest.approx(torques.ravel(), abs=1e-6)
    again = np.einsum("mjk,jk->mj", bare.weight_jacobian(q), functions.moments(shares))
    assert again == pytest.approx(torques, abs=1e-6)


@pytest.mark.slow
def test_an_arm_of_unknown_weight_is_calibrated_with_its_sag(bare):
    cell = simulate(replace(SAGGING, views=60, seed=4))
    known = calibrated(cell, robot=bare)
    assert known.robot_arm.kinematics.level == "elastic"
    assert all(
        spring.stiffness_nm_per_rad is None for spring in arm_found(known).sections.elastic.joints
    )
    assert any("of which its model states nothing" in reason for reason in known.verdict.reasons)
    before = error_m(cell, calibrated(cell, joints=False), bare)
    assert error_m(cell, known, known.robot_arm.model) < 0.06 * before
    q = postures(bare)[:20]
    result = result_of(known)
    ours = known.robot_arm.model.base_from_flange(q)
    # RigidTransform makes rotations orthonormal anew.
    assert result.base_from_flange(q).as_matrix() == pytest.approx(ours, abs=1e-12)
