"""What a session has beside its views: streams, and what they say of loads."""

from dataclasses import replace

import numpy as np
import pytest
from support.kept import assert_same, kept_session, kept_streams
from support.refusals import raised
from support.tracked import known_of

from visioncal.core.errors import DataError, DegenerateError
from visioncal.interchange.formats import convert
from visioncal.present.recording import write_recording
from visioncal.robot import Robot
from visioncal.session import MemoryImages, Session, Stream
from visioncal.session.columns import POSE
from visioncal.session.streams import check_stream, parse_stream, read_streams
from visioncal.session.table import loads_of
from visioncal.simulation import Payload, arm_named
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    random_postures,
    session_of,
    tracked,
)

# An arm that is loaded at its flange, as each of some postures is read with each load.
HUNG = tuple(Payload(kg=load_n / 9.80665) for load_n in (0.0, 10.0, 20.0, 50.0))
POSTURES = random_postures(arm_named("generic-6r-1800"), 6, np.random.default_rng(0))


def stream(**columns):
    return Stream(tuple(columns), np.stack(list(columns.values()), axis=1))


def parsed(*lines):
    robot = parse_stream("\n".join(lines) + "\n", "streams/robot.csv")
    check_stream("robot", robot)
    return robot


def test_columns_are_the_numbers_as_they_were_read():
    robot = parsed("stamp_s,q1_rad, dq1_rad_s", "0.1,1e-3,-0.0", "0.3,.5,2", "")
    assert robot.columns == ("stamp_s", "q1_rad", "dq1_rad_s")
    np.testing.assert_array_equal(robot["q1_rad"], [1e-3, 0.5])
    np.testing.assert_array_equal(robot.joints()[1], [[1e-3], [0.5]])
    with pytest.raises(ValueError, match="read-only"):
        robot.values[0, 0] = 1.0


def test_rows_without_a_pose_are_no_poses():
    robot = parsed(
        "stamp_s," + ",".join(POSE) + ",temp1_c",
        "0,0.4,0,0.5,0,0,0,1,",
        "0.1,,,,,,,,31.5",
        "0.2,0.5,0,0.5,0,0.6,0,0.8,",
    )
    stamps_s, poses = robot.poses()
    np.testing.assert_array_equal(stamps_s, [0.0, 0.2])
    np.testing.assert_array_equal(poses[:, 0, 3], [0.4, 0.5])
    assert np.isnan(robot["temp1_c"]).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["time,q1_rad", "0,1"], "the column stamp_s, the time of each row, is missing"),
        (["stamp_s,q1_rad", "0,1", "0,2"], "line 3, column stamp_s: it does not ascend"),
        (["stamp_s,q1_rad", "0,1", ",2"], "line 3, column stamp_s: it is empty"),
        (["stamp_s,q1_rad", "0,1", "1,2,3"], "line 3: it has 3 fields, but the header has 2"),
        (
            ["stamp_s,q1_rad", "0,1", "1,nan"],
            "line 3, column q1_rad: 'nan' must be a finite number",
        ),
        (["stamp_s,mode", "0,auto"], "line 2, column mode: 'auto'.*numbers alone"),
        (["stamp_s,q2_rad", "0,1"], "lack q1_rad"),
        (["stamp_s,q1_rad,q2_rad", "0,1,"], "line 2, column q1_rad ... q2_rad: some are empty"),
        (["stamp_s," + ",".join(POSE), "0,1,1,1,0,0,0,2"], "line 2, column qx ... qw: .* norm is"),
    ],
)
def test_a_faulty_stream_is_named(lines, words):
    raised(DataError, words, parsed, *lines)


def test_a_name_that_leaves_the_folder_is_refused():
    raised(DataError, "name", kept_session().with_streams, {"../robot": kept_streams()["robot"]})


def test_gaps_are_reported():
    stamps_s = np.arange(1000) / 500
    is_kept = (stamps_s < 0.5) | (stamps_s > 0.9)
    (words,) = (
        kept_session().with_streams({"robot": stream(stamp_s=stamps_s[is_kept])}).warnings[-1:]
    )
    assert "in 1 place" in words
    assert "0.404 s, 0.498 s from the start" in words
    assert not parsed("stamp_s", *map(repr, stamps_s.tolist())).gaps().size


