"""Loads and extends the results of earlier calibrations, and keeps frames that they would lose."""

import json
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.errors import DataError
from visioncal.core.files import absence, read_bytes
from visioncal.core.number_format import some_of
from visioncal.interchange.outputs import (
    CALIBRATION,
    RECORDING,
    Written,
    review_command,
    write_outputs,
)
from visioncal.results import Calibration, Frame, FrameFile, to_document
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.selecting import ANY, ARM, PARTS, Choice, Part

if TYPE_CHECKING:
    from visioncal.dynamics import Identified

# The file by which a session's folder is recognised.
_SESSION = "session.toml"
# Frames of a robot without a calibration, in a folder.
FRAMES = "frames.json"


@dataclass(frozen=True, eq=False)
class Stored:
    """A result with its session and evidence."""

    calibration: Calibration
    session: Session | None  # The session that it was computed from; None where it was not kept.
    evidence: tuple[ViewEvidence, ...]  # Evidence of each view; empty where it was not kept.
    note: str = ""  # Why something is missing, for the user; empty where nothing is.
    review: str = ""  # The command that opens the recording; empty where there is none.


def load_calibration(
    path: Path, choice: Choice = ANY, needs: Collection[Part] = PARTS
) -> Calibration:
    """Loads the result of one camera and one robot, or extracts it from a cell's.

    Args:
        path: An output folder, its calibration.json, or a recording with a result.
        choice: Which camera, robot and target of a cell are meant.
        needs: Which of the three have to be unambiguous.

    Raises:
        DataError: There is none, it cannot be read, or the choice is ambiguous.
    """
    return load_result(path).chosen(choice, needs)


def load_result(path: Path) -> Calibration:
    """Loads a result, of one camera and one robot or of a cell; see `load_exportable`.

    Raises:
        DataError: There is none, or it cannot be read.
    """
    return _calibration(load_exportable(path), path)


def _calibration(found: "Calibration | FrameFile | Identified", path: Path) -> Calibration:
    if not isinstance(found, Calibration):
        what = "frames of tools and fixtures" if isinstance(found, FrameFile) else "dynamics"
        raise DataError(
            f"{path} holds {what}, and no calibration.",
            culprits=[str(path)],
            next_step="Name the calibration's folder or its calibration.json.",
        )
    return found


def load_result_or_frames(path: Path, robot: str | None = None) -> Calibration | FrameFile:
    """Loads a result, of a cell the part of one robot, or a file of frames; see `load_exportable`.

    Raises:
        DataError: There is neither, or it cannot be read.
    """
    found = load_exportable(path)
    if isinstance(found, FrameFile):
        return found
    return _calibration(found, path).chosen(Choice(robot=robot), ARM)


def load_exportable(path: Path) -> "Calibration | FrameFile | Identified":
    """Loads anything that can be exported: a result, frames, or an arm's dynamics.

    Args:
        path: An output folder, a recording with a result, or a file, known by its content.

    Raises:
        DataError: There is none of them, or it cannot be read.
    """
    if path.suffix.lower() == ".rrd":
        # The codec takes half a second to import, which a calibration.json need not wait for.
        from visioncal.present.recording import read_calibration

        calibration = read_calibration(path)
        if calibration is None:
            raise _uncalibrated(path, "the recording of a session")
        return calibration
    names = (path / name for name in (CALIBRATION, DYNAMICS_FILE, FRAMES))
    file = next((name for name in names if name.is_file()), path)
    folder = path.parent if path.name == _SESSION else path
    if file == path and (folder / _SESSION).is_file():
        raise _uncalibrated(folder, "a session")
    content = content_of(file)
    if "frames" in content and "transforms" not in content:
        return FrameFile.load(file)
    if "base" in content and "transforms" not in content:
        # Half a second to import, which loading a calibration need not wait for.
        from visioncal.dynamics import Identified

        return Identified.load(file)
    return Calibration.load(path)


def content_of(path: Path) -> dict[str, object]:
    """The content of a JSON object's file; empty for any other file."""
    if path.suffix.lower() == ".rrd" or absence(path):
        return {}
    try:
        document = json.loads(read_bytes(path))
    except (ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _uncalibrated(path: Path, what: str) -> DataError:
    return DataError(
        f"{path} is {what} without a result.",
        culprits=[str(path)],
        next_step=f"Run visioncal calibrate {shlex.quote(str(path))} -o FOLDER first, and name "
        "that FOLDER.",
    )


def load_stored(path: Path) -> Stored:
    """Loads a result with its session and evidence, from the recording or the one beside it.

    A recording beside a calibration.json that is missing, damaged or of another result is noted.

    Args:
        path: An output folder, its calibration.json, or a recording with a result.

    Raises:
        DataError: There is no result, or it cannot be read.
    """
    calibration = load_result(path)
    if path.suffix.lower() == ".rrd":
        return _with_recording(calibration, path)
    recording = (path if path.is_dir() else path.parent) / RECORDING
    why = f"There is no {RECORDING} beside this result."
    if recording.is_file():
        try:
            if to_document(load_result(recording)) == to_document(calibration):
                return _with_recording(calibration, recording)
            why = f"The {RECORDING} beside this result holds another one."
        except DataError as error:
            why = error.message
    words = f"{why} Pictures, coverage and joint angles are left out here."
    return Stored(calibration, None, (), words)


def _with_recording(calibration: Calibration, recording: Path) -> Stored:
    from visioncal.present.recording import read_evidence

    session, evidence = Session.load(recording), read_evidence(recording)
    return Stored(calibration, session, evidence, review=review_command(recording))


def rewrite_result(folder: Path, calibration: Calibration) -> Written:
    """Replaces the files of an output folder by those of the same session's extended result.

    Session and evidence come from the recording in the folder, whose images are kept byte for byte.
    Without a recording that belongs to the result, none is written, and the report says what is
    missing. Raises DataError.

    Returns:
        The files that were written: without the recording where there was none to extend.
    """
    stored = load_stored(folder)
    if stored.calibration.session_sha256 != calibration.session_sha256:
        raise DataError(
            f"{folder} holds the result of another session, {stored.calibration.session_name!r}, "
            f"than the one that is to be written, {calibration.session_name!r}.",
            culprits=[str(folder)],
            next_step="Name the output folder that the result was loaded from.",
        )
    # Imports the whole calibration, which loading a result need not wait for.
    from visioncal.calibration.run import Run

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
        if seen:
            words += (
                f" By images of the camera as it was calibrated before: {some_of(seen)}. Place "
                "these again."
            )
        return words


def frames_to_keep(folder: Path) -> EndangeredFrames | None:
    """Finds the frames that a new result in a folder would lose; None where there are none.

    An unreadable result is no error: it has nothing to lose. Raises DataError.
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
