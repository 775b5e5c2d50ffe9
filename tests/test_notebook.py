"""What a notebook shows, and the example notebook's cells."""

import ast
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from support.samples import made_up

import visioncal
from visioncal.core.errors import DataError
from visioncal.present.report.drawing import FIGURES

NOTEBOOK = Path(__file__).with_name("cookbook") / "a_notebook.ipynb"
# A notebook shows a value's first lines; nobody reads more.
LINES, LETTERS = 12, 1500


def values_of(notebook: Path) -> list[object]:
    """Runs a notebook's cells in the current folder; the last value of each, as it would show."""
    names: dict[str, object] = {}
    values = []
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, notebook.name, "exec"), names)
        if last is not None:
            values.append(eval(compile(ast.Expression(last.value), notebook.name, "eval"), names))
    return values


def test_the_cells_of_the_example_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session, checkup, calibration, verdict, place, table, _, again, by_corners, holds = values_of(
        NOTEBOOK
    )
    assert checkup.is_sound
    assert verdict is calibration.verdict
    assert (verdict.status, by_corners, holds) == ("good", "good", True)
    assert len(table) == len(session.views)
    # The same images and lens; without joint angles the poses are those that were reported.
    assert np.linalg.norm(again.transforms["flange_from_cam"].translation - place) < 1e-4


def test_values_are_short_in_a_console_and_cards_in_a_notebook():
    sample = made_up()
    for value in (sample.session, sample.calibration, sample.calibration.verdict):
        text = repr(value)
        assert len(text.splitlines()) <= LINES
        assert len(text) <= LETTERS
    for value in (sample.session, sample.calibration, sample.calibration.verdict):
        card = value._repr_html_()
        assert card.startswith("<div")
        # The session's name, and what its views say, come from anywhere.
        assert "<1>" not in card
        assert "<its>" not in card


def test_every_name_is_listed_and_there():
    assert dir(visioncal) == sorted(visioncal.__all__)
    for name in visioncal.__all__:
        assert getattr(visioncal, name) is not None


def test_a_name_that_is_not_there_suggests_the_nearest():
    transforms = made_up().calibration.transforms
    with pytest.raises(KeyError, match="Did you mean flange_from_cam"):
        transforms["flange_from_camera"]
    with pytest.raises(DataError, match="base_from_target"):
        made_up().calibration.covariance("base_from_board")
    assert transforms.get("flange_from_camera") is None


def test_figures_of_the_report_are_drawn_on_their_own(tmp_path):
    calibration = made_up().calibration
    drawing = calibration.plot()
    drawing.save(tmp_path / "residuals.svg")
    text = (tmp_path / "residuals.svg").read_text("utf-8")
    assert text.startswith("<svg xmlns=")
    # Each view's bar, in two panels at least.
    bars = [it.get("d", "") for it in ElementTree.fromstring(text) if it.tag.endswith("path")]
    assert sum(it.count("z") for it in bars) >= 2 * sum(it.used for it in calibration.views)
    assert "--ink:" in drawing._repr_html_()
    with pytest.raises(DataError, match="no figure 'colours'") as caught:
        calibration.plot("colours")
    assert all(it in caught.value.next_step for it in FIGURES)


def test_views_are_records_where_pandas_is_not_installed(monkeypatch):
    calibration = made_up().calibration
    monkeypatch.setattr("visioncal.results.result.find_spec", lambda _: None)
    table = calibration.views_table()
    assert [it["view"] for it in table] == [it.view for it in calibration.views]


def test_arrays_that_do_not_match_are_refused():
    poses = np.tile(np.eye(4), (3, 1, 1))
    image = np.zeros((8, 8), dtype=np.uint8)
    with pytest.raises(DataError, match="beside 2 of image"):
        visioncal.Session.from_arrays([image] * 2, poses, "charuco_9x6_30mm")
    with pytest.raises(DataError, match=r"type float64; .* uint8"):
        visioncal.Session.from_arrays([0.5 * image] * 3, poses, "charuco_9x6_30mm")
