"""The recording of a session, without results."""

from pathlib import Path

from visioncal.interchange.formats.format import OwnFormat
from visioncal.session import Session


def _recognises(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".rrd"


def _write(session: Session, path: Path) -> None:
    # The codec takes half a second to import, which help need not wait for.
    from visioncal.present.recording import write_recording
    from visioncal.present.viewer import blueprint

    write_recording(path, session, None, (), blueprint(session))


RECORDING = OwnFormat("an .rrd recording", ".rrd", _recognises, Session.load, _write)
