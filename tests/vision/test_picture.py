"""Pictures as targets: found, refused in words, printed and kept."""

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.boards import any_page, raster
from support.commands import visioncal
from support.marks import slow
from support.misfits import misfit
from support.printed import PICTURES, Look, label, photographed, photographed_cell, pose_at, poster

from visioncal import calibrate
from visioncal.core.errors import DataError
from visioncal.simulation import CAMERAS, CellOptions, prepare_scene, render, simulate
from visioncal.simulation import project as simulated_px
from visioncal.vision.boards import NotFound, find_target
from visioncal.vision.boards.picture import kept_picture, unfit
from visioncal.vision.camera import project
from visioncal.vision.dense import find_densely
from visioncal.vision.printing.drawing import to_pdf
from visioncal.vision.targets import corner_positions, load_target, target_from_document

WIDE = CAMERAS["wide"]
# A quarter of the pixels.
CAMERA = replace(WIDE, resolution=(640, 400), matrix=WIDE.matrix / 2)


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    path = tmp_path_factory.mktemp("picture") / "poster.png"
    cv2.imwrite(str(path), poster())
    described = {"kind": "picture", "width_m": 0.3, "image": kept_picture(path)}
    return target_from_document(described, "poster")


def seen(picture, covered=0.0, seed=0):
    rng = np.random.default_rng(seed + 10)
    pose = pose_at(rng.uniform(0.4, 0.5), rng.uniform(10, 40), np.array([0.15, 0.11, 0]), rng, 180)
    return photographed(picture, 0.3, CAMERA, pose, Look(covered=covered), seed), pose


@pytest.mark.parametrize("covered", [slow(0.0), 0.15])
def test_patches_are_where_they_are_through_a_lens_that_nobody_states(target, covered):
    image, pose = seen(poster(), covered)
    found = find_target(image, target)
    places = corner_positions(target)[found.ids]
    off = found.px - project(CAMERA, places @ pose[:3, :3].T + pose[:3, 3])
    # Some tell too little.
    assert len(found.ids) > 50
    # The lens bends the print by 6 px; a hundredth of a pixel is noise.
    assert np.median(np.abs(off)) < 0.012
    assert np.sqrt(np.mean((off * found.weights[:, None]) ** 2)) < 0.025


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["label", "board"])
def test_prints_of_many_alike_features_are_found(kind, tmp_path):
    picture = PICTURES[kind](0)
    cv2.imwrite(str(tmp_path / "print.png"), picture)
    image = kept_picture(tmp_path / "print.png")
    target = target_from_document({"kind": "picture", "width_m": 0.3, "image": image}, kind)
    image, pose = seen(picture, 0.15, 1)
    found = find_target(image, target)
    places = corner_positions(target)[found.ids]
    off = found.px - project(CAMERA, places @ pose[:3, :3].T + pose[:3, 3])
    assert np.median(np.abs(off)) < 0.03


