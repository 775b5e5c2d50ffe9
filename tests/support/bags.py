"""Bags of ROS 1 and ROS 2, written by rosbags from a session's folder."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import RigidTransform

from visioncal.core.transforms import exp, invert, log
from visioncal.session import Session

FORMS = {"ros1": None, "sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
# Of each stop the arm rests, of each way to the next it moves for so long [s].
REST_S, WAY_S = 1.2, 0.6


@dataclass(frozen=True)
class BagOptions:
    """What a bag holds, and how."""

    form: str = "mcap"
    is_compressed: bool = False
    camera_late_s: float = 0.0  # The camera's clock ahead of the robot's.
    jitter_s: float = 0.0
    without: tuple[str, ...] = ()  # Topics that are missing.
    poses: str = "tf"  # or `pose`: a topic of PoseStamped.
    frames_s: float = 0.2
    period_s: float = 0.02  # Of the robot's poses, whose times err by up to a fifth of it.
    compression: str = ""  # A format of ROS 1, or a mode of ROS 2, that packs with zstd.
    image_kind: str = "png"  # What compressed images are.
    depth: str = ""  # Of the views: 16UC1, 32FC1, compressed or cloud.
    depth_frame: str = ""  # Its frame, where it is not that of the images.
    names: tuple[str, ...] = ("",)  # Namespaces of the cameras, all of which see the same.
    # Changes a message in place, by its type and its number among those of the topic.
    change: Callable[[str, int, Any], object] = lambda *_: None


def motion(session: Session, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(m,) times and (m, 4, 4) poses: from view to view, with a rest at each."""
    stops = [np.asarray(view.base_from_flange().as_matrix()) for view in session.views]
    poses = []
    for at, (pose, next_pose) in enumerate(zip(stops, [*stops[1:], stops[-1]], strict=True)):
        poses += [pose] * round(REST_S / period_s)
        way = log(invert(pose) @ next_pose)
        shares = np.linspace(0.0, 1.0, round(WAY_S / period_s))
        if at + 1 < len(stops):
            poses += [pose @ exp(way * (0.5 - 0.5 * np.cos(np.pi * share))) for share in shares]
    stamps_s = 1e9 + period_s * np.arange(len(poses))
    if period_s > 0.02:
        stamps_s += np.random.default_rng(1).uniform(-0.2, 0.2, len(poses)) * period_s
    return stamps_s, np.array(poses)


