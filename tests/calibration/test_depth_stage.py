"""Depth against the calibrated chain: its model in its own sigmas, and refusals by name."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.depth_cells import SMALL, TRUE, calibrated, picks
from support.marks import slow
from support.samples import made_up

from visioncal import simulation
from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.depth import with_depth
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert
from visioncal.frames.locate import cloud_in_base
from visioncal.present.recording import write_recording
from visioncal.results import Calibration
from visioncal.results.depth import bending
from visioncal.session import MemoryImages, Session
from visioncal.session.depth import npy_of, ply_of, read_cloud
from visioncal.simulation import DepthOptions
from visioncal.verification import verdict_of, verify
from visioncal.vision.camera import project

FALSE = DepthOptions(boxed=0.5)


def made(mount="eye-in-hand", depth=FALSE):
    """A session with depth, and its calibration."""
    return calibrated(1, mount, depth, 12)[1:]


def without(calibration):
    """A calibration as it is before its depth."""
    return replace(
        calibration,
        camera=replace(calibration.camera, depth=None),
        verdict=replace(calibration.verdict, findings=()),
    )


def changed(change, **document):
    """The session with changed depth pictures."""
    session, _ = made()
    files = {view.image: session.images.read(view.image) for view in session.views}
    for view in session.views:
        raw = cv2.imdecode(np.frombuffer(session.images.read(view.depth), np.uint8), -1)
        name = view.depth
        files[name] = cv2.imencode(".png", change(raw, view.number))[1].tobytes()
    camera = {**session.document["camera"], **document}
    return session.with_content(
        images=MemoryImages(files), document={**session.document, "camera": camera}
    )


def again(change, **document):
    """The findings and the depth of the same calibration with changed depth pictures."""
    made_run, other = made()[1], changed(change, **document)
    result, _ = with_depth(without(made_run.calibration), made_run.evidence, other)
    findings = {}
    for found in result.verdict.findings:
        words = f"{findings[found.kind].words} {found.words}" if found.kind in findings else ""
        findings[found.kind] = replace(found, words=words or found.words)
    return findings, result.camera.depth


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand")])
def test_a_false_depth_is_found_with_a_box_before_the_board(mount):
    _, result = made(mount)
    depth = result.calibration.camera.depth
    error = depth.values - [FALSE.scale, FALSE.offset_m, 0.0, 0.0, FALSE.bowl_m]
    # Chi-square of five exceeds this in one case of a thousand.
    assert error @ np.linalg.solve(depth.covariance, error) < 20.5
    sigmas = np.sqrt(np.diag(depth.covariance))
    # Far under what is to be found: 0.8 %, 2.5 mm, 4 mm.
    assert (sigmas < [1e-3, 3e-4, 3e-4, 3e-4, 3e-4]).all()
    assert depth.ink_m == pytest.approx(FALSE.ink_m, abs=2e-4)
    # Noise at 0.5 m, of pixels of 0.1 mm.
    noise = np.hypot(depth.noise_m[0], depth.noise_m[1] * 0.25)
    assert noise == pytest.approx(np.hypot(FALSE.noise_m * 0.25, 1e-4 / np.sqrt(12)), rel=0.1)
    (found,) = (one for one in result.calibration.verdict.findings if one.kind == "depth_scale")
    assert "mm too long" in found.words
    assert "Correct it" in str(found.do)
    stored = Calibration.from_json(result.calibration.text, "stored").camera.depth
    assert stored.values == pytest.approx(depth.values)


def test_the_noise_of_the_robot_is_in_no_depth():
    session, result = made()
    moved = exp(np.repeat([[2e-3, 1e-3]], 3, axis=1)[0])
    evidence = [
        replace(view, base_from_flange=view.base_from_flange @ moved) for view in result.evidence
    ]
    found, _ = with_depth(without(result.calibration), evidence, session)
    depth = result.calibration.camera.depth
    assert found.camera.depth.values == pytest.approx(depth.values, abs=1e-12)


@pytest.mark.parametrize("images", ["thumbnail", slow("none")])
def test_a_recording_keeps_what_depth_is_compared_with(tmp_path, images):
    session, run = made()
    write_recording(tmp_path / "a.rrd", session, None, (), None, images, run.searches)
    stored = Session.load(tmp_path / "a.rrd")
    assert stored.images.kept == images
    assert stored.digest() == session.digest()
    found, _ = with_depth(without(run.calibration), run.evidence, stored)
    depth = run.calibration.camera.depth
    assert found.camera.depth.ink_m == depth.ink_m
    assert np.array_equal(found.camera.depth.values, depth.values)


@pytest.mark.slow
def test_a_true_depth_is_not_accused():
    _, result = made(depth=TRUE)
    words = {found.kind: found.words for found in result.calibration.verdict.findings}
    assert "depth_scale" not in words
    assert "depth is true" in words["note"]


def test_pictures_in_another_unit_are_named():
    # 0.1 mm that are said to be millimetres.
    findings, depth = again(lambda raw, _: raw, depth_unit_m=0.001)
    assert depth is None
    assert "10 times" in findings["depth_unit"].words
    assert "depth_unit_m = 0.0001" in str(findings["depth_unit"].do)


def test_floats_in_millimetres_are_named_with_their_unit():
    session, result = made()
    files = {view.image: session.images.read(view.image) for view in session.views}
    cells = []
    for view in session.views:
        raw = cv2.imdecode(np.frombuffer(session.images.read(view.depth), np.uint8), -1)
        path = view.depth.replace(".png", ".npy")
        files[path] = npy_of(raw.astype(np.float32) / 10)
        cells.append([path if name == "depth" else view.cell(name) for name in session.columns])
    camera = {k: v for k, v in session.document["camera"].items() if k != "depth_unit_m"}
    other = session.with_content(
        images=MemoryImages(files), cells=cells, document={**session.document, "camera": camera}
    )
    found, _ = with_depth(without(result.calibration), result.evidence, other)
    (said,) = (one for one in found.verdict.findings if one.kind == "depth_unit")
    assert "depth_unit_m = 0.001" in str(said.do)


@pytest.mark.parametrize("px", [12, slow(30)])
def test_pictures_that_are_not_aligned_are_named_with_their_shift(px):
    findings, depth = again(lambda raw, _: np.roll(raw, px, axis=1))
    assert depth is None
    assert "not aligned" in findings["depth_shifted"].words
    found = findings["depth_shifted"].words
    across, down = map(int, found[found.index("(") + 1 : found.index(")")].split(","))
    # To a third of it: what is seen beside the board counts, too.
    assert abs(across - px) <= px / 3
    assert abs(down) <= px / 3


def test_an_empty_picture_and_one_of_another_size_are_named_and_left_out():
    def change(raw, view):
        return {1: np.zeros_like(raw), 2: raw[:50]}.get(view, raw)

    session, _ = made()
    assert {1, 2} <= {view.number for view in session.views}
    findings, depth = again(change)
    assert depth is not None
    said = findings["depth_unread"].words
    assert re.search("view 1: depth holds no distance: all 256000 are 0 or NaN", said)
    assert re.search("view 2: depth has 640 x 50 distances, and the image 640 x 400 pixels", said)
    _, depth = again(lambda raw, _: np.zeros_like(raw))
    assert depth is None


def test_depth_beside_corners_needs_no_image():
    """Black and white are then one."""
    session, made_run = made()
    blank = [replace(view, text={**view.text, "image": ""}) for view in session.views]
    imageless = replace(session, views=tuple(blank))
    result, _ = with_depth(without(made_run.calibration), made_run.evidence, imageless)
    depth = result.camera.depth
    assert depth is not None
    sigma = np.sqrt(depth.covariance[0, 0])
    assert abs(depth.scale - made_run.calibration.camera.depth.scale) < 4 * sigma


def test_depth_beside_measured_poses_without_a_board_is_named():
    session = made_up(9, images=False).session
    depth = cv2.imencode(".png", np.full((40, 64), 500, np.uint16))[1].tobytes()
    names = [f"depth_{view.number}.png" for view in session.views]
    rows = zip(session.views, names, strict=True)
    boardless = session.with_content(
        document={key: value for key, value in session.document.items() if key != "target"},
        target_document=None,
        columns=(*session.columns, "depth"),
        cells=[[*(view.cell(column) for column in session.columns), name] for view, name in rows],
        images=MemoryImages(dict.fromkeys(names, depth)),
    )
    said = {found.kind: found.words for found in calibrate(boardless).verdict.findings}
    assert "needs a camera and a flat board" in said["depth_unread"]


@pytest.mark.slow
def test_distances_along_the_ray_and_clouds_give_the_same():
    session, result = made()
    depth = result.calibration.camera.depth
    rays = simulation.rays(
        SMALL, np.stack(np.meshgrid(np.arange(640), np.arange(400)), axis=-1).astype(float)
    )
    longer = 1.0 / rays[..., 2]
    _, along = again(lambda raw, _: np.rint(raw * longer).astype(np.uint16), depth_of="ray")
    assert along.of == "ray"
    # The offset and the bowl are those of z, and change with the ray; the scale does not.
    assert along.scale == pytest.approx(depth.scale, abs=5e-3)
    files = {view.image: session.images.read(view.image) for view in session.views}
    cells = []
    for view in session.views:
        raw = cv2.imdecode(np.frombuffer(session.images.read(view.depth), np.uint8), -1)
        z = np.where(raw > 0, raw * 1e-4, np.nan)
        points = rays / rays[..., 2:] * z[..., None]
        path = view.depth.replace(".png", ".npy")
        files[path] = npy_of(points)
        assert read_cloud(files[path], path).shape == points.shape
        cells.append([path if name == "depth" else view.cell(name) for name in session.columns])
    other = session.with_content(images=MemoryImages(files), cells=cells)
    found, _ = with_depth(without(result.calibration), result.evidence, other)
    assert found.camera.depth.values == pytest.approx(depth.values, abs=1e-9)


def by_another_camera(session):
    """The session with the same plane's distances by a depth camera of another lens, beside."""
    lens = replace(SMALL, resolution=(424, 240), matrix=np.array([300.0, 300.0, 211.5, 119.5]),
                   distortion=np.zeros(5))  # fmt: skip
    cam_from_depth = compose(
        exp(np.array([0.01, -0.03, 0.005, 0, 0, 0]))[:3, :3], np.array([0.05, 0.004, -0.01])
    )
    cell = calibrated(1, "eye-in-hand", FALSE, 12)[0]
    px = np.stack(np.meshgrid(np.arange(424), np.arange(240)), axis=-1).astype(float)
    rays = np.dstack([(px - lens.matrix[2:]) / lens.matrix[:2], np.ones(px.shape[:2])])
    u, v = np.moveaxis((2 * px + 1) / lens.resolution - 1, -1, 0)
    rng, files = np.random.default_rng(0), {}
    for sight in cell.sights:
        pose = np.linalg.inv(cam_from_depth) @ sight.cam_from_target
        z = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
        measured = FALSE.scale * z + FALSE.offset_m + FALSE.bowl_m * (u**2 + (v * 240 / 424) ** 2)
        measured += 0.8e-3 * z**2 * rng.standard_normal(z.shape)
        raw = np.clip(np.rint(measured / 1e-4), 0, 65535).astype(np.uint16)
        view = next(view for view in session.views if view.number == sight.view)
        files[view.depth] = cv2.imencode(".png", raw)[1].tobytes()
        files[view.image] = session.images.read(view.image)
    turn = Rotation.from_matrix(cam_from_depth[:3, :3]).as_quat().tolist()
    x, y, z = cam_from_depth[:3, 3].tolist()
    document = {
        **session.document,
        "cameras": {
            "depth": {
                "resolution": [424, 240], "matrix": lens.matrix.tolist(),
                "distortion": [0.0] * 5, "depth_unit_m": 1e-4,
            }
        },
        "prior": {
            "cam_from_depth": {
                "x_m": x, "y_m": y, "z_m": z, "sigma_m": 1e-5, "quaternion_xyzw": turn,
                "sigma_rad": 1e-5,
            }
        },
    }  # fmt: skip
    return cell, cam_from_depth, session.with_content(images=MemoryImages(files), document=document)


