"""Whether a session was recorded by the camera that was calibrated."""

from visioncal.core.errors import DataError
from visioncal.results.result import Calibration
from visioncal.session import Session
from visioncal.session.single import check_one_of_each


def check_mount(session: Session, calibration: Calibration) -> None:
    """Refuses the session of a camera that is mounted elsewhere than the calibrated one.

    Raises:
        DataError: So it is.
    """
    check_one_of_each(session)
    if session.mount != calibration.mount:
        raise DataError(
            f"session {session.name!r} has its camera {session.mount}, and the calibration "
            f"{calibration.session_name!r} is of one {calibration.mount}.",
            culprits=["session.toml: mount"],
            next_step="Correct mount in session.toml, or name the calibration of this camera.",
        )


def check_resolution(
    session: Session, calibration: Calibration, resolution: tuple[int, int]
) -> None:
    """Refuses images of another size than those of the calibrated camera.

    Raises:
        DataError: So they are.
    """
    camera = calibration.camera
    if camera is None or resolution == camera.camera.resolution:
        return
    shown, needed = (f"{it[0]} x {it[1]}" for it in (resolution, camera.camera.resolution))
    raise DataError(
        f"session {session.name!r}: its images have {shown} pixels, and the calibrated camera has "
        f"{needed}.",
        culprits=["session.toml: camera.resolution"],
        next_step="Take the images with the same camera, binning and region as calibrated.",
    )