def test_folder_recording_and_copies_hold_the_same(tmp_path):
    # A file of a robot's orders its keys anew.
    session = replace(kept_session(), robot_document=None)
    cells = [[view.cell(column) for column in session.columns] for view in session.views]
    # The kept one has a time and an angle that no folder of today may hold.
    cells = [["1e10" if name == "1e+308" else name for name in row] for row in cells]
    plain = Session.assemble(
        session.document,
        session.columns,
        cells,
        session.images,
        target_document=session.target_document,
    )
    (robot,) = kept_streams().values()
    values = np.where(robot.values == 1e300, 1e4, robot.values)
    session = plain.with_streams({"robot": replace(robot, values=values)})
    session.save(tmp_path / "folder")
    write_recording(tmp_path / "session.rrd", session, None, (), None)
    assert_same(session, Session.load(tmp_path / "folder"))
    assert_same(session, Session.load(tmp_path / "session.rrd"))
    convert(tmp_path / "folder", tmp_path / "again.rrd")
    convert(tmp_path / "again.rrd", tmp_path / "again")
    assert_same(session, Session.load(tmp_path / "again"))


def test_the_digest_knows_streams_and_is_as_it_was_without():
    session, (robot,) = kept_session(), kept_streams().values()
    # As version 0.1.0 had it, before there were streams.
    assert session.digest() == "e83c60275bbfdebda5c33cd9109102a770f3f6bec9646e9bd73d2b99b9de1ba6"
    changed = robot.values.copy()
    changed[1, 1] = 1e-300
    spelt = np.where(robot.values == 0.0, 0.0, robot.values)
    digests = [
        session.with_streams(mapping).digest()
        for mapping in (
            {},
            {"robot": robot},
            {"robot": replace(robot, values=changed)},
            {"gripper": robot},
            {"robot": replace(robot, columns=("stamp_s", "q1_rad", "temp2_c"))},
        )
    ]
    assert len(set(digests)) == len(digests)
    # -0.0 is 0.0 spelt otherwise.
    assert session.with_streams({"robot": replace(robot, values=spelt)}).digest() == digests[1]


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("stamp_s", "1e308", "beyond every recording; write seconds"),
        ("x_m", "-1e308", "beyond every robot cell"),
        ("q1_rad", "1e300", "beyond every joint"),
        ("qx", "1e308", "beyond every number of a cell"),
    ],
)
def test_an_impossible_number_is_named_by_its_column(column, value, words, tmp_path):
    names = ("stamp_s", *POSE, "q1_rad", "dq1_rad_s", "tau1_nm", "note")
    cells = dict.fromkeys(names, "0") | {"qw": "1"}
    first, second = cells, cells | {"stamp_s": "1"} | {column: value}
    lines = [",".join(names), *(",".join(mapping.values()) for mapping in (first, second))]
    (tmp_path / "streams").mkdir()
    (tmp_path / "streams" / "robot.csv").write_text("\n".join(lines))
    raised(DataError, rf"column {column}: .*{words}", read_streams, tmp_path)


HEADER = ("view", "cft_x_m", "cft_y_m", "cft_z_m", "cft_qx", "cft_qy", "cft_qz", "cft_qw")
SEEN = ("0", "0", "0", "1", "0", "0", "0", "1")


def session_with(**cells):
    """A session of one view with some cells."""
    document = {"schema": 1, "name": "loads", "mount": "eye-in-hand"}
    return Session.assemble(
        document, (*HEADER, *cells), [(*SEEN, *cells.values())], MemoryImages({})
    )


def test_loads_are_read_and_an_empty_cell_is_no_load():
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
        ({"payload_kg": "-2"}, "column payload_kg: -2 kg must be a payload"),
        ({"payload_x_m": "0.1"}, "payload_kg, its mass, is missing"),
        ({"payload_kg": "5", "payload_z_m": "100"}, r"within 3 m, .*\(100 mm\?\)"),
        ({"force_z_n": "5e7"}, "5e\\+07 N is beyond every force"),
        ({"approach": "up"}, "column approach: 'up' must be a side"),
    ],
)
def test_an_impossible_load_is_refused(cells, words):
    raised(DataError, words, session_with, **cells)


def test_a_load_that_changes_while_the_arm_stands_still_is_refused():
    options = InstrumentOptions(payloads=HUNG)
    with pytest.raises(DegenerateError, match="views are all from one pose of the robot"):
        known_of(session_of(tracked(options, np.repeat(POSTURES[:1], 12, axis=0))))


def test_views_of_one_stop_share_its_load():
    options = InstrumentOptions(payloads=HUNG)
    session = session_of(tracked(options, np.repeat(POSTURES, 4, axis=0)))
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
