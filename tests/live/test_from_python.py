"""Recording from Python: a function is the camera, and the program moves the arm."""

from contextlib import closing

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.refusals import raised

from visioncal import record
from visioncal.core.errors import DataError, DriverError
from visioncal.live.capture.devices import open_camera
from visioncal.live.drivers.protocols import ArmState, DeviceSetup

BOARD = "charuco_9x6_30mm"


@pytest.fixture(scope="module")
def stops():
    """What a camera shows at each stop, the flange's pose, and the joint angles."""
    plan = fake_plan(4)
    arm, camera = fake_devices(plan)
    found = []
    for stop in plan.stops:
        arm.q0 = stop.q
        found.append((camera.frame().image, arm.state().base_from_flange, stop.q))
    return found


def test_a_session_is_recorded_by_a_function_and_a_generator(stops, tmp_path):
    shown, lines, images = [], [], [stops[0][0]]

    def moved():
        for image, pose, q in stops:
            # Asked for one at a time: the view before is on the disk by then.
            assert len(lines) == len(shown)
            shown.append(image)
            forms = pose, RigidTransform.from_matrix(pose), ArmState(0.0, pose, q)
            yield forms[len(shown) % 3]

    def watch(event):
        lines.append(event.line)

    session = record(tmp_path / "cell", BOARD, lambda: (shown or images)[-1], moved(), watch=watch)
    assert [view.number for view in session.views] == [1, 2, 3, 4]
    for view, (image, pose, q) in zip(session.views, stops, strict=True):
        assert np.allclose(view.base_from_flange().as_matrix(), pose, atol=1e-9)
        stored = cv2.imread(str(tmp_path / "cell" / view.image), -1)
        assert np.array_equal(stored, image)
        if view.number % 3 == 2:
            assert np.allclose(view.joints_rad, q)
    assert all("corners" in line for line in lines)
    assert not visioncal("doctor", tmp_path / "cell").err.startswith("error")


def test_a_stop_without_a_board_gives_no_view(stops, tmp_path):
    images = [stops[0][0], np.zeros_like(stops[0][0]), stops[2][0]]
    shown, lines = [], []

    def moved():
        for image, (_, pose, _) in zip(images, stops, strict=False):
            shown.append(image)
            yield pose

    session = record(
        tmp_path / "cell",
        BOARD,
        lambda: (shown or images)[-1],
        moved(),
        watch=lambda e: lines.append(e.line),
    )
    assert len(session.views) == 2
    assert "not taken" in lines[1]


def test_faults_of_the_program_are_named(stops, tmp_path):
    image, pose, _ = stops[0]

    def broken():
        raise OSError("no such camera")

    out = tmp_path / "cell"
    raised(
        DriverError,
        r"function broken raised OSError: no such camera",
        record,
        out,
        BOARD,
        broken,
        [pose],
    )
    raised(DriverError, r"float64 of shape .*uint8", record, out, BOARD, lambda: image / 2, [pose])
    raised(DriverError, r"metres, but", record, out, BOARD, lambda: image, [np.ones((4, 4))])
    raised(DriverError, r"ended before a view", record, out, BOARD, lambda: image, [])
    # Nothing is left of them.
    assert not out.exists()
    record(out, BOARD, lambda: image, [pose])
    raised(DataError, r"cell", record, out, BOARD, lambda: image, [pose])


def test_a_function_of_a_file_is_a_camera_of_the_command(tmp_path):
    file = tmp_path / "grab.py"
    file.write_text("import numpy as np\ndef picture():\n    return np.full((4, 6), 7, np.uint8)\n")
    with closing(open_camera(f"python:{file}:picture", DeviceSetup())) as camera:
        assert camera.resolution == (6, 4)
        assert (camera.frame().image == 7).all()
    for address, words in (
        (f"{file}:photo", "AttributeError.*photo"),
        (f"{tmp_path}/none.py:picture", "function of a Python file.*python:grab.py:picture"),
        ("picture", "must be a function of a Python file"),
    ):
        raised(DriverError, words, open_camera, f"python:{address}", DeviceSetup())
    raised(
        DriverError, "exposure", open_camera, f"python:{file}:picture", DeviceSetup(exposure_us=9)
    )
