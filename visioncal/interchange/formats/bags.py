"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP), read without ROS by rosbags (extra `ros`).

Images, depth (of images and of organised clouds), CameraInfo, JointState, TF, PoseStamped and
/robot_description are read by their types. The robot's motion becomes a stream on its own clock;
where the arm stood, one frame a stop becomes a view, else frames of the whole sweep. Images are
read from the bag when they are stored, one by one: memory does not grow with the bag.
"""

from array import array
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise, takewhile
from math import hypot
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import Any, TypeAlias
from weakref import finalize

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.calibration.stages.motion import is_standing_still
from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.extras import client_library
from visioncal.core.files import MOST_IMAGE_BYTES, check_journal
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.estimation.trajectory import Trajectory
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ForeignStream,
    ImportOptions,
    frames_to_take,
)
from visioncal.interchange.formats.intrinsics import intrinsics_from
from visioncal.robot import Robot
from visioncal.session.depth import npy_of
from visioncal.session.images import ListedImages
from visioncal.vision.boards.imaging import image_size

# A message, or a reader of these: their classes are made from the bag's own definitions.
Message: TypeAlias = Any
Reader: TypeAlias = Any
_ENDINGS = (".bag", ".mcap", ".db3")
# Frames of a robot that are preferred where TF has several, by what they are.
_BASES = ("base_link", "base", "panda_link0", "fr3_link0", "link_base", "link_0", "world")
_TIPS = ("tool0", "flange", "panda_link8", "fr3_link8", "link_eef", "ee_link", "tcp")
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
class _Contents:
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


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in _ENDINGS
    return any(next(path.glob(f"*{ending}"), None) is not None for ending in _ENDINGS)


def _read(source: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a bag; topics and frames are guessed where the user names none."""
    contents, name = _contents(source, requested), source.stem
    if not contents.images:
        raise DataError(
            f"{source}: no topic has images (sensor_msgs/Image or CompressedImage).",
            culprits=[str(source)],
            next_step="Record the camera's topic, too: ros2 bag record IMAGES /tf /tf_static.",
        )
    cameras = _cameras(contents, requested)
    stream, words, tip, robot = _motion(contents, requested)
    at_s, poses = stream.stamps_s, stream.poses.poses()
    flange = Trajectory(at_s[np.isfinite(poses[:, 0, 0])], poses[np.isfinite(poses[:, 0, 0])])
    rows, places = list[tuple[str, float, str]](), dict[str, tuple[str, int]]()
    # Depth of images: its path and place.
    depths = dict[str, tuple[str, tuple[str, int]]]()
    how = "--robot-key BASE,TIP or a topic names another."
    notes = [f"The robot's motion: {words}. {how}{_refused(contents)}"]
    for topic, camera in cameras.items():
        images = contents.images[topic]
        chosen, how = _chosen(np.array(images.stamps_s), flange)
        notes.append(f"{topic}: {how}")
        for at in chosen.tolist():
            path = f"images/{camera}{'_' if camera else ''}{at:06d}.{images.ending}"
            places[path] = topic, images.received_ns[at]
            rows.append((camera, images.stamps_s[at], path))
        own = [row[1:] for row in rows[len(rows) - len(chosen) :]]
        depths |= _depths(contents, topic, own, notes)
    rows.sort(key=lambda row: row[1])
    columns = {} if len(cameras) == 1 else {"camera": tuple(camera for camera, _, _ in rows)}
    if depths:
        columns["depth"] = tuple(depths.get(path, ("",))[0] for _, _, path in rows)
        places |= dict(depths.values())
    lenses = {camera: _lens(contents, topic, notes) for topic, camera in cameras.items()}
    labels = tuple(f"{name}, {path}" for _, _, path in rows)
    one = next(iter(lenses.values())) if len(lenses) == 1 else None
    return ForeignRecording(
        name=name,
        robot=PoseNumbers.empty(labels),
        images=tuple(Path(path) for _, _, path in rows),
        store=BagImages(places, source),
        stamps_s=np.array([stamp_s for _, stamp_s, _ in rows]),
        mount=_mount(contents, [contents.images[topic].frame for topic in cameras], tip),
        lens=one,
        lenses={} if one is not None else lenses,
        robot_document=None if robot is None else robot.document,
        columns=columns,
        stream=stream,
        notes=tuple(notes),
    )


def _contents(source: Path, requested: ImportOptions) -> _Contents:
    """Reads all messages but the images' pixels."""
    contents = _Contents()
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


def _seven(contents: _Contents, name: str, place: Message, rotation: Message) -> tuple[float, ...]:
    """The numbers of a pose; none where it is no pose, by the tolerance of tf2."""
    turn = rotation.x, rotation.y, rotation.z, rotation.w
    seven = (place.x, place.y, place.z, *turn)
    # No map is as large, nor are numbers that are none.
    if all(abs(number) < 1e9 for number in seven) and abs(hypot(*turn) - 1.0) <= 0.005:
        return seven
    contents.refused.add(name)
    return ()