def test_a_depth_camera_beside_has_its_own_lens_and_place(tmp_path):
    session, result = made()
    cell, cam_from_depth, other = by_another_camera(session)
    assert not [words for words in other.warnings if "depth" in words]
    found, evidence = with_depth(without(result.calibration), result.evidence, other)
    depth = found.camera.depth
    error = depth.values - [FALSE.scale, FALSE.offset_m, 0.0, 0.0, FALSE.bowl_m]
    # Chi-square of five exceeds this in one case of a thousand.
    assert error @ np.linalg.solve(depth.covariance, error) < 20.5
    stored = Calibration.from_json(found.text, "stored")
    assert stored.camera.depth.by.cam_from_depth == pytest.approx(cam_from_depth)
    # Cells are shown where the image has them, on the board.
    cells = next(view.depth for view in evidence if view.depth is not None)
    assert np.abs(cells[:, 4]).mean() < 0.2 * np.abs(cells[:, 3]).mean()
    # A point of a board by the picture of the depth camera, and the picture as a cloud.
    sight = cell.sights[3]
    other.save(tmp_path / "bin")
    (tmp_path / "out").mkdir()
    found.save(tmp_path / "out" / "calibration.json")
    corner = sight.cam_from_target @ [0.1, 0.07, 0.0, 1.0]
    (u, v) = project(SMALL, corner[None, :3])[0]
    words = ("locate", tmp_path / "bin", "-c", tmp_path / "out", "--view", sight.view)
    (place,) = json.loads(visioncal(*words, "--pixel", f"{u:.2f},{v:.2f}", "--json").good().out)
    true = cell.mountings["target"] @ [0.1, 0.07, 0.0, 1.0]
    assert np.linalg.norm(np.subtract(place["p_base_m"], true[:3])) < 2e-3 * place["radius95_mm"]
    rows, columns = np.mgrid[100:140, 180:240]
    rays = np.dstack([(columns - 211.5) / 300, (rows - 119.5) / 300, np.ones(rows.shape)])
    raw = cv2.imdecode(
        np.frombuffer(other.images.read(f"depth/{sight.view:03d}.png"), np.uint8), -1
    )
    points = rays * (raw[100:140, 180:240, None] * 1e-4)
    flange = cell.robot.base_from_flange[3]
    placed = invert(cell.mountings["target"])[:3] @ np.concatenate(
        [cloud_in_base(found, points.reshape(-1, 3), flange).T, np.ones((1, points[..., 0].size))]
    )
    # On the board's plane, where noise of a fifth of a millimetre is averaged.
    assert abs(placed[2].mean()) < 3e-4


