"""Data sets of LeRobot, versions 2 and 3: joints in parquet, images in videos (extra `lerobot`).

Every frame has the joint angles of its moment. Where the arm stood, one frame a stop becomes a
view; of a motion without stops, frames evenly. Videos are read when the session is stored.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from visioncal.core.codec import read, reading
from visioncal.core.conventions import PoseNumbers
from visioncal.core.documents.jsons import parse_json
from visioncal.core.documents.toml import MAX_VALUES, too_many
from visioncal.core.documents.values import mapping
from visioncal.core.errors import DataError
from visioncal.core.extras import client_library
from visioncal.core.files import MOST_IMAGE_BYTES, read_bytes, read_text
from visioncal.core.number_format import known_name, some_of
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.interchange.formats.file_search import path_inside
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ImportOptions,
    frames_to_take,
)
from visioncal.robot.files import read_robot_document, robot_names
from visioncal.session.images import ListedImages

_STATE, _IMAGES = "observation.state", "observation.image"
# Built-in models by words in `robot_type`, beside their own names.
_ARMS = {"so100": "so101", "so-100": "so101", "franka": "panda"}
# Names of what is on the flange, and of cameras there.
_GRIPPERS, _WRISTS = ("gripper", "finger", "hand"), ("wrist", "hand", "gripper", "eef")
# Frames a second of no camera; size of all images that are held.
_MOST_FPS, _MOST_BYTES = 1e5, 4 * MOST_IMAGE_BYTES
# A stop: joints stay within the first for the time before and after [rad, s]; those of another
# stop differ by more than the second.
_STILL_RAD, _STILL_S, _MOVED_RAD = float(np.deg2rad(0.6)), 0.3, float(np.deg2rad(3.0))


class FrameImages(ListedImages[tuple[Path, int] | bytes]):
    """Frames of videos by file and number, or images in parquet, by their paths in the session."""

    def load(self, place: tuple[Path, int] | bytes) -> bytes:
        """Reads one frame, as a PNG."""
        if isinstance(place, bytes):
            return place
        video = cv2.VideoCapture(str(place[0]), cv2.CAP_FFMPEG)
        video.set(cv2.CAP_PROP_POS_FRAMES, place[1])
        found, image = video.read()
        video.release()
        if not found:
            raise DataError(
                f"{place[0]}: frame {place[1]} cannot be decoded.",
                culprits=[str(place[0])],
                next_step="Where ffmpeg reads it, write it anew: ffmpeg -i IN.mp4 -c:v libx264 "
                "-crf 1 OUT.mp4",
            )
        return cv2.imencode(".png", image)[1].tobytes()


def _info(path: Path) -> Path:
    return path / "meta" / "info.json"


def _parquet(path: Path, columns: list[str], rows: IntArray | None = None) -> dict[str, list[Any]]:
    """The columns of a parquet file: images of some rows, or all numbers.

    Some letters of a file may stand for any number of values, and of large ones.
    """
    parquet = client_library("pyarrow.parquet", "lerobot")
    try:
        facts = parquet.read_metadata(path)
        groups = map(facts.row_group, range(facts.num_row_groups))
        parts = (group.column(at) for group in groups for at in range(facts.num_columns))
        found = [part for part in parts if part.path_in_schema.startswith(tuple(columns))]
        if sum(part.num_values for part in found) > (most := 20 * MAX_VALUES):
            raise too_many(str(path), most)
        texts = {part.path_in_schema for part in found if "BYTE_ARRAY" in part.physical_type}
        if rows is None and texts:
            raise _refusal(f"{path}: {some_of(sorted(texts))} has texts, not numbers", str(path))
        # Each value is held once, however often it is repeated.
        table = parquet.read_table(path, columns=columns, read_dictionary=sorted(texts))
        if rows is None:
            return dict(table.to_pydict())
        cells, size = list[Any](), 0
        for cell in table.take(rows)[columns[0]]:
            cells.append(cell.as_py())
            size += len(dict(cells[-1] or {}).get("bytes") or b"")
            if size > _MOST_BYTES:
                words = f"{path}: {len(cells)} images are over {_MOST_BYTES / 1e6:g} MB"
                raise _refusal(words, str(path))
        return {columns[0]: cells}
    # Errors of pyarrow are among these.
    except (OSError, ValueError, LookupError, RuntimeError, TypeError) as error:
        raise _refusal(f"{path} cannot be read as parquet: {error}", str(path)) from error


def _refusal(words: str, culprit: str) -> DataError:
    return DataError(
        f"{words}.",
        culprits=[culprit],
        next_step="Download the data set again, with its large files.",
    )


@dataclass(frozen=True)
class _Info:
    """The fields of meta/info.json that are read."""

    features: Mapping[str, Mapping[str, Any]]
    fps: float = 30.0  # Frames a second.
    robot_type: str = ""
    video_path: str = ""  # Place of a video, with `{names}` of what is known of it.
    chunks_size: int = 1000  # Episodes a chunk.

    @classmethod
    def of(cls, source: Path) -> Self:
        """Reads a data set; raises DataError."""
        where = "meta/info.json"
        with reading(str(_info(source)), "that of a data set of LeRobot", "Download it again."):
            document = mapping(parse_json(read_text(_info(source)), where), where)
            stated = {name: value for name, value in document.items() if value is not None}
            info = read(cls, stated, where)
        if not 0.0 < info.fps < _MOST_FPS or info.chunks_size < 1:
            words = f"{info.fps:g} frames a second and {info.chunks_size} episodes a chunk"
            raise _refusal(f"{where} has {words}; both must be at least 1", where)
        return info

    def video(self, known: Mapping[str, object]) -> str:
        """The place of a video by what is known of it; raises DataError."""

        def value(found: re.Match[str]) -> str:
            known_value = known.get(found[1])
            if known_value is None:
                raise _refusal(f"meta/info.json: video_path asks for {found[0]}", "video_path")
            return str(known_value).rjust(int(found[2] or 0), "0")

        # Lists of other files, which FFmpeg would follow out of the folder, have other endings.
        if not self.video_path.endswith(".mp4"):
            words = f"meta/info.json: video_path is {self.video_path[:80]!r}"
            raise _refusal(f"{words}, but must end in .mp4", "video_path")
        return re.sub(r"\{([^{}:]*)(?::0?([0-9]?)d?)?\}", value, self.video_path)


def _numbers(cells: Sequence[object], name: str) -> FloatArray:
    """The finite numbers of a column, (n,) or (n, k); raises DataError."""
    try:
        numbers = np.array(cells, dtype=float)
    except (ValueError, TypeError) as error:
        raise _refusal(
            f"{name} has rows that are no numbers, or no lists of one length", name
        ) from error
    if not np.isfinite(numbers).all():
        raise _refusal(f"{name} has rows without a number", name)
    return numbers


def _read(source: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a data set; of several cameras the one that `--image-key` names."""
    info = _Info.of(source)
    features, key = info.features, _camera_of(source, info, requested.image)
    state = (*requested.joints, _STATE)[0]
    is_video = features[key].get("dtype") == "video"
    columns = [state, "timestamp", "frame_index", "episode_index"]
    files = sorted((source / "data").glob("chunk-*/*.parquet"))
    rows: dict[str, list[Any]] = {name: [] for name in columns}
    ends = []
    for file in files:
        for name, cells in _parquet(file, columns).items():
            rows[name] += cells
        ends.append(len(rows[state]))
    if not rows[state]:
        raise DataError(
            f"{source}/data has no rows of {state}.",
            culprits=[state],
            next_step="Download the whole data set, with its large files.",
        )
    angles = _numbers(rows[state], state)
    if angles.ndim != 2 or not angles.size:
        raise _refusal(f"{state} has rows that are no lists of joint angles", state)
    joints, notes = _joints(angles, features, state, requested)
    episodes, frames, stamps_s = (_numbers(rows[name], name).ravel() for name in columns[:0:-1])
    reach, count = max(round(_STILL_S * info.fps), 1), len(joints)
    at = np.arange(count)
    sides = np.clip(at + np.array([[-reach], [reach]]), 0, count - 1)
    is_near = np.abs(joints[sides] - joints).max(axis=2) < _STILL_RAD
    is_near &= (episodes[sides] == episodes) & (np.abs(sides - at) == reach)
    still = np.flatnonzero(is_near.all(axis=0))
    moved = np.abs(np.diff(joints[still], axis=0)).max(axis=1, initial=0.0) > _MOVED_RAD
    chosen, how = frames_to_take(at, still, moved, 60)
    paths = tuple(Path(f"images/{at:06d}.png") for at in chosen.tolist())
    places: dict[str, tuple[Path, int] | bytes] = {}
    if is_video:
        starts = _starts(source, info, key, np.unique(episodes).astype(int).tolist())
        for path, at in zip(paths, chosen.tolist(), strict=True):
            file, first = starts[int(episodes[at])]
            places[path.as_posix()] = file, first + int(frames[at])
    else:
        # Of the chosen rows only: all images may take more memory than there is.
        parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
        cells = [
            cell
            for file, first, part in zip(files, [0, *ends], parts, strict=False)
            for cell in (_parquet(file, [key], part - first)[key] if len(part) else [])
        ]
        for path, cell in zip(paths, cells, strict=True):
            places[path.as_posix()] = _image_in(source, mapping(cell, f"a cell of {key}"))
    kind = info.robot_type.lower()
    arms = {name: name for name in robot_names()} | _ARMS
    arm = next((arms[word] for word in sorted(arms, key=len, reverse=True) if word in kind), None)
    mount: Mount = "eye-in-hand" if any(at in key for at in _WRISTS) else "eye-to-hand"
    if requested.robot_model is None:
        notes.append(
            f"Robot type {kind!r} is not a built-in arm: name its model with --robot-model."
            if arm is None
            else f"The flange is {read_robot_document(arm)['tip']} of the built-in model {arm}; "
            "--robot-model names another."
        )
    notes += [
        how,
        f"The camera {key} is assumed to be mounted {mount}, by its name; --mount overrides it.",
    ]
    return ForeignRecording(
        name=source.resolve().name,
        robot=PoseNumbers.empty(tuple(f"frame {at}" for at in chosen.tolist())),
        images=paths,
        store=FrameImages(places),
        joints_rad=joints[chosen],
        stamps_s=stamps_s[chosen] + 1e4 * episodes[chosen],
        mount=mount,
        arm=None if arm is None else {"model": arm},
        notes=tuple(notes),
    )


