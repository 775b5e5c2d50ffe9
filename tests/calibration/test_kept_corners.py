"""Corners that are kept beside a session: found once, and never of another image or board."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from visioncal.calibration.pipeline import calibrate
from visioncal.calibration.stages import corner_cache, detect
from visioncal.calibration.stages.corner_cache import CornerCache
from visioncal.results import to_document
from visioncal.session import Session

KEPT = ".visioncal/corners.json"


@pytest.fixture
def cell(rendered, tmp_path):
    """A session of six of the views, of which one shows no board."""
    folder = tmp_path / "cell"
    shutil.copytree(rendered, folder)
    table = folder / "views.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:7]) + "\n")
    image = folder / Session.load(folder).views[3].image
    blank = detect.cv2.imencode(".png", np.full((800, 1280), 128, np.uint8))[1]
    image.write_bytes(blank.tobytes())
    return folder


@pytest.fixture
def searched(monkeypatch):
    """The views that were searched."""
    views, look_for = [], detect.find_corners

    def counted(image, target, view, *rest, **named):
        views.append(view)
        return look_for(image, target, view, *rest, **named)

    monkeypatch.setattr(detect, "find_corners", counted)
    return views


def facts(folder, *, keep: bool):
    found = detect.detect(Session.load(folder), keeps=keep)
    corners = {
        view: (
            view_corners.ids.tolist(),
            view_corners.px.tolist(),
            view_corners.blur_px,
            np.array(view_corners.weights).tolist(),
        )
        for view, view_corners in found.corners.items()
    }
    return corners, found.rejections, found.resolution


def test_a_second_search_does_not_look_and_finds_the_same_bits(cell, searched):
    first = facts(cell, keep=True)
    assert len(searched) == 6
    assert [value.view for value in first[1]] == [Session.load(cell).views[3].number]
    searched.clear()
    assert facts(cell, keep=False) == first
    assert searched == []


def test_what_is_kept_belongs_to_image_board_and_version(cell, searched, monkeypatch):
    digest = Session.load(cell).digest()
    facts(cell, keep=True)
    assert Session.load(cell).digest() == digest
    searched.clear()
    views = Session.load(cell).views
    one, two = (cell / views[name].image for name in (0, 1))
    one.write_bytes(two.read_bytes())
    facts(cell, keep=False)
    # The bytes are those of another view, which has been searched.
    assert searched == []
    two.write_bytes(two.read_bytes() + b"\0")
    facts(cell, keep=False)
    assert searched == [views[1].number]
    searched.clear()
    session = Session.load(cell)
    (target,) = session.boards.values()
    larger, kept = (
        replace(target, square_m=2 * target.square_m),
        CornerCache.beside(session, grows=False),
    )
    keys = {kept.key(name, board, "") for name in (b"1", b"2") for board in (target, larger)}
    assert len(keys) == 4
    monkeypatch.setattr(corner_cache, "_MADE_BY", {"visioncal": "0.0.1", "opencv": "1"})
    facts(cell, keep=False)
    assert len(searched) == 6


@pytest.mark.parametrize("text", ["", "[1]", "{}", '{"made_by": 1, "searches": []}', "damaged"])
def test_a_damaged_file_counts_as_none(cell, searched, text):
    first = facts(cell, keep=True)
    document = json.loads((cell / KEPT).read_text())
    if text == "damaged":
        document["searches"] = {key: {"size": [1]} for key in document["searches"]}
        text = json.dumps(document)
    (cell / KEPT).write_text(text)
    searched.clear()
    assert facts(cell, keep=True) == first
    assert len(searched) == 6
    searched.clear()
    assert facts(cell, keep=True) == first
    assert searched == []


def test_nothing_is_kept_unasked_or_where_it_cannot_be(cell):
    before = sorted(path.name for path in cell.iterdir())
    asked = replace(calibrate(cell), created="")
    assert sorted(path.name for path in cell.iterdir()) == before
    (cell / ".visioncal").write_text("a file in the place of the folder")
    kept = replace(calibrate(cell, keep_corners=True), created="")
    assert to_document(kept) == to_document(asked)
    (cell / ".visioncal").unlink()
    calibrate(cell, keep_corners=True)
    assert (cell / KEPT).exists()
    again = replace(calibrate(cell), created="")
    assert to_document(again) == to_document(asked)