def test_a_depth_camera_beside_needs_lens_and_place():
    session, _ = made()
    document = {**session.document, "cameras": {"depth": {"resolution": [424, 240]}}}
    with pytest.raises(DataError, match=r"cameras.depth has no.*prior.cam_from_depth is not"):
        session.with_content(document=document)


@pytest.mark.slow
def test_verify_says_that_depth_is_what_it_was():
    session, result = made()
    same = verify(session, result.calibration)
    assert same.passed
    assert "depth is what it was" in " ".join(verdict_of(same).reasons)
    # Wherever the board stands.
    elsewhere = verify(session, result.calibration, board_placed_anew=True)
    assert "depth is what it was" in " ".join(found.words for found in elsewhere.depth)
    assert verify(changed(lambda raw, _: np.zeros_like(raw)), result.calibration).passed


def test_verify_says_that_depth_is_not_what_it_was():
    _, result = made()
    # A millimetre and a half at half a metre, of a model that is known to a third of one.
    other = verify(
        changed(lambda raw, _: np.rint(1.003 * raw).astype(np.uint16)), result.calibration
    )
    assert not other.named
    assert not other.passed
    verdict = verdict_of(other)
    assert verdict.status == "bad"
    (found,) = (one for one in verdict.findings if one.kind == "depth_changed")
    assert "not what it was" in found.words
    # The share of the change, at the middle of the distances.
    metres, mm = map(float, re.search(r"at ([\d.]+) m it reads ([+\d.]+) mm", found.words).groups())
    assert mm == pytest.approx(1e3 * 0.003 * metres, abs=0.15)