@pytest.mark.slow
def test_a_simulated_cell_shows_the_picture(target):
    cell = simulate(CellOptions(views=2, seed=1, target=target))
    scene, (width, height) = prepare_scene(cell), cell.camera().camera.resolution
    for view, pose in enumerate(cell.cam_from_target):
        image = render(scene, view)
        assert image.shape == (height, width)
        found = find_target(image, target)
        places = corner_positions(target)[found.ids] @ pose[:3, :3].T + pose[:3, 3]
        # A part of it is beyond the image's end, and a texel of the sheet is nearly a pixel wide.
        assert len(found.ids) > 40
        assert np.median(np.abs(found.px - simulated_px(cell.camera().camera, places))) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "look",
    [
        Look(disc_px=12.0),
        Look(twist=(0.012, 0.006, 0.002, 0.001, 0.002, 0.005), covered=0.1),
    ],
    ids=["defocus", "motion"],
)
def test_blurred_pictures_whose_pose_is_known_to_millimetres_are_registered(target, look):
    rng, middle = np.random.default_rng(2), np.array([0.15, 0.11, 0.0])
    pose = pose_at(0.45, 20.0, middle, rng)
    image = photographed(poster(), 0.3, CAMERA, pose, look)
    assert isinstance(find_target(image, target), NotFound)
    start = pose.copy()
    start[:3, 3] += (0.002, -0.002, 0.004)
    found = find_densely(image, target, (CAMERA, start))
    off = found.px - project(
        CAMERA, corner_positions(target)[found.ids] @ pose[:3, :3].T + pose[:3, 3]
    )
    assert len(found.ids) > 40
    # A hundredth of the blur, and within the sigmas.
    assert np.median(np.abs(off)) < 0.1
    assert 0.1 < np.mean((off / found.sigma_px[:, None]) ** 2) < 2.0
    travel_px = 0.0 if look.disc_px else 457.1 * np.linalg.norm(look.twist[:2]) / 0.45
    assert found.motion_px == pytest.approx(travel_px, abs=2.0)


@pytest.mark.slow
def test_a_picture_calibrates_a_lens_that_nobody_states(tmp_path):
    cv2.imwrite(str(tmp_path / "poster.png"), poster())
    (tmp_path / "poster.toml").write_text(
        'kind = "picture"\nwidth_m = 0.3\nimage = "poster.png"\n', "utf-8"
    )
    session, cell = photographed_cell(poster(), tmp_path / "poster.toml", 10, seed=0, covered=0.15)
    edge = calibrate(session).edges["flange_from_cam"]
    off = np.linalg.inv(edge.matrix) @ cell.transforms["flange_from_cam"]
    # Half a metre before the camera; with patches that are known along one direction alone, 0.6 mm.
    assert 1e3 * np.linalg.norm((off @ [0, 0, 0.5, 1])[:3] - [0, 0, 0.5]) < 0.3
    # Six degrees of freedom: 16.8 is 99 %.
    assert misfit(edge, cell.transforms["flange_from_cam"]) < 16.8


@pytest.mark.slow
@pytest.mark.parametrize("disc_px", [4.0, 8.0])
def test_pictures_out_of_focus_are_registered_by_a_disc(target, disc_px):
    pose = pose_at(0.45, 20.0, np.array([0.15, 0.11, 0.0]), np.random.default_rng(2))
    found = find_target(photographed(poster(), 0.3, CAMERA, pose, Look(disc_px=disc_px)), target)
    places = corner_positions(target)[found.ids]
    off = found.px - project(CAMERA, places @ pose[:3, :3].T + pose[:3, 3])
    # By a Gaussian a tenth of a pixel, as patches are then bent by the shape of the blur.
    assert np.median(np.abs(off)) < 0.05
    assert found.blur_px == pytest.approx(disc_px / 2, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("views", [[1], [1, 6]])
def test_small_prints_of_alike_letters_are_found(tmp_path, views):
    cell = simulate(CellOptions(views=8, seed=0, camera=CAMERA))
    cv2.imwrite(str(tmp_path / "print.png"), label())
    document = {"kind": "picture", "width_m": 0.3, "image": kept_picture(tmp_path / "print.png")}
    small = target_from_document(document, "label")
    # A pixel is four of the picture's own, whose clearest features are finer.
    for pose in cell.cam_from_target[views]:
        image = photographed(label(), 0.3, CAMERA, pose)
        assert len(find_target(image, small).ids) > 50


@pytest.mark.slow
def test_a_guard_and_locate_look_for_the_picture_in_images(target, tmp_path, monkeypatch):
    session, cell = photographed_cell(poster(), target, 8, seed=0)
    monkeypatch.chdir(tmp_path)
    calibrate(session).save(Path("calibration.json"))
    for view in session.views:
        Path(f"{view.number}.png").write_bytes(session.images.read(view.image))
    cv2.imwrite("label.png", label())

    def judged(pushed_m):
        pushed = np.eye(4)
        pushed[:3, 3] = 0.0, 0.0, pushed_m
        lines = [
            json.dumps({"time_s": at, "base_from_flange": (pose @ pushed).tolist(),
                        "image": f"{view.number}.png"})
            for at, (view, pose) in enumerate(
                zip(session.views, cell.robot.base_from_flange, strict=True))
        ]  # fmt: skip
        lines.append('{"time_s": 99, "image": "label.png"}')
        typed = "\n".join(lines).encode()
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(typed)))
        done = visioncal("guard", "--against", ".")
        return done.status, [json.loads(line) for line in done.out.splitlines()]

    status, answers = judged(0.0)
    assert status == 2
    assert all(answer["holds"] for answer in answers[:-1])
    assert "the picture is not seen" in answers[-1]["error"]["message"]
    assert "Look at label.png: is target" in answers[-1]["error"]["next"]
    pose = cell.robot.base_from_flange[0]
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    typed = "--pose=" + ",".join(str(value) for value in (*pose[:3, 3], *quaternion))
    cv2.imwrite("mirrored.png", cv2.flip(cv2.imread("0.png", 0), 1))
    refused = visioncal("locate", "mirrored.png", "-c", ".", typed)
    assert refused.status == 2
    assert "the picture is seen mirrored" in refused.err
    assert "Look at mirrored.png: is target" in refused.err
    status, answers = judged(0.003)
    assert (status, answers[-2]["holds"]) == (3, False)


