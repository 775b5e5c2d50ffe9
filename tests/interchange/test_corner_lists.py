"""Corners that other programs have found, with poses of the robot beside them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal
from support.foreign_samples import picture, quaternions

from visioncal.core.errors import DataError
from visioncal.interchange.formats import ImportOptions, convert
from visioncal.simulation import BOARDS, CellOptions, simulate

VIEWS = 12
NAMES = [f"shot_{at}.png" for at in range(1, VIEWS + 1)]
CELL = simulate(CellOptions(target=BOARDS["checkerboard"], views=VIEWS, cut_views=0.0, seed=3))
PX = np.array([view_corners.px for view_corners in CELL.corners])
REQUESTED = ImportOptions(
    mount="eye-in-hand", target="checkerboard_9x6_25mm", resolution=(1280, 800)
)


def poses(folder, *, named=True):
    lines = ["x,y,z,qx,qy,qz,qw" + ",image" * named]
    for name, row in zip(NAMES, quaternions(CELL.robot.base_from_flange).tolist(), strict=True):
        lines.append(",".join([*map(repr, row), *[name] * named]))
    path = folder / "poses.csv"
    path.write_text("\n".join(lines))
    return path


def mrcal(folder):
    lines = ["#!/usr/bin/env mrgingham", "## generated", "# filename x y level"]
    # As a shell sorts them: 1, 10, 11, 12, 2.
    for at in sorted(range(VIEWS), key=lambda index: NAMES[index]):
        lines += [f"/data/{NAMES[at]} {x!r} {y!r} 0" for x, y in PX[at].tolist()]
    path = folder / "corners.vnl"
    path.write_text("\n".join(lines))
    return path


def table(folder):
    lines = ["file,corner_id,x,y"]
    for name, px in zip(NAMES, PX.tolist(), strict=True):
        rows = [f"{name},{at},{x!r},{y!r}" for at, (x, y) in enumerate(px)]
        lines += rows[::-1]
    path = folder / "corners.csv"
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize("form", [mrcal, table])
@pytest.mark.parametrize("named", [True, False])
def test_corners_are_read_by_image_or_in_order(tmp_path, form, named):
    requested = replace(REQUESTED, corners=form(tmp_path))
    session = convert(poses(tmp_path, named=named), tmp_path / "cell", requested=requested)
    assert sorted(session.corners) == [*range(VIEWS)]
    for view, corners in session.corners.items():
        assert corners.ids.tolist() == [*range(54)]
        np.testing.assert_array_equal(corners.px, PX[view])
    by_order = any("by their order" in warning for warning in session.warnings)
    assert by_order == (not named)


def test_they_are_calibrated_with(tmp_path):
    words = ("--mount", "eye-in-hand", "--target", "checkerboard_9x6_25mm")
    source, corners, cell = poses(tmp_path), mrcal(tmp_path), tmp_path / "cell"
    size = ("--resolution", "1280,800")
    done = visioncal("convert", str(source), str(cell), "--corners", str(corners), *words, *size)
    assert done.status == 0, done.said
    options = ("--json", "--no-report", "--no-recording")
    done = visioncal("calibrate", str(cell), "-o", str(tmp_path / "out"), *options)
    assert done.status == 0, done.said
    found = np.array(json.loads(done.out)["transforms"]["flange_from_cam"]["matrix"])
    np.testing.assert_allclose(found, CELL.transforms["flange_from_cam"], atol=2e-3)


def test_what_was_not_found_is_not_there(tmp_path):
    path = mrcal(tmp_path)
    lines = path.read_text().splitlines()
    first = next(at for at, line in enumerate(lines) if "shot_3.png" in line)
    lines[first] = "/data/shot_3.png - - -"
    lines[first + 2] = f"{lines[first + 2].rpartition(' ')[0]} -"
    lines = [line for line in lines if "shot_5.png" not in line] + ["/data/shot_5.png - - -"]
    path.write_text("\n".join(lines))
    picture(tmp_path / "shot_3.png", (1280, 800))
    picture(tmp_path / "shot_5.png", (1280, 800))
    requested = replace(REQUESTED, corners=path)
    session = convert(poses(tmp_path), tmp_path / "cell", requested=requested)
    assert session.corners[2].ids.tolist() == [1, *range(3, 54)]
    assert [view.number for view in session.views] == [0, 1, 2, 3, *range(5, VIEWS)]
    # Images beside them are kept where there are corners.
    assert [view.number for view in session.views if view.image] == [2]
    assert any("1 of 12 rows are left out" in warning for warning in session.warnings)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.vnl", "# filename x y level\na.png 1 2 0\n", "the recording's images are shot_1.png"),
        ("a.vnl", "# filename x y level\na.png 1 2\n", "line 2: it does not have the columns"),
        ("a.vnl", "a.png 1 2\n", "the header, none"),
        ("a.vnl", "# filename x y\na.png - -\n", "holds no corners"),
        ("a.csv", "point,x,y\n0,1,2\n", "the image, x and y of each corner are needed"),
        ("a.csv", "image,x,y\na.png,one,2\n", "line 2: '0 one 2'; numbers are needed"),
        ("a.csv", "image,id,x,y\na.png,0.5,1,2\n", "its number is not whole"),
        ("a.json", "{}", r"no table.*filename,id,x,y"),
        ("a.csv", "image,x,y\na.png,1,2\n", "the recording's images are shot_1.png"),
        ("a.csv", "image,x,y\nl/a.png,1,2\nr/a.png,1,2\n", "corners of a.png twice"),
    ],
)
def test_what_is_wrong_with_them_is_said(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    requested = replace(REQUESTED, corners=tmp_path / name)
    with pytest.raises(DataError, match=words):
        convert(poses(tmp_path), tmp_path / "cell", requested=requested)


def test_the_board_and_the_size_of_the_images_are_asked_for(tmp_path):
    source, corners = poses(tmp_path), mrcal(tmp_path)
    asked = ImportOptions(mount="eye-in-hand", corners=corners)
    with pytest.raises(DataError, match="has corners, but what target they show is not known"):
        convert(source, tmp_path / "cell", requested=asked)
    asked = ImportOptions(mount="eye-in-hand", corners=corners, target="checkerboard_9x6_25mm")
    with pytest.raises(DataError, match="how large the images are is not known"):
        convert(source, tmp_path / "cell", requested=asked)