def _add_image(contents: _Contents, topic: str, message: Message, received_ns: int) -> None:
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


def _add_cloud(contents: _Contents, topic: str, message: Message, received_ns: int) -> None:
    size, frame = (message.width, message.height), message.header.frame_id.strip("/")
    images = contents.depths.setdefault(topic, _Images("npy", frame, size))
    images.stamps_s.append(_stamp_s(message, received_ns))
    images.received_ns.append(received_ns)


def _add_joints(contents: _Contents, topic: str, message: Message, received_ns: int) -> None:
    if len(message.position) == len(message.name) > 0:
        rows = contents.joints.setdefault(topic, {})
        values = rows.setdefault(tuple(message.name), array("d"))
        values.extend((_stamp_s(message, received_ns), *map(float, message.position)))


def _add_pose(contents: _Contents, topic: str, message: Message, received_ns: int) -> None:
    pose = message.pose
    if seven := _seven(contents, topic, pose.position, pose.orientation):
        values = contents.poses.setdefault(topic, array("d"))
        values.extend((_stamp_s(message, received_ns), *seven))


def _add_frames(contents: _Contents, topic: str, message: Message, received_ns: int) -> None:
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


def _add_description(contents: _Contents, topic: str, message: Message, _: int) -> None:
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


def _namespace(topic: str) -> str:
    """The beginning of the topics of one camera."""
    parts = topic.strip("/").split("/")
    endings = ("compressed", "image_raw", "image_rect", "image_color", "image_rect_color", "image")
    while parts and parts[-1] in (*endings, "camera_info"):
        parts.pop()
    return "/".join(parts)


def _cameras(contents: _Contents, requested: ImportOptions) -> dict[str, str]:
    """The topics of images to take, and the cameras' names; the only one has none."""
    topics = list(contents.images)
    if requested.image is not None:
        asked = [name.strip() for name in requested.image.split(",")]
        for name in asked:
            if name not in topics:
                raise _no_topic(name, topics, "--image-key")
        topics = asked
    # Of one camera, raw images come before compressed ones, and unrectified before rectified ones.
    topics.sort(key=lambda name: ("compressed" in name, "rect" in name))
    first = {_namespace(topic): topic for topic in reversed(topics)}
    if len(first) == 1:
        return dict.fromkeys(first.values(), "")
    names = {space: space.replace("/", "_").replace("-", "_") or "cam" for space in first}
    return {topic: names[space] for space, topic in sorted(first.items())}


def _depths(
    contents: _Contents, topic: str, rows: Sequence[tuple[float, str]], notes: list[str]
) -> dict[str, tuple[str, tuple[str, int]]]:
    """Paths and places of depth, by the paths of a topic's images with their times [s]."""
    images, found = contents.images[topic], dict[str, tuple[str, tuple[str, int]]]()
    aligned = {
        name: depth
        for name, depth in contents.depths.items()
        if (depth.frame, depth.size) == (images.frame, images.size)
    }
    if not aligned:
        others = [f"{name} ({at.frame}, {at.size})" for name, at in contents.depths.items()]
        if others:
            notes.append(
                f"{topic} ({images.frame}, {images.size}): no depth is aligned to it: "
                f"{some_of(others, 6)}. Record aligned depth (realsense2_camera: "
                "align_depth.enable:=true)."
            )
        return found
    # Distances come before clouds, which are larger.
    name = min(aligned, key=lambda name: (aligned[name].ending == "npy", name))
    depth, stamps_s = aligned[name], np.array(aligned[name].stamps_s)
    # Depth of the same picture is nearer than the next one.
    limit_s = 0.5 * float(np.median(np.abs(np.diff(stamps_s)))) if len(stamps_s) > 1 else 0.05
    for stamp_s, path in rows:
        nearest = int(np.argmin(np.abs(stamps_s - stamp_s)))
        if abs(stamps_s[nearest] - stamp_s) <= limit_s:
            own = str(Path(path.replace("images/", "depth/", 1)).with_suffix(f".{depth.ending}"))
            found[path] = own, (name, depth.received_ns[nearest])
    notes.append(f"{topic}: {len(found)} of {len(rows)} images have depth by {name}.")
    return found


def _no_topic(name: str, names: Sequence[str], option: str) -> DataError:
    return DataError(
        f"The bag has no {name!r}; it has {some_of(list(names), 20)}.",
        culprits=[name],
        next_step=did_you_mean(name, names) or f"Say {option} with one of these.",
    )


