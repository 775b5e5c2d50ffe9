"""Tables say the same on the page and in the recording, and one camera is a cell of one."""

from dataclasses import replace

import numpy as np
from support.aligned_cells import made_up_cell, with_cell
from support.samples import made_up

from visioncal.core.number_format import significant
from visioncal.present import result_parts
from visioncal.present.recording.notes import result_markdown, table_lines
from visioncal.present.tables import Table, TableRow
from visioncal.results import Moved

CELL = made_up_cell(3)


def test_columns_in_which_nothing_is_known_are_left_out():
    unknown = significant(None)
    rows = [("a", unknown, "1", ""), TableRow(("a heading",)), ("b", unknown, "2", "")]
    table = Table.of(("what", "deg", "mm", "note"), rows, (0, 3))
    assert table.titles == ("what", "mm")
    assert table.words == (0,)
    assert [row.cells for row in table.rows] == [("a", "1"), ("a heading",), ("b", "2")]


def test_tables_side_by_side_have_all_rows_in_their_order():
    table = Table.of(("view",), [(str(index),) for index in range(7)])
    found = list(table.parts(3))
    assert [len(table.rows) for table in found] == [3, 3, 1]
    assert [row for table in found for row in table.rows] == list(table.rows)


def test_cells_of_a_table_are_text_in_markdown():
    table = Table.of(("a|b", "mm"), [TableRow(("[x](y)", "1"), "taken"), TableRow(("joint_1",))])
    assert list(table_lines(table)) == [
        "",
        r"| a\|b | mm |",
        "| --- | ---: |",
        r"| **\[x\]\(y\)** | 1 |",
        r"| **joint\_1** |  |",
    ]


def test_one_camera_has_one_of_each_without_a_name():
    calibration = made_up().calibration
    assert result_parts.cameras(calibration) == {"": calibration.camera}
    (robot,) = calibration.by_name.robots.values()
    assert (robot.model, robot.arm) == (calibration.robot, calibration.arm)
    assert [view.view for view in calibration.views] == [view.view for view in calibration.views]
    frames = result_parts.frames(calibration)
    assert frames.parents == {
        "base": "cell", "flange": "base", "cam": "flange", "target": "base"
    }  # fmt: skip
    assert frames.robots == {"flange": ""}
    edge = calibration.edges["flange_from_cam"]
    np.testing.assert_array_equal(frames.matrices["cam"], edge.matrix)


def test_frames_of_a_cell_hang_as_they_did_last():
    former = "cam_top_until_stop_4"
    edges = {**CELL.edges, f"cell_from_{former}": CELL.tree.edge_of("cam_top")}
    moved = with_cell(
        replace(CELL, edges=edges, joint_covariance=np.pad(CELL.joint_covariance, (0, 6))),
        tree={**CELL.cell.tree, former: "cell"},
        moved=(Moved("cam_top", former, 4, 5, 0.58, 0.03),),
    )
    frames = result_parts.frames(moved)
    assert frames.parents == CELL.cell.tree
    assert frames.matrices.keys() == CELL.cell.tree.keys() - CELL.cell.flanges.keys()
    # The frame of the cell is that of its reference.
    np.testing.assert_array_equal(frames.matrices[CELL.cell.reference], np.eye(4))
    assert "Between stops 4 and 5." in result_markdown("verdict", moved).replace("\\", "")
