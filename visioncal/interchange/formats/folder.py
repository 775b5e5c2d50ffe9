"""A session's folder."""

from pathlib import Path

from visioncal.interchange.formats.format import OwnFormat
from visioncal.session import Session


def _recognises(path: Path) -> bool:
    return (path / "session.toml").is_file()


def _write(session: Session, path: Path) -> None:
    session.save(path)


FOLDER = OwnFormat("a session's folder", "", _recognises, Session.load, _write)
