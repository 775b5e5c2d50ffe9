"""The report of an aligned cell says what the result has."""

import re
from dataclasses import replace

import numpy as np
from support.aligned_cells import made_up_cell, with_cell

from visioncal.core.number_format import significant
from visioncal.present.network_layout import pairs, weakest_frame
from visioncal.present.report.network import known_in_each_other
from visioncal.present.report.page import render, write_report
from visioncal.results import Calibration, Moved, RobotResult, UnconnectedFrame, ViewResult
from visioncal.results.arm import ArmLevel, ArmResult

CELL = made_up_cell(5)


def render_cell(found: Calibration) -> str:
    return render(found, None, ())


def text_of(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))


def test_the_graph_has_every_frame_with_its_sigma():
    html = render_cell(CELL)
    figure = re.search(r"<svg[^>]*The network of frames.*?</svg>", html, re.DOTALL)[0]
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", figure)
    for frame in ("base_b", "cam_top", "cam_hand", "target_plate"):
        edge = CELL.tree.edge_of(frame)
        assert frame in labels
        worth = f"{significant(edge.sigma_mm)} mm, {significant(edge.sigma_deg)}°"
        assert worth in [label.replace("&#176;", "°") for label in labels]
    assert "the reference" in labels
    assert {"robot a", "robot b"} <= set(labels)


def test_observations_are_counted_by_who_saw_whom():
    of_top = {"seer": "cam_top", "seen": "target_plate"}
    views = (
        ViewResult(0, True, residual_mm=3.0, residual_deg=0.1, **of_top, stop=0),
        ViewResult(1, True, residual_mm=4.0, residual_deg=0.3, **of_top, stop=1),
        ViewResult(2, False, "disagrees", residual_mm=90.0, residual_deg=9.0, **of_top, stop=2),
        ViewResult(3, False, "blurred", seer="cam_hand", seen="target_plate", stop=2),
    )
    first, second = pairs(views)
    assert (first.used, first.left_out, first.rms.mm) == (2, 1, 12.5**0.5)
    assert (second.used, second.rms) == (0, None)
    words = text_of(render_cell(replace(CELL, views=views)))
    assert "2 (\N{MINUS SIGN}1)" in words
    assert "view 2 not used cam_top of target_plate: disagrees" in words


def test_the_table_has_any_frame_in_any_other():
    table = next(known_in_each_other(CELL.tree))
    assert table.titles == ("the cell", "base_a", "base_b", "cam_top")
    rows = {row.cells[0]: row.cells[1:] for row in table.rows}
    assert list(rows) == ["base_a", "base_b", "cam_top"]
    edge = CELL.between("cam_top", "base_b")
    assert rows["cam_top"][1].startswith(f"{significant(edge.sigma_mm)} mm")
    assert rows["cam_top"][2] == ""


def test_errors_of_robots_are_told_where_they_were_estimated():
    levels = tuple(
        ArmLevel(level=name, unknowns=6, rms_mm=mm, held_out_mm=mm, likelihood_ratio=0.0)
        for name, mm in (("nominal", 0.31), ("offsets", 0.17))
    )
    arm = RobotResult(arm=ArmResult(level="offsets", levels=levels))
    words = text_of(render_cell(with_cell(CELL, robots={"a": arm})))
    assert "The arm of a Taken: offsets of the joints." in words
    assert "left out of the fit to 0.17 mm, the arm as stated to 0.31 mm." in words
    assert "The arm" not in text_of(render_cell(CELL))


def test_what_moved_and_what_is_untied_is_told(tmp_path):
    tree = {**CELL.cell.tree, "cam_top_until_stop_4": "cell"}
    edges = {**CELL.edges, "cell_from_cam_top_until_stop_4": CELL.tree.edge_of("cam_top")}
    found = with_cell(
        replace(CELL, edges=edges, joint_covariance=np.pad(CELL.joint_covariance, (0, 6))),
        tree=tree,
        moved=(Moved("cam_top", "cam_top_until_stop_4", 4, 5, 0.58, 0.03, ("target_plate",)),),
        untied=(UnconnectedFrame("cam_<far>", "Let it see target_plate."),),
    )
    write_report(tmp_path / "report.html", found, None, ())
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    words = text_of(html)
    assert "Between stops 4 and 5. cam_top is where it stood last" in words
    assert "It may have been target_plate instead" in words
    assert "Let it see target_plate." in words
    # Names are text, never markup.
    assert "<far>" not in html
    # The network shows the cell as it is now.
    graph = re.search(r"<svg[^>]*The network of frames.*?</svg>", html, re.DOTALL)[0]
    assert "until_stop" not in graph
    assert weakest_frame(found.tree) == weakest_frame(CELL.tree)
