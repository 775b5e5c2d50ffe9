"""Real arms that others measured with an instrument, against plain least squares."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from support.tracked import known_of

from visioncal.core.types import FloatArray
from visioncal.robot import read_robot_document
from visioncal.session import MemoryImages, Session

# What is not stated of these instruments is taken as usual for their kind.
MEASURING_ARM, LASER = {"sigma_m": 6e-5}, {"sigma_m": 2e-5, "sigma_rad": 1e-4}
CONTACT = {"sigma_m": 3e-4}


def readings_session(
    name: str,
    robot: dict,
    instrument: dict,
    joints: FloatArray,
    read: FloatArray,
    *,
    points: Sequence[str] = ("",),
    held: Sequence[int] = (),
) -> Session:
    """A session of readings, as its text would be read.

    Args:
        name: Its name.
        robot: The robot's document.
        instrument: Its noise.
        joints: (s, n) [rad].
        read: (s p, 3) places or (s p, 7) poses [m], those of one stop together.
        points: The names of p points.
        held: Stops that no fit uses.
    """
    turned = read.shape[1] == 7
    columns = ["view", "stop", "role", "point", "meas_x_m", "meas_y_m", "meas_z_m"]
    columns += ["meas_qx", "meas_qy", "meas_qz", "meas_qw"] * turned
    columns += [f"q{index + 1}_rad" for index in range(joints.shape[1])]
    cells = []
    for view, row in enumerate(read):
        stop, point = divmod(view, len(points))
        role = "holdout" if stop in held else ""
        numbers = (*row, *joints[stop])
        cells.append(
            [
                str(view),
                str(stop),
                role,
                points[point],
                *(repr(float(number)) for number in numbers),
            ]
        )
    document = {
        "schema": 1,
        "name": name,
        "instrument": instrument,
        "robot": {"model": robot["name"], "tip": robot["tip"]},
    }
    return Session.assemble(document, columns, cells, MemoryImages({}), robot_document=robot)


def irb120(data: Path) -> Session:
    """Three points at 36 stops of an ABB IRB 120 (Wu et al. 2015)."""
    joints, read = irb120_set(data, "CaliJointAngles", "CaliPosition")
    robot = read_robot_document("irb120")
    return readings_session("irb120", robot, MEASURING_ARM, joints, read, points=("a", "b", "c"))


def irb120_set(data: Path, joints: str, places: str) -> tuple[FloatArray, FloatArray]:
    """Joint angles [rad] and places [m] of one of its sets."""
    folder = data / "irb120_position"
    q, read = (loadmat(folder / f"{name}.mat")[name].astype(float) for name in (joints, places))
    return np.deg2rad(q), 1e-3 * read


def rokae(data: Path, held: Sequence[int] = ()) -> Session:
    """Poses at 30 stops of a six-axis arm, by a laser."""
    folder = data / "rokae_laser_6d"
    lines = (folder / "joint_angle.csv").read_text().splitlines()
    inside = [re.search(r"j:\{([^}]*)\}", line)[1] for line in lines if "j:{" in line]
    q = np.array([[float(part) for part in text.split(",")[:6]] for text in inside])
    rows = [line.split() for line in (folder / "laser_pos.csv").read_text().splitlines() if line]
    measured = np.array([[float(name) for name in row[7:13]] for row in rows])
    turns = Rotation.from_euler("xyz", measured[:, 3:], degrees=True).as_quat()
    read = np.column_stack([1e-3 * measured[:, :3], turns])
    table = np.loadtxt(folder / "dh.csv", delimiter=",", skiprows=1)
    return readings_session("rokae", modified_table(table), LASER, np.deg2rad(q), read, held=held)


def modified_table(rows: FloatArray) -> dict:
    """A robot's document of Craig's form from (n, 4) alpha [deg], a [mm], d [mm], theta [deg]."""
    joints = [
        {
            "name": f"joint_{at + 1}",
            "alpha_rad": float(np.deg2rad(alpha)),
            "a_m": float(1e-3 * a),
            "d_m": float(1e-3 * d),
            "theta_offset_rad": float(np.deg2rad(theta)),
        }
        for at, (alpha, a, d, theta) in enumerate(rows)
    ]
    return {
        "schema": 1,
        "name": "rokae",
        "tip": "flange",
        "convention": "modified",
        "joint": joints,
    }


def talos(data: Path, held: Sequence[int] = ()) -> Session:
    """Contacts of the left hand of a TALOS at 61 postures."""
    folder = data / "figaroh_small"
    with (folder / "talos_left_arm_contact.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = [row for row in rows[0] if row.endswith("_joint")]
    q = np.array([[float(row[name]) for name in names] for row in rows])
    read = np.array([[float(row[name]) for name in ("x1", "y1", "z1")] for row in rows])
    robot = read_robot_document(str(folder / "talos.urdf"), tip="gripper_left_base_link")
    return readings_session("talos", robot, CONTACT, q, read, held=held)


@pytest.mark.slow
def test_an_irb_120_by_a_measuring_arm(real_data):
    known = known_of(irb120(real_data))
    # 4.67 mm in the mean, the frames fitted.
    assert known.robot_arm.kinematics.result.nominal.rms_mm > 4.0
    assert known.findings.held_out.mm < 0.3
    assert known.verdict.status == "good"
    for joints, read, limit in (
        # Plain least squares leave 0.253 and 0.294 mm in the mean.
        ("TestJointAngles", "TestPosition", 0.26),
        ("TestJointAngles2", "TestPosition2", 0.26),
    ):
        q, places = irb120_set(real_data, joints, read)
        flange, x = known.robot_arm.model.base_from_flange(q), known.assessment.state.edges[0]
        in_base = places @ x[:3, :3].T + x[:3, 3]
        on_flange = np.einsum("mji,mj->mi", flange[:, :3, :3], in_base - flange[:, :3, 3])
        # The sets have another tool: its point is what the first five configurations say.
        away = 1e3 * np.linalg.norm(on_flange - on_flange[:5].mean(axis=0), axis=1)
        assert away.mean() < limit
        assert away[5:].mean() < limit


def test_a_six_axis_arm_by_a_laser(real_data):
    known = known_of(rokae(real_data))
    assert known.robot_arm.kinematics.result.nominal.rms_mm > 2.0
    # Plain least squares leave 0.099 mm and 0.038 deg in the fit; left out they are at 0.12 mm.
    assert known.findings.rms.mm < 0.1
    assert known.findings.rms.deg < 0.03
    assert known.findings.held_out.mm < 0.13


@pytest.mark.slow
def test_a_humanoid_by_contacts(real_data):
    held = list(range(3, 61, 10))
    known = known_of(talos(real_data, held))
    away = [view.residual_mm for view in known.findings.pairs[0].views if view.view in held]
    # Joint offsets alone leave 0.87 mm, in the fit.
    assert np.median(away) < 0.95
    # Its joints hardly moved: the method says that this arm is not known elsewhere.
    assert known.verdict.status != "good"