class _Bag:
    """A bag in the making: its messages by time."""

    def __init__(self, options: BagOptions):
        self.options, self.is_first = options, options.form == "ros1"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_first else Stores.ROS2_HUMBLE)
        if self.is_first:
            frames = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(frames, "tf2_msgs/msg/TFMessage"))
        self.of = {name.rsplit("/", 1)[1]: each for name, each in self.types.types.items()}
        self.messages, self.rng, self.counts = [], np.random.default_rng(0), Counter()

    def header(self, at_s, frame):
        sec, rest = divmod(round(1e9 * at_s), 10**9)
        stamp = self.types.types["builtin_interfaces/msg/Time"](int(sec), int(rest))
        return self.of["Header"](
            stamp=stamp, frame_id=frame, **({"seq": 0} if self.is_first else {})
        )

    def moved(self, pose):
        transform = RigidTransform.from_matrix(pose)
        return transform.translation.tolist(), self.of["Quaternion"](
            *transform.rotation.as_quat().tolist()
        )

    def frame(self, at_s, parent, child, pose):
        place, turn = self.moved(pose)
        stated = self.of["Transform"](self.of["Vector3"](*place), turn)
        return self.of["TransformStamped"](self.header(at_s, parent), child, stated)

    def add(self, topic, kind, message, at_s):
        if topic not in self.options.without:
            self.options.change(kind.rpartition("/")[2], self.counts[topic], message)
            self.counts[topic] += 1
            late_s = abs(self.rng.normal(0.0, self.options.jitter_s))
            self.messages.append((at_s + late_s, topic, kind, message))

    def add_motion(self, stamps_s, poses):
        for at_s, pose in zip(stamps_s, poses, strict=True):
            if self.options.poses == "pose":
                place, turn = self.moved(pose)
                stated = self.of["Pose"](self.of["Point"](*place), turn)
                message = self.of["PoseStamped"](self.header(at_s, "base_link"), stated)
                self.add("/tcp_pose", "geometry_msgs/msg/PoseStamped", message, at_s)
            else:
                link = self.frame(at_s, "base_link", "wrist_3_link", pose)
                self.add("/tf", "tf2_msgs/msg/TFMessage", self.of["TFMessage"]([link]), at_s)

    def add_still(self, at_s, pairs):
        links = [self.frame(at_s, parent, child, np.eye(4)) for parent, child in pairs]
        self.add("/tf_static", "tf2_msgs/msg/TFMessage", self.of["TFMessage"](links), at_s)

    def add_image(self, space, frame, at_s, file, pixels):
        header = self.header(at_s + self.options.camera_late_s, frame)
        if self.options.is_compressed:
            data = np.frombuffer(file.read_bytes(), np.uint8)
            if self.options.image_kind == "jpeg":
                data = cv2.imencode(".jpg", pixels)[1].ravel()
            kind, topic = "CompressedImage", f"{space}/image_raw/compressed"
            message = self.of[kind](header, self.options.image_kind, data)
        else:
            height, width = pixels.shape
            kind, topic = "Image", f"{space}/image_raw"
            message = self.of[kind](header, height, width, "mono8", 0, width, pixels.ravel())
        self.add(topic, f"sensor_msgs/msg/{kind}", message, at_s)

    def add_depth(self, space, frame, at_s, session, view):
        header = self.header(at_s + 0.003, self.options.depth_frame or frame)
        raw = cv2.imdecode(np.frombuffer(session.images.read(view.depth), np.uint8), -1)
        unit_m = session.declaration.camera.depth_unit_m
        mm, kind = np.round(raw * unit_m * 1e3).astype("u2"), "Image"
        (height, width), topic = raw.shape, f"{space}/aligned_depth_to_color/image_raw"
        if self.options.depth == "16UC1":
            message = self.of[kind](
                header, height, width, "16UC1", 0, 2 * width, mm.view("u1").ravel()
            )
        elif self.options.depth == "32FC1":
            metres = np.where(raw > 0, raw * unit_m, np.nan).astype("f4")
            message = self.of[kind](
                header, height, width, "32FC1", 0, 4 * width, metres.view("u1").ravel()
            )
        elif self.options.depth == "compressed":
            kind, topic = "CompressedImage", f"{topic}/compressedDepth"
            data = np.concatenate([np.zeros(12, "u1"), cv2.imencode(".png", mm)[1].ravel()])
            message = self.of[kind](header, "16UC1; compressedDepth png", data)
        else:
            kind, topic = "PointCloud2", f"{space}/depth/color/points"
            v, u = np.mgrid[:height, :width]
            z = np.where(raw > 0, raw * unit_m, np.nan)
            table = np.zeros((height, width), "f4,f4,f4,u4,f4")
            for name, values in zip(
                ("f0", "f1", "f2"), ((u - width / 2) * z, (v - height / 2) * z, z), strict=True
            ):
                table[name] = values
            fields = [self.of["PointField"](axis, 4 * at, 7, 1) for at, axis in enumerate("xyz")]
            message = self.of[kind](
                header,
                height,
                width,
                fields,
                False,
                20,
                20 * width,
                table.view("u1").ravel(),
                False,
            )
        self.add(topic, f"sensor_msgs/msg/{kind}", message, at_s + 0.003)

    def add_lens(self, space, frame, at_s, lens):
        fx, fy, cx, cy = lens.matrix
        k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        r, p = np.eye(3).ravel(), np.zeros(12)
        numbers = {"d": np.array(lens.distortion), "k": k, "r": r, "p": p}
        if self.is_first:
            numbers = {name.upper(): value for name, value in numbers.items()}
        message = self.of["CameraInfo"](
            header=self.header(at_s, frame), width=lens.resolution[0], height=lens.resolution[1],
            distortion_model="plumb_bob", binning_x=0, binning_y=0,
            roi=self.of["RegionOfInterest"](0, 0, 0, 0, False), **numbers,
        )  # fmt: skip
        self.add(f"{space}/camera_info", "sensor_msgs/msg/CameraInfo", message, at_s)

    def write(self, path):
        writer = (
            Writer1(path)
            if self.is_first
            else Writer2(path, version=9, storage_plugin=FORMS[self.options.form])
        )
        if packed := self.options.compression:
            writer.set_compression(
                *([Writer1.CompressionFormat[packed]] if self.is_first
                  else [CompressionMode[packed], CompressionFormat.ZSTD])
            )  # fmt: skip
        pack = self.types.serialize_ros1 if self.is_first else self.types.serialize_cdr
        with writer:
            connections = {}
            for at_s, topic, kind, message in sorted(self.messages, key=lambda each: each[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.types)
                writer.write(connections[topic], round(1e9 * at_s), pack(message, kind))


def write_bag(path: Path, session: Session, folder: Path, options: BagOptions) -> Path:
    """Writes a bag of the session's views, and returns its path."""
    bag, (stamps_s, poses) = _Bag(options), motion(session, options.period_s)
    bag.add_motion(stamps_s, poses)
    eye = "wrist_3_link" if session.mount == "eye-in-hand" else "base_link"
    optical = [(eye, f"{name}optical") for name in options.names]
    bag.add_still(stamps_s[0], [("wrist_3_link", "tool0"), *optical])
    begins_s = stamps_s[0] + (REST_S + WAY_S) * np.arange(len(session.views))
    for name in options.names:
        space, frame = f"/{name}/camera" if name else "/camera", f"{name}optical"
        for begin_s, view in zip(begins_s, session.views, strict=True):
            file = folder / view.image
            pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            for seen_s in np.arange(0.05, REST_S + WAY_S - 0.05, options.frames_s):
                bag.add_image(space, frame, begin_s + seen_s, file, pixels)
                if options.depth:
                    bag.add_depth(space, frame, begin_s + seen_s, session, view)
        if session.camera is not None:
            bag.add_lens(space, frame, stamps_s[0], session.camera)
    bag.write(path)
    return path
