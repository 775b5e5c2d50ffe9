"""Files that a recording of others names: none from elsewhere, none for another, none that crashes.

Links need a file system that has them; elsewhere those tests are left out.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.foreign_samples import BASE_FROM_FLANGE, CHARUCO, picture, quaternions, visp

from visioncal.core.errors import DataError
from visioncal.core.files import natural
from visioncal.interchange.formats import (
    ImportOptions,
    PoseImportOptions,
    assemble,
    convert,
    read_foreign,
)
from visioncal.interchange.formats.file_search import files_in, images_named

WISHES = ImportOptions(mount="eye-in-hand", target=CHARUCO)


@pytest.fixture
def naming(tmp_path):
    """Writes a table whose rows name these images, and reads it."""

    def assembled(*names, requested=WISHES):
        poses = quaternions(BASE_FROM_FLANGE).tolist()
        lines = [
            ",".join([name, *map(repr, pose)])
            for name, pose in zip(names, poses[: len(names)], strict=True)
        ]
        header = "image,x,y,z,qx,qy,qz,qw"
        (tmp_path / "poses.csv").write_text("\n".join([header, *lines]), encoding="utf-8")
        return assemble(read_foreign(tmp_path / "poses.csv", requested))

    return assembled


def linked(path, to):
    try:
        path.symlink_to(to)
    except OSError:
        pytest.skip("no links here")


def grey(path, level):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((20, 30), level, np.uint8))


def test_every_row_keeps_its_own_image(tmp_path, naming):
    names = ("a/x.png", "b/x.png", "c/1_x.png", "d/X.png", "a/x.png")
    for level, name in enumerate(names[:4], start=1):
        grey(tmp_path / name, 10 * level)
    session = naming(*names)
    data = [session.images.read(view.image) for view in session.views]
    levels = [int(cv2.imdecode(np.frombuffer(value, np.uint8), 0)[0, 0]) for value in data]
    assert levels == [10, 20, 30, 40, 10]
    assert len({view.image.lower() for view in session.views}) == 4


OUTSIDE = {
    "long": "a" * 300 + ".png",
    "parent": "..",
    "NUL": "a\0.png",
    "above": "../secret.png",
    "absolute": "/etc/hostname",
    "deep": "a/" * 3000 + "b.png",
}


@pytest.mark.parametrize("name", OUTSIDE.values(), ids=OUTSIDE.keys())
def test_names_of_images_that_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="or leaves the folder"):
        images_named([name], tmp_path, None)


@pytest.mark.parametrize("name", OUTSIDE.values(), ids=OUTSIDE.keys())
def test_where_images_lie_now_the_last_part_of_a_name_counts(tmp_path, name):
    picture(tmp_path / "own.png")
    last = name.rsplit("/", 1)[-1]
    if last == "hostname":
        with pytest.raises(DataError, match=r"an image is named '/etc/hostname'.*Correct it"):
            images_named([name], tmp_path, tmp_path)
    elif last in ("secret.png", "b.png"):
        assert images_named([name], tmp_path, tmp_path) == (tmp_path / last,)
    else:
        with pytest.raises(DataError, match="or leaves the folder"):
            images_named([name], tmp_path, tmp_path)


def test_links_that_lead_out_are_not_followed(tmp_path, naming):
    inside, outside = tmp_path / "in", tmp_path / "outside"
    picture(outside / "a.png")
    inside.mkdir()
    linked(inside / "a.png", outside / "a.png")
    linked(inside / "folder", outside)
    picture(inside / "own.png")
    linked(inside / "b.png", inside / "own.png")
    linked(tmp_path / "circle.png", tmp_path / "circle.png")
    assert [path.name for path in files_in(inside)] == ["b.png", "own.png"]
    linked(tmp_path / "out.png", "/etc/hostname")
    for name in ("out.png", "circle.png"):
        with pytest.raises(DataError, match="or leaves the folder"):
            naming(name)
    # The folder that the user names may be a link itself.
    linked(tmp_path / "alias", inside)
    assert [path.name for path in files_in(tmp_path / "alias")] == ["b.png", "own.png"]


def test_poses_are_not_read_through_a_link(tmp_path):
    outside, source = tmp_path / "outside", tmp_path / "in"
    outside.mkdir()
    source.mkdir()
    for at in range(3):
        np.savetxt(outside / f"pose_{at}.txt", BASE_FROM_FLANGE[at])
    linked(source / "poses", outside)
    for at in range(3):
        linked(source / f"pose_{at}.txt", outside / f"pose_{at}.txt")
    with pytest.raises(DataError, match="in no format that is known"):
        read_foreign(source, WISHES)


def test_what_is_no_image_is_not_copied(tmp_path, naming):
    (tmp_path / "a.png").write_text("root:x:0:0")
    picture(tmp_path / "b.png")
    with pytest.raises(DataError, match=r"a\.png is no image"):
        naming("a.png", "b.png")
    session = naming("b.png")
    (tmp_path / "b.png").write_text("root:x:0:0")
    with pytest.raises(DataError, match=r"b\.png is no image"):
        session.save(tmp_path / "out")


def test_an_empty_image_is_a_view_without_one(tmp_path, naming):
    (tmp_path / "a.png").write_bytes(b"")
    picture(tmp_path / "b.png", size=(64, 48))
    assert naming("a.png", "b.png").resolution == (64, 48)


def test_an_image_beyond_any_sensor_is_not_read(tmp_path, naming):
    picture(tmp_path / "a.png")
    with (tmp_path / "a.png").open("r+b") as file:
        # A hole: nothing is written to the disk.
        file.truncate(400_000_000)
    with pytest.raises(DataError, match="more than 300 MB"):
        naming("a.png")


def test_digits_of_other_scripts_are_letters(tmp_path):
    names = ["10.png", "2.png", "1²2.png", "1٣2.png"]
    for name in names:
        picture(tmp_path / name)
    assert {path.name for path in files_in(tmp_path)} == set(names)
    assert natural(tmp_path / "2.png") < natural(tmp_path / "10.png")


def test_a_size_that_is_no_number_is_left_aside(tmp_path):
    recording = visp(tmp_path)
    note = tmp_path / "chessboard-data.txt"
    note.write_text("Chessboard\n9 x 6\nsquare size: 0.02.5 m\n")
    assert read_foreign(recording.source, recording.requested).target is None


def test_a_recording_keeps_its_robots_reading_beside_its_images(tmp_path):
    recording = visp(tmp_path / "in")
    said = replace(recording.requested, robot=PoseImportOptions(inverse=True))
    session = convert(recording.source, tmp_path / "out", requested=said)
    found = session.views[2].base_from_flange().inv().as_matrix()
    # Through a rotation vector and a quaternion, in double precision.
    np.testing.assert_allclose(found, BASE_FROM_FLANGE[2], atol=1e-14)
