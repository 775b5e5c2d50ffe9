"""Errors that grow with time, reach or gravity: named, recovered, and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, reporting, showing
from support.marks import slow

from visioncal.core.transforms import exp
from visioncal.estimation.effects import RANDOM_EFFECTS
from visioncal.simulation import CellOptions, fine_camera, simulate

MOUNTS = ("eye-in-hand", "eye-to-hand")
FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1, views=30)
KINDS = {effect.kind for effect in RANDOM_EFFECTS}
TILT_RAD_M = np.array([1.2e-3, -0.9e-3])
BEND_M = np.array([[4e-4, 0.0, 0.0], [0.0, -4e-4, 0.0], [0.0, 2e-4, 4e-4]])


def time_of(cell):
    return np.linspace(0.0, 1.0, len(cell.robot.base_from_flange))


def tilted(cell):
    poses = cell.robot.base_from_flange
    reach = np.hypot(poses[:, 0, 3], poses[:, 1, 3])
    twists = np.zeros((len(poses), 6))
    twists[:, :2] = TILT_RAD_M * reach[:, None]
    return reporting(cell, base_from_flange=exp(-twists) @ poses)


def crept(cell):
    twists = np.zeros((len(cell.robot.base_from_flange), 6))
    twists[:, 3:] = (time_of(cell) - 0.5)[:, None] * [2e-4, -1e-4, 3e-4]
    return reporting(cell, base_from_flange=exp(-twists) @ cell.robot.base_from_flange)


def bent(cell):
    poses = cell.robot.base_from_flange
    twists = np.zeros((len(poses), 6))
    twists[:, 3:] = -poses[:, 2, :3] @ BEND_M.T
    return reporting(cell, base_from_flange=poses @ exp(-twists))


def warmed(cell):
    centre = cell.options.camera.matrix[2:]
    grown = 1.0 + 1.5e-3 * (1.0 - np.exp(-3.0 * time_of(cell)))
    return showing(
        cell,
        [
            replace(view, px=centre + by * (view.px - centre))
            for view, by in zip(cell.corners, grown, strict=True)
        ],
    )


def effects_of(known):
    """The values and the sigmas of the random effects of a fit, by kind."""
    problem, fit = known.cell_fit.inlier_problem, known.cell_fit.inlier_fit.fit
    sigmas = np.sqrt(np.diag(known.assessment.covariance))
    return {
        name.partition(" of ")[0]: (problem.values_of(name, fit.state), sigmas[columns])
        for name, columns in problem.effect_columns.items()
        if name.partition(" of ")[0] in KINDS
    }


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
@pytest.mark.parametrize(
    ("change", "kind", "true"),
    [
        (tilted, "base_tilts", TILT_RAD_M),
        slow(crept, "base_creeps", np.array([0.0, 0.0, 0.0, 2e-4, -1e-4, 3e-4])),
        slow(bent, "bracket_bends", None),
        (warmed, "lens_grows", np.array([1.5e-3])),
    ],
    ids=["tilt", "creep", "bracket", "lens"],
)
def test_what_grows_is_named_and_recovered(mount, change, kind, true):
    known = calibrated(change(simulate(replace(FINE, mount=mount))), joints=False)
    assert kind in {finding.kind for finding in known.verdict.findings}
    assert kind in next(iter(known.assessment.budget_mm.values()))
    if true is not None:
        values, sigmas = effects_of(known)[kind]
        # Up to six values: beyond four sigma once in some thousand.
        assert np.all(np.abs(values - true) < 4.0 * sigmas)


@pytest.mark.parametrize(
    ("mount", "joints", "wrong_m"),
    [
        (MOUNTS[0], True, 0.0),
        slow(MOUNTS[1], False, 0.0),
        (MOUNTS[0], False, 2e-4),
        slow(MOUNTS[1], False, 2e-4),
    ],
)
def test_nothing_is_named_where_nothing_grows(mount, joints, wrong_m):
    options = {"dh_sigma_m": wrong_m, "dh_sigma_rad": wrong_m}
    known = calibrated(simulate(replace(FINE, mount=mount, **options)), joints=joints)
    assert not KINDS & {finding.kind for finding in known.verdict.findings}
    assert wrong_m or not effects_of(known)
