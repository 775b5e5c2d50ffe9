"""The live camera: as good as the simulator's own pictures at rest."""

import numpy as np
import pytest
from support.live_cell import FakeClock
from support.marks import slow

from visioncal.core.errors import DataError, DriverError
from visioncal.live.drivers.protocols import CameraDevice
from visioncal.live.simulated.cell import SimulatedCamera
from visioncal.simulation import CellOptions, Second, prepare_scene, render, simulate
from visioncal.simulation.render import LiveView
from visioncal.vision.boards.charuco import CHARUCO
from visioncal.vision.boards.kind import DetectedCorners

TARGET = CellOptions().target


def a_cell(**options):
    # No repeatability: the cell's own pictures are of the true arm at the reported joints.
    still = {"robot_sigma_m": 0.0, "robot_sigma_rad": 0.0}
    bent = {"dh_sigma_m": 3e-4, "dh_sigma_rad": 3e-4}
    return simulate(CellOptions(views=3, seed=3, **{**still, **bent, **options}))


def errors_px(image, exact):
    found = CHARUCO.search(image, TARGET)
    assert isinstance(found, DetectedCorners)
    ids, mine, theirs = np.intersect1d(found.ids, exact.ids, return_indices=True)
    assert len(ids) > 0.8 * len(exact.ids)
    return found.px[mine] - exact.px[theirs]


@pytest.mark.parametrize("mount", [slow("eye-in-hand"), "eye-to-hand"])
def test_at_rest_corners_are_as_good_as_in_a_written_session(mount):
    cell = a_cell(mount=mount)
    scene, live = prepare_scene(cell), LiveView(cell)
    written = [errors_px(render(scene, index), cell.exact_corners[index]) for index in range(3)]
    taken = [
        errors_px(live.picture(cell.robot.joints[name, None]), cell.exact_corners[name])
        for name in (0, 1, 2)
    ]
    # Both are the detector's noise on other grain: over 100 corners their rms differ by some 15 %.
    assert np.std(np.vstack(taken)) < 1.3 * np.std(np.vstack(written))


def test_two_boards_are_refused():
    with pytest.raises(DataError, match="2 boards"):
        LiveView(simulate(CellOptions(views=2, second=Second())))


def a_camera(true_joints=None, **options):
    """A camera, with a clock that passes only where somebody waits."""
    cell, time = a_cell(**options), FakeClock(100.003)
    told = true_joints or (lambda moments: np.tile(cell.robot.joints[0], (len(moments), 1)))
    camera = SimulatedCamera(cell, told, rate_hz=10.0, exposure_s=0.02, clock=time)
    return cell, time, camera


def test_pictures_come_at_even_times_and_begin_after_the_call():
    _, time, camera = a_camera()
    assert isinstance(camera, CameraDevice)
    stamps = []
    for _ in range(3):
        asked = time.seconds
        frame = camera.frame()
        assert frame.stamp_s - 0.5 * frame.exposure_s >= asked - 1e-9
        stamps.append(frame.stamp_s)
    assert np.diff(stamps) == pytest.approx([0.1, 0.1])


def test_the_arm_is_asked_for_the_time_of_exposure():
    asked = []

    def told(moments):
        asked.extend(moments)
        return np.tile(cell.robot.joints[0], (len(moments), 1))

    cell, _, camera = a_camera(told)
    frame = camera.frame()
    assert min(asked) == pytest.approx(frame.stamp_s - 0.01)
    assert max(asked) == pytest.approx(frame.stamp_s + 0.01)


def test_an_unplugged_camera_says_so_in_time():
    _, time, camera = a_camera()
    camera.is_unplugged = True
    before = time.seconds
    with pytest.raises(DriverError, match="no picture within"):
        camera.frame(timeout_s=0.5)
    assert time.seconds - before <= 0.5 + 1e-9


def test_intrinsics_are_told_only_where_the_cell_states_them():
    assert np.array_equal(a_camera()[2].factory.matrix, a_cell().stated[""].matrix)
    _, _, camera = a_camera(state_intrinsics=False)
    assert camera.factory is None
