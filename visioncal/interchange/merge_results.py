"""Writes an extended result into its folder, and keeps frames that a new result would lose."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from visioncal.calibration.pipeline import Run
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes
from visioncal.core.number_format import some_of
from visioncal.interchange.outputs import CALIBRATION, Written, write_outputs
from visioncal.interchange.result_files import FRAMES, load_stored
from visioncal.results import Calibration, Frame, FrameFile


def rewrite_result(folder: Path, calibration: Calibration) -> Written:
    """Replaces the files of an output folder by those of the same session's extended result.

    Session and evidence come from the recording in the folder, whose images are kept byte for byte.
    Without a recording that belongs to the result, none is written, and the report says what is
    missing.

    Returns:
        The files that were written: without the recording where there was none to extend.

    Raises:
        DataError: The folder has no result, one of another session, or cannot be written; the files
            in it are unchanged.
    """
    stored = load_stored(folder)
    if stored.calibration.session_sha256 != calibration.session_sha256:
        raise DataError(
            f"{folder} holds the result of another session, {stored.calibration.session_name!r}, "
            f"than the one that is to be written, {calibration.session_name!r}.",
            culprits=[str(folder)],
            next_step="Name the output folder that the result was loaded from.",
        )
    return write_outputs(folder, stored.session, Run(calibration, stored.evidence), stored.note)


@dataclass(frozen=True, eq=False)
class EndangeredFrames:
    """Frames of a result that a new result without them is about to replace."""

    file: Path  # The file in which they are kept.
    frames: Mapping[str, Frame]  # By the transforms that place them.
    before: Mapping[str, Frame]  # The frames that the file holds already.

    def keep(self) -> None:
        """Writes them to the file, beside its frames of other names."""
        FrameFile({**self.before, **self.frames}).save(self.file)

    @property
    def words(self) -> str:
        """Message to the user: where the frames are kept, and which to place again."""
        # Imports everything that places frames, and few results have any.
        from visioncal.frames.frame_from_images import depends_on_camera

        seen = [name for name, frame in self.frames.items() if depends_on_camera(frame)]
        words = (
            f"{some_of(list(self.frames))} had joined the result that this one replaces: kept in "
            f"{self.file}."
        )
        replaced = sorted(self.before.keys() & self.frames.keys())
        if replaced:
            words += f" It had another {some_of(replaced)} of an earlier time."
        if seen:
            words += (
                f" By images of the camera as it was calibrated before: {some_of(seen)}. Place "
                "these again."
            )
        return words


def frames_to_keep(folder: Path) -> EndangeredFrames | None:
    """Finds the frames that a new result in a folder would lose; None where there are none.

    An unreadable result is no error: it has nothing to lose.

    Raises:
        DataError: The file of frames there cannot be read, nor be replaced.
    """
    file = folder / CALIBRATION
    try:
        # Reading a whole result takes ten times as long.
        text = read_bytes(file)
        frames = Calibration.from_json(text, str(file)).frames if b'"frames"' in text else {}
    except DataError:
        return None
    if not frames:
        return None
    file = folder / FRAMES
    return EndangeredFrames(file, frames, FrameFile.load(file).frames if file.exists() else {})