def _lens(contents: _Contents, topic: str, notes: list[str]) -> dict[str, Any]:
    """The fields of `[camera]` of a topic's images, by the CameraInfo beside it."""
    size = list(contents.images[topic].size)
    space = _namespace(topic)
    info = next((at for name, at in contents.lenses.items() if _namespace(name) == space), None)
    # ROS 1 has them in capitals.
    fields = {name.lower(): value for name, value in vars(info).items()} if info else {}
    if not np.any(fields.get("k", 0.0)):
        notes.append(f"{topic}: no CameraInfo states its lens, which is estimated.")
        return {"resolution": size}
    content = {
        "camera_matrix": np.reshape(fields["k"], (3, 3)).tolist(),
        "distortion_coefficients": np.asarray(fields["d"]).tolist(),
        "distortion_model": fields["distortion_model"] or "plumb_bob",
    }
    if "rect" in topic:
        content |= {"distortion_coefficients": [0.0] * 5, "distortion_model": "plumb_bob"}
    lens, more = intrinsics_from(content, f"{topic}: CameraInfo")
    notes += more
    return lens | {"resolution": size}


def _motion(
    contents: _Contents, requested: ImportOptions
) -> tuple[ForeignStream, str, str, Robot | None]:
    """The robot's motion, where it is from, the tip's frame in TF if any, and the robot's model."""
    names, tip = requested.robot.names, ""
    if len(names) == 1 and names[0] not in contents.poses:
        raise _no_topic(names[0], [*contents.poses, *contents.parents], "--robot-key BASE,TIP")
    is_named_pose = len(names) == 1
    if not is_named_pose and contents.moving:
        base, tip = names[:2] if len(names) > 1 else _ends(contents)
        stamps_s, poses = _between(contents, base, tip)
        words = f"{tip} in {base} by TF"
    elif is_named_pose or len(contents.poses) == 1:
        topic = names[0] if is_named_pose else next(iter(contents.poses))
        stamps_s, poses = _rows(contents.poses[topic])
        words = f"topic {topic}"
    else:
        stamps_s, poses, words = np.zeros(0), np.zeros((0, 4, 4)), ""
    joints_s, joints, robot = _joint_rows(contents, requested, tip)
    if robot is not None and not len(stamps_s):
        stamps_s, poses = joints_s, robot.base_from_flange(joints)
        words = f"joint angles through /robot_description up to {robot.tip}"
    if not len(stamps_s):
        raise DataError(
            "The bag does not say where the robot was: it has "
            f"{some_of([*contents.poses, *contents.joints]) or 'no poses'}, and neither TF of a "
            f"moving arm nor joints with /robot_description.{_refused(contents)}",
            culprits=[*contents.poses, *contents.joints],
            next_step="Name its poses: --robot-key TOPIC (of PoseStamped) or BASE,TIP (frames "
            "of TF); or record /tf, /tf_static and /robot_description, too.",
        )
    every_s = np.union1d(stamps_s, joints_s)
    found = np.full((len(every_s), 4, 4), np.nan)
    found[np.searchsorted(every_s, stamps_s)] = poses
    q = None
    if robot is not None:
        q = np.full((len(every_s), robot.joint_count), np.nan)
        q[np.searchsorted(every_s, joints_s)] = joints
    labels = tuple(f"sample {at}" for at in range(len(every_s)))
    return ForeignStream(every_s, PoseNumbers.of_poses(found, labels), q), words, tip, robot


def _table(values: "array[float]", width: int) -> FloatArray:
    """(m, width) rows that begin with their time, in the order of time, each time once."""
    table = np.frombuffer(values, dtype=float).reshape(-1, width)
    return np.asarray(table[np.unique(table[:, 0], return_index=True)[1]])


def _rows(values: "array[float]") -> tuple[FloatArray, FloatArray]:
    """(m,) times and (m, 4, 4) poses, in the order of time, each time once."""
    table = _table(values, 8)
    rotations = Rotation.from_quat(table[:, 4:])
    poses = RigidTransform.from_components(table[:, 1:4], rotations)
    return table[:, 0], np.asarray(poses.as_matrix())


def _ends(contents: _Contents) -> tuple[str, str]:
    """The frames of the arm's base and tip: the ends of the longest chain of moving frames."""

    def moves(link: tuple[str, str]) -> bool:
        return link[::-1] in contents.moving

    # Frames and those above them, as long as each moves in the next.
    chains = [
        [child, *(above for _, above in takewhile(moves, pairwise(contents.chain(child))))]
        for _, child in contents.moving
        if not any(parent == child for parent, _ in contents.moving)
    ]
    if not chains:
        raise DataError(
            f"The moving frames of TF go round: {some_of([*contents.parents], 6)}.",
            culprits=[*contents.parents],
            next_step="Name the base and the tip of the arm: --robot-key base_link,tool0",
        )
    longest = max(map(len, chains))
    pairs = [f"{chain[-1]},{chain[0]}" for chain in chains if len(chain) == longest]
    if len(pairs) > 1:
        raise DataError(
            f"TF has several moving chains of {longest - 1} joints: {some_of(pairs, 6)}.",
            culprits=[pair.partition(",")[2] for pair in pairs],
            next_step=f"Say which is the robot's: --robot-key {pairs[0]}",
        )
    tip, *_, base = max(chains, key=len)
    below = [name for name in contents.parents if tip in contents.chain(name)]
    above = contents.chain(base)
    return (
        next((name for name in _BASES if name in above), base),
        next((name for name in _TIPS if name in below), tip),
    )


