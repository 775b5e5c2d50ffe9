"""A session's folder."""

from pathlib import Path

from visioncal.interchange.formats.format import OwnFormat
from visioncal.session import Session


def _recognises(path: Path) -> bool:
    # A result is no session either, but what it is and where its session lies is told on reading.
    is_result = path.name == "calibration.json" or (path / "recording.rrd").is_file()
    return is_result or (path / "session.toml").is_file()


def _write(session: Session, path: Path) -> None:
    session.save(path)


FOLDER = OwnFormat("a session's folder", "", _recognises, Session.load, _write)