@pytest.mark.slow
def test_without_depth_nothing_of_it_is_loaded():
    code = (
        "import sys, numpy as np, visioncal; from visioncal import simulation as s;"
        "cell = s.simulate(s.CellOptions(views=8));"
        "visioncal.calibrate(s.cell_session(cell, 'x', seen='poses'));"
        "print([name for name in sys.modules if name in ('visioncal.calibration.stages.depth', "
        "'visioncal.session.depth')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
@pytest.mark.parametrize(("mount", "count"), [("eye-in-hand", 300), ("eye-to-hand", 300)])
def test_picks_by_depth_are_within_their_radius(mount, count):
    cell, _, result = calibrated(1, mount, FALSE, 12)
    error, raw, radius = picks(cell, result, FALSE, np.random.default_rng(2), count).T
    # 95 %, where 100 scatter by 2.2 % and one calibration's errors are common to all.
    assert 0.88 < np.mean(error < radius) < 0.995
    assert np.linalg.norm(error) < 0.4 * np.linalg.norm(raw)


def test_a_cloud_is_flat_and_in_place_in_the_base(tmp_path):
    cell, _, result = calibrated(1, "eye-to-hand", FALSE, 8)
    calibration = result.calibration
    pose = calibration.edges["base_from_cam"].matrix
    # The table z = 0.1 of the base, seen along every fifth pixel by the true camera.
    px = np.stack(np.meshgrid(np.arange(0, 640, 5), np.arange(0, 400, 5)), axis=-1).astype(float)
    rays = simulation.rays(SMALL, px)
    rays = rays / rays[..., 2:]
    table_cam = np.linalg.inv(cell.mountings["cam"]) @ [0.0, 0.0, 0.1, 1.0]
    normal = cell.mountings["cam"][2, :3]
    z = (normal @ table_cam[:3]) / (rays @ normal)
    u, v = np.moveaxis((2 * px + 1) / [640, 400] - 1, -1, 0)
    measured = FALSE.scale * z + FALSE.offset_m + FALSE.bowl_m * (u**2 + (v * 400 / 640) ** 2)
    cloud = rays * np.where((z > 0.2) & (z < 1.5), measured, np.nan)[..., None]
    np.save(tmp_path / "cloud.npy", cloud)
    calibration.save(tmp_path / "calibration.json")
    output = tmp_path / "base.npy"
    visioncal("locate", "-c", tmp_path, "--cloud", tmp_path / "cloud.npy", "-o", output).good()
    points = np.load(output).reshape(-1, 3)
    away = points[np.isfinite(points[:, 2]), 2] - 0.1
    assert len(away) > 1000
    assert np.abs(np.median(away)) < 2e-4
    assert np.std(away) < 2e-4
    in_base, by_others = tmp_path / "base.ply", ply_of(cloud).replace(b"visioncal", b"a scanner")
    placing = ("locate", "-c", tmp_path, "--cloud")
    for _ in range(2):
        # A cloud of an earlier call is replaced.
        visioncal(*placing, tmp_path / "cloud.npy", "-o", in_base).good()
    measured_cloud = tmp_path / "scan.ply"
    measured_cloud.write_bytes(by_others)
    for source, why in (
        (tmp_path / "cloud.npy", "was not written by visioncal"),
        (measured_cloud, "the cloud of --cloud itself"),
    ):
        visioncal(*placing, source, "-o", measured_cloud).refused(why)
    assert measured_cloud.read_bytes() == by_others
    visioncal(*placing, tmp_path / "none.npy", "-o", in_base).refused("none.npy does not exist")
    again_there = read_cloud(in_base.read_bytes(), "base.ply")
    # Floats of the file.
    assert again_there == pytest.approx(points[np.isfinite(points[:, 2])], abs=1e-6)
    assert pose.shape == (4, 4)


def test_a_cloud_is_corrected_where_the_lens_distorts():
    depth = made()[1].calibration.camera.depth
    lens = replace(SMALL, distortion=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]))
    px = np.array([[2.0, 2.0], [637.0, 200.0], [320.0, 398.0]])
    rays = simulation.rays(lens, px)
    true = np.full(3, 0.8)
    measured = depth.scale * true + bending(px, lens.resolution) @ depth.values[1:]
    placed, where = depth.corrected(rays / rays[:, 2:] * measured[:, None], lens)
    # 4 mm of a bowl would be off by 1 at the pixels without distortion; rounding.
    assert placed[:, 2] == pytest.approx(true, abs=1e-8)
    assert where == pytest.approx(px, abs=1e-4)


