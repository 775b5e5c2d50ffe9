"""Sizes of errors of lenses and boards by the one likelihood, and lenses by the robot's motion."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.cells import calibrated, known_of, reporting, session_of, showing

import visioncal
from visioncal.calibration.stages.cameras import detect_targets, estimate_lenses
from visioncal.calibration.stages.error_sizes import error_sizes, solve_session
from visioncal.core.transforms import apply, invert, log
from visioncal.estimation import joint
from visioncal.estimation.moves import still_to_come
from visioncal.estimation.unknowns import LENS
from visioncal.fit import candidates
from visioncal.model.boards import shape_basis
from visioncal.model.effects import Named
from visioncal.model.effects.effect import LensEffect
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate
from visioncal.vision.board_shape import board_basis
from visioncal.vision.camera import project
from visioncal.vision.lens_field import LensLevels, displacements
from visioncal.vision.targets import corner_positions


def square_of(path, edge):
    """Squared error of an edge over its covariance, by a world's truth."""
    truth = np.array(json.loads((path.parent / f"{path.name}.truth.json").read_text())["X_true"])
    error = log(invert(truth) @ edge.matrix)
    return float(error @ np.linalg.solve(edge.covariance, error))


@pytest.mark.slow
def test_a_far_board_and_an_unknown_lens_are_distinguished_by_the_robots_motion(real_data):
    # At 3 m the board is flat in its images, which tell no focal length.
    path = real_data / "field/worlds/far3m-h-4000"
    result = visioncal.calibrate(path)
    assert result.camera.estimated
    assert np.allclose(result.camera.camera.matrix[:2], 900.0, atol=14.0)
    edge = result.edges["flange_from_cam"]
    assert square_of(path, edge) < chi2.ppf(0.999, 6)
    assert np.sqrt(np.diag(edge.covariance)[3:].max()) < 5e-3


@pytest.mark.slow
def test_a_lens_field_turns_no_long_session(real_data):
    # Errors of 0.08 px beyond the lens model in 200 views before a fixed camera.
    path = real_data / "field/worlds/o_clean200_field.08-t-4000"
    (edge, *_) = visioncal.calibrate(path).edges.values()
    assert square_of(path, edge) < chi2.ppf(0.999, 6)


def sizes_of(known):
    """The sizes of errors by what is known of a session."""
    return error_sizes(known, solve_session(known))


def field_of(cell, size_px, rng):
    """Corners displaced by a field of this size, in units of the whole image's lens model."""
    levels, lens = LensLevels(size_px, 0.2), cell.stated[""]
    count = displacements(np.zeros((1, 2)), lens, 0.0, levels).shape[2]
    values = rng.normal(size=count)
    return showing(
        cell,
        [
            replace(seen, px=seen.px + displacements(seen.px, lens, 0.0, levels) @ values)
            for seen in cell.corners
        ],
    )


def test_frames_are_fitted_from_the_boards_and_lenses_of_the_one_likelihood():
    cell = simulate(CellOptions(views=20, seed=4, board_scale=1.002, board_bow_m=1e-3))
    known = estimate_lenses(known_of(cell, joints=True))
    solved = solve_session(known)
    sizes, (target,) = error_sizes(known, solved), known.session.boards.values()
    ((frame, shape),) = sizes.shapes.items()
    points = corner_positions(target)
    by_likelihood = shape_basis(points) @ solved.fit.state.values["shape", frame]
    assert np.ptp(by_likelihood[:, 2]) > 5e-4
    assert np.allclose(board_basis(points) @ shape, by_likelihood, rtol=0.0, atol=1e-15)
    assert {name: lens.matrix.tolist() for name, lens in sizes.cameras.items()} == {
        name: solved.fit.camera(name).matrix.tolist() for name in known.cameras
    }


def test_lens_and_frames_come_to_rest_beside_residuals_of_pixels(monkeypatch):
    # Steps of the lens shrink by a fifth each beside three pixels that no lens of its model has.
    cell = simulate(CellOptions(views=14, seed=600, state_intrinsics=False))
    rng = np.random.default_rng(0)
    warped = []
    for seen in cell.corners:
        u, v = ((seen.px - [640.0, 400.0]) / 640.0).T
        warp = 3.0 * np.stack([np.sin(5 * u + 3 * v), np.cos(4 * v - 2 * u)], axis=1)
        warped.append(replace(seen, px=seen.px + warp + rng.normal(0.0, 0.5, seen.px.shape)))
    ends = []
    for rounds in (joint._ROUNDS, 4 * joint._ROUNDS):
        monkeypatch.setattr(joint, "_ROUNDS", rounds)
        fit = calibrated(showing(cell, warped), joints=False).cell_fit.fit
        ends.append((fit.values((LENS, "cam")), fit.frames["cam"]))
    moved = np.abs(ends[0][0] - ends[1][0])[:4] / fit.sigmas((LENS, "cam"))[:4]
    # Steps of less than a fiftieth of a sigma, which halve, end it.
    assert moved.max() < 0.1
    assert np.allclose(ends[0][1], ends[1][1], rtol=0.0, atol=1e-5)


