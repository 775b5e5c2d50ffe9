"""Real arms that others measured with an instrument, against plain least squares."""

import numpy as np
import pytest
from support import thirdparty
from support.tracked import known_of


@pytest.mark.slow
def test_an_irb_120_by_a_measuring_arm(real_data):
    known = known_of(thirdparty.irb120(real_data))
    # 4.67 mm in the mean, the frames fitted.
    assert known.robot_arm.kinematics.result.nominal.rms_mm > 4.0
    assert known.findings.held_out.mm < 0.3
    assert known.verdict.status == "good"
    for joints, read, limit in (
        # Plain least squares leave 0.253 and 0.294 mm in the mean.
        ("TestJointAngles", "TestPosition", 0.26),
        ("TestJointAngles2", "TestPosition2", 0.26),
    ):
        q, places = thirdparty.irb120_set(real_data, joints, read)
        flange, x = known.robot_arm.model.base_from_flange(q), known.assessment.state.edges[0]
        in_base = places @ x[:3, :3].T + x[:3, 3]
        on_flange = np.einsum("mji,mj->mi", flange[:, :3, :3], in_base - flange[:, :3, 3])
        # The sets have another tool: its point is what the first five configurations say.
        away = 1e3 * np.linalg.norm(on_flange - on_flange[:5].mean(axis=0), axis=1)
        assert away.mean() < limit
        assert away[5:].mean() < limit


def test_a_six_axis_arm_by_a_laser(real_data):
    known = known_of(thirdparty.rokae(real_data))
    assert known.robot_arm.kinematics.result.nominal.rms_mm > 2.0
    # Plain least squares leave 0.099 mm and 0.038 deg in the fit; left out they are at 0.12 mm.
    assert known.findings.rms.mm < 0.1
    assert known.findings.rms.deg < 0.03
    assert known.findings.held_out.mm < 0.13


@pytest.mark.slow
def test_a_humanoid_by_contacts(real_data):
    held = list(range(3, 61, 10))
    known = known_of(thirdparty.talos(real_data, held))
    away = [view.residual_mm for view in known.findings.pairs[0].views if view.view in held]
    # Joint offsets alone leave 0.87 mm, in the fit.
    assert np.median(away) < 0.95
    # Its joints hardly moved: the method says that this arm is not known elsewhere.
    assert known.verdict.status != "good"
