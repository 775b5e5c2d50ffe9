"""Bags of ROS and data sets of LeRobot become sessions that calibrate to the same."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.bags import FORMS, BagOptions, write_bag
from support.lerobot import KEY, write_dataset
from support.marks import crossed, slow
from support.refusals import raised

from visioncal import calibrate, simulation
from visioncal.core.errors import DataError
from visioncal.core.transforms import pose_difference
from visioncal.interchange.formats import (
    ImportOptions,
    PoseImportOptions,
    bag_messages,
    convert,
    lerobot,
)
from visioncal.interchange.formats.lerobot import FrameImages
from visioncal.session import Session
from visioncal.session.depth import read_depth
from visioncal.session.motion import motion_of
from visioncal.simulation import CAMERAS, CellOptions, DepthOptions

BOARD = ImportOptions(target="charuco_9x6_30mm")
LENS = {"matrix": [457.1, 456.8, 322.65, 198.4], "distortion": [-0.1, 0.06, 0.0, 0.0, 0.0]}


@pytest.fixture(scope="module")
def source(rendered) -> Session:
    session = Session.load(rendered)
    document = session.document | {"camera": session.document["camera"] | LENS}
    return replace(session, document=document, views=session.views[:6])


def bag(path: Path, source: Session, rendered: Path, **options) -> Path:
    return write_bag(path, source, rendered, BagOptions(**options))


@pytest.fixture(scope="module")
def dataset(source, rendered, tmp_path_factory):
    """Writes data sets of LeRobot, of which each video is coded once."""

    @cache
    def written(version, robot):
        folder = tmp_path_factory.mktemp("sets") / "set"
        return write_dataset(folder, source, rendered, version, robot)

    return lambda path, version, robot: shutil.copytree(written(version, robot), path)


def pixels(store, path):
    return cv2.imdecode(np.frombuffer(store.read(path), np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize(
    ("form", "options"),
    [
        *((form, {}) for form in FORMS),
        ("mcap", {"is_compressed": True, "camera_late_s": 0.05, "jitter_s": 0.01}),
    ],
)
def test_a_bag_is_the_session_that_it_was_made_of(form, options, source, rendered, tmp_path):
    path = bag(tmp_path / ("b.bag" if form == "ros1" else "b"), source, rendered, form=form,
               is_compressed=options.pop("is_compressed", False), **options)  # fmt: skip
    said = []
    requested = replace(BOARD, progress=lambda *each: said.append(each))
    session = convert(path, tmp_path / "out", requested=requested)
    assert session.mount == "eye-in-hand"
    assert said[-1][1] == said[-1][2]
    assert [*session.declaration.camera.matrix] == LENS["matrix"]
    assert len(session.views) == len(source.views)
    flange = motion_of(session, None, "robot").flange
    late_s = options.get("camera_late_s", 0.0)
    for view, meant in zip(session.views, source.views, strict=True):
        assert np.array_equal(
            pixels(session.images, view.image), pixels(source.images, meant.image)
        )
        pose = flange.at(np.array([view.stamp_s - late_s]))[0]
        away = pose_difference(pose, meant.base_from_flange().as_matrix())
        # Written stamps have a tenth of a microsecond, and quaternions sixteen digits.
        assert max(away) < 1e-6


@pytest.mark.parametrize(("kind", "ending"), [("png", ".png"), ("jpeg", ".jpg")])
def test_compressed_images_are_kept_byte_by_byte(kind, ending, source, rendered, tmp_path):
    path = bag(tmp_path / "b", source, rendered, is_compressed=True, image_kind=kind)
    session = convert(path, tmp_path / "out", requested=BOARD)
    for view, meant in zip(session.views, source.views, strict=True):
        assert view.image.endswith(ending)
        data = source.images.read(meant.image)
        if kind == "jpeg":
            data = cv2.imencode(".jpg", pixels(source.images, meant.image))[1].tobytes()
        assert session.images.read(view.image) == data


@pytest.mark.slow
@pytest.mark.parametrize("period_s", [0.2, 0.3])
def test_stops_are_found_at_any_rate_of_the_robot(period_s, source, rendered, tmp_path):
    path = bag(tmp_path / "b", source, rendered, period_s=period_s, frames_s=0.1)
    session = convert(path, tmp_path / "out", requested=BOARD)
    assert len(session.views) == len(source.views)
    assert any("one a stop of the robot" in note for note in session.warnings)
    motion = motion_of(session, None, "robot")
    for view, meant in zip(session.views, source.views, strict=True):
        (pose,) = motion.flange.at(np.array([view.stamp_s]))
        # Written stamps have a tenth of a microsecond, and quaternions sixteen digits.
        assert max(pose_difference(pose, meant.base_from_flange().as_matrix())) < 1e-6
    result = calibrate(tmp_path / "out")
    assert result.clock.method == "rest"
    assert [view.used for view in result.views].count(True) == len(source.views)


def test_depth_is_no_picture(with_depth, tmp_path):
    source, change = Session.load(with_depth), setting("Image", "encoding", "16UC1")
    path = bag(tmp_path / "b", source, with_depth, change=change)
    raised(DataError, "no topic has images", convert, path, tmp_path / "out", requested=BOARD)
    change = setting("CompressedImage", "format", "16UC1; png compressed ")
    path = bag(tmp_path / "c", source, with_depth, change=change, is_compressed=True)
    raised(DataError, "no topic has images", convert, path, tmp_path / "out", requested=BOARD)


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory):
    """A folder of a session with depth of 0.1 mm."""
    folder = tmp_path_factory.mktemp("depth") / "cell"
    small = replace(CAMERAS["wide"], resolution=(320, 200), matrix=CAMERAS["wide"].matrix / 4)
    cell = simulation.simulate(CellOptions(camera=small, views=6))
    simulation.write_session(cell, folder, depth=DepthOptions())
    return folder


@pytest.mark.parametrize(
    ("kind", "form"), crossed(["16UC1", "32FC1", "compressed", "cloud"], ["ros1", "mcap"])
)
def test_depth_of_a_bag_is_that_of_its_views(kind, form, with_depth, tmp_path):
    source = Session.load(with_depth)
    path = tmp_path / ("b.bag" if form == "ros1" else "b")
    bag(path, source, with_depth, form=form, depth=kind, frames_s=0.4)
    session = convert(path, tmp_path / "out", requested=BOARD)
    assert any("6 of 6 images have depth" in note for note in session.warnings)
    for view, meant in zip(session.views, source.views, strict=True):
        data = [one.images.read(at.depth) for one, at in ((session, view), (source, meant))]
        depth = read_depth(data[0], view.depth, (320, 200))
        meant_m = read_depth(data[1], meant.depth, (320, 200), 1e-4)
        # Whole millimetres, or floats of four bytes.
        limit = 0.51e-3 if kind in ("16UC1", "compressed") else 1e-6
        assert np.allclose(depth, meant_m, 0.0, limit, equal_nan=True)


def test_depth_of_another_frame_is_named_and_left_out(with_depth, tmp_path):
    source = Session.load(with_depth)
    path = bag(tmp_path / "b", source, with_depth, depth="16UC1", depth_frame="other", frames_s=0.4)
    session = convert(path, tmp_path / "out", requested=BOARD)
    assert not any(view.depth for view in session.views)
    (said,) = (note for note in session.warnings if "no depth is aligned" in note)
    assert "/camera/aligned_depth_to_color/image_raw (other, (320, 200))" in said
    assert "align_depth.enable" in said


PACKED = [slow("ros1", "BZ2"), ("ros1", "LZ4"), ("sqlite3", "MESSAGE"), ("mcap", "STORAGE")]


@pytest.mark.parametrize(("form", "compression"), PACKED)
def test_few_bytes_do_not_fill_the_memory(form, compression, with_depth, tmp_path, monkeypatch):
    # Images of 64 kB.
    source = Session.load(with_depth)
    data = np.zeros(3_000_000, np.uint8)
    change = setting("Image", "data", data, lambda at: at == 3)
    options, ending = {"form": form, "compression": compression}, ".bag" * (form == "ros1")
    sound = bag(tmp_path / f"a{ending}", source, with_depth, **options)
    assert len(convert(sound, tmp_path / "a-out", requested=BOARD).views) == len(source.views)
    path = bag(tmp_path / f"b{ending}", source, with_depth, change=change, **options)
    monkeypatch.setattr(bag_messages, "MOST_IMAGE_BYTES", 2_000_000)
    words = "over 2 MB, decompressed"
    raised(DataError, words, convert, path, tmp_path / "out", requested=BOARD)
    assert not (tmp_path / "out").exists()


def test_cameras_of_a_bag_are_a_whole_cell(source, rendered, tmp_path):
    path = bag(tmp_path / "b", source, rendered, is_compressed=True, names=("left", "right"))
    session = convert(path, tmp_path / "out", requested=BOARD)
    assert list(session.cameras) == ["left_camera", "right_camera"]
    only = replace(BOARD, image="/left/camera/image_raw/compressed")
    assert not convert(path, tmp_path / "one", requested=only).declaration.cameras
    unknown = convert(path, tmp_path / "lens", requested=replace(BOARD, intrinsics="estimate"))
    assert all(one.matrix is None for one in unknown.declaration.cameras.values())
    with pytest.raises(DataError, match="several cameras") as caught:
        convert(path, tmp_path / "none", requested=replace(BOARD, resolution=(640, 400)))
    assert "--image-key" in caught.value.next_step


@pytest.mark.parametrize(
    ("options", "message", "step"),
    [
        ({"without": ("/tf",)}, "does not say where the robot was", "--robot-key"),
        ({"without": ("/camera/image_raw/compressed",)}, "no topic has images", "ros2 bag record"),
        ({"poses": "pose"}, "how the camera is mounted is not known", "--mount"),
    ],
)
def test_missing_topics_of_a_bag_are_named(options, message, step, source, rendered, tmp_path):
    path = bag(tmp_path / "b", source, rendered, is_compressed=True, **options)
    caught = raised(DataError, message, convert, path, tmp_path / "out", requested=BOARD)
    assert step in caught.next_step
    assert not (tmp_path / "out").exists()


def test_poses_frames_and_lenses_may_be_named(source, rendered, tmp_path):
    path = bag(tmp_path / "b", source, rendered, is_compressed=True, poses="pose")
    # Intrinsics without an image size take that of the bag.
    fx, fy, cx, cy = LENS["matrix"]
    stated = {"camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]}
    lens = tmp_path / "lens.json"
    lens.write_text(json.dumps(stated | {"distortion_coefficients": LENS["distortion"]}))
    requested = replace(BOARD, mount="eye-in-hand", intrinsics=str(lens))
    session = convert(path, tmp_path / "out", requested=requested)
    assert len(session.views) == len(source.views)
    assert session.declaration.camera.resolution == source.declaration.camera.resolution
    assert [*session.declaration.camera.matrix] == LENS["matrix"]
    frames = bag(tmp_path / "frames", source, rendered, is_compressed=True)
    wrong = replace(BOARD, robot=PoseImportOptions(("base_link", "tool1")))
    caught = raised(DataError, "no 'tool1'", convert, frames, tmp_path / "none", requested=wrong)
    assert "tool0" in caught.next_step


def test_data_sets_of_lerobot_are_one_session(source, dataset, tmp_path):
    """Of both versions."""
    first, session = (
        convert(
            dataset(tmp_path / version, version, "ur10e_follower"),
            tmp_path / f"{version}-out",
            requested=BOARD,
        )
        for version in ("v2.1", "v3.0")
    )
    assert session.declaration.robot.model == "ur10e"
    assert len(session.views) == len(source.views)
    q = np.array([view.joints_rad for view in session.views])
    assert np.abs(q - [view.joints_rad for view in source.views]).max() < 1e-4
    assert first.document == session.document | {"name": first.document["name"]}
    for view, other in zip(session.views, first.views, strict=True):
        assert view.numbers == other.numbers
        assert np.array_equal(pixels(session.images, view.image), pixels(first.images, other.image))


@pytest.mark.slow
def test_a_data_set_of_lerobot_calibrates(source, dataset, tmp_path):
    made = dataset(tmp_path / "v3.0", "v3.0", "ur10e_follower")
    session = convert(made, tmp_path / "out", requested=BOARD)
    transform = calibrate(session, level="hand-eye").transforms["flange_from_cam"]
    meant = calibrate(source, level="hand-eye").transforms["flange_from_cam"]
    # A video's compression moves corners by some hundredths of a pixel.
    assert pose_difference(transform.as_matrix(), meant.as_matrix())[0] < 0.5


HUGE = "{chunk_index:>9000000000}{episode_chunk:>9000000000}"
HOSTILE = [
    None, [], "text", {}, {"features": None}, {"features": []}, {"features": {KEY: []}},
    {"features": {KEY: None}}, {"fps": 0}, {"fps": -1.0}, {"fps": "fast"}, {"fps": 1e300},
    {"fps": [30]}, {"chunks_size": 0}, {"chunks_size": "many"}, {"chunks_size": 1.5},
    {"robot_type": ["ur10e"]}, {"robot_type": 3}, {"video_path": 7}, {"video_path": HUGE},
    {"video_path": "{episode_chunk.__class__}"}, {"video_path": "{nothing}"}, {"video_path": "{"},
    {"video_path": "../{video_key}.mp4"}, {"video_path": "/etc/passwd"}, {"video_path": ""},
]  # fmt: skip


@pytest.mark.parametrize("version", [slow("v2.1"), "v3.0"])
def test_a_hostile_description_of_a_data_set_is_refused(version, dataset, tmp_path):
    path = dataset(tmp_path / "set", version, "ur10e")
    file = path / "meta" / "info.json"
    info = json.loads(file.read_text())
    for hostile in HOSTILE:
        changed = info | hostile if isinstance(hostile, dict) and hostile else hostile
        file.write_text(json.dumps(changed))
        with pytest.raises(DataError) as caught:
            convert(path, tmp_path / "out", requested=BOARD)
        assert caught.value.culprits
        assert len(caught.value.message) < 500
    # A playlist may name any file of the machine.
    file.write_text(json.dumps(info | {"video_path": "list.m3u8"}))
    raised(DataError, "must end in .mp4", convert, path, tmp_path / "out", requested=BOARD)
    # What says how much there is is no reason to look for as much.
    file.write_text(json.dumps(info | {"total_episodes": 10**12}))
    assert convert(path, tmp_path / "out", requested=BOARD).views


@pytest.mark.parametrize(
    ("name", "cells"),
    [
        ("observation.state", [[1.0], [1.0, 2.0]]),
        ("observation.state", [[], []]),
        ("observation.state", [[1.0, None], [1.0, 2.0]]),
        ("observation.state", ["a", "b"]),
        ("timestamp", [None, 1.0]),
        ("episode_index", [2**62, 5]),
        ("frame_index", ["x", "y"]),
    ],
)
def test_rows_of_a_data_set_that_are_no_numbers_are_refused(name, cells, dataset, tmp_path):
    path = dataset(tmp_path / "set", "v3.0", "ur10e")
    (file,) = (path / "data").rglob("*.parquet")
    columns = pq.read_table(file).to_pydict()
    count = len(columns["timestamp"])
    pq.write_table(pa.table(columns | {name: (cells * count)[:count]}), file)
    with pytest.raises(DataError) as caught:
        convert(path, tmp_path / "out", requested=BOARD)
    assert caught.value.culprits


def test_image_files_of_a_data_set_are_read_inside_its_folder(source, rendered, dataset, tmp_path):
    path = dataset(tmp_path / "set", "v2.1", "ur10e")
    info = json.loads((path / "meta" / "info.json").read_text())
    info["features"][KEY] = {"dtype": "image"}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    file = next((path / "data").rglob("*.parquet"))
    table, image = pq.read_table(file), rendered / source.views[0].image
    for folder, name in ((path, "frame.png"), (tmp_path, "../frame.png")):
        shutil.copy(image, folder / "frame.png")
        later = (rendered / source.views[-1].image).read_bytes()
        cells = [{"bytes": None, "path": name}] * 40 + [{"bytes": later}] * (len(table) - 40)
        whole = table.append_column(KEY, pa.array(cells))
        # In two files, as the rows of a data set of several episodes.
        pq.write_table(whole[:40], file)
        pq.write_table(whole[40:], file.with_name("episode_000001.parquet"))
        if folder == path:
            session = convert(path, tmp_path / "out", requested=BOARD)
            assert session.images.read(session.views[0].image) == image.read_bytes()
            assert session.images.read(session.views[-1].image) == later
    raised(DataError, "leaves the folder", convert, path, tmp_path / "none", requested=BOARD)


def test_a_damaged_bag_is_refused(source, rendered, dataset, tmp_path):
    path = bag(tmp_path / "b.bag", source, rendered, form="ros1", is_compressed=True)
    path.write_bytes(path.read_bytes()[:100_000])
    raised(DataError, "cannot be read as a bag", convert, path, tmp_path / "out", requested=BOARD)
    path = dataset(tmp_path / "set", "v3.0", "ur10e")
    next((path / "data").rglob("*.parquet")).write_text("version https://git-lfs.github.com")
    raised(DataError, "cannot be read as parquet", convert, path, tmp_path / "out", requested=BOARD)


def test_a_video_that_is_not_the_same_when_read_twice_leaves_nothing(
    dataset, tmp_path, monkeypatch
):
    path = dataset(tmp_path / "set", "v2.1", "ur10e_follower")
    read, load = iter(range(10_000)), FrameImages.load
    # As damaged ones, whose decoder shows what its memory held.
    monkeypatch.setattr(FrameImages, "load", lambda *at: load(*at) + b"%d" % next(read))
    raised(DataError, "read twice", convert, path, tmp_path / "out", requested=BOARD)
    assert not (tmp_path / "out").exists()


def test_no_more_rows_of_a_data_set_are_read_than_fit(dataset, tmp_path, monkeypatch):
    path = dataset(tmp_path / "set", "v3.0", "ur10e")
    # As of a file of some hundred kB that holds as many equal rows as a memory does not.
    monkeypatch.setattr(lerobot, "MAX_VALUES", 10)
    raised(DataError, "more than 200 values", convert, path, tmp_path / "out", requested=BOARD)


def test_a_repeated_value_of_a_data_set_does_not_fill_the_memory(dataset, tmp_path, monkeypatch):
    path = dataset(tmp_path / "set", "v3.0", "ur10e")
    about = path / "meta" / "info.json"
    info = json.loads(about.read_text())
    info["features"][KEY]["dtype"] = "image"
    about.write_text(json.dumps(info))
    (file,) = (path / "data").rglob("*.parquet")
    table = pq.read_table(file)
    # A hundred kB that stand for as many large images as there are rows.
    large = pa.array([b"\x89PNG" + bytes(3_000_000)])
    same = pa.DictionaryArray.from_arrays(pa.array([0] * len(table), pa.int32()), large)
    cells = pa.StructArray.from_arrays([same, pa.array([""] * len(table))], ["bytes", "path"])
    pq.write_table(table.append_column(KEY, cells), file)
    assert file.stat().st_size < 300_000
    monkeypatch.setattr(lerobot, "_MOST_BYTES", 10_000_000)
    raised(DataError, "images are over 10 MB", convert, path, tmp_path / "out", requested=BOARD)
    text = pa.DictionaryArray.from_arrays(same.indices, pa.array([3_000_000 * "1"]))
    at = table.schema.get_field_index("timestamp")
    pq.write_table(table.set_column(at, "timestamp", text), file)
    raised(DataError, "has texts, not num", convert, path, tmp_path / "out", requested=BOARD)


def setting(kind, path, value, which=lambda _: True):
    """Sets a field of messages of a type, such as `transforms.0.transform.rotation.w`."""
    *to, last = path.split(".")

    def change(each, at, message):
        if each == kind and which(at):
            for name in to:
                message = message[0] if name == "0" else getattr(message, name)
            object.__setattr__(message, last, value)

    return change


PLACE, TURN = "transforms.0.transform.translation.", "transforms.0.transform.rotation."


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (setting("TFMessage", f"{PLACE}x", np.nan), "Rows of base_link from wrist_3_link, wrist"),
        slow(setting("TFMessage", f"{TURN}w", 1e300), "Rows of base_link from wrist_3_link, wrist"),
        (setting("TFMessage", f"{PLACE}x", 1e308), "are no poses, and were left out"),
        (setting("TFMessage", "transforms.0.child_frame_id", "base_link"), "where the robot was"),
        slow(setting("TFMessage", "transforms", []), "where the robot was"),
        (setting("Image", "height", 2**31), r"camera.resolution\[1\]"),
        (setting("Image", "step", 0), "has 64000 bytes"),
        slow(setting("Image", "width", 0), r"camera.resolution\[0\]"),
        slow(setting("Image", "encoding", "mono16"), "cannot be read as a bag"),
        (setting("Image", "encoding", "\x1b[31m"), "its images are of encoding"),
        slow(setting("Image", "data", np.zeros(0, np.uint8)), "has 0 bytes"),
        (setting("CameraInfo", "k", np.full(9, np.nan)), "the nine numbers"),
        (setting("CameraInfo", "d", np.ones(100_000)), "100000 coefficients"),
        slow(setting("CameraInfo", "distortion_model", "=1"), "the lens model '=1'"),
    ],
)
def test_messages_that_lie_are_refused(change, message, with_depth, tmp_path):
    path = bag(tmp_path / "b", Session.load(with_depth), with_depth, change=change)
    raised(DataError, message, convert, path, tmp_path / "out", requested=BOARD)
    assert not (tmp_path / "out").exists()


def test_frames_in_a_cycle_are_refused(with_depth, tmp_path):
    def change(kind, at, message):
        if kind == "TFMessage":
            names = ("a", "b") if at % 2 else ("b", "a")
            object.__setattr__(message.transforms[0], "child_frame_id", names[0])
            message.transforms[0].header.frame_id = names[1]

    path = bag(tmp_path / "b", Session.load(with_depth), with_depth, change=change)
    raised(DataError, "go round", convert, path, tmp_path / "out", requested=BOARD)


def test_invalid_poses_are_left_out(with_depth, tmp_path):
    source = Session.load(with_depth)
    whole = convert(bag(tmp_path / "b", source, with_depth), tmp_path / "whole", requested=BOARD)
    # As tf2 does, of which a buffer keeps no such transform.
    change = setting("TFMessage", f"{TURN}w", 0.0, lambda at: at % 50 == 7)
    path = bag(tmp_path / "c", source, with_depth, change=change)
    session = convert(path, tmp_path / "out", requested=BOARD)
    assert len(session.views) == len(whole.views)
    assert any("Rows of base_link from wrist_3_link" in said for said in session.warnings)
