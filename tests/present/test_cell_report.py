"""The report of an aligned cell says what the result has."""

import re
from dataclasses import replace

from support.aligned_cells import made_up_cell

from visioncal.core.number_format import significant
from visioncal.present.network_layout import pairs
from visioncal.present.report.page import render
from visioncal.results import ViewResult

CELL = made_up_cell(5)


def render_cell(found):
    return render(found, None, ())


def text_of(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))


def test_a_table_has_every_frame_with_its_sigma():
    words = text_of(render_cell(CELL))
    for frame in ("base_b", "cam_top", "cam_hand", "target_plate"):
        edge = CELL.tree.edge_of(frame)
        assert f"{significant(edge.sigma_mm)} mm, {significant(edge.sigma_deg)}°" in words
        assert frame in words


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
    assert "cam_top target_plate 2 1" in words
    assert "view 2 not used cam_top of target_plate: disagrees" in words
