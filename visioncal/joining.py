"""Writes a result anew that an earlier calibration has written, with what has joined it since."""

from pathlib import Path

from visioncal.calibration import Calibration
from visioncal.errors import DataError
from visioncal.outputs import write_outputs
from visioncal.pipeline import Run
from visioncal.stored import load_stored


def rewrite(folder: Path, calibration: Calibration) -> tuple[Path, ...]:
    """Replaces the files of an output folder by those of the same session's extended result.

    Session and evidence come from the recording in the folder; its images stay as they are, byte by
    byte. Where there is no recording, or none that belongs to the result, it is left alone and the
    report says what is missing. All files are made aside first: where one of them fails, those in
    the folder stay as they were.

    Args:
        folder: What `visioncal calibrate` has written.
        calibration: The result in it with what has joined it, such as frames.

    Returns:
        The files that were written: without the recording where that was left alone.

    Raises:
        DataError: The folder has no result, one of another session, or cannot be written.
    """
    stored = load_stored(folder)
    if stored.calibration.session_sha256 != calibration.session_sha256:
        raise DataError(
            f"{folder} holds the result of another session, {stored.calibration.session_name!r}, "
            f"than the one that is to be written, {calibration.session_name!r}.",
            culprits=[str(folder)],
            next_step="Name the output folder that the result was loaded from.",
        )
    run = Run(calibration, stored.evidence)
    return write_outputs(folder, stored.session, run, stored.note)
