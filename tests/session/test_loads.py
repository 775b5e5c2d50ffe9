"""What sessions say of loads, and what of it is refused."""

from dataclasses import replace

import numpy as np
import pytest
from support.loaded import HUNG, NOMINAL, loaded_postures
from support.refusals import raised
from support.tracked import known_of

from visioncal.core.errors import DataError, DegenerateError
from visioncal.robot import Robot
from visioncal.session import MemoryImages, Session
from visioncal.session.table import loads_of
from visioncal.simulation.instrument_session import InstrumentOptions, session_of, tracked

HEADER = ("view", "cft_x_m", "cft_y_m", "cft_z_m", "cft_qx", "cft_qy", "cft_qz", "cft_qw")
SEEN = ("0", "0", "0", "1", "0", "0", "0", "1")


def session_with(**cells):
    """A session of one view with some cells."""
    document = {"schema": 1, "name": "loads", "mount": "eye-in-hand"}
    return Session.assemble(
        document, (*HEADER, *cells), [(*SEEN, *cells.values())], MemoryImages({})
    )


def test_loads_are_read_and_nothing_is_no_load():
    view = session_with(payload_kg="5", payload_z_m="0.1", force_z_n="-20").views[0]
    loads = loads_of([view.numbers, {}], ["+", ""])
    assert loads.payload_kg.tolist() == [5.0, 0.0]
    assert loads.payload_m.tolist() == [[0, 0, 0.1], [0, 0, 0]]
    assert loads.force_n.tolist() == [[0, 0, -20], [0, 0, 0]]
    assert loads.side.tolist() == [1.0, 0.0]
    assert not loads.from_both_sides


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"payload_kg": "-2"}, "column payload_kg: -2 kg is no payload"),
        ({"payload_x_m": "0.1"}, "payload_kg, its mass, is missing"),
        ({"force_z_n": "5e7"}, "5e\\+07 N is no force"),
        ({"approach": "up"}, "column approach: 'up' is no side"),
    ],
)
def test_what_can_be_no_load_is_refused(cells, words):
    raised(DataError, words, session_with, **cells)


def test_a_load_that_changes_while_the_arm_stands_still_is_refused():
    options = InstrumentOptions(robot=NOMINAL.name, payloads=HUNG)
    with pytest.raises(DegenerateError, match="views are all from one pose of the robot"):
        known_of(session_of(tracked(options, np.repeat(loaded_postures(1)[:1], 12, axis=0))))


def test_views_of_one_stop_share_its_load():
    options = InstrumentOptions(robot=NOMINAL.name, payloads=HUNG)
    session = session_of(tracked(options, loaded_postures(6)))
    views = tuple(replace(view, stop=view.stop // 4) for view in session.views)
    with pytest.raises(DataError, match="views 0 and 1 are of stop 0 and differ in payload"):
        known_of(replace(session, views=views))
    # Where stops have no numbers, a stop is a pose under a load.
    bare = replace(session, views=tuple(replace(view, stop=None) for view in session.views))
    assert len({observation.station for observation in bare.observations}) > 6


def test_gravity_goes_with_the_session():
    facts = {"schema": 1, "name": "wall", "mount": "eye-in-hand"}
    robot = {"model": "ur5e", "gravity_m_s2": [9.81, 0.0, 0.0]}
    session = Session.assemble(facts | {"robot": robot}, HEADER, [SEEN], MemoryImages({}))
    arm = Robot.from_document(session.robot_document)
    assert arm.gravity.tolist() == [9.81, 0.0, 0.0]
    # On a wall the first joint has to be held, too.
    assert np.abs(arm.load_torques(np.full((1, 6), 0.3))[0, 0]) > 1.0