@pytest.mark.slow
def test_other_pictures_are_not_found_and_mirrored_ones_are_named(target):
    image, _ = seen(poster())
    mirrored = find_target(np.ascontiguousarray(image[:, ::-1]), target)
    assert isinstance(mirrored, NotFound)
    assert "mirrored" in mirrored.reason
    for other in (label(), poster(7)):
        found = find_target(seen(other)[0], target)
        assert "is not seen" in found.reason
    plain = find_target(np.full((400, 640), 120, np.uint8), target)
    assert "the image is plain" in plain.reason


@pytest.mark.slow
def test_pictures_by_which_no_pose_is_known_are_refused():
    half = poster()[:450]
    turned = np.concatenate([half, half[::-1, ::-1]])
    tile = cv2.resize(poster(), (300, 225))
    assert unfit(poster()) == ""
    assert unfit(label()) == ""
    assert "turned by a half" in unfit(turned)
    assert "repeats itself" in unfit(np.tile(tile, (4, 4)))
    assert "too plain" in unfit(np.full((300, 400), 90, np.uint8))
    quarter = poster(size=(450, 450))
    square = np.block([[quarter, np.rot90(quarter, 3)], [np.rot90(quarter), np.rot90(quarter, 2)]])
    assert "turned by a" in unfit(np.ascontiguousarray(square))


@pytest.mark.slow
def test_a_picture_is_printed_at_its_size_and_read_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("flyer.png", poster())
    visioncal("target", "make", "flyer.png", "--width-mm", "120", "-o", "boards")
    made = load_target("boards/flyer.toml")
    assert (made.kind, made.square_m) == ("picture", 0.12)
    assert load_target("boards/flyer.toml") == made
    page = raster(to_pdf(any_page(made)), 254)
    # Ten pixels a millimetre; the picture is as it was, to its compression and one pixel's place.
    best = cv2.matchTemplate(page, cv2.resize(poster(), (1200, 900)), cv2.TM_CCOEFF_NORMED)
    assert best.max() > 0.98
    away = 'kind = "picture"\nwidth_m = 0.1\nimage = "../flyer.png"\n'
    (tmp_path / "boards/away.toml").write_text(away, "utf-8")
    with pytest.raises(DataError, match="leads out of the folder"):
        load_target("boards/away.toml")
    refused = visioncal("target", "make", "flyer.png", "-o", "boards")
    assert refused.status == 2
    assert "--width-mm" in refused.err
