"""Stops whose poses or joint angles are misread, or of another tool, beside a calibration."""

import shlex
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.marks import slow
from support.refusals import raised

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.session import Session
from visioncal.session.columns import POSE, pose_row
from visioncal.session.table import reported_matrices
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.verification import verdict_of, verify
from visioncal.verification.change_hypotheses import LENGTH, NOISE

# A gripper's tip, 150 mm before the flange and turned.
TOOL = exp(np.array([0.0, 0.0, 0.5, 0.01, 0.0, 0.15]))
JOINTS = {f"q{at}_rad" for at in range(1, 7)}


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """The poses of 20 calibrated views without joint angles, and of 6 later ones."""
    folder = tmp_path_factory.mktemp("cell") / "all"
    session = Session.load(
        write_session(simulate(CellOptions(views=26, seed=5)), folder, images=False)
    )
    without = tuple(name for name in session.columns if name not in JOINTS)
    session = with_numbers(
        replace(session, columns=without),
        lambda numbers: {name: at for name, at in numbers.items() if name not in JOINTS},
    )
    fit, later = session.only(range(20)), session.only(range(20, 26))
    return calibrate(fit), later, fit


def with_numbers(session, change):
    views = tuple(replace(view, numbers=change(view.numbers)) for view in session.views)
    return replace(session, views=views)


def in_mm(numbers):
    return numbers | {name: 1e3 * numbers[name] for name in POSE[:3]}


def w_first(numbers):
    return numbers | dict(zip(POSE[3:], np.roll([numbers[at] for at in POSE[3:]], 1), strict=True))


def with_tool(session):
    poses = reported_matrices(session.views)
    views = tuple(
        replace(view, numbers=view.numbers | pose_row(poses[view.number] @ TOOL))
        for view in session.views
    )
    return replace(session, views=views)


MISREAD = {
    "millimetres": (in_mm, "With the robot's positions in mm"),
    "w first": (w_first, "as a quaternion w, x, y, z"),
}


@pytest.mark.parametrize("name", ["millimetres", slow("w first")])
def test_poses_that_are_misread_are_no_change_of_the_cell(taken, name, tmp_path):
    calibration, later, _ = taken
    change, words = MISREAD[name]
    session = with_numbers(later, change)
    found = verify(session, calibration)
    assert not found.passed
    assert not found.named
    assert words in verdict_of(found).reasons[0]
    calibration.save(tmp_path / "out.json")
    session.save(tmp_path / "later")
    done = visioncal("verify", tmp_path / "later", "--against", tmp_path / "out.json")
    assert done.status == 3
    # The commands that it prints mend it.
    line = next(line for line in done.out.splitlines() if "visioncal convert" in line)
    for command in line.split("&&"):
        done = visioncal(*shlex.split(command)[1:]).good()
    assert done.out.startswith("pass")


def test_a_log_that_repeats_one_pose_does_not_pass(taken):
    calibration, later, _ = taken
    first = {name: later.views[0].numbers[name] for name in POSE}
    found = verify(with_numbers(later, lambda numbers: numbers | first), calibration)
    assert not found.passed
    assert "all rows have one position of the robot" in verdict_of(found).reasons[0]


def test_another_tool_of_the_controller_is_named_beside_a_camera_that_moved(taken):
    calibration, later, _ = taken
    found = verify(with_tool(later), calibration)
    assert [change.name for change in found.named] == ["camera"]
    first = verdict_of(found).findings[0]
    assert "or another tool was active in the controller" in first.words
    assert "controller's tool" in first.do.words
    assert not first.do.command


def test_an_arm_that_grew_is_found_without_joint_angles(taken):
    calibration, later, _ = taken

    def shorter(numbers):
        return numbers | {name: numbers[name] / 1.0005 for name in POSE[:3]}

    found = verify(with_numbers(later, shorter), calibration)
    assert found.named[0].name == LENGTH
    growth = found.named[0].explained
    # Five sigma.
    assert abs(growth.values[0] - 5e-4) < 5.0 * np.sqrt(growth.covariance[0, 0])
    assert found.named[0].is_possible


def test_scatter_may_be_a_joint_that_slipped_where_no_angles_are_recorded(taken):
    calibration, later, _ = taken
    rng = np.random.default_rng(3)

    def scattered(numbers):
        return numbers | {name: numbers[name] + 2e-3 * rng.standard_normal() for name in POSE[:3]}

    found = verify(with_numbers(later, scattered), calibration)
    assert found.named[0].name == NOISE
    assert "or a joint slipped" in verdict_of(found).reasons[0]


def test_joint_angles_that_cannot_be_used_are_refused_by_their_fault(tmp_path):
    options = CellOptions(views=40, seed=5, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
    session = Session.load(write_session(simulate(options), tmp_path / "all", images=False))
    calibration, later = calibrate(session.only(range(32))), session.only(range(32, 40))
    assert calibration.joint_fit.arm is not None

    def in_degrees(numbers):
        return numbers | {name: np.rad2deg(numbers[name]) for name in JOINTS}

    in_degrees, mixed = with_numbers(later, in_degrees), with_numbers(later, w_first)
    raised(DataError, "With the angles in degrees", verify, in_degrees, calibration)
    raised(DataError, "as a quaternion w, x, y, z", verify, mixed, calibration)