@pytest.mark.slow
def test_sizes_of_a_field_are_found_and_of_a_sound_cell_none():
    cell = simulate(CellOptions(views=30, seed=4))
    found = sizes_of(estimate_lenses(known_of(cell, joints=False)))
    (sound,) = found.levels.values()
    assert (sound.field, sound.jitter, sound.gains) == (0.0, 0.0, (0.0,) * 4)
    assert not found.lenses
    moved = field_of(cell, 0.3, np.random.default_rng(2))
    found = sizes_of(estimate_lenses(known_of(moved, joints=False)))
    (levels,) = found.levels.values()
    # In units of the corners' noise. Of some dozen functions, the size is known to a third.
    assert 0.2 < levels.field * cell.options.pixel_sigma_px < 0.45
    assert levels.gains[0] > 13.8
    # Corners of a stated noise have the same field, in units of that.
    px = 2.0 * cell.options.pixel_sigma_px
    stated = showing(moved, [replace(seen, stated_px=px) for seen in moved.corners])
    found = sizes_of(estimate_lenses(known_of(stated, joints=False)))
    (levels,) = found.levels.values()
    assert 0.2 < levels.field * px < 0.45


@dataclass(frozen=True, eq=False)
class Bows(LensEffect, Named):
    """A distortion that changes evenly until the end: as an effect that is added later may."""

    kind, bounds, count, most = "lens bows", (1e-1, 1e-6, 1.0), 1, 0.1
    clause, do, says = "", "", str

    @classmethod
    def of_lens(cls, camera, lens, _):
        """Of each lens."""
        yield cls(camera, lens)

    def columns(self, moments, _):
        """Of the first coefficient of distortion."""
        found = self.none(moments)
        found[:, 4, 0] = still_to_come(moments.progress, 0.0)
        return found


def test_a_named_effect_on_a_lens_needs_no_second_entry(monkeypatch):
    """It reaches the fit of frames, whose corners are as at the end, whatever it changes."""
    cell, true = simulate(CellOptions(views=20, seed=4)), 0.05
    lens, left = cell.stated[""], true * (1.0 - np.linspace(0.0, 1.0, len(cell.corners)))
    points, looks = corner_positions(cell.options.target), []
    for seen, pose, by in zip(cell.corners, cell.cam_from_target, left, strict=True):
        other = replace(lens, distortion=lens.distortion + by * np.eye(len(lens.distortion))[0])
        moved = [project(at, apply(pose, points[seen.ids])) for at in (lens, other)]
        looks.append(replace(seen, px=seen.px + moved[1] - moved[0]))
    monkeypatch.setattr(candidates, "NAMED", (Bows,))
    sizes = sizes_of(estimate_lenses(known_of(showing(cell, looks), joints=False)))
    (grown,) = sizes.grown
    assert isinstance(grown.effect, Bows)
    # Beyond four sigma once in some thousand.
    assert abs(grown.values[0] - true) < 4.0 * np.sqrt(grown.covariance[0, 0])
    shown = lens, cell.cam_from_target[0], apply(cell.cam_from_target[0], points[looks[0].ids])
    ended = sizes.steadied(grown.effect.frame, 0, looks[0], shown)
    off = [np.abs(at.px - cell.corners[0].px).max() for at in (looks[0], ended)]
    assert off[1] < 0.1 * off[0]


def test_errors_of_a_held_lens_count():
    cell = simulate(CellOptions(views=22, seed=6))
    session = session_of(cell)
    camera = session.document["camera"]
    longer = (np.array(camera["matrix"]) * [1.01, 1.01, 1.0, 1.0]).tolist()
    rows = [[view.cell(column) for column in session.columns] for view in session.views]
    off = Session.assemble(
        {**session.document, "camera": {**camera, "matrix": longer, "intrinsics": "hold"}},
        session.columns,
        rows,
        session.images,
        target_document=session.target_document,
    )
    found = {seen.view: seen for seen in cell.corners}
    known = replace(known_of(cell, joints=False), session=off, cameras={})
    known = estimate_lenses(detect_targets(known, found))
    (covariance,) = sizes_of(known).lenses.values()
    # By a size in pixels: half of one per cent of the focal length at least.
    assert np.sqrt(covariance[0, 0]) > 0.005 * longer[0]


@pytest.mark.slow
def test_no_board_explains_poses_that_agree_nowhere():
    cell = simulate(CellOptions(views=14, seed=3))
    places = cell.robot.base_from_flange.copy()
    places[:, :3, 3] = places[:, [0, 2, 1], 3]
    known = calibrated(reporting(cell, base_from_flange=places), joints=False)
    assert all(sizes.is_held for sizes in known.cell_fit.sizes.boards.values())
    assert "board_size" not in {cause.kind for cause in known.verdict.causes}
