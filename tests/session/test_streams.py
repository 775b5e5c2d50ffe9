"""Streams beside the views: read, checked, told, and kept in every storage of a session."""

from dataclasses import replace

import numpy as np
import pytest
from support.kept import assert_same, kept_session, kept_streams
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.interchange.formats import convert
from visioncal.present.recording import write_recording
from visioncal.session import Session, Stream
from visioncal.session.streams import check_stream, parse_stream, read_streams

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


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
        (["stamp_s,q1_rad", "0,1", "1,nan"], "line 3, column q1_rad: 'nan' is no finite number"),
        (["stamp_s,mode", "0,auto"], "line 2, column mode: 'auto'.*numbers alone"),
        (["stamp_s,q2_rad", "0,1"], "lack q1_rad"),
        (["stamp_s,q1_rad,q2_rad", "0,1,"], "line 2, column q1_rad ... q2_rad: some are empty"),
        (["stamp_s," + ",".join(POSE), "0,1,1,1,0,0,0,2"], "line 2, column qx ... qw: .* norm is"),
    ],
)
def test_what_is_wrong_is_named(lines, words):
    raised(DataError, words, parsed, *lines)


def test_a_name_that_leaves_the_folder_is_refused():
    raised(DataError, "name", kept_session().with_streams, {"../robot": kept_streams()["robot"]})


def test_gaps_are_told():
    stamps_s = np.arange(1000) / 500
    there = (stamps_s < 0.5) | (stamps_s > 0.9)
    (told,) = kept_session().with_streams({"robot": stream(stamp_s=stamps_s[there])}).warnings[-1:]
    assert "in 1 place" in told
    assert "0.404 s, 0.498 s from the start" in told
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
        ("stamp_s", "1e308", "no time of a recording; write seconds"),
        ("x_m", "-1e308", "no place in a robot cell"),
        ("q1_rad", "1e300", "no angle of a joint"),
        ("qx", "1e308", "no number that a cell has"),
    ],
)
def test_a_number_that_no_cell_has_is_named_by_its_column(column, value, words, tmp_path):
    names = ("stamp_s", *POSE, "q1_rad", "dq1_rad_s", "tau1_nm", "note")
    cells = dict.fromkeys(names, "0") | {"qw": "1"}
    first, second = cells, cells | {"stamp_s": "1"} | {column: value}
    lines = [",".join(names), *(",".join(mapping.values()) for mapping in (first, second))]
    (tmp_path / "streams").mkdir()
    (tmp_path / "streams" / "robot.csv").write_text("\n".join(lines))
    raised(DataError, rf"column {column}: .*{words}", read_streams, tmp_path)