def test_a_pixel_is_located_by_the_depth_of_its_view(tmp_path):
    _, session, result = calibrated(1, "eye-in-hand", FALSE, 12)
    session.save(tmp_path / "bin")
    (tmp_path / "out").mkdir()
    result.calibration.save(tmp_path / "out" / "calibration.json")
    view = next(view for view in result.evidence if view.depth is not None)
    u, v = np.rint(view.depth[0, :2]).astype(int).tolist()
    locate = ("locate", tmp_path / "bin", "-c", tmp_path / "out", "--view", view.view)
    seen = visioncal(*locate, "--pixel", f"{u},{v}", "--json").good().out
    plane = visioncal(
        *locate, "--pixel", f"{u},{v}", "--plane", "base_from_target", "--json"
    ).good()
    (by_depth,), (by_plane,) = json.loads(seen), json.loads(plane.out)
    away_mm = 1e3 * np.linalg.norm(np.subtract(by_depth["p_base_m"], by_plane["p_base_m"]))
    # Ink is deeper by up to 2 mm.
    assert away_mm < 2.0 + 2.0 * by_depth["radius95_mm"]
    assert "depth" in by_depth["budget_mm"]
    path = tmp_path / "bin" / session.views[0].image
    refused = visioncal(*locate, "--pixel", f"{u},{v}", "--depth", path)
    assert refused.status == 2
    assert "no depth picture" in refused.err
