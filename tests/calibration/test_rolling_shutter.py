"""Rolling shutters: rows of an image that are taken one after the other, seen by a moving robot."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated_sweep
from support.marks import slow
from support.swept_cells import HOW, cell_of, swept_session

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import calibrate
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import MOUNTS
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.effects.rolling_shutter import delayed_points, target_twists
from visioncal.present.recording import write_recording
from visioncal.present.report.content import method_facts
from visioncal.session import Session
from visioncal.simulation import (
    CellOptions,
    SimulatedCell,
    SweepOptions,
    cell_session,
    sweep,
    write_session,
)
from visioncal.simulation.layout import NetworkOptions
from visioncal.vision.targets import numbered_positions

READOUT_S = 0.0124
# 12 s at 30 Hz, at up to 0.2 m/s and 0.5 rad/s.
HURRIED = SweepOptions(stops=8, camera_minus_robot_s=0.037, readout_s=READOUT_S)


def swept(seed: int, how: SweepOptions = HURRIED, **options) -> SimulatedCell:
    return sweep(CellOptions(seed=seed, pixel_sigma_px=0.1, **options), how)


def x_error(moved: SimulatedCell, known: RunState) -> np.ndarray:
    """(6,) right perturbation of the camera's edge, true to estimated."""
    return log(invert(next(iter(moved.transforms.values()))) @ known.assessment.state.edges[0])


def distance(error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared, in units of its covariance."""
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_target_moves_in_front_of_the_camera_as_finite_motion_has_it(mount):
    rng, step_s = np.random.default_rng(0), 1e-4
    x, z = (exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1]) for _ in range(2))
    flange, speeds = exp(rng.normal(size=(4, 6))), rng.normal(size=(4, 6))

    def seen(at_s):
        chain = flange @ exp(speeds * at_s)
        return invert(chain @ x) @ z if mount == "eye-in-hand" else invert(x) @ chain @ z

    twists = target_twists(mount, flange, x, seen(0.0), speeds)
    moved = log(invert(seen(-step_s)) @ seen(step_s)) / (2.0 * step_s)
    # Central differences of a screw motion are exact but for rounding.
    np.testing.assert_allclose(twists, moved, atol=1e-9)


def test_corners_move_with_the_readout_as_differences_say():
    moved = swept(0, replace(HURRIED, stops=3))
    camera, target = moved.options.camera, moved.options.target
    stack = CornerStack.of(
        {view_corners.view: view_corners for view_corners in moved.corners},
        numbered_positions([target]),
    )
    twists = np.random.default_rng(1).normal(size=(len(stack.views), 6))
    step_s = 1e-6
    _, jacobian = delayed_points(stack, camera, twists, READOUT_S)
    ahead, behind = (
        delayed_points(stack, camera, twists, READOUT_S + value)[0] for value in (step_s, -step_s)
    )
    # Places of 0.3 m at rounding over the step.
    np.testing.assert_allclose(jacobian[:, :, 0], (ahead - behind) / (2 * step_s), atol=1e-8)


def test_the_simulation_takes_every_row_at_its_own_time():
    moved, still = swept(1), swept(1, replace(HURRIED, readout_s=0.0))
    cell, camera = moved, moved.options.camera
    away_px = []
    for at, (late, stamped) in enumerate(zip(cell.exact_corners, still.exact_corners, strict=True)):
        both, here, there = np.intersect1d(late.ids, stamped.ids, return_indices=True)
        off = late.px[here] - stamped.px[there]
        rows = late.px[here, 1] / (camera.resolution[1] - 1) - 0.5
        away_px.append(np.abs(off).max())
        # In the middle row nothing moves; elsewhere the more, the farther from it.
        near = np.abs(rows) < 0.02
        assert np.all(np.abs(off[near]) < 0.3), at
        assert len(both) > 4
    assert max(away_px) > 2.0


@pytest.mark.parametrize(("seed", "mount"), [(1, MOUNTS[0]), slow(1, MOUNTS[1])])
def test_the_readout_is_found_and_the_camera_is_where_it_is(seed, mount):
    moved = swept(seed, mount=mount)
    known = calibrated_sweep(moved)
    found = next(iter(known.clocks.values())).clock.shutter
    assert found.kind == "rolling"
    # Four sigma, of which none is so large that this were easy: a hundredth of the readout.
    assert abs(found.readout_s - READOUT_S) < 4.0 * found.readout_sigma_s
    assert found.readout_sigma_s < 0.01 * READOUT_S
    error, covariance = x_error(moved, known), known.assessment.covariance[:6, :6]
    # Six degrees of freedom: one in ten thousand is beyond.
    assert distance(error, covariance) < 27.9
    assert known.pixel_px == pytest.approx(0.1, rel=0.05)
    assert known.verdict.status == "good"


def test_a_global_shutter_is_not_mistaken():
    known = calibrated_sweep(swept(3, replace(HURRIED, readout_s=0.0)))
    shutter = next(iter(known.clocks.values())).clock.shutter
    assert shutter.kind == "global"
    assert abs(shutter.readout_s) < 4.0 * shutter.readout_sigma_s
    assert not any("rolling" in note for note in known.notes)


@pytest.mark.slow
def test_it_is_said_and_written(tmp_path):
    folder = write_session(swept(5), tmp_path / "swept", images=False)
    result = calibrate(folder)
    shutter = result.clock.shutter
    assert shutter.kind == "rolling"
    # A line's time is that of the whole over the 799 steps between 800 rows.
    assert shutter.line_s == pytest.approx(shutter.readout_s / 799)
    (said,) = [reason for reason in result.verdict.reasons if "rolling shutter" in reason]
    readout_ms = 1e3 * shutter.readout_s
    assert f"the image's last line is taken {readout_ms:.2f} ms after the first" in said
    (fact,) = [fact for fact in method_facts(result) if fact.label == "rolling shutter"]
    # It is rounded by its sigma, to some hundredths of a millisecond.
    assert float(fact.value.split()[0]) == pytest.approx(readout_ms, abs=0.01)
    # A recording has what was seen, not what was set straight.
    session = Session.load(folder)
    write_recording(tmp_path / "it.rrd", session, None, (), None)
    assert Session.load(tmp_path / "it.rrd").digest() == session.digest()


def test_poses_that_others_measured_say_nothing_of_rows():
    session = cell_session(
        swept(6, replace(HURRIED, readout_s=0.0, stops=5)), "swept", seen="poses"
    )
    assert calibrate(session).clock.shutter is None


@pytest.mark.slow
def test_a_camera_of_a_whole_cell_has_its_own():
    cell = cell_of(NetworkOptions(stops=16, seed=1), replace(HOW, readout_s=READOUT_S))
    session, corners = swept_session(cell)
    found = calibrate(session, corners=corners)
    (told,) = found.cell.details.clocks.values()
    shutter = told.shutter
    assert shutter.kind == "rolling"
    assert abs(shutter.readout_s - READOUT_S) < 4.0 * shutter.readout_sigma_s
    edge = found.between("base_a", "cam_side")
    away = log(invert(cell.between("base_a", "cam_side")) @ edge.matrix)
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert distance(away, edge.covariance) < 22.0
    assert any(
        "cam_side and robot b: The camera has a rolling" in reason
        for reason in found.verdict.reasons
    )
