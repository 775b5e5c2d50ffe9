"""Recording from Python: a camera that is a function, and an arm that the program moves."""

from collections.abc import Callable, Iterable
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.types import Camera, CameraMount, FloatArray, Image, Target
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.journal import CaptureFacts, Journal, RecordedCell
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.recording import Capture, CaptureEvent, ask_and_take
from visioncal.live.drivers.function import FunctionCamera, GivenStops
from visioncal.live.drivers.protocols import ArmState
from visioncal.robot import load_robot
from visioncal.session import Session
from visioncal.vision.targets import load_target


@typed
def record(
    folder: Path | str,
    target: Target | str,
    camera: Callable[[], Image],
    stops: Iterable[FloatArray | RigidTransform | ArmState],
    *,
    mount: CameraMount = "eye-in-hand",
    robot: str | None = None,
    lens: Camera | None = None,
    frames: int = 3,
    watch: Callable[[CaptureEvent], None] = lambda _: None,
) -> Session:
    """Records a session with a camera that is a function, while the program moves the arm.

        def stops():
            for posture in postures:
                arm.move(posture)
                yield arm.pose()

        session = visioncal.record("session", "charuco_9x6_30mm", grab, stops())
        calibration = visioncal.calibrate(session)

    A view is on the disk before the next stop is asked for. A stop whose image shows no board, or
    does not come to rest, gives no view.

    Args:
        folder: A new or empty folder for the session.
        target: The board, or its name or file.
        camera: Takes a picture and returns it: (h, w) grey or (h, w, 3) blue, green, red of uint8.
            It is called once before the first stop.
        stops: The flange in the base at each stop: (4, 4) [m], a RigidTransform, or an `ArmState`
            with joint angles. The next one is asked for after the view of the one before.
        mount: Where the camera is.
        robot: A built-in arm's name, or the file of its model; None where it is not known.
        lens: Intrinsics that the camera reports; None for none.
        frames: Pictures a view, of which the sharpest is kept.
        watch: Called with what became of each stop; `line` of it is a sentence.

    Returns:
        The session.

    Raises:
        DriverError: The function gives no picture, a stop is no pose, or no stop gave a view.
        DataError: The folder is not empty or cannot be written, or target or robot are not known.
    """
    board = load_target(target) if isinstance(target, str) else target
    arm = None if robot is None else load_robot(robot)
    program = GivenStops(stops)
    cell = LiveCell(program, FunctionCamera(camera, factory=lens))
    recorded, path = RecordedCell(mount, board, arm), Path(folder)
    facts = CaptureFacts.of(cell, path.name, recorded, None)
    journal = Journal.begin(path, facts, cell.clock.unix_offset_s(), 0)
    # The program says when the arm rests; the images alone are compared.
    options = CaptureOptions(frames=frames, still=Stillness(quiet_s=0.0), missed_in_a_row=0)
    try:
        capture = Capture(cell, board, arm, lens, journal, options, None, watch)
        ask_and_take(capture, program, 0)
    finally:
        journal.remove_unbegun()
    return Session.load(path)
