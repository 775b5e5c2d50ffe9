"""Messages of a bag of ROS 1 or ROS 2: images, clouds, joints, poses and frames."""

from array import array
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import hypot
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import Any, TypeAlias
from weakref import finalize

import cv2
import numpy as np

from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.extras import client_library
from visioncal.core.files import MOST_IMAGE_BYTES, check_journal
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.session.depth import npy_of
from visioncal.session.images import ListedImages
from visioncal.vision.boards.imaging import image_size

# A message, or a reader of these: their classes are made from the bag's own definitions.
Message: TypeAlias = Any
Reader: TypeAlias = Any
# Conversions of raw images to what an image file holds, by encoding.
_COLOURS: Mapping[str, int | None] = {
    **dict.fromkeys(("mono8", "8UC1", "mono16", "bgr8", "8UC3"), None),
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
}
# Encodings of depth, with the endings of its files, and types of PointCloud2's fields.
_DEPTHS: Mapping[str, str] = {"16UC1": "png", "32FC1": "tiff"}
_FIELDS: Mapping[int, str] = {7: "f4", 8: "f8"}


@dataclass(frozen=True, eq=False)
class _Images:
    """The images of one topic."""

    ending: str  # Of their files: that of a compressed image, which is one, or png.
    frame: str  # The camera's frame in TF.
    size: tuple[int, int]  # (width, height) [px].
    stamps_s: "array[float]" = field(default_factory=lambda: array("d"))
    received_ns: "array[int]" = field(default_factory=lambda: array("q"))


