"""The document of a session's folder, and what is near where there is none."""

import shlex
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.core.files import MOST_TOML_BYTES, read_text_inside
from visioncal.session.images import IMAGE_ENDINGS

# Files of other programs that may hold images, too.
_HOLDING_IMAGES = (".bag", ".mcap", ".db3", ".parquet", ".npz", ".mp4", ".zdf")


def session_text(path: Path) -> str:
    """Content of a folder's session.toml.

    Raises:
        DataError: The folder has none; the step names a session near it, or how to convert.
    """
    # calibration.json stands for the output folder that contains it.
    folder = path.parent if path.name == "calibration.json" else path
    recording = folder / "recording.rrd"
    if recording.is_file() and not (folder / "session.toml").exists():
        raise DataError(
            f"{path} must be a session, but is a result.",
            culprits=[str(path)],
            next_step=f"Its recording is the session: name {recording}.",
        )
    try:
        return read_text_inside(path, "session.toml", MOST_TOML_BYTES)
    except DataError as error:
        # The session's folder above, below, or beside it under a similar name.
        found = [path.parent / "session.toml", *sorted(path.glob("*/session.toml"))]
        if not path.exists():
            siblings = {file.parent.name: file for file in path.parent.glob("*/session.toml")}
            found += [siblings[name] for name in get_close_matches(path.name, siblings, 1, 0.8)]
        near = next((file.parent for file in found if file.is_file()), None)
        if near is None and (not path.exists() or (path / "session.toml").exists()):
            raise
        step = (
            f"Name the session's folder: {shlex.quote(str(near))}"
            if near is not None
            else _conversion_of(path)
        )
        message = error.message if path.is_dir() else f"{path} must be the folder of a session."
        raise error.but(message, next_step=step) from error


def _may_hold_images(folder: Path, endings: set[str]) -> bool:
    """Whether files of other kinds may hold pictures: recordings, or arrays of many bytes."""
    others = endings & {*_HOLDING_IMAGES}
    arrays = [file for file in islice(folder.rglob("*.npz"), 999) if file.is_file()]
    size = sum(file.stat().st_size for file in arrays)
    # Arrays of so many bytes together may be pictures; poses take some thousands.
    return bool(others - {".npz"}) or size > 1_000_000


def _conversion_of(path: Path) -> str:
    """Advice for pictures and poses that are no session yet: a folder of both, or either alone."""
    named = path.parent if path.suffix.lower() in IMAGE_ENDINGS else path
    named = named if named.name.strip(".") else named.resolve()
    made = shlex.quote(f"{named.with_suffix('') if named.is_file() else named}-session")
    what, source, images = "A folder's pictures and poses", shlex.quote(str(named)), ""
    board = " and their board, which is asked for where no file beside describes it"
    endings = {file.suffix.lower() for file in islice(named.rglob("*.*"), 999) if file.is_file()}
    if named.is_file():
        what, images = "A table of poses and a folder of pictures", " --images PICTURES"
    elif endings and endings.issubset(IMAGE_ENDINGS):
        what, images = "A folder of pictures and a table of their poses", f" --images {source}"
        source = "TABLE"
    elif endings and endings.isdisjoint(IMAGE_ENDINGS) and not _may_hold_images(named, endings):
        what, board = "A folder's poses of robot and target", ""
    return (
        f"{what} become a session by the camera's mount (eye-to-hand where it is fixed){board}. "
        f"Run: visioncal convert {source} {made}{images} --mount eye-in-hand && "
        f"visioncal doctor {made}"
    )
