"""What is known of a whole cell's frames beforehand: priors of places, and of whole transforms."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.simulation import simulate
from visioncal.simulation.layout import CameraAt, NetworkOptions
from visioncal.simulation.records import cell_session

STOPS = 14


@pytest.fixture(scope="module")
def cell():
    return simulate(NetworkOptions(stops=STOPS))


def aligned(cell, prior, **columns):
    session = cell_session(cell, "cell", seen="names")
    session = replace(session, document={**session.document, "prior": prior}, **columns)
    return calibrate(session, corners={corner.view: corner for corner in cell.corners})


def whole(matrix, sigma_m, sigma_rad):
    """A transform as a prior states it."""
    x, y, z = matrix[:3, 3].tolist()
    turn = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return {
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "sigma_m": sigma_m,
        "quaternion_xyzw": turn,
        "sigma_rad": sigma_rad,
    }


@pytest.mark.slow
def test_a_prior_narrows_what_it_is_of(cell):
    height = float(cell.between("base_a", "base_b")[2, 3])
    before = aligned(cell, {}).between("base_a", "base_b")
    prior = {"base_a_from_base_b": {"z_m": height, "sigma_m": 1e-6}}
    found = aligned(cell, prior)
    after = found.between("base_a", "base_b")
    turn = after.matrix[:3, :3]
    sigma_m = np.sqrt(np.diag(turn @ after.covariance[3:, 3:] @ turn.T))
    assert after.matrix[2, 3] == pytest.approx(height, abs=4e-6)
    assert sigma_m[2] <= 1.01e-6
    assert after.sigma_mm < before.sigma_mm
    assert found.verdict.status == "good"


def test_a_prior_that_is_wrong_is_named_with_what_the_observations_say(cell):
    height = float(cell.between("base_a", "base_b")[2, 3])
    prior = {"base_a_from_base_b": {"z_m": height + 0.02, "sigma_m": 1e-3}}
    found = aligned(cell, prior)
    (doubt,) = [reason for reason in found.verdict.reasons if "contradicted" in reason]
    assert "z_m of base_a_from_base_b" in doubt
    said_mm, sigma_mm = map(float, re.search(r"alone say (\S+) mm to (\S+) mm", doubt).groups())
    # Four of the sigmas that are stated: one run in fifteen thousand.
    assert abs(said_mm - 1e3 * height) < 4 * sigma_mm < 0.4
    assert found.verdict.status == "check"


@pytest.mark.slow
def test_a_camera_that_sees_nothing_of_the_rest_is_tied_by_a_drawing():
    """A stereo rig: the right camera is known from the left one, and sees a board by itself."""
    options = NetworkOptions(stops=STOPS)
    cell = simulate(options)
    session = cell_session(cell, "cell", seen="names")
    # Of the right camera, only what it sees of the floor is left.
    kept = [
        view
        for view in session.views
        if view.text.get("camera") != "right" or view.text.get("target") == "floor"
    ]
    kept = [
        view
        for view in kept
        if view.text.get("camera") != "left" or view.text.get("target") != "floor"
    ]
    corners = {view_corners.view: view_corners for view_corners in cell.corners}
    loose = calibrate(replace(session, views=tuple(kept)), corners=corners)
    assert {untied.frame for untied in loose.cell.untied} == {"cam_right", "target_floor"}
    rig = cell.between("cam_left", "cam_right")
    prior = {"cam_left_from_cam_right": whole(rig, 1e-4, 1e-4)}
    document = {**session.document, "prior": prior}
    found = calibrate(replace(session, views=tuple(kept), document=document), corners=corners)
    assert not found.cell.untied
    edge = found.between("base_a", "target_floor")
    away = log(invert(cell.between("base_a", "target_floor")) @ edge.matrix)
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert away @ np.linalg.solve(edge.covariance, away) < 22.0
    # Nobody moves before the right camera: its board may be of any size.
    assert not any("than stated" in reason for reason in found.verdict.reasons)
    assert 0.1 < found.between("cam_left", "cam_right").sigma_mm < 0.2


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ({"base_a_from_camleft": {"z_m": 0.1, "sigma_m": 1e-3}}, "did you mean cam_left"),
        ({"base_a_from_target_plate_a": {"z_m": 0.1, "sigma_m": 1e-3}}, "robot a moves one"),
        ({"cam_left_from_cam_left": {"z_m": 0.1, "sigma_m": 1e-3}}, "they are one"),
        (
            {"cam_left_from_cam_right": {"z_m": 0.1, "sigma_m": 1e-3, "sigma_rad": 1e-3}},
            "quaternion_xyzw and sigma_rad together",
        ),
    ],
)
def test_a_prior_of_no_fixed_place_is_refused(cell, prior, words):
    with pytest.raises(DataError) as raised:
        aligned(cell, prior)
    assert words in f"{raised.value.message} {raised.value.next_step}".replace("Did", "did")


@pytest.mark.slow
def test_cameras_of_other_mounts_take_priors_too():
    options = NetworkOptions(stops=STOPS, cameras=(CameraAt("hand", "a"), CameraAt("left")))
    cell = simulate(options)
    truth = cell.mountings["cam_hand"]
    prior = {"flange_a_from_cam_hand": {"x_m": float(truth[0, 3]), "sigma_m": 1e-6}}
    found = aligned(cell, prior)
    assert found.tree.edge_of("cam_hand").matrix[0, 3] == pytest.approx(truth[0, 3], abs=4e-6)