def _camera_of(source: Path, info: _Info, key: str | None) -> str:
    """The key of the images that are wanted, by default the first; raises DataError."""
    cameras = [name for name in info.features if name.startswith(_IMAGES)]
    key = key or next(iter(cameras), "")
    step = "Name one with --image-key."
    return known_name("images", key, cameras, next_step=step, of=str(source))


def episode_frames(
    source: Path, key: str | None
) -> dict[int, tuple[int, Callable[[int], bytes], float]]:
    """Number of frames, file of each, and frames per second, by episode of a data set.

    Raises:
        DataError: The data set cannot be read, or has no such images.
    """
    info = _Info.of(source)
    key = _camera_of(source, info, key)
    numbers: list[IntArray] = []
    files = sorted((source / "data").glob("chunk-*/*.parquet"))
    for file in files:
        cells = _parquet(file, ["episode_index"])["episode_index"]
        numbers.append(_numbers(cells, "episode_index").astype(int).ravel())
    episodes = np.unique(np.concatenate([*numbers, np.zeros(0, int)])).tolist()
    is_video = info.features[key].get("dtype") == "video"
    starts = _starts(source, info, key, episodes) if is_video else {}

    def frame_of(episode: int, rows: Sequence[tuple[int, int]], at: int) -> bytes:
        if is_video:
            file, first = starts[episode]
            return FrameImages({}).load((file, first + at))
        number, row = rows[at]
        (cell,) = _parquet(files[number], [key], np.array([row]))[key]
        return _image_in(source, mapping(cell, f"a cell of {key}"))

    found: dict[int, tuple[int, Callable[[int], bytes], float]] = {}
    for episode in episodes:
        rows = [
            (number, row)
            for number, column in enumerate(numbers)
            for row in np.flatnonzero(column == episode).tolist()
        ]
        found[episode] = len(rows), partial(frame_of, episode, rows), info.fps
    return found


