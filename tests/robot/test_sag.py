"""What pulls at an arm, by the application's model and by the simulation's: they share nothing."""

from dataclasses import replace

import numpy as np
import pytest
from support.refusals import raised
from support.slopes import jacobian

from visioncal.core.errors import DataError
from visioncal.robot import Loads, Robot, load_robot
from visioncal.robot.conversion import table_of, with_base
from visioncal.robot.elasticity import deflected_joints
from visioncal.robot.tables import table_document
from visioncal.simulation import Payload, arm_named
from visioncal.simulation.arms import loaded_joints

LOAD = Payload(5.0, (0.03, -0.02, 0.11), (12.0, -30.0, 4.0))
COMPLIANCE = (5e-5, 1e-4, 8e-5, 1.5e-4, 1.2e-4, 2e-4)


def postures(count=12):
    return np.random.default_rng(0).uniform(-2.5, 2.5, (count, 6))


def loads_of(payload, count):
    return Loads.alike(count, payload.kg, payload.centre_m, payload.force_n)


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10e", "generic-6r-1800"])
def test_the_arm_gives_way_as_it_does_in_the_simulation(name):
    q, robot, arm = postures(), load_robot(name), arm_named(name)
    # An industrial arm is fifty times as stiff.
    compliance = np.array(COMPLIANCE) * (0.02 if name.startswith("generic") else 1.0)
    sagged = loaded_joints(arm, compliance, q, [LOAD] * len(q))
    ours = deflected_joints(robot, q, compliance, loads_of(LOAD, len(q)))
    # Three looks at the bent arm leave less than a micrometre at its end.
    assert ours == pytest.approx(sagged, abs=1e-6)
    assert np.abs(sagged - q).max() > 1e-3


def test_a_torque_is_the_change_of_height_of_what_is_lifted():
    """The principle of virtual work, by differences of where a lone mass is."""
    q, robot = postures(4), load_robot("ur10e")
    weightless = replace(robot, masses=None)
    load = Payload(3.0, (0.05, 0.02, 0.2))
    torques = weightless.load_torques(q, loads_of(load, len(q)))
    heights = jacobian(lambda by: (robot.base_from_flange(q + by) @ [*load.centre_m, 1.0])[:, 2], 6)
    assert torques == pytest.approx(-load.kg * 9.80665 * heights, abs=1e-6)


def test_masses_survive_what_becomes_of_a_robot():
    q, robot = postures(), load_robot("ur10e")
    held = robot.load_torques(q)
    corrected = robot.corrected(functions=np.zeros((6, 4)))
    assert corrected.load_torques(q) == pytest.approx(held, abs=1e-9)
    again = Robot.from_document(corrected.document)
    assert again.load_torques(q) == pytest.approx(held, abs=1e-9)
    # Seen from another frame the arm hangs as it did.
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    assert with_base(robot, turn).load_torques(q) == pytest.approx(held, abs=1e-9)
    assert with_base(robot, turn).gravity == pytest.approx([-9.80665, 0, 0])
    # A wall is another matter: the first joint has to hold something then.
    leaning = Robot.from_document(dict(robot.document) | {"gravity_m_s2": [9.81, 0, 0]})
    assert np.abs(leaning.load_torques(q)[:, 0]).max() > 1.0 > np.abs(held[:, 0]).max()


def test_an_arm_of_unknown_masses_has_no_load_torques():
    robot = load_robot("irb120")
    assert robot.masses is None
    assert not robot.load_torques(np.zeros((1, 6))).any()
    table = table_document(table_of(load_robot("ur5e"), "standard"))
    table["joint"][2]["mass_kg"] = -3.0
    raised(DataError, r"mass_kg is missing", Robot.from_document, table)
    for row in table["joint"]:
        row |= {"mass_kg": 1.0, "com_m": [0, 0, 0]}
    table["joint"][2]["mass_kg"] = -3.0
    with pytest.raises(
        DataError, match=r"joint elbow_joint: mass_kg is -3.0, but must be a mass of 0 kg"
    ):
        Robot.from_document(table)
    document = dict(robot.document) | {"gravity_m_s2": [0, 0, -1000]}
    raised(DataError, "gravity_m_s2", Robot.from_document, document)