@dataclass(frozen=True, eq=False)
class BagContents:
    """Content of a bag by topic; of images their timestamps alone."""

    images: dict[str, _Images] = field(default_factory=dict)
    depths: dict[str, _Images] = field(default_factory=dict)
    lenses: dict[str, Any] = field(default_factory=dict)  # The first CameraInfo.
    # Times, and positions by the joints' names.
    joints: dict[str, dict[tuple[str, ...], "array[float]"]] = field(default_factory=dict)
    poses: dict[str, "array[float]"] = field(default_factory=dict)  # Time and seven numbers a row.
    # The same of `parent_from_child`; those at rest have one row.
    moving: dict[tuple[str, str], "array[float]"] = field(default_factory=dict)
    still: dict[tuple[str, str], "array[float]"] = field(default_factory=dict)
    descriptions: list[str] = field(default_factory=list)
    # Frames with invalid poses, which are left out, as tf2 does.
    refused: set[str] = field(default_factory=set)

    @cached_property
    def parents(self) -> dict[str, str]:
        """The parent of each frame of TF."""
        return {child: parent for parent, child in (*self.still, *self.moving)}

    def chain(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root of TF."""
        names = [frame]
        while (parent := self.parents.get(names[-1])) is not None and parent not in names:
            names.append(parent)
        return names


@dataclass(frozen=True, eq=False)
class BagImages(ListedImages[tuple[str, int]]):
    """Images in a bag: topic and time of receipt [ns], by path."""

    source: Path
    _lock: Lock = field(default_factory=Lock, repr=False)  # A reader is of one thread at a time.

    @cached_property
    def _reader(self) -> Reader:
        stack = ExitStack()
        finalize(self, stack.close)
        return stack.enter_context(_opened(self.source))

    def load(self, place: tuple[str, int]) -> bytes:
        """Reads one image: as it was compressed, or as a PNG; depth as a TIFF or a .npy, too."""
        topic, at_ns = place
        with self._lock, _bag_errors(self.source):
            reader = self._reader
            connections = [each for each in reader.connections if each.topic == topic]
            rows = reader.messages(connections=connections, start=at_ns, stop=at_ns + 1)
            connection, _, raw = next(iter(rows))
            message = reader.deserialize(raw, connection.msgtype)
            if hasattr(message, "fields"):
                return _cloud(message, topic)
            if hasattr(message, "encoding"):
                return _png(message, topic)
            return bytes(message.data)[_start(message.format) :]


@contextmanager
def _opened(source: Path) -> Iterator[Reader]:
    """An open reader of a bag of any form; raises DataError."""
    libraries = (
        *("rosbags.highlevel", "rosbags.typesys", "lz4.frame"),
        *("rosbags.rosbag1.reader", "rosbags.rosbag2.reader", "rosbags.rosbag2.storage_mcap"),
    )
    highlevel, typesys, lz4, first, second, mcap = (
        client_library(name, "ros") for name in libraries
    )
    paths = sorted(source.glob("*.bag")) if source.is_dir() else [source]
    # rosbags sets no limit: some letters may stand for more than there is memory.
    zstd: Any = vars(mcap)["zstd"]
    of = {"bz2": BZ2Decompressor, "lz4": lz4.LZ4FrameDecompressor, "zstd": zstd.ZstdDecompressor}
    for table in (first.decompressors, mcap.DECOMPRESSORS):
        table |= {name: partial(_limited, of[name]) for name in of if name in table}
    vars(second)["zstd"] = SimpleNamespace(open=zstd.open, decompress=partial(_limited, of["zstd"]))
    for path in source.iterdir() if source.is_dir() else [source]:
        check_journal(path)
    with _bag_errors(source):
        # Bags of old versions of ROS 2 do not hold the definitions of their messages.
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader(paths or [source], default_typestore=types) as reader:
            yield reader


def _limited(decompressor: Callable[[], Any], data: bytes, *_: int) -> bytes:
    """Decompresses to as much as the largest image at most; raises DataError."""
    stream = decompressor()
    found: bytes = stream.decompress(data, max_length=MOST_IMAGE_BYTES)
    if not stream.eof:
        words = f"A part of the bag is damaged, or over {MOST_IMAGE_BYTES / 1e6:g} MB"
        raise DataError(f"{words}, decompressed.", next_step="Record it in smaller chunks.")
    return found


@contextmanager
def _bag_errors(source: Path) -> Iterator[None]:
    """Turns whatever a damaged bag's reader meets into a DataError."""
    try:
        yield
    except VisioncalError:
        raise
    except Exception as error:
        raise DataError(
            f"{source} cannot be read as a bag: {error}.",
            culprits=[str(source)],
            next_step="A bag of ROS 1 that was not closed: rosbag reindex. One of ROS 2 is the "
            "folder with its metadata.yaml: ros2 bag reindex FOLDER.",
        ) from error


def _png(message: Message, topic: str) -> bytes:
    """A raw image as a PNG, one of floats as a TIFF."""
    ending, code = _DEPTHS.get(message.encoding, "png"), _COLOURS.get(message.encoding)
    if message.encoding not in (*_COLOURS, *_DEPTHS):
        raise DataError(
            f"topic {topic}: its images are of encoding {message.encoding!r}; known are "
            f"{', '.join(_COLOURS)}.",
            culprits=[topic],
            next_step="Record the topic of its rectified or compressed images.",
        )
    data, size = bytes(message.data), {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
    if not 0 < message.width <= message.step or len(data) != message.height * message.step:
        raise DataError(
            f"topic {topic}: an image of {message.width} x {message.height} px with rows of "
            f"{message.step} bytes has {len(data)} bytes.",
            culprits=[topic],
            next_step="Record it anew, or name another topic with --image-key.",
        )
    kind = np.dtype(size.get(message.encoding, "u1"))
    sent = kind.newbyteorder(">" if message.is_bigendian else "<")
    lines = np.frombuffer(data, "u1").reshape(message.height, message.step)
    used = lines[:, : message.step - message.step % message.width]
    pixels = np.ascontiguousarray(used).view(sent).reshape(message.height, message.width, -1)
    pixels = pixels.astype(kind)
    image = pixels if code is None else cv2.cvtColor(pixels, code)
    return cv2.imencode(f".{ending}", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _start(form: str) -> int:
    """Where the PNG begins in a compressed image: that of depth has a header."""
    return 12 if "compressedDepth" in form else 0


def _cloud(message: Message, topic: str) -> bytes:
    """An organised cloud as a .npy of (h, w, 3)."""
    at = {each.name: each for each in message.fields}
    kinds = [_FIELDS.get(at[axis].datatype if axis in at else 0) for axis in "xyz"]
    count = message.width * message.height
    if None in kinds or message.row_step != message.width * message.point_step:
        raise DataError(
            f"topic {topic}: its clouds have no x, y and z of floats in whole rows.",
            culprits=[topic],
            next_step="Record the sensor's own organised cloud.",
        )
    order = ">" if message.is_bigendian else "<"
    row = np.dtype(
        {
            "names": [*"xyz"],
            "formats": [f"{order}{kind}" for kind in kinds],
            "offsets": [at[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    table = np.frombuffer(bytes(message.data), row, count).reshape(message.height, message.width)
    return npy_of(np.stack([table[axis].astype("f4") for axis in "xyz"], axis=-1))


def contents_of(source: Path, requested: ImportOptions) -> BagContents:
    """Reads all messages but the images' pixels."""
    contents = BagContents()
    with _opened(source) as reader:
        known = [each for each in reader.connections if each.msgtype in _READERS]
        count = sum(each.msgcount for each in known)
        messages = enumerate(reader.messages(connections=known), start=1)
        for at, (connection, received_ns, raw) in messages:
            message = reader.deserialize(raw, connection.msgtype)
            _READERS[connection.msgtype](contents, connection.topic, message, received_ns)
            if requested.progress is not None and (at % 200 == 0 or at == count):
                requested.progress("bag", at, count)
    return contents


def _stamp_s(message: Message, received_ns: int) -> float:
    """The time in a message's header [s]; that of receipt where it states none."""
    stamp = message.header.stamp
    return (stamp.sec + 1e-9 * stamp.nanosec) or 1e-9 * received_ns


def _seven(
    contents: BagContents, name: str, place: Message, rotation: Message
) -> tuple[float, ...]:
    """The numbers of a pose; none where it is no pose, by the tolerance of tf2."""
    turn = rotation.x, rotation.y, rotation.z, rotation.w
    seven = (place.x, place.y, place.z, *turn)
    # No map is as large, nor are numbers that are none.
    if all(abs(number) < 1e9 for number in seven) and abs(hypot(*turn) - 1.0) <= 0.005:
        return seven
    contents.refused.add(name)
    return ()


def _add_image(contents: BagContents, topic: str, message: Message, received_ns: int) -> None:
    images = contents.images.get(topic) or contents.depths.get(topic)
    if images is None:
        is_raw = hasattr(message, "encoding")
        data, kind = (b"", message.encoding) if is_raw else (bytes(message.data), message.format)
        size = (message.width, message.height) if is_raw else image_size(data[_start(kind) :])
        ending = "jpg" if data[:2] == b"\xff\xd8" else "png"
        depth = _DEPTHS.get(kind[:5], "") if is_raw or ending == "png" else ""
        # Pictures that show depth by colours, and floats that were compressed, are neither.
        if (
            size is None
            or (not depth and "depth" in topic.lower())
            or (depth == "tiff" and not is_raw)
        ):
            return
        group = contents.depths if depth else contents.images
        frame = message.header.frame_id.strip("/")
        images = group[topic] = _Images(depth or ending, frame, size)
    images.stamps_s.append(_stamp_s(message, received_ns))
    images.received_ns.append(received_ns)


def _add_cloud(contents: BagContents, topic: str, message: Message, received_ns: int) -> None:
    size, frame = (message.width, message.height), message.header.frame_id.strip("/")
    images = contents.depths.setdefault(topic, _Images("npy", frame, size))
    images.stamps_s.append(_stamp_s(message, received_ns))
    images.received_ns.append(received_ns)


def _add_joints(contents: BagContents, topic: str, message: Message, received_ns: int) -> None:
    if len(message.position) == len(message.name) > 0:
        rows = contents.joints.setdefault(topic, {})
        values = rows.setdefault(tuple(message.name), array("d"))
        values.extend((_stamp_s(message, received_ns), *map(float, message.position)))


def _add_pose(contents: BagContents, topic: str, message: Message, received_ns: int) -> None:
    pose = message.pose
    if seven := _seven(contents, topic, pose.position, pose.orientation):
        values = contents.poses.setdefault(topic, array("d"))
        values.extend((_stamp_s(message, received_ns), *seven))


def _add_frames(contents: BagContents, topic: str, message: Message, received_ns: int) -> None:
    for each in message.transforms:
        edge = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
        name, moved = " from ".join(edge), each.transform
        moved = _seven(contents, name, moved.translation, moved.rotation)
        if not moved or edge[0] == edge[1]:
            continue
        if "static" in topic:
            contents.still[edge] = array("d", (0.0, *moved))
        else:
            rows = contents.moving.setdefault(edge, array("d"))
            rows.extend((_stamp_s(each, received_ns), *moved))


def _add_description(contents: BagContents, topic: str, message: Message, _: int) -> None:
    if topic.endswith("robot_description") and "<robot" in message.data:
        contents.descriptions.append(message.data)


_READERS = {
    "sensor_msgs/msg/Image": _add_image,
    "sensor_msgs/msg/CompressedImage": _add_image,
    "sensor_msgs/msg/PointCloud2": _add_cloud,
    "sensor_msgs/msg/CameraInfo": lambda contents, topic, message, _: contents.lenses.setdefault(
        topic, message
    ),
    "sensor_msgs/msg/JointState": _add_joints,
    "geometry_msgs/msg/PoseStamped": _add_pose,
    "tf2_msgs/msg/TFMessage": _add_frames,
    "tf/msg/tfMessage": _add_frames,
    "std_msgs/msg/String": _add_description,
}