def _image_in(source: Path, cell: Mapping[str, Any]) -> bytes:
    """The image that a cell holds, or names."""
    data = cell.get("bytes")
    if data and isinstance(data, bytes):
        return data
    return read_bytes(path_inside(source, str(cell.get("path"))), MOST_IMAGE_BYTES)


def _joints(
    state: FloatArray, features: Mapping[str, Any], key: str, requested: ImportOptions
) -> tuple[FloatArray, list[str]]:
    """(n, j) joint angles [rad], without the gripper, and notes on what was assumed."""
    names = features.get(key, {}).get("names")
    if isinstance(names, Mapping):
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == state.shape[1]:
        arm = [at for at, name in enumerate(names) if not any(x in str(name) for x in _GRIPPERS)]
        state = state[:, arm]
    is_deg = requested.joints_deg or bool(np.abs(state).max() > 2.0 * np.pi + 0.1)
    notes = []
    if is_deg and not requested.joints_deg:
        notes.append(
            f"{key} is in degrees, by its size. Of a servo arm that was recorded with "
            "use_degrees=false it is in hundredths of each joint's range, which are no angles: "
            "record it anew."
        )
    return np.deg2rad(state) if is_deg else state, notes


def _starts(
    source: Path, info: _Info, key: str, episodes: Sequence[int]
) -> dict[int, tuple[Path, int]]:
    """The video of each episode, and the episode's first frame in it."""
    tables = sorted((source / "meta" / "episodes").glob("chunk-*/*.parquet"))
    starts: dict[int, tuple[Path, int]] = {}
    for table in tables:
        prefix = f"videos/{key}/"
        names = [f"{prefix}{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
        columns = _parquet(table, ["episode_index", *names])
        numbers = [_numbers(cells, name).ravel().tolist() for name, cells in columns.items()]
        for episode, chunk, file, from_s in zip(*numbers, strict=True):
            known = {"video_key": key, "chunk_index": int(chunk), "file_index": int(file)}
            starts[int(episode)] = path_inside(source, info.video(known)), round(from_s * info.fps)
    lost = [episode for episode in episodes if tables and episode not in starts]
    if lost:
        words = f"meta/episodes names no video of the episodes {some_of([*map(str, lost)])}"
        raise _refusal(f"{words}, which have rows in {source}/data", "meta/episodes")
    if not tables:
        for episode in episodes:
            chunk = episode // info.chunks_size
            known = {"video_key": key, "episode_chunk": chunk, "episode_index": episode}
            starts[episode] = path_inside(source, info.video(known)), 0
    return starts


LEROBOT = ForeignFormat(
    "lerobot", "a data set of LeRobot", lambda path: path.is_dir() and _info(path).is_file(), _read
)
