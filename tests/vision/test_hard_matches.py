"""Matches by kornia, where it is installed; and what stands without it."""

import base64
import subprocess
import sys
from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.printed import poster

from visioncal import Session
from visioncal.core.errors import DataError
from visioncal.vision import hard_matches as matching
from visioncal.vision.boards import find_target, picture
from visioncal.vision.boards.imaging import encode_png
from visioncal.vision.boards.picture import features_of
from visioncal.vision.hard_matches import hard_matches, is_installed, light_glue
from visioncal.vision.register.image_model import Print
from visioncal.vision.targets import target_from_document

needs_kornia = pytest.mark.skipif(not is_installed(), reason="kornia is not installed")
# Its modules warn of what they will leave out.
quiet = pytest.mark.filterwarnings("default")


def turned(grey):
    """A picture seen from aside, and where (n, 2) of its pixels are then."""
    height, width = grey.shape
    ends = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = np.array([[80, 60], [420, 140], [400, 330], [60, 420]], np.float32)
    flat = cv2.getPerspectiveTransform(ends, seen)
    image = cv2.warpPerspective(grey, flat, (640, 480), flags=cv2.INTER_AREA, borderValue=110)
    return image, lambda px: cv2.perspectiveTransform(px[None], flat)[0]


@needs_kornia
@quiet
def test_matches_by_neighbours_are_right():
    grey = poster()
    image, where = turned(grey)
    seen, known = features_of(image), features_of(grey)
    pairs = next(hard_matches(seen, known))
    off = np.linalg.norm(where(known.px[pairs[:, 1]]) - seen.px[pairs[:, 0]], axis=1)
    assert len(pairs) > 30
    # A feature is found to a pixel or two.
    assert np.mean(off < 5.0) > 0.8


@needs_kornia
@quiet
def test_weights_in_the_cache_are_used_and_others_refused(tmp_path, monkeypatch):
    import torch
    from kornia.feature import LightGlue

    torch.manual_seed(0)
    sizes = {"input_dim": 128, "descriptor_dim": 64, "n_layers": 2, "add_scale_ori": True}
    network = LightGlue(None, **sizes)
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    file = folder / "sift_lightglue.pth"
    # Under the authors' older names.
    state = {
        ".".join([name.split(".")[2], name.split(".")[1], *name.split(".")[3:]])
        if name.startswith("transformers.")
        else name: value
        for name, value in network.state_dict().items()
    }
    torch.save(state, file)
    loaded = light_glue(file)
    assert not loaded.training
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    grey = poster(size=(400, 300))
    ways = list(hard_matches(features_of(grey), features_of(grey)))
    assert [way.shape[1] for way in ways] == [2, 2]
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "none"))
    assert len(list(hard_matches(features_of(grey), features_of(grey)))) == 1
    assert len(list(hard_matches(features_of(grey), features_of(grey), folder))) == 2
    torch.save({"transformers.0.self_attn.Wqkv.weight": torch.zeros(3, 3)}, file)
    with pytest.raises(DataError, match="does not have the weights"):
        light_glue(file)
    file.write_bytes(b"no weights")
    with pytest.raises(DataError, match="does not have the weights"):
        light_glue(file)


def test_weights_are_searched_where_they_are_named_and_nowhere_else(tmp_path, monkeypatch):
    monkeypatch.setattr(matching, "is_installed", lambda: False)
    with pytest.raises(DataError, match="kornia's, which is not installed"):
        matching.check_weights(tmp_path)
    monkeypatch.setattr(matching, "is_installed", lambda: True)
    with pytest.raises(DataError, match="has no file sift_lightglue"):
        matching.check_weights(tmp_path)
    (tmp_path / "sift_lightglue.pth").touch()
    matching.check_weights(tmp_path)
    matching.check_weights(None)


def test_a_session_hands_the_folder_of_weights_to_its_pictures_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    visioncal("simulate", "cell", "--views", 10, "--seed", 1, "--no-images")
    session, image = Session.load("cell"), encode_png(poster())
    document = {"kind": "picture", "width_m": 0.3, "image": base64.b64encode(image).decode()}
    label = target_from_document(document, "label")
    given = replace(session, targets={"label": label}).with_weights(tmp_path)
    assert given.target is session.target
    folders = []
    monkeypatch.setattr(picture, "is_installed", lambda: True)
    monkeypatch.setattr(picture, "hard_matches", lambda *args: folders.append(args[2]) or iter([]))
    monkeypatch.setattr(cv2, "BFMatcher", lambda: Mock(knnMatch=lambda *_, **__: []))
    assert "not seen" in find_target(poster(), given.targets["label"]).reason
    assert folders[0] == tmp_path


def test_calibrate_and_locate_take_a_folder_of_weights(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(matching, "is_installed", lambda: True)
    visioncal("simulate", "cell", "--views", 10, "--seed", 1, "--no-images")
    calibrated = ("calibrate", "cell", "-o", "out", "--no-report", "--no-recording")
    assert visioncal(*calibrated).status == 0
    cv2.imwrite("photo.png", poster())
    located = ("locate", "photo.png", "-c", "out", "--target", "charuco_9x6_30mm", "--force")
    for command in (calibrated, located):
        refused = visioncal(*command, "--weights", "nowhere")
        assert refused.status == 2
        assert "nowhere has no file sift_lightglue" in refused.err


def test_a_picture_is_found_by_other_matches_where_its_own_fail(monkeypatch):
    grey = poster()
    image, where = turned(grey)
    seen, known = features_of(image), features_of(grey)
    nearest = np.array([
        (at, np.argmin(np.linalg.norm(where(known.px) - px, axis=1)))
        for at, px in enumerate(seen.px)
    ])  # fmt: skip
    near = np.linalg.norm(where(known.px[nearest[:, 1]]) - seen.px, axis=1) < 2.0
    matched = picture._Known(flat_print(grey), known, "")
    # A ratio test that nothing passes.
    monkeypatch.setattr(cv2, "BFMatcher", lambda: Mock(knnMatch=lambda *_, **__: []))
    monkeypatch.setattr(picture, "is_installed", lambda: False)
    assert "not seen" in matched.matched(image)
    monkeypatch.setattr(picture, "is_installed", lambda: True)
    monkeypatch.setattr(picture, "hard_matches", lambda *_: iter([nearest[near]]))
    flat, places, px = matched.matched(image)
    off = cv2.perspectiveTransform(places[None, :, :2], flat)[0] - px
    assert np.median(np.linalg.norm(off, axis=1)) < 2.0


@pytest.mark.slow
def test_no_matcher_is_imported_without_a_picture():
    code = (
        "import sys, visioncal.calibration.run, visioncal.vision.boards; "
        "heavy = ('torch', 'kornia', 'visioncal.vision.register', 'visioncal.vision.patches', "
        "'visioncal.vision.dense'); "
        "print([name for name in sys.modules if name.startswith(heavy)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def flat_print(grey):
    return Print(grey.astype(np.float32) / 255, 0.3 / grey.shape[1], np.zeros(2))