def _refused(contents: _Contents) -> str:
    names = some_of(sorted(contents.refused), 6)
    return f" Rows of {names} are no poses, and were left out." if names else ""


def _between(contents: _Contents, base: str, tip: str) -> tuple[FloatArray, FloatArray]:
    """(m,) times and (m, 4, 4) `base_from_tip` by TF."""
    known = {*contents.parents, *contents.parents.values()}
    for name in (base, tip):
        if name not in known:
            raise _no_topic(name, sorted(known), "--robot-key BASE,TIP")
    up, down = contents.chain(base), contents.chain(tip)
    common = next((name for name in up if name in down), "")
    sides = [chain[: chain.index(common) + 1] if common else [] for chain in (up, down)]
    links = {(parent, child) for side in sides for child, parent in pairwise(side)}
    moving = links & contents.moving.keys()
    if not moving:
        raise DataError(
            f"TF does not move {tip} in {base}{'' if common else ': nothing joins them'}.",
            culprits=[base, tip],
            next_step="Name the base and the tip of the arm: --robot-key base_link,tool0",
        )
    tracks = {link: Trajectory(*_rows(contents.moving[link])) for link in moving}
    # Timestamps of the least frequent transform; the others are interpolated.
    at_s = min((track.stamps_s for track in tracks.values()), key=len)
    at_s = at_s[np.all([track.covers(at_s) for track in tracks.values()], axis=0)]
    from_common = []
    for side in sides:
        pose = np.eye(4)[None]
        for child, parent in pairwise(side):
            track = tracks.get((parent, child))
            rows = contents.still.get((parent, child), array("d"))
            pose = (_rows(rows)[1] if track is None else track.at(at_s)) @ pose
        from_common.append(pose)
    poses = invert(from_common[0]) @ from_common[1]
    return at_s, np.broadcast_to(poses, (len(at_s), 4, 4))


def _joint_rows(
    contents: _Contents, requested: ImportOptions, tip: str
) -> tuple[FloatArray, FloatArray, Robot | None]:
    """(m,) times and (m, n) joint angles in the order of the bag's own robot model, and that."""
    none = np.zeros(0), np.zeros((0, 0)), None
    if not contents.descriptions or requested.robot_model is not None:
        return none
    document = {"schema": 1, "name": "robot", "urdf": contents.descriptions[0]}
    robot: Robot | None = None
    for end in filter(None, (requested.tip or tip, *_TIPS)):
        with suppress(VisioncalError):
            robot = Robot.from_document(document | {"tip": end})
            break
    topics = requested.joints or tuple(contents.joints)
    tables = [rows for topic in topics for rows in contents.joints.get(topic, {}).items()]
    for names, values in tables:
        if robot is not None and {*robot.joint_names} <= {*names}:
            table = _table(values, 1 + len(names))
            order = [1 + names.index(name) for name in robot.joint_names]
            return table[:, 0], table[:, order], robot
    return none


def _chosen(stamps_s: FloatArray, flange: Trajectory) -> tuple[IntArray, str]:
    """Numbers of the frames to take, as `frames_to_take` has them."""
    order = np.argsort(stamps_s, kind="stable")
    still = order[is_standing_still(flange, stamps_s[order])]
    poses = flange.at(stamps_s[still])
    # Another stop: a milliradian or a millimetre further.
    moved = np.abs(log(invert(poses[:-1]) @ poses[1:])).max(axis=1) > 1e-3
    return frames_to_take(order, still, moved, 600)


def _mount(contents: _Contents, frames: Sequence[str], tip: str) -> Mount | None:
    """How the cameras are mounted, where TF has their frames beside the arm's."""
    moving = {child for _, child in contents.moving}
    hands = {
        bool(moving & {*contents.chain(frame)}) for frame in frames if frame in contents.parents
    }
    if not tip or len(hands) != 1:
        return None
    return "eye-in-hand" if hands.pop() else "eye-to-hand"


BAG = ForeignFormat("bag", "a bag of ROS 1 or ROS 2 (.bag, .mcap, or its folder)", _is_bag, _read)
