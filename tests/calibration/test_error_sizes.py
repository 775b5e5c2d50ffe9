"""Sizes of errors of lenses and boards by the one likelihood, and lenses by the robot's motion."""

import json
from dataclasses import replace

import numpy as np
from scipy.stats import chi2
from support.cells import known_of, showing

import visioncal
from visioncal.calibration.stages.cameras import estimate_lenses
from visioncal.calibration.stages.error_sizes import estimate_error_sizes
from visioncal.core.transforms import invert, log
from visioncal.estimation.lens_field import LensLevels, displacements
from visioncal.simulation import CellOptions, simulate


def square_of(path, edge):
    """Squared error of an edge over its covariance, by a world's truth."""
    truth = np.array(json.loads((path.parent / f"{path.name}.truth.json").read_text())["X_true"])
    error = log(invert(truth) @ edge.matrix)
    return float(error @ np.linalg.solve(edge.covariance, error))


def test_a_far_board_and_an_unknown_lens_are_told_apart_by_the_robots_motion(real_data):
    # At 3 m the board is flat in its images, which tell no focal length.
    path = real_data / "field/worlds/far3m-h-4000"
    result = visioncal.calibrate(path)
    assert result.camera.estimated
    assert np.allclose(result.camera.camera.matrix[:2], 900.0, atol=14.0)
    edge = result.edges["flange_from_cam"]
    assert square_of(path, edge) < chi2.ppf(0.999, 6)
    assert np.sqrt(np.diag(edge.covariance)[3:].max()) < 5e-3


def test_a_lens_field_turns_no_long_session(real_data):
    # Errors of 0.08 px beyond the lens model in 200 views before a fixed camera.
    path = real_data / "field/worlds/o_clean200_field.08-t-4000"
    (edge, *_) = visioncal.calibrate(path).edges.values()
    assert square_of(path, edge) < chi2.ppf(0.999, 6)


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


def test_sizes_of_a_field_are_found_and_of_a_sound_cell_none():
    cell = simulate(CellOptions(views=30, seed=4))
    found = estimate_error_sizes(estimate_lenses(known_of(cell, joints=False)))
    (sound,) = found.levels.values()
    assert (sound.field, sound.jitter, sound.gains) == (0.0, 0.0, (0.0, 0.0, 0.0))
    assert not found.lenses
    moved = field_of(cell, 0.3, np.random.default_rng(2))
    found = estimate_error_sizes(estimate_lenses(known_of(moved, joints=False)))
    (levels,) = found.levels.values()
    # In units of the corners' noise. Of some dozen functions, the size is known to a third.
    assert 0.2 < levels.field * cell.options.pixel_sigma_px < 0.45
    assert levels.gains[0] > 13.8
